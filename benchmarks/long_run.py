"""Whether a long training grows: its memory, open files and threads, and those of its page.

    python benchmarks/long_run.py --minutes 120 --json docs/runs/long_run.json

The training is one of the Ant with its page open to a visitor, who takes in all and draws nothing.
"""

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

import tyro
from page import visitor


@dataclass(frozen=True)
class LongConfig:
    """A long training, looked at each minute."""

    env: str = "ant_umaze"
    """What is trained."""
    minutes: float = 120.0
    """How long."""
    every: float = 60.0
    """Seconds between two looks."""
    json: Path | None = None
    """Where to write what was seen."""


def look(process: int) -> dict[str, float]:
    """Memory (MiB), open files and threads of a process."""
    place = Path(f"/proc/{process}")
    status = dict(line.split(":", 1) for line in (place / "status").read_text().splitlines())
    return {
        "memory": round(int(status["VmRSS"].split()[0]) / 1024, 1),
        "files": len(list((place / "fd").iterdir())),
        "threads": int(status["Threads"]),
    }


def child(process: int) -> int:
    """The first process that a process has started."""
    return int(Path(f"/proc/{process}/task/{process}/children").read_text().split()[0])


def main(cfg: LongConfig) -> None:
    with tempfile.TemporaryDirectory() as out:
        words = [sys.executable, "-m", "goalgan_bt.train", "--env", cfg.env, "--out", out]
        words += ["--total-steps", "1000000000", "--iterations", "1000000000", "--viz-port", "0"]
        training = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        assert training.stdout is not None
        address = ""
        while not address.startswith("view: "):
            address = training.stdout.readline()
        port = int(address.split()[1].rsplit(":", 1)[1])
        Thread(target=visitor, args=(port,), daemon=True).start()
        Thread(target=lambda: [None for _ in training.stdout or ()], daemon=True).start()
        page, begin, seen = child(training.pid), time.monotonic(), []
        while time.monotonic() - begin < 60 * cfg.minutes and training.poll() is None:
            time.sleep(cfg.every)
            (folder,) = Path(out).iterdir()
            row = {
                "minutes": round((time.monotonic() - begin) / 60, 2),
                "training": look(training.pid),
                "page": look(page),
                "reports": len(list((folder / "frames").iterdir())),
            }
            seen.append(row)
            print(json.dumps(row), flush=True)
            if cfg.json is not None:
                cfg.json.write_text(json.dumps(seen, indent=1) + "\n")
        training.terminate()
        training.wait(timeout=60)


if __name__ == "__main__":
    main(tyro.cli(LongConfig, description=__doc__))
