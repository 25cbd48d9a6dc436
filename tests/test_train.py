"""The whole thing, small: runs and what they leave behind, and how the real command ends."""

import contextlib
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, fields, replace
from pathlib import Path

import conftest
import msgspec
import numpy as np
import pytest
import torch
import viser
import websockets.sync.client
from conftest import call, run_module, started
from viser import _messages

from goalgan_bt.envs import maze as mazes
from goalgan_bt.learners import maze_learner, table
from goalgan_bt.learners.maze import train
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.maze_learner import MazeLearner
from goalgan_bt.runs import checkpoint, run_folder
from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import read_metrics
from goalgan_bt.runs.signals import Stop
from goalgan_bt.viz.__main__ import ALONE

TINY = {
    "point_umaze": "--rollout.num-envs 32 --rollout.steps 50 --backtracking.min-transitions 200",
    "ant_umaze": "--rollout.num-envs 32 --rollout.steps 50 --backtracking.min-transitions 200",
    "point_nd": "--rollout.num-envs 32 --rollout.steps 50 --backtracking.min-transitions 200",
}
FAST = (
    "--action-repeat 1 --updates 1 --horizon 60 --coverage.rollouts 1 --gan.pretrain-steps 20 "
    "--gan.steps 10 --policy.final-std None"
)


PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}


def settings(env, *more):
    words = f"--env {env} {TINY[env]} {FAST} --threads 1".split()
    return table.from_command_line([*words, *more])


def words_of(*flags, out):
    tiny = [*TINY["point_umaze"].split(), *FAST.split()] if "point_umaze" in flags else []
    quiet = [] if "--viz" in flags else ["--viz", "none"]
    return [*map(str, flags), *tiny, "--out", str(out), *quiet]


def run(*flags, out):
    return call("train", *words_of(*flags, out=out))


@contextlib.contextmanager
def endless(out):
    """A run without an end, in the background, and its run folder."""
    with started("train", *words_of("--env", "point_umaze", out=out), **PIPES) as process:
        yield process, Path(process.stdout.readline().removeprefix("run folder: ").strip())


def columns(folder):
    """metrics.csv without the columns that measure time and memory."""
    _, rows = read_metrics(folder)
    return [{k: v for k, v in r.items() if not k.startswith(("time/", "memory/"))} for r in rows]


@pytest.mark.parametrize("env", TINY)
def test_a_tiny_run_leaves_a_whole_run_folder(env, tmp_path):
    cfg = settings(env, "--iterations", "6")
    run_folder.write_meta(tmp_path, None)
    _, _, coverage, steps = train(cfg, tmp_path)
    assert steps == 7 * 32 * 50  # the first batch made the goals of the first iteration
    rows = columns(tmp_path)
    assert [int(r["iteration"]) for r in rows] == [1, 2, 3, 4, 5, 6]
    assert float(rows[-1]["eval/coverage"]) == pytest.approx(coverage, abs=1e-5)
    assert rows[0]["eval/coverage"] == rows[2]["eval/coverage"] == ""
    assert rows[1]["eval/coverage"]  # not in the first: it shall show soon
    assert int(rows[-1]["steps/train"]) == steps and int(rows[-1]["steps/eval"]) > 0
    assert (int(rows[-1]["steps/label"]) > 0) == (env == "point_nd")  # fresh labels there
    frames = frame_paths(tmp_path)
    assert len(frames) == 6
    with np.load(frames[-1], allow_pickle=False) as frame:
        n = len(frame["goals"])
        assert frame["success"].shape == frame["label"].shape == frame["replayed"].shape == (n,)
        assert set(np.unique(frame["label"])) <= {-1, 0, 1}
        assert frame["coverage"].shape == frame["estimate"].shape == (len(frame["test_goals"]),)
        assert set(np.unique(frame["coverage"])) <= {0.0, 1.0}  # one attempt each
        assert (coverage > 0.1) == (env == "ant_umaze")  # a novice has the tiles beneath it
        assert frame["coverage"].mean() == pytest.approx(coverage)
        assert frame["traces"].shape[1] == len(frame["trace_goals"])


def test_recall_traces_are_learned_and_imitated(tmp_path):
    tiny = "--method", "traces_only", "--iterations", "14"
    tiny += "--goals.near", "inf", "--goals.neighbours", "4"
    train(settings("ant_umaze", *tiny), tmp_path)
    rows = columns(tmp_path)
    assert any(r.get("imitation/loss") for r in rows)
    assert any(r.get("backtracking/state_nll") for r in rows)
    plain = tmp_path / "plain"
    plain.mkdir()
    train(settings("ant_umaze", *tiny, "--backtracking.trace-length", "0"), plain)
    assert not any(r.get("imitation/loss") for r in columns(plain))


def test_fresh_labelling_rollouts_are_counted(tmp_path):
    cfg = settings("point_umaze", "--iterations", "2", "--goals.label-rollouts", "1")
    train(cfg, tmp_path)
    steps = [int(r["steps/label"]) for r in columns(tmp_path)]
    assert 0 < steps[0] < steps[1] <= 2 * 300 * 60


def test_same_seed_same_metrics(tmp_path):
    results = []
    for i, seed in enumerate((1, 1, 2)):
        folder = tmp_path / str(i)
        folder.mkdir()
        train(settings("point_umaze", "--iterations", "4", "--seed", str(seed)), folder)
        results.append(columns(folder))
    assert results[0] == results[1]
    assert results[0] != results[2]


def test_resume_goes_on_where_the_checkpoint_was(tmp_path):
    run_folder.write_meta(tmp_path, None)
    train(settings("point_umaze", "--iterations", "3"), tmp_path)
    first = columns(tmp_path)
    cfg = replace(settings("point_umaze", "--iterations", "5"), resume=tmp_path)
    train(cfg, tmp_path)
    rows = columns(tmp_path)
    assert [int(r["iteration"]) for r in rows] == [1, 2, 3, 4, 5]
    # The same rows; a column that came later is empty in them.
    assert [{k: row[k] for k in old} for row, old in zip(rows, first, strict=False)] == first
    assert int(rows[4]["steps/train"]) == 6 * 32 * 50
    assert int(rows[4]["steps/eval"]) > int(rows[2]["steps/eval"])


def same(x, y):
    """Whether two states are, in every tensor and value."""
    if isinstance(x, torch.Tensor):
        return torch.equal(x, y)
    if isinstance(x, dict):
        return x.keys() == y.keys() and all(same(x[key], y[key]) for key in x)
    if isinstance(x, list | tuple):
        return len(x) == len(y) and all(map(same, x, y))
    return x == y


def test_a_checkpoint_holds_everything(tmp_path):
    """A learner of another seed becomes the one that was saved, in every part."""
    traces = "--imitation.source", "traces"  # what is imitated is remembered
    cfg, other = (settings("ant_umaze", "--seed", seed, *traces) for seed in "19")
    env = make_env(cfg, 8)
    train(replace(cfg, iterations=6), tmp_path)
    saved, loaded = MazeLearner(env, cfg), MazeLearner(env, other)
    run = maze_learner.load(saved, tmp_path)
    assert run["iteration"] == 6 and run["steps"]["train"] > 0 < run["seconds"]
    assert len(saved.curriculum.visited) > 3 and saved.transitions.size > 0
    assert not same(saved.state_dict(), loaded.state_dict())
    loaded.load_state_dict(saved.state_dict())
    assert same(saved.state_dict(), loaded.state_dict())
    x, y = saved, loaded
    assert x.rng.random() == y.rng.random()
    assert np.array_equal(x.curriculum.propose(3), y.curriculum.propose(3))
    assert x.transitions.cursor == y.transitions.cursor
    for ours, theirs in zip(x.tensors(), y.tensors(), strict=True):
        assert torch.equal(ours, theirs)


def test_a_failed_resume_leaves_the_run_as_it_was(tmp_path):
    out = tmp_path / "runs"
    begun = run_module("train", *words_of("--env", "point_umaze", "--iterations", 2, out=out))
    assert begun.returncode == 0 and not begun.stderr
    (folder,) = out.iterdir()
    before = {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}
    for flags, message in (
        (["--iterations", 4, "--policy.hidden", 5], "cannot resume"),
        (["--iterations", 2], "has reached its limits"),
        (["--iterations", 4, "--seed", 7], "--seed of a run cannot change"),
    ):
        done = run("--resume", folder, *flags, out=out)
        assert done.returncode == 2 and message in done.stderr
        assert before == {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}
    assert run("--resume", folder, "--iterations", 3, out=out).returncode == 0


def test_a_resumed_learner_takes_new_learning_rates_and_buffers(tmp_path):
    trained = tmp_path / "run"
    trained.mkdir()
    run_folder.write_meta(trained, mazes.layout("umaze"))
    cfg = table.from_command_line([*conftest.TINY.split(), "--imitation.source", "traces"])
    train(cfg, trained)
    value, model = cfg.value, cfg.backtracking
    value, model = replace(value, learning_rate=0.5), replace(model, buffer=2 * model.buffer)
    cfg = replace(cfg, value=value, backtracking=model)
    learner = MazeLearner(make_env(cfg, 2), cfg)
    maze_learner.load(learner, trained)
    assert learner.value.optimiser.param_groups[0]["lr"] == 0.5
    rows = learner.transitions
    assert rows.size > 100
    rows.add(*(np.ones_like(getattr(rows, name)[:4]) for name in rows.COLUMNS))
    assert np.abs(rows.actions[: rows.size]).sum(axis=1).min() > 0  # no row of zeros


def test_closed_standard_output_is_one_line(tmp_path):
    words = words_of("--env", "point_umaze", "--iterations", 40, out=tmp_path)
    with started("train", *words, **PIPES) as process:
        process.stdout.readline()
        process.stdout.close()
        errors = process.stderr.read()
        assert process.wait(timeout=60) == 2
    assert "standard output was closed" in errors.splitlines()[0]
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        ("missing", "start a new run"),
        ("cut", "it is damaged or cut short"),
        ("empty", "it is damaged or cut short"),
        ("other sizes", "of other settings"),
        ("pickle", "it is damaged .Weights only load failed"),
        ("older", "it is of an older version of goalgan_bt"),
        ("newer", "it is of format 999, and this version reads 2"),
        ("link", "Too many levels of symbolic links"),
        ("pipe", "is no file"),
    ],
)
def test_a_damaged_checkpoint_is_refused_in_one_line(folder, damage, why):
    cfg, path = table.load(folder), folder / "checkpoint.pt"
    (folder / "checkpoint_previous.pt").unlink()
    data = path.read_bytes()
    path.unlink()
    if damage == "other sizes":
        cfg = replace(cfg, policy=replace(cfg.policy, hidden=(5,)))
        path.write_bytes(data)
    elif damage == "pickle":
        checkpoint.save({"learner": print}, path)
    elif damage == "older":
        torch.save({"learner": {}}, path)
    elif damage == "link":
        (folder / "elsewhere").write_bytes(data)
        path.symlink_to("elsewhere")
    elif damage == "pipe":
        os.mkfifo(path)
    elif damage != "missing":
        newer = data.replace(b"goalgan_bt 002 sha256", b"goalgan_bt 999 sha256")
        path.write_bytes({"cut": data[:5000], "empty": b"", "newer": newer}[damage])
    with pytest.raises(RunError, match=why) as error:
        maze_learner.load(MazeLearner(make_env(cfg, 2), cfg), folder)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--env", "moon"], "unknown environment 'moon'"),
        (["--env", "point_umaze", "--iterations", "-3"], "--iterations must be greater than 0"),
        (["--env", "point_umaze", "--map", "none.txt"], "cannot read the map none.txt"),
        (["--env", "point_nd", "--dim", "9"], "--dim must be 2 to 6, not 9"),
        (["--viz", "browser", "--viz-host", "192.0.2.1"], "cannot listen on 192.0.2.1"),
        (["--resume", "nowhere"], "nowhere is no run"),
        (["--resume", "nowhere", "--help"], "nowhere is no run"),
    ],
)
def test_bad_input_ends_in_one_line_and_code_2(flags, message, tmp_path):
    refused(run(*flags, out=tmp_path), message)
    assert not any(tmp_path.iterdir())


def refused(done, message):
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 2 and len(lines) == 1
    assert lines[0].startswith("error: ") and message in lines[0]


def test_bad_input_ends_the_process_so(tmp_path):
    refused(run_module("train", "--frobnicate", "--out", tmp_path), "frobnicate")
    assert not any(tmp_path.iterdir())


def test_a_broken_map_names_its_place(tmp_path):
    path = tmp_path / "mine.txt"
    path.write_text("####\n#SX#\n####\n")
    done = run("--env", "point_umaze", "--map", path, out=tmp_path / "runs")
    assert done.returncode == 2
    assert "mine.txt: row 2, column 3: unknown character 'X'" in done.stderr


def test_without_arguments_it_trains_the_ant(tmp_path):
    with started("train", cwd=tmp_path, **PIPES) as process:
        first = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert first.startswith("run folder: runs/ant_umaze-"), errors
    assert process.returncode == 130 and "Traceback" not in errors


@pytest.mark.parametrize("now", ["another map", "no map"])
def test_a_resumed_run_stays_in_its_own_maze(tmp_path, now):
    path = tmp_path / "mine.txt"
    path.write_text("#####\n#S..#\n#####\n")
    out = tmp_path / "runs"
    done = run("--env", "point_umaze", "--map", path, "--iterations", 2, out=out)
    assert done.returncode == 0, done.stderr
    path.unlink()
    if now == "another map":
        path.write_text("######\n#S...#\n######\n")
    (folder,) = out.iterdir()
    done = run("--resume", folder, "--iterations", 4, out=out)
    assert done.returncode == 0, done.stderr
    tiles = {len(read_frame(frame)["test_goals"]) for frame in frame_paths(folder)}
    assert tiles == {3 * 16}  # three free cells, throughout


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 2)])
def test_interrupted_runs_leave_a_checkpoint_that_resumes(tmp_path, number, code):
    with endless(tmp_path) as (process, folder):
        for _ in range(2):  # the first checkpoint is the second iteration's
            assert "steps" in process.stdout.readline()
        refused(run("--resume", folder, out=tmp_path), "is being trained by another process")
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == code
    assert len(errors.strip().splitlines()) == 1
    assert f"--resume {folder}" in errors
    done = int(columns(folder)[-1]["iteration"])
    resumed = run("--resume", folder, "--iterations", done + 2, out=tmp_path)
    assert resumed.returncode == 0, resumed.stderr
    assert int(columns(folder)[-1]["iteration"]) == done + 2


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="sees torch load in /proc")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 2)])
def test_interrupted_while_it_imports_it_says_one_line(number, code):
    with started("train", stderr=subprocess.PIPE) as process:
        maps = Path(f"/proc/{process.pid}/maps")
        while "libtorch" not in maps.read_text():
            time.sleep(0.01)
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == code
    assert errors == "error: interrupted: nothing new was saved, give the same command again\n"


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 2 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", disk]
    if subprocess.run(mounted, capture_output=True).returncode:
        pytest.skip("cannot mount a small disk here")
    yield disk
    subprocess.run(["umount", "-l", disk], check=True)


def test_a_full_disk_is_one_line_and_the_last_checkpoint_is_whole(small_disk):
    with endless(small_disk) as (process, folder):
        _, errors = process.communicate(timeout=100)
    assert process.returncode == 2
    assert "the disk is full" in errors and len(errors.strip().splitlines()) == 1
    assert f"--resume {folder}" in errors
    saved = checkpoint.read(folder / "checkpoint.pt")["run"]["iteration"]
    subprocess.run(["mount", "-o", "remount,size=20m", small_disk], check=True)
    resumed = run("--resume", folder, "--iterations", saved + 1, out=small_disk)
    assert resumed.returncode == 0, resumed.stderr
    assert not list(folder.glob("*.part"))


@pytest.mark.skipif(shutil.which("setpriv") is None, reason="needs setpriv")
def test_a_folder_that_becomes_read_only_is_one_line(tmp_path):
    """Also for root, who else may write anywhere."""
    words = [sys.executable, "-m", "goalgan_bt.train", "--env", "point_umaze", "--out", tmp_path]
    words += words_of("--env", "point_umaze", out=tmp_path)
    plain = ["setpriv", "--bounding-set=-dac_override", "--", *map(str, words)]
    process = subprocess.Popen(plain, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        folder = Path(process.stdout.readline().removeprefix("run folder: ").strip())
        while not (folder / "checkpoint.pt").exists():
            assert process.poll() is None
            time.sleep(0.05)
        for place in (folder, folder / "frames"):
            place.chmod(0o555)
        _, errors = process.communicate(timeout=100)
    finally:
        process.kill()
        for place in (folder, folder / "frames"):
            place.chmod(0o755)
    assert process.returncode == 2
    (line,) = errors.strip().splitlines()
    assert "Permission denied" in line and f"--resume {folder}" in line
    saved = checkpoint.read(folder / "checkpoint.pt")["run"]["iteration"]
    resumed = run("--resume", folder, "--iterations", saved + 1, out=tmp_path)
    assert resumed.returncode == 0, resumed.stderr


def test_help_shows_defaults_of_the_preset():
    done = call("train", "--env", "point_umaze", "--help")
    assert done.returncode == 0
    assert "2000000" in done.stdout and "four_rooms_N" in done.stdout
    assert "--backtracking" not in done.stdout and "--help-all" in done.stdout


@pytest.mark.parametrize("env", ["ant_umaze", "point_nd", "four_rooms_15", "hopper"])
def test_help_is_short_and_all_of_it_is_there_for_who_asks(env):
    short, whole = (call("train", "--env", env, flag).stdout for flag in ("--help", "--help-all"))
    assert len(short.splitlines()) < 60
    said = {word for word in whole.split() if word.startswith("--")}
    config = table.learner_of(env).config
    for name, _ in run_folder.flat(asdict(table.from_command_line(["--env", env]))):
        assert f"--{name.replace('_', '-')}" in {word.rstrip(",") for word in said}, name
    for name in (f.name for f in fields(config)):
        flag = "--" + name.replace("_", "-")
        assert (flag in short.replace(",", " ").split()) == (name in table.OFTEN), name


@pytest.mark.parametrize("how", ["Ctrl-C", "alone"])
def test_in_a_terminal_the_page_stays_while_somebody_looks(tmp_path, how):
    """Ctrl-C after a run that ended well ends the page, silently and well; so does the last one
    who looks, so that no shell loop waits for ever."""
    master, slave = pty.openpty()
    flags = "--env", "point_umaze", "--iterations", 1, "--viz", "browser", "--viz-port", 0
    pipes = {"stdin": slave, "stdout": slave, "stderr": subprocess.PIPE}
    with started("train", *words_of(*flags, out=tmp_path), **pipes) as process:
        os.close(slave)
        seen = b""
        while b"the page stays while somebody looks" not in seen:
            seen += os.read(master, 1000)
        if how == "Ctrl-C":
            process.send_signal(signal.SIGINT)
        else:
            port = int(re.search(rb"127.0.0.1:(\d+)", seen)[1])
            looking = visitor(port)
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(timeout=ALONE + 5)
            looking.close()
            while b"nobody looks" not in seen:
                seen += os.read(master, 1000)
        _, errors = process.communicate(timeout=60)
    os.close(master)
    assert process.returncode == 0 and errors == ""


def visitor(port):
    """A browser's connection to a page."""
    camera = (1.0, 0, 0, 0), (0.0, 0, 9), 1.0, 0.1, 100.0, 600, 800, (0.0, 0, 0), (0.0, 1, 0)
    message = _messages.ViewerCameraMessage(*camera).as_serializable_dict()
    protocols = [f"viser-v{viser.__version__}"]
    address = f"ws://127.0.0.1:{port}"
    browser = websockets.sync.client.connect(address, subprotocols=protocols, max_size=None)
    browser.send(msgspec.msgpack.encode(message))
    return browser


def test_after_an_error_a_launchers_kill_does_not_cut_off_the_last_words():
    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(ValueError), Stop(goodbye=True):
            raise ValueError
        os.kill(os.getpid(), signal.SIGTERM)  # torchrun's, when another rank has died
        signal.signal(signal.SIGTERM, before)
        with Stop() as stop:
            os.kill(os.getpid(), signal.SIGTERM)
            assert stop.requested
        assert signal.getsignal(signal.SIGTERM) == before
    finally:
        signal.signal(signal.SIGTERM, before)
