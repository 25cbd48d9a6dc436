"""The report of a study: tables as text and CSV, and a picture."""

import io
import math
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from goalgan_bt.runs import files
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.metrics_csv import write_table
from goalgan_bt.runs.run_folder import task_of
from goalgan_bt.study.plan import Study, Trial, grid, settings
from goalgan_bt.study.published import Published, published
from goalgan_bt.study.statistics import (
    Curve,
    areas,
    band,
    ends,
    interval,
    iqm,
    paired,
    ratio,
    time_to,
)
from goalgan_bt.study.tables import Tables

THRESHOLDS = (0.3, 0.48, 0.63, 0.9)  # coverage; 0.48 and 0.63 are Goyal et al. 2019's


# Whom times are compared with: all methods with the first of these, those with traces with the
# others; where a study has none of them, all with its own first method.
REFERENCES = (
    "goal_gan",
    "actor_critic",
    "per",
    "straight_line",
    "self_imitation",
    "hindsight",
    "trpo",
    "sac",
)


TIMES = """\
Time to a coverage over that of another method, paired by seed: geometric mean and 95% interval
(Student's, of the logarithms); in brackets how many runs of each reached it. Those that did not
count with all their steps; where fewer than half did there is no figure."""


NOTES = """\
Interquartile means over seeds with 95% percentile bootstrap intervals (with five seeds they are
rather 90%). `area`: mean coverage over the run. `to 0.63`: median of the training steps (millions)
until coverage first reaches 0.63, on lines between reports; runs that never do count as infinite.
Steps (millions) and wall time (with one simulation thread) are means per run."""


DIFFERENCES = "Difference to another method, paired by seed: mean and 95% interval (Student's)."


RETURN_NOTES = """\
Interquartile means over seeds with 95% percentile bootstrap intervals; with three seeds those are
the mean, the lowest and the highest, with four the mean is that of the middle two. Of several
comparisons some differ by chance. `area`: mean return over the run, from the first report on. Steps
(millions) and wall time are means per run; other runs shared the cores, some more than others, so
that the times of two rows do not compare."""


def curves(tables: Tables) -> dict[tuple[str, str], dict[int, Curve]]:
    """The runs by environment and method, then by seed."""
    points: dict[tuple[str, str, int], list[tuple[float, float]]] = {}
    for row in tables.curves:
        key = row["env"], row["method"], int(row["seed"])
        begin = [(0.0, 0.0)] if tables.measure == "coverage" else []
        point = float(row["steps"]), float(row[tables.measure])
        points.setdefault(key, begin).append(point)
    runs: dict[tuple[str, str], dict[int, Curve]] = {}
    for (env, method, seed), rows in sorted(points.items()):
        runs.setdefault((env, method), {})[seed] = Curve(*np.array(rows).T)
    return runs


def report(study: Study, tables: Tables) -> None:
    """Write README.md, summary.csv and curves.png beside the tables of a study."""
    runs = curves(tables)
    rows: list[dict[str, str]] = []
    text = [f"# Study {study.name}", "", f"From `python -m goalgan_bt.study {study.called}`."]
    asked = grid(study)
    there = sum(map(tables.has, asked))
    if there < len(asked):
        text += ["", f"**Not finished: {there} of {len(asked)} runs are in.**"]
    envs = [env for env in study.envs if any((env, method) in runs for method in study.methods)]
    if not envs:
        raise UsageError(f"{tables.folder} holds no run of this study's methods")
    for env in envs:
        of = {method: runs[env, method] for method in study.methods if (env, method) in runs}
        here = {method: _row(env, method, seeds, tables) for method, seeds in of.items()}
        rows += here.values()
        best_first = sorted(here, key=lambda method: -iqm(areas(of[method])))
        table = _markdown([here[method] for method in best_first])
        compared = _ratios(of) if study.measure == "coverage" else _differences(of)
        text += ["", f"## {env}", "", *table, "", *compared]
    text += [
        "",
        *(NOTES if study.measure == "coverage" else RETURN_NOTES).splitlines(),
        f"Raw figures: runs.csv, costs.csv. {_commits(tables.costs)}",
        "",
        f"![{study.measure} over training steps](curves.png)",
        "",
    ]
    write_table(tables.folder / "summary.csv", list(rows[0]), rows)
    (tables.folder / "README.md").write_text("\n".join(text))
    picture = io.BytesIO()
    draw(study._replace(envs=envs), runs).savefig(picture, dpi=130)
    files.write_atomically(
        tables.folder / "curves.png", lambda file: file.write(picture.getvalue())
    )


def _commits(costs: list[dict[str, str]]) -> str:
    """The commit of most runs, and which runs were made with others."""
    made: dict[str, list[str]] = {}
    for row in costs:
        of = row["commit"].split("+")  # more than one where a run was resumed with other code
        short = (one[:12] + "-dirty" * one.endswith("-dirty") for one in of)
        made.setdefault("+".join(short) or "unknown", []).append(f"{row['method']} of {row['env']}")
    most, *others = sorted(made, key=lambda commit: -len(made[commit]))
    text = f"Commit: {most}"
    for commit in others:
        some = made[commit]
        text += f"; {commit} for {len(some)} of the runs of {', '.join(dict.fromkeys(some))}"
    return f"{text}."


def _row(env: str, method: str, seeds: dict[int, Curve], tables: Tables) -> dict[str, str]:
    of = list(seeds.values())
    costs = [row for row in tables.costs if (row["env"], row["method"]) == (env, method)]
    row = {
        "env": env,
        "method": method,
        "seeds": str(len(of)),
        "area": str(interval(areas(seeds))),
        "at the end": str(interval(ends(seeds))),
    }
    for threshold in THRESHOLDS if tables.measure == "coverage" else ():
        median = np.median([time_to(curve, threshold) for curve in of]) / 1e6
        digits = 2 if median >= 0.1 else 3  # a grid world takes thousands of steps, not millions
        row[f"to {threshold:g}"] = f"{median:.{digits}f}" if np.isfinite(median) else "-"
    for kind in ("train", "label", "eval"):
        row[f"{kind} steps"] = f"{np.mean([float(cost[kind]) for cost in costs]) / 1e6:.1f}"
    row["wall s"] = f"{np.mean([float(cost['seconds']) for cost in costs]):.0f}"
    return row


def _markdown(rows: list[dict[str, str]]) -> list[str]:
    names = [name for name in rows[0] if name != "env"]
    lines = [f"| {' | '.join(names)} |", "|" + " --- |" * len(names)]
    return lines + [f"| {' | '.join(row[name] for name in names)} |" for row in rows]


def _ratios(of: dict[str, dict[int, Curve]]) -> list[str]:
    lines = []
    references = [method for method in REFERENCES if method in of] or [next(iter(of))]
    for reference in references:
        for method in of:
            seeds = sorted(set(of[method]) & set(of[reference]))
            traced = method.startswith("recall_traces") or reference == references[0]
            if method == reference or not seeds or not traced:
                continue
            cells = []
            for threshold in THRESHOLDS:
                ours, theirs = ([of[name][seed] for seed in seeds] for name in (method, reference))
                cells.append(str(ratio(ours, theirs, threshold)))
            lines.append(f"| {method} over {reference} | {len(seeds)} | {' | '.join(cells)} |")
    if not lines:
        return []
    heads = " | ".join(f"{threshold:g}" for threshold in THRESHOLDS)
    return [
        *TIMES.splitlines(),
        "",
        f"| times | seeds | {heads} |",
        "|" + " --- |" * (len(THRESHOLDS) + 2),
        *lines,
    ]


def _differences(of: dict[str, dict[int, Curve]]) -> list[str]:
    reference = next((method for method in REFERENCES if method in of), next(iter(of)))
    others = [method for method in of if method != reference]
    pairs = [(method, reference) for method in others]
    if "recall_traces" in others:  # its controls are compared with it, too
        pairs += [("recall_traces", other) for other in others if other != "recall_traces"]
    lines = []
    for one, other in pairs:
        if not (seeds := sorted(set(of[one]) & set(of[other]))):
            continue
        ours, theirs = ({seed: of[name][seed] for seed in seeds} for name in (one, other))
        cells = [paired(figure(ours) - figure(theirs)) for figure in (areas, ends)]
        lines.append(f"| {one} less {other} | {len(seeds)} | {cells[0]} | {cells[1]} |")
    if not lines:
        return []
    heads = ["| difference | seeds | area | at the end |", "| --- | --- | --- | --- |"]
    return [DIFFERENCES, "", *heads, *lines]


def draw(study: Study, runs: dict[tuple[str, str], dict[int, Curve]]) -> Figure:
    """Coverage or return over training steps, a panel per environment; where more than two have a
    coverage, also that at the end over environments."""
    envs, methods = study.envs, list(study.methods)
    panels = len(envs) + (len(envs) > 2 and study.measure == "coverage")
    across = min(panels, 2)
    down = math.ceil(panels / across)
    figure = Figure(figsize=(8.5 * across, 5 * down), layout="constrained")
    axes = figure.subplots(down, across, squeeze=False).flat
    for ax, env in zip(axes, envs, strict=False):
        of = {method: runs.get((env, method), {}) for method in methods}
        learned = asdict(settings(Trial(env, "", 0, study.flags)))
        title = env if learned.get("map") is None else task_of(learned)
        _curves(ax, title, of, study.measure, published(learned))
    if panels > len(envs):
        _ends(axes[len(envs)], envs, runs, methods)
    for ax in axes[panels:]:
        ax.set_axis_off()
    return figure


def _curves(
    ax: Axes,
    title: str,
    of: dict[str, dict[int, Curve]],
    measure: str,
    lines: tuple[Published, ...],
) -> None:
    """Interquartile mean per method, with its interval if there are few, and what was published."""
    for i, (method, seeds) in enumerate(of.items()):
        if not seeds:
            continue
        first = max(curve.steps[0] for curve in seeds.values())
        last = min(curve.steps[-1] for curve in seeds.values())
        measured = max(curve.steps[curve.steps > 0][0] for curve in seeds.values())
        grid = np.linspace(first, last, 150)
        if measured < last / 100:  # grid worlds: most of it happens at once, and is measured then
            grid = np.geomspace(measured, last, 150)
            ax.set_xscale("log")
        bounds = band(list(seeds.values()), grid)
        style = _style(i)
        ax.plot(grid / 1e6, bounds[:, 0], label=f"{method} ({len(seeds)})", **style)
        if len(of) <= 10:  # more would hide the lines; the table has the intervals
            ax.fill_between(grid / 1e6, *bounds[:, 1:].T, color=style["color"], alpha=0.12, lw=0)
    for line, (x, side) in zip(lines, ((0, "left"), (1, "right")), strict=False):
        steps, level = line.last
        name = f"{line.method}, published, {steps / 1e6:.0f}M steps"
        ax.axhline(level, color="0.6", lw=0.8, ls=":")
        at = ax.get_yaxis_transform()  # x as a share of the axis, y as it is
        ax.text(x, level, name, transform=at, fontsize=7, color="0.4", va="bottom", ha=side)
    ax.set(title=title, xlabel="million environment steps of training", ylabel=measure)
    _finish(ax, measure)


def _ends(
    ax: Axes, envs: list[str], runs: dict[tuple[str, str], dict[int, Curve]], methods: list[str]
) -> None:
    """Coverage at the end over environments: interquartile mean and interval per method."""
    for i, method in enumerate(methods):
        there = [j for j, env in enumerate(envs) if (env, method) in runs]
        found = np.array([interval(ends(runs[envs[j], method])) for j in there]).reshape(-1, 3)
        value, low, high = found.T
        x = np.array(there) + 0.04 * (i - len(methods) / 2)  # so that no bar hides another
        ax.errorbar(x, value, (value - low, high - value), label=method, capsize=3, **_style(i))
    ax.set_xticks(range(len(envs)), [env.replace(" --", "\n--") for env in envs])
    ax.set(title="at the end", ylabel="coverage")
    _finish(ax, "coverage")


def _style(i: int) -> dict[str, Any]:
    return {"color": f"C{i % 10}", "linestyle": "-" if i < 10 else "--"}


def _finish(ax: Axes, measure: str) -> None:
    if measure == "coverage":
        ax.set_ylim(0, 1.02)
    ax.grid(alpha=0.25)
    ax.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
