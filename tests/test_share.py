"""`python -m goalgan_bt.share`: a folder that is a run, its model card, and a hub in small."""

import base64
import contextlib
import hashlib
import json
import os
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from conftest import call

from goalgan_bt import load_policy
from goalgan_bt.learners import table
from goalgan_bt.learners.evaluation import at_home
from goalgan_bt.runs import run_folder
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import read_metrics
from goalgan_bt.share import FILES, command

hub = pytest.importorskip("huggingface_hub")


@pytest.fixture
def shared(trained, tmp_path):
    out = tmp_path / "new/shared"
    done = call("share", trained, "--out", out)
    assert done.returncode == 0 and not done.stderr, done.stderr
    assert done.stdout.startswith(f"{out} (") and len(done.stdout.splitlines()) == 1
    return out


def files(folder):
    return sorted(str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file())


def test_what_is_shared_is_a_run_and_acts_as_it_did(trained, shared):
    last = frame_paths(trained)[-1].name
    assert files(shared) == sorted([*FILES[:-1], f"frames/{last}"])
    assert at_home(shared, 16, True, 0, 1) == at_home(trained, 16, True, 0, 1) | {
        "run": str(shared)
    }
    state, goal = load_policy(trained).env.start_state, np.array([3.0, 0.0])
    assert np.array_equal(
        load_policy(shared).act(state, goal), load_policy(trained).act(state, goal)
    )
    assert "coverage" in read_frame(frame_paths(shared)[-1])
    assert call("share", shared, "--out", shared / "again").returncode == 0
    assert call("evaluate", shared, "--episodes", 4).returncode == 0


def test_no_path_and_no_typed_command_is_in_it(folder, tmp_path):
    for name in ("config.json", "meta.json"):
        told = json.loads((folder / name).read_text())
        secret = str(tmp_path / "secret")
        told |= {"argv": ["--out", secret]} if name == "meta.json" else {"out": secret}
        if name == "meta.json":
            told["resumed"] = [{"argv": ["--resume", secret], "commit": "1234abc"}]
        else:
            told |= {"resume": secret, "viz_host": "secret.example"}
        (folder / name).write_text(json.dumps(told))
    assert call("share", folder, "--out", tmp_path / "out").returncode == 0
    for name in files(tmp_path / "out"):
        data = (tmp_path / "out" / name).read_bytes()
        assert b"secret" not in data and str(tmp_path).encode() not in data, name
        assert str(Path.home()).encode() not in data, name
    assert "+1234abc" in (tmp_path / "out/README.md").read_text()


def test_the_card_is_what_the_hub_reads(trained, shared):
    card = hub.ModelCard.load(shared / "README.md")
    data = card.data
    assert data.library_name == "goalgan_bt" and data.pipeline_tag == "reinforcement-learning"
    assert {"reinforcement-learning", "point_umaze", "recall_traces"} <= set(data.tags)
    _, rows = read_metrics(trained)
    measured = [row for row in rows if row["eval/coverage"]][-1]
    assert {one.metric_type: one.metric_value for one in data.eval_results} == {
        "coverage": float(measured["eval/coverage"]),
        "coverage_deterministic": float(measured["eval/coverage_deterministic"]),
    }
    assert {one.dataset_type for one in data.eval_results} == {"point_umaze"}
    assert f"| training steps | {int(rows[-1]['steps/train']):,} (iteration 4) |" in card.text
    assert f"{float(measured['eval/coverage']):.3f}" in card.text
    assert "load_policy" in card.text and "#S..#" in card.text
    words = next(line for line in card.text.splitlines() if "goalgan_bt.train" in line)
    assert words == f"python -m goalgan_bt.train {' '.join(command(table.load(trained)))}"


def test_a_card_without_measurements_or_frame(folder, tmp_path):
    for frame in frame_paths(folder):
        frame.unlink()
    columns, *rows = (folder / "metrics.csv").read_text().splitlines()
    kept = [i for i, name in enumerate(columns.split(",")) if not name.startswith("eval/")]
    lines = [",".join(line.split(",")[i] for i in kept) for line in (columns, *rows)]
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
    assert call("share", folder, "--out", tmp_path / "out").returncode == 0
    assert hub.ModelCard.load(tmp_path / "out/README.md").data.eval_results is None
    assert not (tmp_path / "out/frames").exists()


@pytest.mark.parametrize(
    "words",
    [
        "",
        "--env ant_umaze",
        "--method goal_gan --seed 3 --total-steps 1000 --iterations 7",
        "--env point_nd --dim 3 --goals.near 2.5",
        "--env ant_spiral --policy.hidden 8 8 --places.no-heading --places.way straight",
        "--env point_umaze --method traces_only --minutes 0.5 --horizon 400 --physics warp",
        "--env ant_umaze --policy.final-std None --goals.near inf --goals.frontier 0",
    ],
)
def test_the_command_gives_the_settings_again(words):
    cfg = table.from_command_line(words.split())
    assert table.from_command_line(command(cfg)) == cfg


def test_the_command_names_the_map_without_its_folder(tmp_path):
    (tmp_path / "my.txt").write_text("####\n#S.#\n####\n")
    cfg = table.from_command_line(["--env", "point_umaze", "--map", str(tmp_path / "my.txt")])
    assert command(cfg) == ["--env", "point_umaze", "--map", "my.txt"]


def test_bad_words_end_in_one_line(trained, folder, tmp_path, monkeypatch):
    def refused(problem, *words):
        done = call("share", *words)
        assert done.returncode == 2 and problem in done.stderr, done.stderr
        assert len(done.stderr.splitlines()) == 1

    out = tmp_path / "out"
    for at in (folder, folder / "meta.json"):
        refused("is there already and not empty", trained, "--out", at)
    refused("is no run", tmp_path, "--out", out)
    refused("--out", trained)
    for name in ("just_a_name", "a/b/c", "user/na me", "../x", "user/"):
        refused("must be user/name", trained, "--out", out, f"--to={name}")
    settings = (folder / "config.json").read_text()
    run_folder.write_settings(folder, {"env": "hopper", "method": "trpo"})
    refused("no maze: nothing of it can be loaded here", folder, "--out", out)
    (folder / "config.json").write_text(settings)
    for name in ("checkpoint.pt", "checkpoint_previous.pt"):
        (folder / name).write_bytes(b"broken")
    refused("it is damaged", folder, "--out", out)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    refused('huggingface_hub is missing: pip install "goalgan_bt[hub]"', trained, "--out", out)
    assert not out.exists()


def test_half_a_folder_is_removed(trained, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("goalgan_bt.share.read_own", full)
    done = call("share", trained, "--out", tmp_path / "out")
    assert done.returncode == 2 and "the disk is full" in done.stderr
    assert not (tmp_path / "out").exists()


class Hub(BaseHTTPRequestHandler):
    """One repository, as the client asks for it."""

    files: dict = {}  # noqa: RUF012
    commit = "0123456789abcdef0123456789abcdef01234567"

    def answer(self, content, **headers):
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(200)
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def do_POST(self):
        here = f"http://{self.headers['Host']}"
        asked = self.rfile.read(int(self.headers["Content-Length"]))
        if self.path.startswith("/api/repos/create"):
            self.answer({"url": f"{here}/user/walker"})
        elif "/preupload/" in self.path:
            wanted = json.loads(asked)["files"]
            one = {"uploadMode": "regular", "shouldIgnore": False}
            self.answer({"files": [{"path": file["path"], **one} for file in wanted]})
        elif "/commit/" in self.path:
            for line in asked.splitlines():
                if (told := json.loads(line))["key"] == "file":
                    content = base64.b64decode(told["value"]["content"])
                    self.files[told["value"]["path"]] = content
            address = f"{here}/user/walker/commit/{self.commit}"
            self.answer({"commitUrl": address, "commitOid": self.commit})
        else:  # the card's check
            self.answer({"errors": [], "warnings": []})

    def do_GET(self):
        path = self.path.split("?")[0]
        if "/resolve/" in path:
            content = self.files[path.split("/", 5)[5]]
            etag = hashlib.sha1(content).hexdigest()
            self.answer(content, ETag=f'"{etag}"', X_Repo_Commit=self.commit)
        elif "/tree/" in path:
            self.answer(
                [
                    {
                        "type": "file",
                        "path": name,
                        "size": len(content),
                        "oid": hashlib.sha1(content).hexdigest(),
                    }
                    for name, content in self.files.items()
                ]
            )
        else:
            names = [{"rfilename": name} for name in self.files]
            self.answer({"id": "user/walker", "sha": self.commit, "siblings": names})

    do_HEAD = do_GET

    def log_message(self, *_):
        pass


@contextlib.contextmanager
def served():
    with ThreadingHTTPServer(("127.0.0.1", 0), Hub) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def elsewhere(tmp_path, endpoint, *words):
    """In a process of its own: the client reads at its import where the hub is."""
    given = {"HF_ENDPOINT": endpoint, "HF_HOME": str(tmp_path / "home"), "HF_TOKEN": "hf_x"}
    quiet = {"HF_HUB_DISABLE_PROGRESS_BARS": "1", "HF_HUB_DISABLE_XET": "1", "NO_PROXY": "*"}
    return subprocess.run(
        [sys.executable, *map(str, words)],
        env=os.environ | given | quiet,
        capture_output=True,
        text=True,
        timeout=120,
    )


FETCH = """
import goalgan_bt, goalgan_bt.share, sys
folder = goalgan_bt.share.fetch("user/walker", local_files_only="offline" in sys.argv)
print(goalgan_bt.load_policy(folder).iteration, folder)
"""


def test_a_hub_takes_it_and_gives_it_back_without_what_else_is_there(trained, tmp_path):
    Hub.files = {}
    out = tmp_path / "out"
    with served() as address:
        words = ("-m", "goalgan_bt.share", trained, "--out", out, "--to", "user/walker")
        done = elsewhere(tmp_path, address, *words)
        assert done.returncode == 0, done.stderr
        assert done.stdout.splitlines()[1].endswith("/user/walker")
        assert sorted(Hub.files) == files(out)
        assert all((out / name).read_bytes() == data for name, data in Hub.files.items())
        assert '"user/walker"' in (out / "README.md").read_text()
        Hub.files |= {"evil.pkl": b"x", "frames/evil.pt": b"x", "ended.txt": b"x"}
        done = elsewhere(tmp_path, address, "-c", FETCH)
        assert done.returncode == 0, done.stderr
    iteration, folder = done.stdout.split()
    assert iteration == "4" and files(Path(folder)) == files(out)
    again = elsewhere(tmp_path, address, "-c", FETCH, "offline")
    assert again.stdout == done.stdout, again.stderr


def test_without_a_network_it_ends_in_one_line(trained, tmp_path):
    out, nobody = tmp_path / "out", "http://127.0.0.1:9"
    done = elsewhere(
        tmp_path, nobody, "-m", "goalgan_bt.share", trained, "--out", out, "--to", "user/walker"
    )
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
    assert "cannot upload to user/walker" in done.stderr and "hf upload user/walker" in done.stderr
    assert load_policy(out).iteration == 4
    done = elsewhere(tmp_path, nobody, "-c", FETCH)
    last = done.stderr.splitlines()[-1]
    assert last.startswith("goalgan_bt.runs.errors.UsageError: cannot fetch user/walker (")
