"""The curves of the panel, drawn by uPlot in the browser."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import viser
from viser import uplot

from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.recall.settings import DEPTHS
from goalgan_bt.study.published import published
from goalgan_bt.viz.palette import RUNS
from goalgan_bt.viz.run import Run

MOST = 400  # points of a curve that are sent to the page


@dataclass(frozen=True)
class Plot:
    """A title and the metrics in it: (column of `metrics.csv`, name of the curve)."""

    title: str
    curves: tuple[tuple[str, str], ...]
    share: bool = False  # whether all values lie between 0 and 1


OF_GOALS = (
    Plot(
        "Coverage",
        (
            ("eval/coverage", "measured"),
            ("eval/coverage_deterministic", "deterministic"),
            ("curriculum/estimated_coverage", "estimated"),
        ),
        share=True,
    ),
    Plot(
        "Goals and success",
        (
            ("curriculum/intermediate", "intermediate"),
            ("curriculum/too_easy", "too easy"),
            ("rollout/success", "success"),
        ),
        share=True,
    ),
    Plot("KL of a step, nats", (("trpo/kl", "TRPO"), ("imitation/kl", "imitation"))),
    Plot(
        "Losses",
        (
            ("gan/discriminator_loss", "discriminator"),
            ("gan/generator_loss", "generator"),
        ),
    ),
    Plot(
        "Backtracking model, -log likelihood of new transitions, nats",
        (
            ("backtracking/held_out_action_nll", "q(a | s')"),
            ("backtracking/held_out_state_nll", "q(ds | a, s')"),
        ),
    ),
    Plot(
        "Recall traces",
        (
            ("backtracking/decoded", "goals decoded"),
            ("backtracking/valid", "steps valid"),
            ("backtracking/arrived", "arrive in the simulator"),
        ),
        share=True,
    ),
    Plot(
        "Recall traces still valid so many steps before the goal",
        tuple((f"backtracking/valid_{n}", str(n)) for n in DEPTHS),
        share=True,
    ),
    Plot(
        "Reward per action",
        (("rollout/reward", "true"), ("rollout/shaping", "shaping by places")),
    ),
    Plot(
        "Recall traces, metres per action",
        (
            ("backtracking/moved", "length of a step"),
            ("backtracking/gap", "error of a step"),
            ("backtracking/gap_last", "error of the last step"),
        ),
    ),
    Plot("Imitation loss, nats", (("imitation/loss", "-log pi(a | s, g)"),)),
    Plot("Environment steps per second", (("time/fps", "training"),)),
)


OF_ROOMS = (
    Plot("Success from the start", (("eval/coverage", "measured"),), share=True),
    Plot("Discounted return", (("eval/return", "measured"),)),
    Plot(
        "States visited",
        (("train/states", "in training so far"), ("eval/states", "by the trained policy")),
    ),
)
OF_RUNNING = (
    Plot("Return of an episode", (("eval/return", "measured"),)),
    Plot(
        "Backtracking model, -log likelihood of steps, nats",
        (("recall/action_nll", "q(a | s')"), ("recall/state_nll", "q(ds | a, s')")),
    ),
    Plot("Recall traces: share of valid steps", (("recall/valid", "valid"),), share=True),
    Plot("Imitation: KL, nats", (("recall/kl", "KL"),)),
    Plot("Environment steps per second", (("time/fps", "training"),)),
)
PLOTS = {"goals": OF_GOALS, "rooms": OF_ROOMS, "running": OF_RUNNING}


def thinned(n: int) -> np.ndarray:
    """At most `MOST` of n rows, evenly spread, the last one always among them."""
    return np.unique(np.linspace(0, n - 1, min(n, MOST)).round().astype(int))


def joined(x: FloatArray, y: FloatArray) -> FloatArray:
    """y with the gaps between known values joined by lines; NaN outside of them."""
    known = np.isfinite(y)
    if not known.any():
        return y
    filled = np.interp(x, x[known], y[known])
    first, last = np.flatnonzero(known)[[0, -1]]
    filled[:first], filled[last + 1 :] = np.nan, np.nan
    return filled


def series(run: Run, plot: Plot) -> tuple[FloatArray, ...]:
    """Million steps and every curve of a plot, each (n,)."""
    if not len(run.metrics):
        return np.zeros(1), *np.full((len(plot.curves), 1), np.nan)
    column = run.metrics.column
    steps = column("steps/train") / 1e6
    rows = thinned(len(steps))
    return (steps[rows], *(joined(steps, column(name))[rows] for name, _ in plot.curves))


def levels(run: Run, plot: Plot) -> list[tuple[str, float]]:
    """The coverage that was published for a run's task, as lines of a plot: (name, coverage)."""
    return [
        (f"{line.method}, {line.last[0] / 1e6:.0f}M steps", line.last[1])
        for line in (published(run.settings) if plot is OF_GOALS[0] else ())
    ]


class Curves:
    """The plots of one run, or of several: then a line for each run in every plot, which shows the
    first of the plot's curves.

    Args:
        gui: where they go.
        runs: one or more.
    """

    def __init__(self, gui: viser.GuiApi, runs: list[Run]) -> None:
        self._runs = runs
        kinds = dict.fromkeys(run.kind for run in runs)
        self._plots = list(dict.fromkeys(plot for kind in kinds for plot in PLOTS[kind]))
        self._handles: list[Any] = []
        for plot in self._plots:
            names = [name for _, name in plot.curves]
            shown = plot
            if len(runs) > 1:
                shown = replace(plot, title=f"{plot.title}: {names[0]}")
                names = [run.task_and_method() for run in self._runs_in(plot)]
            shares = len(runs) == 1  # all curves of a run, or one of each run that has it
            colours = [RUNS[i] for i, run in enumerate(runs) if plot in PLOTS[run.kind]]
            data, lines = self._data(plot), self._levels(plot)
            self._handles.append(_add(gui, shown, data, names, lines, RUNS if shares else colours))

    def refresh(self) -> None:
        """Send what is new to the page."""
        for plot, handle in zip(self._plots, self._handles, strict=True):
            handle.data = self._data(plot)

    def _data(self, plot: Plot) -> tuple[FloatArray, ...]:
        runs = self._runs_in(plot)
        known = [series(run, plot) for run in runs]
        if len(self._runs) == 1:
            x, *curves = known[0]
        else:
            x = np.unique(np.concatenate([steps for steps, *_ in known]))
            x = x[thinned(len(x))]
            curves = [np.interp(x, steps, first, right=np.nan) for steps, first, *_ in known]
        return (x, *curves, *(np.full(len(x), y) for _, y in self._levels(plot)))

    def _runs_in(self, plot: Plot) -> list[Run]:
        """Those whose kind has such a plot."""
        return [run for run in self._runs if plot in PLOTS[run.kind]]

    def _levels(self, plot: Plot) -> list[tuple[str, float]]:
        """What was published, where the runs have one task."""
        runs = self._runs_in(plot)
        return levels(runs[0], plot) if len({run.task for run in runs}) == 1 else []


def _add(
    gui: viser.GuiApi,
    plot: Plot,
    data: tuple[FloatArray, ...],
    names: list[str],
    levels: list[tuple[str, float]],
    colours: Sequence[str],
) -> viser.GuiUplotHandle:
    """A plot with the curves of those names, and published levels."""
    lines = [
        uplot.Series(label=name, stroke=colours[i % len(colours)], width=2, spanGaps=True)
        for i, name in enumerate(names)
    ]
    lines += [
        uplot.Series(label=name, stroke="#999999", width=1, dash=(4, 4 + 4 * i))
        for i, (name, _) in enumerate(levels)
    ]
    scales = {"x": uplot.Scale(time=False)}
    if plot.share:
        scales["y"] = uplot.Scale(range=(0.0, 1.05))
    return gui.add_uplot(
        data,
        (uplot.Series(label="million steps"), *lines),
        title=plot.title,
        scales=scales,
        axes=(uplot.Axis(stroke="#888888"), uplot.Axis(stroke="#888888", size=45)),
        legend=uplot.Legend(show=True),
        aspect=1.6,
    )
