"""A first look at runs: coverage over steps and over the maze, as a PNG.

python -m goalgan_bt.plot runs/ant_umaze-20261122-101500-s0
"""

import os
import signal
import sys

if __name__ == "__main__":  # nothing to lose: it goes at once, without a word
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))

from dataclasses import dataclass
from pathlib import Path

import tyro

from goalgan_bt.command_line import UsageError, parse
from goalgan_bt.progress import complain, say
from goalgan_bt.record import RunError


@dataclass(frozen=True)
class PlotConfig:
    """Draw coverage curves and coverage maps of one or several runs."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders."""
    out: Path | None = None
    """PNG to write; by default curves.png in the first run folder."""
    maps: int = 4
    """Coverage maps per run, spread over training."""
    at: tuple[int, ...] = ()
    """Iterations whose maps to draw instead."""


def main() -> int:
    """The command line; returns the exit code."""
    try:
        cfg = parse(PlotConfig, None, "python -m goalgan_bt.plot")
        if not cfg.runs or not 1 <= cfg.maps <= 50:
            raise UsageError("name at least one run folder, and ask for 1 to 50 maps")
        if len(cfg.at) > 50 or min(cfg.at, default=1) < 1:
            raise UsageError("--at takes 1 to 50 iterations, each 1 or more")
        if cfg.out is not None and cfg.out.suffix != ".png":
            raise UsageError(f"cannot write '{cfg.out}': its name must end in .png")
        try:
            from goalgan_bt.viz import pictures
        except ImportError:
            raise RunError('plots need matplotlib: pip install "goalgan_bt[plots]"') from None
        path = cfg.out or cfg.runs[0] / "curves.png"
        pictures.overview(list(cfg.runs), cfg.maps, cfg.at).savefig(path, dpi=150)
    except (RunError, OSError, ValueError) as error:
        complain(str(error))
        return 2
    say(str(path))
    return 0


if __name__ == "__main__":
    sys.exit(main())
