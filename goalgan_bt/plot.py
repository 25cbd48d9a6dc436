"""A first look at runs, and figures for a paper: coverage over steps and over the maze.

python -m goalgan_bt.plot runs/ant_umaze-20261122-101500-s0
python -m goalgan_bt.plot runs --out figure.pdf --width 85
"""

from goalgan_bt.runs.signals import exit_with, leave_at_once

if __name__ == "__main__":  # nothing to lose: it goes at once, without a word
    leave_at_once()

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from goalgan_bt.runs.command_line import check_ranges, check_target, parse, run_command
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.files import write_atomically
from goalgan_bt.runs.ranges import ABOVE_ZERO, between
from goalgan_bt.runs.run_folder import runs_in
from goalgan_bt.runs.terminal import say


@dataclass(frozen=True)
class PlotConfig:
    """Draw coverage curves and coverage maps of runs. More than six are grouped by task and method:
    means over seeds with 95% intervals."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, or folders of runs, of which all runs are taken."""
    out: Path | None = None
    """PNG, SVG or PDF to write; by default curves.png in the first folder."""
    maps: Annotated[int, between(1, 50)] = 4
    """Coverage maps per run, spread over training."""
    at: Annotated[tuple[int, ...], ABOVE_ZERO] = ()
    """Iterations whose maps to draw instead."""
    width: Annotated[float | None, between(60, 1000)] = None
    """For print: the figure's width in mm (a column of a paper has 80 to 90), with small type."""


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    return run_command(lambda: work(argv))


def work(argv: list[str] | None) -> None:
    """What the command line asks for.

    Raises:
        UsageError, RunError: saying what is wrong.
    """
    cfg = parse(PlotConfig, argv, "python -m goalgan_bt.plot")
    check_ranges(cfg)
    if not cfg.runs:
        raise UsageError("name at least one run folder: python -m goalgan_bt.plot RUN")
    if len(cfg.at) > 50:
        raise UsageError("--at takes at most 50 iterations")
    if cfg.out is not None:
        check_target(cfg.out, (".png", ".svg", ".pdf"))
    try:
        from goalgan_bt.viz import pictures
    except ImportError:
        raise RunError('plots need matplotlib: pip install "goalgan_bt[plots]"') from None
    path = cfg.out or cfg.runs[0] / "curves.png"
    kind, dpi = path.suffix[1:].lower(), 150 if cfg.width is None else 600
    with pictures.for_print(cfg.width is not None):
        figure = pictures.overview(runs_in(cfg.runs), cfg.maps, cfg.at, cfg.width)
        # The folder may be another's: a link that lies there must not lead what is written away.
        write_atomically(path, lambda file: figure.savefig(file, format=kind, dpi=dpi))
    say(str(path))


if __name__ == "__main__":
    exit_with(main())
