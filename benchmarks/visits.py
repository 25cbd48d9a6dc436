"""Where policies go in four rooms: visitation counts by method and size (Goyal et al. 2019, 5.2).

    python -m goalgan_bt.study four_rooms
    python benchmarks/visits.py runs/studies/four_rooms docs/studies/four_rooms

writes visits.png, mean counts over seeds, and visits.csv: in how many of the free cells the trained
policy was in its last fifty episodes, and how many were visited in training: those that a
step began in, so never the goal.
"""

import csv
import io
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from goalgan_bt.runs.command_line import parse
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.metrics_csv import read_metrics, write_table
from goalgan_bt.runs.terminal import complain, say

COLUMNS = ("env", "method", "seeds", "free", "trained", "training", "return")


@dataclass(frozen=True)
class Settings:
    """Draw and count where policies went in four rooms."""

    runs: tyro.conf.Positional[Path]
    """The run folders of a study: ENV/METHOD-sSEED/RUN."""
    out: tyro.conf.Positional[Path]
    """Where visits.png and visits.csv go."""


def visits(folder: Path) -> dict[tuple[str, str], list[dict[str, np.ndarray]]]:
    """The counts of a study's runs by environment and method."""
    found: dict[tuple[str, str], list[dict[str, np.ndarray]]] = {}
    newest = {file.parents[1]: file for file in sorted(folder.glob("*/*-s*/*/visits.npz"))}
    for place, file in newest.items():  # a run that was cut off was made again
        _, rows = read_metrics(file.parent)
        with np.load(file) as counts:
            run = {name: counts[name] for name in ("trained", "training")}
        run["return"] = np.array(float(rows[-1]["eval/return"]))
        method = place.name.rpartition("-s")[0]
        found.setdefault((place.parent.name, method), []).append(run)
    if not found:
        raise UsageError(f"{folder} holds no run of four rooms: run the study first")
    return found


def row(env: str, method: str, runs: list[dict[str, np.ndarray]]) -> dict[str, str]:
    """Cells visited, means over seeds."""
    cells = {name: np.mean([(run[name] > 0).sum() for run in runs]) for name in runs[0]}
    return {
        "env": env,
        "method": method,
        "seeds": str(len(runs)),
        "free": str(np.isfinite(runs[0]["trained"]).sum()),
        "trained": f"{cells['trained']:.1f}",
        "training": f"{cells['training']:.1f}",
        "return": f"{np.mean([run['return'] for run in runs]):.3f}",
    }


def draw(
    found: dict[tuple[str, str], list[dict[str, np.ndarray]]],
    rows: dict[tuple[str, str], dict[str, str]],
) -> Figure:
    """A map of the trained policy's visits for each method and size, on one logarithmic scale."""
    envs = sorted({env for env, _ in found})
    methods = sorted({method for _, method in found})
    figure = Figure(figsize=(2.6 * len(envs) + 1, 2.6 * len(methods)), layout="constrained")
    axes = figure.subplots(len(methods), len(envs), squeeze=False)
    for i, method in enumerate(methods):
        for j, env in enumerate(envs):
            ax = axes[i, j]
            ax.set(xticks=[], yticks=[], facecolor="0.35")
            if (env, method) not in found:
                continue
            counts = np.mean([run["trained"] for run in found[env, method]], axis=0)
            image = ax.imshow(counts, cmap="viridis", norm=LogNorm(0.1, 100, clip=True))
            known = rows[env, method]
            ax.set_title(f"{env[11:]}: {known['trained']} of {known['free']} cells", fontsize=9)
            if j == 0:
                ax.set_ylabel(method)
    figure.colorbar(image, ax=axes, label="visits in 50 episodes, mean over seeds", shrink=0.5)
    return figure


def main() -> int:
    """Write table and picture."""
    try:
        settings = parse(Settings, None, "python benchmarks/visits.py")
        found = visits(settings.runs)
        settings.out.mkdir(parents=True, exist_ok=True)
        rows = {key: row(*key, found[key]) for key in sorted(found)}
        write_table(settings.out / "visits.csv", COLUMNS, list(rows.values()))
        picture = io.BytesIO()
        draw(found, rows).savefig(picture, dpi=110)
        (settings.out / "visits.png").write_bytes(picture.getvalue())
    except (UsageError, RunError, OSError) as error:
        complain(str(error))
        return 2
    writer = csv.DictWriter(sys.stdout, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows.values())
    say(str(settings.out / "visits.png"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
