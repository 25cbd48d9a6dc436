"""What a page says of a run."""

import time
from typing import Any

import numpy as np

from goalgan_bt.runs.metrics_csv import Metrics
from goalgan_bt.runs.run_folder import flat
from goalgan_bt.viz.run import Frame, Run, labels, success, visits

CLICK = "**Click on the floor**: the body goes there."
SILENT = 120.0  # seconds without news after which a run counts as stopped


def plain(text: str) -> str:
    """A text from a run folder as markdown that shows just that text.

    The page's markdown takes HTML and reads images from the server's disk: nothing of the sort may
    come from a folder.
    """
    return "".join(x if x.isalnum() or x in " .,-:()" else f"&#{ord(x)};" for x in text)


def state(run: Run) -> str:
    """What goes on in a run, in a few words."""
    if run.gone:
        return "is gone: the folder has vanished; this is the last that was seen of it."
    metrics = run.metrics
    if not len(metrics):
        return "has begun; no iteration is finished yet."
    coverage, steps = measured(metrics)
    seen, speed = metrics.last("steps/train"), metrics.last("time/fps")
    known = (  # what a table may lack is NaN, and left out
        (True, f"iteration {metrics.last('iteration'):,.0f}"),
        (seen == seen, f"{seen / 1e6:.2f}M steps"),
        (speed == speed, f"{speed:,.0f} steps/s"),
        (coverage == coverage, f"coverage {coverage:.2f} at {steps / 1e6:.2f}M"),
    )
    progress = ", ".join(words for there, words in known if there)
    if (ended := run.ended()) is not None:
        return f"ended ({ended}): {progress}"
    learns = time.time() - metrics.changed < SILENT
    return f"{'learns' if learns else 'is silent'}: {progress}"


def doing(run: Run) -> str:
    """What a run is about at the moment, in a sentence or two for who has never seen one."""
    metrics, over = run.metrics, run.ended() is not None or run.gone
    if run.kind == "running":
        value = metrics.last("eval/return")
        told = "" if value != value else f"; its last measured return is {value:,.0f}"
        return f"{'A body has learned' if over else 'A body learns'} to run{told}."
    if run.kind == "rooms":
        value = metrics.last("eval/coverage")
        told = "" if value != value else f" It finds it in {value:.0%} of its tries."
        return f"An agent looks for the goal, which is in the far one of four rooms.{told}"
    world = "box" if run.maze is None else "maze"
    if over:
        covered, _ = measured(metrics)
        known = "" if covered != covered else f" It reaches **{covered:.0%}** of the {world}."
        click = "" if run.gone else f" {CLICK}"
        return f"A body has learned to go through this {world}.{known}{click}"
    frame = run.frame(run.iterations[-1]) if run.iterations else None
    if frame is None or not len(frame["goals"]):
        return f"A body learns to reach every place of this {world}. It has just begun."
    what = f"A body learns to reach every place of this {world}."
    return " ".join([what, practised(run, frame), covers(metrics, world), CLICK])


def covers(metrics: Metrics, world: str) -> str:
    """How much of its world a body reaches: one figure, the other in brackets with its date."""
    covered, steps = measured(metrics)
    estimate = metrics.last("curriculum/estimated_coverage")
    if steps == metrics.last("steps/train") or (estimate != estimate and covered == covered):
        return f"It reaches **{covered:.0%}** of the {world}."
    if estimate != estimate:
        return ""
    before = "" if covered != covered else f"; measured at {steps / 1e6:.2f}M steps: {covered:.0%}"
    return f"It reaches about **{estimate:.0%}** of the {world} (its own estimate{before})."


def practised(run: Run, frame: Frame) -> str:
    """Which goals are tried in a report, and how that goes."""
    kinds, goals = labels(frame), np.asarray(frame["goals"], dtype=float)
    some = goals[kinds == 0] if (kinds == 0).any() else goals
    if run.maze is not None:
        far = run.maze.way_from_start(some[:, :2])
        whole = f"the farthest place of the maze is {run.maze.longest_way:.0f} m away"
    else:
        far = np.linalg.norm(some, axis=1)
        whole = "as the crow flies"
    far = far[np.isfinite(far)]
    if not len(far):
        return "It tries goals that no body can reach, for now."
    near, most = np.percentile(far, [10, 90])
    where = f"{near:.0f} m" if round(near) == round(most) else f"{near:.0f} to {most:.0f} m"
    walls = 0.0 if run.maze is None else 1 - float(run.maze.is_free(goals[:, :2]).mean())
    told = f"Now it practises {where} from the start ({whole})"
    success = run.metrics.last("rollout/success")
    if success == success:
        told += f"; {success:.0%} of its attempts succeed"
    return told + (f", {walls:.0%} of the goals lie in walls." if walls >= 0.005 else ".")


def measured(metrics: Metrics) -> tuple[float, float]:
    """The last coverage that was measured, and after how many steps; NaN if none was."""
    known = np.flatnonzero(np.isfinite(metrics.column("eval/coverage")))
    if not len(known):
        return np.nan, np.nan
    return tuple(metrics.column(name)[known[-1]] for name in ("eval/coverage", "steps/train"))


def caption(run: Run, iteration: int) -> str:
    """One report in a line of markdown."""
    frame, steps = run.frame(iteration), run.metrics.at(iteration, "steps/train")
    words = [f"Iteration {iteration:,}"]
    if steps == steps:
        words.append(f"{steps:,.0f} steps")
    if frame is not None and run.kind == "rooms":
        words.append(f"{np.mean(visits(frame) > 0):.0%} of the cells visited")
    elif frame is not None:
        rate, measured = success(frame)
        kind = "coverage (measured)" if measured else "coverage (estimated)"
        words.append(f"{kind} **{np.mean(rate) if len(rate) else np.nan:.2f}**")
    return " · ".join(words)


def settings_rows(settings: dict[str, Any]) -> list[tuple[str, str]]:
    """Settings as rows of name, with dots, and value."""
    return [(name, str(value)) for name, value in flat(settings)]


def settings_table(settings: dict[str, Any]) -> str:
    """Settings as a markdown table."""
    rows = [f"| {plain(name)} | {plain(text)} |" for name, text in settings_rows(settings)]
    return "\n".join(["| setting | value |", "|---|---|", *rows])
