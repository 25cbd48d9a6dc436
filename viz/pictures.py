"""Pictures of run folders with matplotlib: coverage over steps, coverage over the maze."""

import contextlib
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from goalgan_bt.runs import run_folder
from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import read_metrics
from goalgan_bt.runs.terminal import complain
from goalgan_bt.study.published import Published, published
from goalgan_bt.viz.run import Run, labels, places, success

# Red (never reached) over pale yellow to blue (mastered): readable for colour-blind people.
COLOURS = "RdYlBu"
LABELS = {-1: ("too hard", "#a50026"), 0: ("intermediate", "#111111"), 1: ("too easy", "#4575b4")}


def curve(ax: Axes, folders: list[Path], until: int | None = None) -> None:
    """Measured coverage over training steps, a line per run, and the published figures; where runs
    have no coverage, their return.

    Args:
        ax: where to draw.
        folders: the runs.
        until: the last iteration to draw; the axes stay those of the whole run.

    Raises:
        RunError: if a folder is no run, or some have coverage and others not.
    """
    tables = [read_metrics(folder) for folder in folders]
    covered = {"eval/coverage" in names or "eval/return" not in names for names, _ in tables}
    if len(covered) > 1:
        raise RunError("some of these runs have a coverage, others a return: one at a time")
    measure = "coverage" if covered == {True} else "return"
    references: dict[Published, None] = {}  # in the order given
    for i, (folder, (_, rows)) in enumerate(zip(folders, tables, strict=True)):
        rows = [row for row in rows if row.get(f"eval/{measure}")]
        if not rows and run_folder.maze_of(folder) is None:
            raise RunError(f"{folder} holds no report yet: there is nothing to draw")
        known = sum(until is None or int(row["iteration"]) <= until for row in rows)
        try:
            steps = [int(row["steps/train"]) for row in rows]
            values = [float(row[f"eval/{measure}"]) for row in rows]
            if not all(map(math.isfinite, values)):
                raise ValueError(f"a {measure} is not finite")
        except ValueError as error:
            raise RunError(f"{folder / 'metrics.csv'} is damaged: {error}") from None
        values[known:] = [math.nan] * (len(rows) - known)
        run = Run(folder)
        ax.update_datalim([(x, 0.0) for x in steps], updatey=False)
        ax.plot(steps, values, color=f"C{i}", label=_title(run), marker=".", markersize=4)
        references |= dict.fromkeys(published(run.settings))
    for line, grey in zip(references, ("0.65", "0.35") * 9, strict=False):
        label = f"{line.method} (published)"
        ax.plot(*zip(*line.points, strict=True), "o--", color=grey, markersize=3, label=label)
        ax.set_xscale("log")
    floors = [value for _, rows in tables for value in last_of(rows, "eval/floor") if value > 0]
    if floors:
        ax.axhline(min(floors), color="0.6", lw=0.8, ls=":", label="a body that does not move")
    ax.set(xlabel="environment steps of training", ylabel=measure)
    if measure == "coverage":
        ax.set_ylim(0, 1.02)
    ax.grid(alpha=0.25)
    ax.legend(fontsize=7, frameon=False, loc="upper left" if measure == "coverage" else "best")


def last_of(rows: list[dict[str, str]], name: str) -> list[float]:
    """The last value of a metric that is known and a number, if any is."""
    for row in reversed(rows):
        with contextlib.suppress(ValueError):
            return [float(row.get(name) or "")]
    return []


def _title(run: Run) -> str:
    """What tells a run from others, in three words; matplotlib reads formulas between dollars."""
    known = [run.settings.get(name) for name in ("method", "seed")]
    title = run.name if None in known else "{} {} s{}".format(run.task, *known)
    return title.replace("$", r"\$")


def coverage_map(ax: Axes, folder: Path, frame: Path, goals: float = 7.0) -> Any:
    """One report seen from above: tiles by success, goals by label, recall traces.

    Tiles show the measured coverage, or the learner's own estimate where the report has none.

    Args:
        ax: where to draw.
        folder: the run.
        frame: one of its frames.
        goals: the area of a goal's dot, square points; 0 leaves goals and traces away.

    Returns:
        What `Figure.colorbar` needs.

    Raises:
        RunError: if the folder is no run or its goals are not places in a maze.
    """
    maze = run_folder.maze_of(folder)
    if maze is None:
        raise RunError(f"{folder} has no maze to draw: only its curve can be plotted")
    arrays = read_frame(frame)
    rate, measured = success(arrays)
    tiles = arrays["test_goals"]
    ax.set_facecolor("#55595f")
    side = maze.tile_side(len(tiles))
    image = ax.scatter([], [], c=[], cmap=COLOURS, vmin=0, vmax=1)
    for (x, y), value in zip(tiles, rate, strict=True):
        colour = image.to_rgba(value)
        ax.add_patch(Rectangle((x - side / 2, y - side / 2), side, side, color=colour, lw=0))
    if goals:
        lines = np.swapaxes(places(arrays, "traces", 3)[..., :2], 0, 1)
        ax.add_collection(LineCollection(list(lines), colors="#111111", linewidths=0.5, alpha=0.5))
        for label, (text, shade) in LABELS.items():
            x, y = arrays["goals"][labels(arrays) == label, :2].T
            ax.scatter(x, y, s=goals, color=shade, label=text, lw=0.3, edgecolors="white")
    ax.plot(0, 0, marker="*", color="white", markeredgecolor="#111111", markersize=9)
    ax.set(xlim=(maze.low[0], maze.high[0]), ylim=(maze.low[1], maze.high[1]), aspect="equal")
    ax.set(xticks=[], yticks=[])
    kind = "coverage" if measured else "estimate"
    ax.set_title(f"iteration {int(frame.stem)}: {kind} {np.mean(rate):.2f}", fontsize=9)
    return image


def measured_frames(folder: Path) -> list[Path]:
    """The frames that hold a measured coverage, oldest first; one that is damaged is told."""
    measured = []
    for frame in frame_paths(folder):
        try:
            if success(read_frame(frame))[1]:
                measured.append(frame)
        except RunError as error:
            complain(f"{error}: it is left out", "warning")
    return measured


def frames_at(folder: Path, iterations: tuple[int, ...]) -> list[Path]:
    """The frames nearest to those iterations, measured or not.

    Raises:
        RunError: for iterations that the run has not come to.
    """
    frames = frame_paths(folder)
    if frames and max(iterations, default=0) > (last := int(frames[-1].stem)):
        raise RunError(f"{folder} has no report of iteration {max(iterations)}: its last is {last}")
    return [min(frames, key=lambda frame: abs(int(frame.stem) - i)) for i in iterations if frames]


def overview(folders: list[Path], maps: int = 4, at: tuple[int, ...] = ()) -> Figure:
    """A row of coverage maps over training per run, and all curves below.

    Args:
        folders: the runs.
        maps: how many measured reports of each run to show, evenly spread.
        at: or the iterations whose reports to show.

    Raises:
        RunError: if a folder is no run or holds no such report yet.
    """
    maps = len(at) or maps
    with_maze = [folder for folder in folders if run_folder.maze_of(folder) is not None]
    if at and not with_maze:
        raise RunError("--at chooses maps, and these runs have no maze to draw")
    rows = len(with_maze)
    figure = Figure(figsize=(2.4 * maps, 2.6 * rows + 3.2), layout="constrained")
    grid = figure.add_gridspec(rows + 1, maps, height_ratios=[2.6] * rows + [3.2])
    for r, folder in enumerate(with_maze):
        frames = frames_at(folder, at) or measured_frames(folder)
        if not frames:
            raise RunError(f"{folder} holds no report yet: wait for its first evaluation")
        picks = np.unique(np.linspace(0, len(frames) - 1, maps).round().astype(int))
        axes = [figure.add_subplot(grid[r, c]) for c in range(len(picks))]
        for ax, pick in zip(axes, picks, strict=True):
            image = coverage_map(ax, folder, frames[pick])
        axes[0].set_ylabel(_title(Run(folder)).replace(" ", "\n"), fontsize=7)
        axes[0].legend(fontsize=6, loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=3)
        figure.colorbar(image, ax=axes, label="success", shrink=0.8)
    curve(figure.add_subplot(grid[rows, :]), folders)
    return figure
