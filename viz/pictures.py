"""Pictures of run folders with matplotlib: coverage over steps, coverage over the maze."""

import contextlib
import io
import math
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context, rcParams
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from goalgan_bt.runs import run_folder
from goalgan_bt.runs.errors import RunError
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import read_metrics
from goalgan_bt.runs.terminal import complain
from goalgan_bt.study.published import published
from goalgan_bt.study.statistics import Curve, band
from goalgan_bt.viz import palette
from goalgan_bt.viz.run import Run, drawn, floor_of, labels, places

WALL = "#c9cdd3"
SCALE = {"goals": "success", "rooms": "visits, logarithmic"}  # what the colours of a map tell
PRINT = {  # for a column of a paper
    "font.size": 7,
    "axes.linewidth": 0.5,
    "lines.linewidth": 1.0,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "pdf.fonttype": 42,  # letters stay letters
    "svg.fonttype": "none",
}
MM = 1 / 25.4  # inches


def for_print(wanted: bool = True) -> AbstractContextManager[None]:
    """Inside, figures are drawn and saved as a paper wants them, if that is wanted."""
    style: Any = PRINT if wanted else {}
    return rc_context(style)


class NoReport(RunError):
    """A run has nothing to draw yet."""


class Measured(NamedTuple):
    """What a run was measured to be worth, in the order of time.

    run; measure: coverage or return; iterations, steps (of training), values: (n,) each;
    floor: the coverage of a body that does not move, 0 where it is not known.
    """

    run: Run
    measure: str
    iterations: NDArray[np.int64]
    steps: NDArray[np.int64]
    values: NDArray[np.float64]
    floor: float


def measured(folder: Path) -> Measured:
    """What a run was measured to be worth.

    Raises:
        RunError: if the folder is no run, or its metrics are damaged, or there are none to draw.
    """
    begun = (folder / "metrics.csv").exists() or not run_folder.env_of(folder)
    names, rows = read_metrics(folder) if begun else ([], [])
    covered = "eval/coverage" in names or "eval/return" not in names
    measure = "coverage" if covered else "return"
    floor = last_of(rows, "eval/floor")
    rows = [row for row in rows if row.get(f"eval/{measure}")]
    if not rows:
        raise NoReport(f"{folder} holds no report yet: wait for its first evaluation")
    try:
        columns = [[int(row[name]) for row in rows] for name in ("iteration", "steps/train")]
        values = [float(row[f"eval/{measure}"]) for row in rows]
        if not all(map(math.isfinite, values)):
            raise ValueError(f"a {measure} is not finite")
    except ValueError as error:
        raise RunError(f"{folder / 'metrics.csv'} is damaged: {error}") from None
    iterations, steps = (np.array(column, dtype=np.int64) for column in columns)
    return Measured(
        Run(folder), measure, iterations, steps, np.array(values), max(floor, default=0)
    )


def last_of(rows: list[dict[str, str]], name: str) -> list[float]:
    """The last value of a metric that is known and a number, if any is."""
    for row in reversed(rows):
        with contextlib.suppress(ValueError):
            return [float(row.get(name) or "")]
    return []


def curve(ax: Axes, runs: list[Measured], until: int | None = None) -> None:
    """What runs were measured to be worth over training steps, a line per run, beside the published
    figures of their tasks.

    Args:
        ax: where to draw.
        runs: of one measure.
        until: the last iteration to draw; the axes stay those of the whole run.

    Raises:
        RunError: if some have coverage and others not.
    """
    for i, run in enumerate(runs):
        values = run.values.copy()
        values[run.iterations > (np.inf if until is None else until)] = np.nan
        ax.update_datalim([(x, 0.0) for x in run.steps], updatey=False)
        ax.plot(run.steps, values, color=f"C{i}", label=_title(run.run), marker=".", markersize=4)
    _around(ax, runs)


def curves_of_methods(ax: Axes, methods: dict[str, list[Measured]]) -> None:
    """The interquartile mean over the seeds of each method, with its 95% bootstrap interval where
    there are two seeds or more.

    Args:
        ax: where to draw.
        methods: runs of one task by method.

    Raises:
        RunError: if some have coverage and others not.
    """
    for i, (method, runs) in enumerate(methods.items()):
        # To the last report of any: a seed that ended early does not cut the others off.
        ends = min(run.steps[0] for run in runs), max(run.steps[-1] for run in runs)
        grid = np.linspace(*ends, 150)
        bounds = band([Curve(run.steps.astype(float), run.values) for run in runs], grid)
        name = f"{method.replace('$', '')} ({len(runs)} seed{'s' * (len(runs) > 1)})"
        dot = "o" if ends[0] == ends[1] else ""
        ax.plot(grid, bounds[:, 0], color=f"C{i % 10}", label=name, marker=dot)
        ax.fill_between(grid, *bounds[:, 1:].T, color=f"C{i % 10}", alpha=0.15, lw=0)
    _around(ax, [run for runs in methods.values() for run in runs])


def _around(ax: Axes, runs: list[Measured]) -> None:
    """What was published for the tasks of these runs, a motionless body's floor, axes, legend."""
    if len({run.measure for run in runs}) > 1:
        raise RunError("some of these runs have a coverage, others a return: one at a time")
    measure = runs[0].measure
    references = dict.fromkeys(line for run in runs for line in published(run.run.settings))
    for line, grey in zip(references, ("0.65", "0.35") * 9, strict=False):
        label = f"{line.method} (published)"
        ax.plot(*zip(*line.points, strict=True), "o--", color=grey, markersize=3, label=label)
        ax.set_xscale("log")
    if floors := [run.floor for run in runs if run.floor > 0]:
        ax.axhline(min(floors), color="0.6", lw=0.8, ls=":", label="a body that does not move")
    ax.set(xlabel="environment steps of training", ylabel=measure)
    if measure == "coverage":
        ax.set_ylim(0, 1.02)
    ax.grid(alpha=0.25)
    ax.legend(fontsize=_small(7), loc="best", framealpha=0.75, edgecolor="none")


def _title(run: Run) -> str:
    """What tells a run from others; matplotlib reads formulas between dollars."""
    return run.task_and_method().replace("$", r"\$")


def coverage_map(
    ax: Axes, folder: Path, frame: Path, goals: float = 7.0, scale: float = 1.0
) -> Any:
    """One report seen from above: tiles by success, goals by label, recall traces.

    Tiles show the measured coverage, or the learner's own estimate where the report has none.

    Args:
        ax: where to draw.
        folder: the run.
        frame: one of its frames.
        goals: the area of a goal's dot, square points; 0 leaves goals and traces away.
        scale: of type and star.

    Returns:
        What `Figure.colorbar` needs.

    Raises:
        RunError: if the folder is no run or its goals are not places in a maze.
    """
    maze = run_folder.maze_of(folder)
    if maze is None:
        raise RunError(f"{folder} has no maze to draw: only its curve can be plotted")
    arrays = read_frame(frame)
    rate, what = floor_of(arrays)
    tiles = arrays["test_goals"]
    ax.set_facecolor(WALL)
    side = maze.tile_side(len(tiles))
    image = ax.scatter([], [], c=[], cmap=palette.SUCCESS, vmin=0, vmax=1)
    for (x, y), colour in zip(tiles, palette.colours(rate) / 255, strict=True):
        ax.add_patch(Rectangle((x - side / 2, y - side / 2), side, side, color=colour, lw=0))
    if goals and what != "visits":
        lines = np.swapaxes(places(arrays, "traces", 3)[..., :2], 0, 1)
        ax.add_collection(LineCollection(list(lines), colors="#ff5a36", linewidths=0.5, alpha=0.7))
        for label, kind in palette.GOALS.items():
            x, y = arrays["goals"][labels(arrays) == label, :2].T
            dots = ax.scatter(x, y, s=goals, marker=kind.marker, label=kind.text, lw=0.4)
            dots.set(facecolor=palette.css(kind.fill), edgecolor=palette.css(kind.rim))
    ax.plot(
        *maze.start,
        marker="*",
        color="white",
        markeredgecolor="#111111",
        markersize=9 * min(1.0, scale),
    )
    (x0, y0), (x1, y1) = drawn(maze, np.stack([maze.low, maze.high]))
    ax.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xticks=[], yticks=[])
    mean = np.mean(rate > 0 if what == "visits" else rate)
    told = f"iteration {int(frame.stem)}\n{what} {mean:.2f}"
    ax.set_title(told, fontsize=min(_small(9), 9 * scale))
    return image


def measured_frames(folder: Path) -> list[Path]:
    """The frames whose map was measured, oldest first; one that is damaged is told."""
    found = []
    for frame in frame_paths(folder):
        try:
            if floor_of(read_frame(frame))[1] != "estimate":
                found.append(frame)
        except RunError as error:
            complain(f"{error}: it is left out", "warning")
    return found


def frames_at(folder: Path, iterations: tuple[int, ...]) -> list[Path]:
    """The frames nearest to those iterations, measured or not.

    Raises:
        RunError: for iterations that the run has not come to.
    """
    frames = frame_paths(folder)
    if frames and max(iterations, default=0) > (last := int(frames[-1].stem)):
        raise RunError(f"{folder} has no report of iteration {max(iterations)}: its last is {last}")
    return [min(frames, key=lambda frame: abs(int(frame.stem) - i)) for i in iterations if frames]


FEW = 6  # runs, each of which has a line and maps of its own


class Picture(Figure):
    """A figure that a notebook shows by itself."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png", dpi=100)
        return file.getvalue()


def overview(
    folders: list[Path], maps: int = 4, at: tuple[int, ...] = (), width: float | None = None
) -> Figure:
    """Coverage maps over training, a row for each run, and curves below.

    More than `FEW` runs are grouped: a panel of curves for each task, a line for each method, and
    the maps of the first run of each method. Of several runs, those without a report are left out,
    which is told.

    Args:
        folders: the runs.
        maps: how many measured reports of each run to show, evenly spread.
        at: or the iterations whose reports to show.
        width: of the figure in millimetres, for print; by default it is made for a screen.

    Raises:
        RunError: if a folder is no run, or none holds a report yet.
    """
    runs = _reporting(folders)
    tasks, many = by_task_and_method(runs), len(runs) > FEW
    shown = [of[0] for methods in tasks.values() for of in methods.values()] if many else runs
    rows = _rows([run.run for run in shown if run.run.maze is not None], at, len(runs) > 1)
    if at and not rows:
        raise RunError("--at chooses maps, and these runs have no maze to draw")
    columns = min(len(at) or maps, max((len(frames) for _, frames in rows), default=1))
    panels = len(tasks) if many or len({run.measure for run in runs}) > 1 else 1
    beside = min(panels, 3 if width is None else 2)
    # One for a screen is as large as it needs to be; one for print has the width that is asked for.
    across = max(2.4 * columns, 5.5 * beside) if width is None else width * MM
    of_map, of_curve = 1.15 * min(across / columns, 3.0), max(1.8, 0.6 * across / beside)
    heights = [of_map * len(rows) + 0.35] * bool(rows) + [of_curve * math.ceil(panels / beside)]
    figure = Picture(figsize=(across, sum(heights)), layout="constrained")
    *above, below = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False).flat
    for part in above:
        _maps(part, rows, columns, across)
    axes = below.subplots(math.ceil(panels / beside), beside, squeeze=False).flat
    for ax in axes[panels:]:
        ax.set_axis_off()
    if panels == 1 and not many:
        curve(axes[0], runs)
        return figure
    for ax, (task, methods) in zip(axes, tasks.items(), strict=False):
        if many:
            curves_of_methods(ax, methods)
        else:
            curve(ax, [run for of in methods.values() for run in of])
        ax.set_title(task.replace("$", r"\$"), fontsize=rcParams["font.size"])
    return figure


def _reporting(folders: list[Path]) -> list[Measured]:
    """What runs were measured to be worth; of several, those with nothing to draw are left out."""
    runs = []
    for folder in folders:
        try:
            runs.append(measured(folder))
        except NoReport as error:
            if len(folders) == 1:
                raise
            complain(f"{error}: it is left out", "warning")
    if not runs:
        raise RunError("none of these runs holds a report yet: there is nothing to draw")
    return runs


def _rows(runs: list[Run], at: tuple[int, ...], several: bool) -> list[tuple[Run, list[Path]]]:
    """Runs with the frames whose maps can be drawn; of several, those without one have none."""
    rows = [(run, frames_at(run.folder, at) or measured_frames(run.folder)) for run in runs]
    if not several and rows and not rows[0][1]:
        raise RunError(f"{runs[0].folder} holds no report yet: wait for its first evaluation")
    return [(run, frames) for run, frames in rows if frames]


def by_task_and_method(runs: list[Measured]) -> dict[str, dict[str, list[Measured]]]:
    """Runs by task and method, those of a method by seed."""
    tasks: dict[str, dict[str, list[Measured]]] = {}
    for run in sorted(runs, key=lambda run: str(run.run.settings.get("seed", "")).zfill(9)):
        method = str(run.run.settings.get("method", "?"))
        tasks.setdefault(run.run.task, {}).setdefault(method, []).append(run)
    return tasks


def _maps(part: SubFigure, rows: list[tuple[Run, list[Path]]], columns: int, across: float) -> None:
    """Coverage maps, a row for each run, in a figure of that width in inches."""
    axes = part.subplots(len(rows), columns, squeeze=False)
    scale = across / columns / 2.4  # of one that is made for a screen
    for row, (run, frames) in zip(axes, rows, strict=True):
        picks = np.unique(np.linspace(0, len(frames) - 1, columns).round().astype(int))
        for ax, pick in zip(row, picks, strict=False):
            image = coverage_map(ax, run.folder, frames[pick], min(7.0, 7.0 * scale), scale)
        for ax in row[len(picks) :]:
            ax.set_axis_off()
        row[0].set_ylabel(_title(run).replace(" ", "\n"), fontsize=_small(7))
    label = " or ".join(sorted({SCALE[run.kind] for run, _ in rows}))
    part.colorbar(image, ax=axes, label=label, shrink=0.8)
    found = (ax.get_legend_handles_labels() for ax in axes[:, 0])
    handles, names = max(found, key=lambda pair: len(pair[0]))
    if handles:
        part.legend(handles, names, loc="outside lower center", ncols=3, fontsize=_small(7))


def _small(points: float) -> float:
    """A size of type, smaller where all type is small."""
    return min(points, float(rcParams["font.size"]) - 1)
