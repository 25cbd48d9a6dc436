"""A run folder from a stranger is data, never a danger; a page answers its own visitors only."""

import contextlib
import io
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
import time
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import call
from test_resume import new_folder, settings

from goalgan_bt.learners import maze, table
from goalgan_bt.learners.trained_policy import TrainedPolicy
from goalgan_bt.runs import checkpoint, files, run_folder
from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import Metrics, read_metrics
from goalgan_bt.runs.signals import Stop
from goalgan_bt.viz import page_process
from goalgan_bt.viz.run import Run
from goalgan_bt.viz.server import (
    MESSAGES,
    MOST_VISITORS,
    Allowance,
    is_loopback,
    of_this_machine,
)
from goalgan_bt.viz.view import View

NAMES = "lock", "meta.json.part", "metrics.csv", "ended.txt", "curves.png", "checkpoint.pt"


def seen(place):
    """All files below a place and what is in them."""
    return {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}


# Links and pipes.


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_written_through_a_link(name, folder, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("mine\n")
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(secret)
    done = call("train", "--resume", folder, "--iterations", 6, "--viz", "none")
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "link" in done.stderr
    assert secret.read_text() == "mine\n" and (folder / name).is_symlink()


def test_commands_do_not_write_through_a_link(folder, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("mine\n")
    for name in ("curves.png", "eval.json"):
        (folder / name).symlink_to(secret)
    assert call("plot", folder).returncode == 0
    done = call("evaluate", folder, "--episodes", 1, "--json", folder / "eval.json")
    assert done.returncode == 0, done.stderr
    assert secret.read_text() == "mine\n"
    assert not any((folder / name).is_symlink() for name in ("curves.png", "eval.json"))


@pytest.mark.parametrize("damage", ["a link", "cut short"])
def test_what_is_shared_is_what_was_loaded(damage, folder, tmp_path):
    pytest.importorskip("huggingface_hub")
    path, secret = folder / checkpoint.NAME, tmp_path / "secret"
    secret.write_text("mine\n")
    data = path.read_bytes()
    path.unlink()
    if damage == "a link":
        path.symlink_to(secret)
    else:
        path.write_bytes(data[:-1000])
    done = call("share", folder, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert TrainedPolicy(tmp_path / "out").iteration == 2
    assert all("mine" not in x.decode(errors="replace") for x in seen(tmp_path / "out").values())


def test_frames_are_not_written_into_another_folder(folder, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    (folder / "frames").rename(elsewhere)
    (folder / "frames").symlink_to(elsewhere)
    before = seen(elsewhere)
    done = call("train", "--resume", folder, "--iterations", 6, "--viz", "none")
    assert done.returncode == 2 and "frames is a link" in done.stderr
    assert seen(elsewhere) == before and frame_paths(folder) == []


def test_a_link_at_a_frame_is_refused(folder, tmp_path):
    frame = frame_paths(folder)[-1]
    frame.rename(tmp_path / "frame.npz")
    frame.symlink_to(tmp_path / "frame.npz")
    done = call("train", "--resume", folder, "--iterations", 6, "--viz", "none")
    assert done.returncode == 2 and "is a link" in done.stderr
    with pytest.raises(RunError, match="symbolic"):
        read_frame(frame)


@pytest.mark.parametrize("name", ["meta.json", "config.json", "metrics.csv", "ended.txt"])
def test_what_a_link_leads_to_is_not_shown(name, folder, tmp_path):
    secret = tmp_path / "secret"
    shutil.copy(folder / name, secret)
    (folder / name).unlink()
    (folder / name).symlink_to(secret)
    if name == "ended.txt":
        assert run_folder.ended(folder) is None
    elif name == "metrics.csv":
        metrics = Metrics(folder / name)
        assert not metrics.refresh() and len(metrics) == 0
        with pytest.raises(RunError, match="symbolic"):
            read_metrics(folder)
    else:
        with pytest.raises(RunError, match=r"symbolic|is no run"):
            Run(folder)


@pytest.mark.parametrize(
    "name", ["meta.json", "config.json", "metrics.csv", "ended.txt", "checkpoint.pt"]
)
def test_a_pipe_hangs_nobody(name, folder):
    (folder / name).unlink()
    os.mkfifo(folder / name)
    begin = time.monotonic()
    done = call("train", "--resume", folder, "--iterations", 6, "--viz", "none")
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    with contextlib.suppress(RunError):
        Run(folder).refresh()
    done = call("plot", folder, "--out", folder / "x.png")
    assert done.returncode == (0 if name in ("ended.txt", "checkpoint.pt") else 2)
    assert time.monotonic() - begin < 20


# Sizes.


def bomb(path, members):
    """An archive of zeros: megabytes that say they are gigabytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in members:
            with archive.open(name, "w", force_zip64=True) as file:
                header = io.BytesIO()
                np.lib.format.write_array_header_1_0(
                    header, {"descr": "<f8", "fortran_order": False, "shape": (2**26, 2)}
                )
                file.write(header.getvalue())
                for _ in range(64):
                    file.write(bytes(2**24))


def test_a_zip_bomb_is_refused_by_its_declared_size(folder):
    frame = frame_paths(folder)[-1]
    bomb(frame, ["goals.npy"])
    assert frame.stat().st_size < 3e6
    with pytest.raises(RunError, match="too large for a frame"):
        read_frame(frame)
    assert Run(folder).frame(int(frame.stem)) is None


def test_a_checkpoint_that_would_unfold_is_refused(folder):
    path = folder / "checkpoint.pt"
    shutil.copy(path, folder / "good.pt")
    with (
        zipfile.ZipFile(folder / "good.pt") as good,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for part in good.infolist():
            archive.writestr(part.filename, good.read(part))
        archive.writestr("archive/data/999", bytes(2**24))
    sealed(path)
    with pytest.raises(ValueError, match="larger than itself"):
        checkpoint.read(path)


def sealed(path):
    """A file as its own author could seal it: a checksum keeps nobody from anything."""
    import hashlib

    data = path.read_bytes()
    seal = f"goalgan_bt {checkpoint.VERSION:03d} sha256 {hashlib.sha256(data).hexdigest()}"
    path.write_bytes(data[:-2] + len(seal).to_bytes(2, "little") + seal.encode())


@pytest.mark.parametrize(
    ("name", "size"), [("config.json", 2), ("meta.json", 2), ("metrics.csv", 300)]
)
def test_texts_that_are_too_large_are_refused(name, size, folder):
    with (folder / name).open("r+b") as file:
        file.truncate(size * 2**20)
    with pytest.raises(OSError, match=r"has .* bytes, where at most"):
        files.read_own(folder / name, run_folder.SMALL if size == 2 else files.LARGE)
    if name != "metrics.csv":
        with pytest.raises(RunError):
            Run(folder)


def test_a_table_of_gigabytes_is_not_read(folder):
    """A file with a hole in it."""
    with (folder / "metrics.csv").open("r+b") as file:
        file.truncate(20 * 2**30)
    live = Metrics(folder / "metrics.csv")
    assert not live.refresh() and len(live) == 0


def test_a_checkpoint_of_terabytes_is_refused_at_once(folder):
    path = folder / checkpoint.NAME
    data = path.read_bytes()
    with path.open("r+b") as file:
        file.truncate(2**40)
        file.seek(0, 2)
        file.write(data[-checkpoint.SEALED :])
    begin = time.monotonic()
    with pytest.raises(ValueError, match="more than"):
        checkpoint.read(path)
    assert time.monotonic() - begin < 1


def test_a_huge_maze_is_refused_at_once(folder):
    meta = json.loads((folder / "meta.json").read_text())
    rows = ["#" * 400, "#S" + "." * 397 + "#", *["#" + "." * 398 + "#"] * 397, "#" * 400]
    meta["maze"]["rows"] = rows
    (folder / "meta.json").write_text(json.dumps(meta))
    begin = time.monotonic()
    with pytest.raises(RunError, match="more than 10,000 cells"):
        Run(folder)
    assert time.monotonic() - begin < 1


ABSURD = [
    ("--policy.hidden", "200000", "200000"),
    ("--backtracking.buffer", "1000000000000"),
    ("--rollout.steps", "100000000"),
]


@pytest.mark.parametrize("flags", ABSURD, ids=lambda flags: flags[0])
def test_absurd_sizes_end_in_one_line(flags, tmp_path):
    words = [sys.executable, "-m", "goalgan_bt.train", "--env", "point_umaze", "--viz", "none"]
    words += ["--iterations", "2", "--out", str(tmp_path), *flags]
    done = subprocess.run(words, capture_output=True, text=True, timeout=100)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: out of memory: use smaller settings")


def test_a_map_without_an_end_is_no_map():
    done = call("train", "--env", "point_umaze", "--map", "/dev/zero", "--viz", "none")
    assert done.returncode == 2 and "it is no file" in done.stderr


# Checkpoints.


def test_every_flipped_bit_is_found(folder):
    """torch itself found none of 200."""
    path = folder / "checkpoint.pt"
    good = path.read_bytes()
    rng = np.random.default_rng(0)
    for bit in rng.integers(8 * len(good), size=200):
        data = bytearray(good)
        data[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"damaged|format"):
            checkpoint.read(path)


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(folder, capsys):
    before = checkpoint.read(folder / checkpoint.PREVIOUS)["run"]["iteration"]
    path = folder / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:-1000])
    assert TrainedPolicy(folder).iteration == before
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: ") and "it is damaged or cut short; the one before" in line
    done = call("train", "--resume", folder, "--iterations", 6, "--viz", "none")
    assert done.returncode == 0
    assert [int(row["iteration"]) for row in read_metrics(folder)[1]] == list(range(1, 7))


@pytest.mark.parametrize("newest", ["sound", "damaged"])
def test_a_save_that_fails_leaves_both_checkpoints_as_they_were(newest, folder):
    """What is damaged never takes the place of the one before it."""
    path = folder / checkpoint.NAME
    if newest == "damaged":
        path.write_bytes(path.read_bytes()[:-1000])
    before = seen(folder)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            checkpoint.save_run({"weights": torch.zeros(100_000)}, folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert seen(folder) == before
    checkpoint.save_run({"weights": torch.zeros(1)}, folder)
    previous = checkpoint.read(folder / checkpoint.PREVIOUS)["run"]["iteration"]
    assert previous == (4 if newest == "sound" else 2)


def replaced(state, path, value):
    """A nested state with one of its values replaced."""
    if not path:
        return value
    return state | {path[0]: replaced(state[path[0]], path[1:], value)}


def moments(network):
    """Where the moments of a network's optimiser are."""
    return ("learner", network, "_extra_state", "state", 0)


WRONG = {
    "moments of one number, which torch would believe": (
        (*moments("value"), "exp_avg"),
        torch.zeros(1),
    ),
    "moments of whole numbers": (
        (*moments("value"), "exp_avg_sq"),
        torch.zeros(1, dtype=torch.int64),
    ),
    "no step": ((*moments("value"), "step"), torch.zeros(0)),
    "no outcome": (("learner", "curriculum", "estimator", "success"), torch.zeros(0)),
    "goals of another size": (("learner", "curriculum", "visited"), torch.zeros(3, 5)),
    "goals nowhere": (("learner", "curriculum", "replay"), torch.full((3, 2), 1e30)),
    "episodes that are longer than time": (
        ("collector", "age"),
        torch.full((16,), 10**6),
    ),
    "more than is stored": (("learner", "places", "keys"), torch.zeros(1).expand(10**9)),
    "no time": (("run", "seconds"), float("nan")),
    "a policy alone": (("learner",), {"policy": {}, "places": {}}),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_checkpoint_that_was_made_to_be_wrong_is_one_line(name, folder):
    """With its checksum right: that keeps nobody from anything."""
    where, value = WRONG[name]
    state = checkpoint.read(folder / checkpoint.NAME)
    (folder / checkpoint.PREVIOUS).unlink()
    checkpoint.save(replaced(state, where, value), folder / checkpoint.NAME)
    done = call("train", "--resume", folder, "--iterations", 6, "--viz", "none")
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.splitlines()) == 1 and "cannot resume" in done.stderr


def test_settings_of_an_optimiser_are_not_taken_from_a_file(folder):
    state = checkpoint.read(folder / checkpoint.NAME)
    where = ("learner", "value", "_extra_state", "param_groups")
    checkpoint.save(replaced(state, where, [{"betas": "x"}]), folder / checkpoint.NAME)
    done = call("train", "--resume", folder, "--iterations", 6, "--viz", "none")
    assert done.returncode == 0, done.stderr


def test_a_run_that_is_killed_after_its_first_iteration_goes_on(tmp_path):
    cfg = settings("point_umaze", "recall_traces")
    folder = new_folder(tmp_path / "run", replace(cfg, iterations=1))
    with pytest.raises(ZeroDivisionError):
        maze.train(cfg, folder, Fails())
    assert checkpoint.read(folder / checkpoint.NAME)["run"]["iteration"] == 1


class Fails(Stop):
    """Asked the second time, it ends everything."""

    asked = 0

    @property
    def requested(self):
        self.asked += 1
        return self.asked > 1 and 1 / 0


def test_a_checkpoint_is_read_by_torch_alone(folder):
    state = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert state["run"]["iteration"] == 4


# A resume that fails, and damaged texts.


@pytest.mark.parametrize("name", ["meta.json", "metrics.csv"])
def test_damaged_texts_do_not_stop_a_run_whose_checkpoint_is_whole(name, folder):
    (folder / name).write_bytes(b"\xff{nonsense,,\n1,2")
    done = call("train", "--resume", folder, "--iterations", 5, "--viz", "none")
    assert done.returncode == 0, done.stderr
    assert name in done.stderr
    assert run_folder.maze_of(folder) is not None
    assert read_metrics(folder)[1][-1]["iteration"] == "5"
    assert call("plot", folder, "--out", folder / "x.png").returncode == 0


def test_rows_that_are_lost_inside_the_table_are_told(folder):
    lines = (folder / "metrics.csv").read_text().splitlines(keepends=True)
    (folder / "metrics.csv").write_text("".join(lines[:2] + lines[4:]))
    done = call("train", "--resume", folder, "--iterations", 5, "--viz", "none")
    assert done.returncode == 0 and "2 have no row" in done.stderr


def test_the_table_has_one_kind_of_line_end(folder):
    assert b"\r" not in (folder / "metrics.csv").read_bytes()


def test_a_damaged_frame_is_told_and_left_out(folder, tmp_path):
    path = frame_paths(folder)[1]
    path.write_bytes(path.read_bytes()[:100])
    done = call("plot", folder, "--out", tmp_path / "x.png")
    assert done.returncode == 0 and "it is left out" in done.stderr
    assert "allow_pickle" not in done.stderr
    done = call("viz", folder, "--export", tmp_path / "x.html")
    assert done.returncode == 0 and "report 2 of" in done.stderr


def test_a_resumed_run_does_not_listen_where_its_folder_says(folder):
    told = json.loads((folder / "config.json").read_text())
    told |= {"viz_host": "0.0.0.0", "viz_port": 1, "viz": "browser", "track": True}
    (folder / "config.json").write_text(json.dumps(told))
    cfg = table.from_command_line(["--resume", str(folder), "--iterations", "6"])
    assert (cfg.viz_host, cfg.viz_port, cfg.track) == ("127.0.0.1", 8080, False)


def test_a_page_that_cannot_start_is_told(folder, monkeypatch, capsys):
    monkeypatch.setenv("PYTHONPATH", str(folder))
    (folder / "viser.py").write_text("raise RuntimeError('no page today')\n")
    page = page_process.PageProcess("127.0.0.1", 0)
    page.open(folder)
    assert page._known.wait(60)
    page.close()
    assert "there is no page, training goes on: it ended with: RuntimeError: no page today" in (
        capsys.readouterr().err
    )


# The page.


@pytest.fixture
def view(trained):
    page = View([Run(trained)], "127.0.0.1", 0)
    yield page
    with contextlib.redirect_stdout(io.StringIO()):
        page.close()


def answer(view, request):
    """The first line that a page's server answers."""
    with socket.create_connection(("127.0.0.1", view.server.get_port()), timeout=10) as line:
        line.sendall(request)
        return line.recv(1000).split(b"\r\n")[0].decode()


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "[::1",
        "127.0.0.1.evil.example",
        "",
        "a b",
        "\u00e4",
        "localhost@evil",
        "1" * 9,
    ],
)
def test_a_host_that_is_not_this_machine_is_refused(view, host):
    told = answer(view, f"GET / HTTP/1.1\r\nHost: {host}\r\n\r\n".encode("latin-1"))
    assert " 403 " in told or " 400 " in told, told


def test_two_hosts_or_two_origins_are_refused(view):
    port = view.server.get_port()
    for extra in ("Host: localhost", f"Origin: http://localhost:{port}\r\nOrigin: http://evil"):
        request = f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\n{extra}\r\n\r\n"
        assert " 403 " in answer(view, request.encode())


@pytest.mark.parametrize("path", ["/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd"])
def test_no_file_outside_is_served(view, path):
    assert " 404 " in answer(view, f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())


def test_what_is_loopback():
    assert is_loopback("127.0.0.1") and is_loopback("127.0.0.2") and is_loopback("localhost")
    assert not is_loopback("0.0.0.0")
    assert of_this_machine("127.0.0.2") and of_this_machine("localhost")
    assert of_this_machine("[::1]:80") and of_this_machine("localhost:8080")
    assert not of_this_machine("evil.example") and not of_this_machine("")


def test_on_another_loopback_address_a_foreign_name_is_refused_too(trained):
    page = View([Run(trained)], "127.0.0.2", 0)
    try:
        with socket.create_connection(("127.0.0.2", page.server.get_port()), timeout=10) as line:
            line.sendall(b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n")
            assert b" 403 " in line.recv(1000).split(b"\r\n")[0]
    finally:
        page.close()


UPGRADE = (
    "GET / HTTP/1.1\r\nHost: localhost:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
    "Sec-WebSocket-Protocol: viser-v{version}\r\n\r\n"
)


def test_there_is_an_end_to_visitors_and_they_may_come_again(view):
    import viser

    port = view.server.get_port()
    request = UPGRADE.format(port=port, version=viser.__version__).encode()
    with contextlib.ExitStack() as lines:

        def come():
            line = lines.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
            line.sendall(request)
            return line.recv(100).split(b"\r\n")[0]

        assert all(b" 101 " in come() for _ in range(MOST_VISITORS))
        assert b" 503 " in come()
    deadline = time.monotonic() + 20
    while b" 101 " not in answer(view, request).encode():
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_large_messages_end_their_visitor_only(view):
    import viser
    import websockets.sync.client
    from websockets.exceptions import ConnectionClosed

    address = f"ws://127.0.0.1:{view.server.get_port()}"
    protocols = [f"viser-v{viser.__version__}"]
    with websockets.sync.client.connect(address, subprotocols=protocols, max_size=None) as browser:
        with pytest.raises(ConnectionClosed):
            browser.send(bytes(2**22))
            while True:
                browser.recv(timeout=20)
        assert browser.protocol.close_code == 1009
    assert " 200 " in answer(view, b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")


def test_uploads_are_kept_by_nobody(view):
    from viser import _messages

    handlers = view.server._websock_server._incoming_handlers
    assert _messages.FileTransferStartUpload not in handlers
    assert _messages.FileTransferPart not in handlers


def test_who_sends_too_fast_is_held_up_and_nobody_else(view):
    import msgspec
    import viser
    import websockets.sync.client
    from viser import _messages

    update = _messages.GuiUpdateMessage("nobody", {"value": 1})
    nonsense = msgspec.msgpack.encode(update.as_serializable_dict())
    heard = []
    handle = view.server._websock_server._handle_incoming_message

    async def count(client, message):
        heard.append(time.monotonic())
        await handle(client, message)

    view.server._websock_server._handle_incoming_message = count
    address = f"ws://127.0.0.1:{view.server.get_port()}"
    protocols = [f"viser-v{viser.__version__}"]
    with websockets.sync.client.connect(address, subprotocols=protocols, max_size=None) as browser:
        for _ in range(int(MESSAGES) + 60):
            browser.send(nonsense)
        deadline = time.monotonic() + 20
        while len(heard) < MESSAGES + 60:
            assert time.monotonic() < deadline, len(heard)
            time.sleep(0.05)
            assert " 200 " in answer(view, b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert 0.9 < heard[-1] - heard[0] < 10  # the sixty above what is free at once


def test_who_comes_and_goes_too_often_is_refused(view):
    import viser

    port = view.server.get_port()
    request = UPGRADE.format(port=port, version=viser.__version__).encode()
    told = [answer(view, request) for _ in range(MOST_VISITORS)]
    told += [answer(view, request) for _ in range(2)]  # each refusal takes its time
    assert any(" 503 " in line for line in told)


def test_an_allowance_is_as_counted_by_hand(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("goalgan_bt.viz.server.time.monotonic", lambda: now[0])
    visits = Allowance(2, 4.0)
    assert [visits.take() for _ in range(3)] == [True, True, False]
    now[0] = 0.25
    assert [visits.take() for _ in range(2)] == [True, False]
    now[0] = 100.0
    assert [visits.wait() for _ in range(4)] == [0.0, 0.0, 0.25, 0.5]
