"""What a page says of a run."""

from typing import Any

import numpy as np

from goalgan_bt.viz.run import Run, number, success

SILENT = 120.0  # seconds without news after which a run counts as stopped


def state(run: Run) -> str:
    """What goes on in a run, in a few words."""
    if run.gone:
        return "is gone: the folder has vanished; this is the last that was seen of it."
    if not run.rows:
        return "has begun; no iteration is finished yet."
    row = run.rows[-1]
    measured = run.column("eval/coverage")
    measured = measured[np.isfinite(measured)]
    coverage = f", coverage {measured[-1]:.2f}" if len(measured) else ""
    progress = (
        f"iteration {number(row.get('iteration')):,.0f}, "
        f"{number(row.get('steps/train')) / 1e6:.2f}M steps, "
        f"{number(row.get('time/fps')):,.0f} steps/s{coverage}"
    )
    if (ended := run.ended()) is not None:
        return f"ended ({ended}): {progress}"
    return f"{'learns' if run.age() < SILENT else 'is silent'}: {progress}"


def caption(run: Run, iteration: int) -> str:
    """One report in a line of markdown."""
    frame, row = run.frame(iteration), run.row_of(iteration)
    words = [f"Iteration {iteration:,}"]
    if row:
        words.append(f"{number(row.get('steps/train')):,.0f} steps")
    if frame is not None:
        rate, measured = success(frame)
        kind = "coverage (measured)" if measured else "coverage (estimated)"
        words.append(f"{kind} **{np.mean(rate) if len(rate) else np.nan:.2f}**")
    return " · ".join(words)


def settings_rows(settings: dict[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Settings as rows of name, with dots, and value."""
    rows = []
    for name, value in settings.items():
        if isinstance(value, dict):
            rows += settings_rows(value, f"{prefix}{name}.")
        else:
            rows.append((prefix + name, str(value)))
    return rows


def settings_table(settings: dict[str, Any]) -> str:
    """Settings as a markdown table."""
    safe = str.maketrans({"|": "/", "<": "&lt;", "`": "'"})
    rows = [f"| {name} | {text.translate(safe)} |" for name, text in settings_rows(settings)]
    return "\n".join(["| setting | value |", "|---|---|", *rows])
