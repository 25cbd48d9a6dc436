"""What looking costs: steps/s of training with no page, one and twenty, and the page's memory.

    python benchmarks/page.py --json docs/runs/page.json

Training and page run as always; a visitor is a websocket that asks for and takes in all that a
browser would, but draws nothing, as if the browser were on another machine.
"""

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import tyro
import viser
import websockets.sync.client
from viser import _messages

from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import read_metrics
from goalgan_bt.runs.run_writer import RunWriter


@dataclass(frozen=True)
class PageConfig:
    """Steps/s with and without pages, alternating; then memory over an hour of reports."""

    env: str = "ant_umaze"
    """What is trained."""
    seconds: float = 30.0
    """Of training per measurement, after a warm-up of 8 s."""
    rounds: int = 3
    """Measurements of each kind."""
    pages: tuple[int, ...] = (0, 1, 20)
    """Numbers of visitors to compare; the first is the reference."""
    rude: int = 0
    """How many of the visitors misbehave, where there are so many (see `rude_visitor`)."""
    reports: int = 3600
    """Reports that pass while the page's memory is watched; 0: none."""
    pause: float = 1.0
    """Seconds between two of them: the page looks once a second."""
    json: Path | None = None
    """Where to write the rows."""


def visitor(port: int) -> None:
    """Look at the page until it goes."""
    camera = (1.0, 0, 0, 0), (0.0, 0, 9), 1.0, 0.1, 100.0, 600, 800, (0.0, 0, 0), (0.0, 1, 0)
    message = _messages.ViewerCameraMessage(*camera).as_serializable_dict()
    try:
        with websockets.sync.client.connect(
            f"ws://127.0.0.1:{port}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None
        ) as browser:
            browser.send(msgspec.msgpack.encode(message))
            for _ in browser:
                pass
    except (OSError, websockets.exceptions.WebSocketException):
        pass


def rude_visitor(port: int, kind: int) -> None:
    """Misbehave until the page goes: 0 sends nonsense as fast as it can, 1 comes and goes, 2 sends
    what is too large, 3 never reads what it gets, 4 asks for files outside, under another name."""
    connect = websockets.sync.client.connect
    address, ours = f"ws://127.0.0.1:{port}", [f"viser-v{viser.__version__}"]
    update = _messages.GuiUpdateMessage("nobody", {"value": "../../etc/passwd"})
    nonsense = msgspec.msgpack.encode(update.as_serializable_dict())
    request = b"GET /../../etc/passwd HTTP/1.1\r\nHost: evil.example\r\n\r\n"
    while True:
        try:
            if kind == 4:
                with socket.create_connection(("127.0.0.1", port), timeout=5) as line:
                    line.sendall(request)
                    line.recv(100)
                continue
            with connect(address, subprotocols=ours, max_size=None) as browser:
                while kind == 0:
                    browser.send(nonsense)
                if kind == 2:
                    browser.send(bytes(2**24))
                if kind == 3:
                    time.sleep(1e6)
        except ConnectionRefusedError:
            return
        except (OSError, websockets.exceptions.WebSocketException):
            continue


def serve(folder: Path, visitors: int, rude: int = 0) -> subprocess.Popen[str]:
    """A page over a run with so many visitors, some of them rude, in a process of their own."""
    page = subprocess.Popen(
        [sys.executable, "-m", "goalgan_bt.viz", folder, "--port", "0", "--with-parent"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert page.stdout is not None and page.stdin is not None
    port = int(page.stdout.readline().strip().rsplit(":", 1)[1])
    if os.fork() == 0:
        page.stdin.close()  # or else the page would never see its end
        os.nice(19)  # they would use another machine's cores
        polite = max(0, visitors - rude)
        threads = [threading.Thread(target=visitor, args=(port,)) for _ in range(polite)]
        threads += [
            threading.Thread(target=rude_visitor, args=(port, i % 5))
            for i in range(visitors - polite)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        os._exit(0)
    return page


def steps_per_second(cfg: PageConfig, visitors: int, out: Path) -> float:
    """Of a training with so many visitors to its page."""
    words = [sys.executable, "-m", "goalgan_bt.train", "--env", cfg.env, "--viz", "none"]
    words += ["--out", str(out), "--report-every", "1"]
    training = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert training.stdout is not None
    folder = Path(training.stdout.readline().removeprefix("run folder: ").strip())
    threading.Thread(target=training.stdout.read, daemon=True).start()
    while not list((folder / "frames").glob("*.npz")):
        time.sleep(0.2)
    rude = cfg.rude if visitors >= cfg.rude else 0
    page = serve(folder, visitors, rude) if visitors else None
    time.sleep(8 + cfg.seconds)
    training.kill()
    training.wait()
    if page is not None:
        page.kill()
        page.wait()
    _, rows = read_metrics(folder)
    steps = np.array([float(row["steps/train"]) for row in rows])
    seconds = np.array([float(row["time/total"]) for row in rows])
    late = seconds > seconds[-1] - cfg.seconds
    shutil.rmtree(folder)
    return float(np.ptp(steps[late]) / np.ptp(seconds[late]))


def memory(cfg: PageConfig, out: Path) -> list[float]:
    """MiB of the page's process at ten moments while an hour of reports passes, with a visitor."""
    words = [sys.executable, "-m", "goalgan_bt.train", "--env", cfg.env, "--viz", "none"]
    words += ["--out", str(out), "--iterations", "2", "--report-every", "1"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    folder = Path(done.stdout.splitlines()[0].removeprefix("run folder: "))
    frame = read_frame(frame_paths(folder)[-1])
    _, (_, row) = read_metrics(folder)
    values = {name: float(text) for name, text in row.items() if text}
    page = serve(folder, 1)
    records, sizes = RunWriter(folder, 2), []
    for i in range(cfg.reports):
        values |= {"iteration": i + 3, "steps/train": values["steps/train"] + 12_800}
        records.metrics(values)
        frame["coverage"] = np.random.default_rng(i).random(len(frame["coverage"]))
        records.frame(i + 3, **frame)
        time.sleep(cfg.pause)
        if (i + 1) % max(1, cfg.reports // 10) == 0:
            status = Path(f"/proc/{page.pid}/status").read_text()
            kib = next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]
            sizes.append(round(int(kib) / 1024, 1))
            print(f"after {i + 1:,} reports: {sizes[-1]} MiB", flush=True)
    page.kill()
    page.wait()
    return sizes


def main() -> None:
    cfg = tyro.cli(PageConfig)
    rows = []
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory)
        found: dict[int, list[float]] = {visitors: [] for visitors in cfg.pages}
        for _ in range(cfg.rounds):
            for visitors in cfg.pages:
                found[visitors].append(steps_per_second(cfg, visitors, out))
                print(f"{visitors} visitors: {found[visitors][-1]:,.0f} steps/s", flush=True)
        reference = np.array(found[cfg.pages[0]])
        for visitors, speeds in found.items() if cfg.rounds else ():
            ratio = np.array(speeds) / reference
            print(f"{visitors} visitors: {np.median(speeds):,.0f} steps/s, {np.median(ratio):.3f}")
            rows.append(
                {
                    "name": "training",
                    "env": cfg.env,
                    "visitors": visitors,
                    "rude": cfg.rude if visitors >= cfg.rude else 0,
                    "steps_per_second": [round(x) for x in speeds],
                    "ratio": round(float(np.median(ratio)), 3),
                }
            )
        if cfg.reports:
            sizes = memory(cfg, out)
            rows.append({"name": "memory_mib", "reports": cfg.reports, "over_time": sizes})
    if cfg.json is not None:
        cfg.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
