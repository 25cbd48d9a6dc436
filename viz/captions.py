"""What a page says of a run."""

import time
from typing import Any

import numpy as np

from goalgan_bt.runs.metrics_csv import Metrics
from goalgan_bt.runs.run_folder import flat
from goalgan_bt.viz.run import Run, success

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
    progress = (
        f"iteration {metrics.last('iteration'):,.0f}, "
        f"{metrics.last('steps/train') / 1e6:.2f}M steps, "
        f"{metrics.last('time/fps'):,.0f} steps/s"
        + (f", coverage {coverage:.2f} at {steps / 1e6:.2f}M" if coverage == coverage else "")
    )
    if (ended := run.ended()) is not None:
        return f"ended ({ended}): {progress}"
    learns = time.time() - metrics.changed < SILENT
    return f"{'learns' if learns else 'is silent'}: {progress}"


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
    if frame is not None:
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
