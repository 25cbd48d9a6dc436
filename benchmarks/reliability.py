"""How far a run can be trusted: all of it measured anew, and written into docs/reliability.md.

    python benchmarks/reliability.py

Half an hour. The counts come from files that `benchmarks/kills.py`, `benchmarks/fuzz.py`,
`benchmarks/page.py` and `benchmarks/long_run.py` write; `--only table` only writes the document
from those that are there.
"""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as xml
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from goalgan_bt.learners import maze, maze_learner, table
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.maze_learner import MazeLearner
from goalgan_bt.runs import checkpoint, run_folder
from goalgan_bt.runs.metrics_csv import read_metrics

ROOT = Path(__file__).parents[1]
RUNS, DOCUMENT = ROOT / "docs/runs", ROOT / "docs/reliability.md"
BEGIN, END = "<!-- counts: python benchmarks/reliability.py -->", "<!-- end -->"
TESTS = {
    "resumed as if never stopped": ("tests/test_resume.py", "tests/test_ranks.py"),
    "faults planted": ("tests/test_faults.py",),
    "folders and visitors that mean harm": ("tests/test_strangers.py",),
}
KINDS = {  # of `benchmarks/fuzz.py`
    "map": "maps",
    "env": "names and sizes of environments",
    "flags": "flags of the command line",
    "settings": "`config.json`, its bytes",
    "values": "`config.json`, its values",
    "meta": "`meta.json`",
    "metrics": "`metrics.csv`",
    "run": "run folders, as the page reads them",
    "frame": "frames, their bytes",
    "arrays": "frames, their arrays",
    "bytes_of_checkpoint": "checkpoints, their bytes",
    "state": "checkpoints with their checksum right, loaded",
    "resume": "such checkpoints, trained on from",
    "places": "places of a checkpoint",
    "study": "study files",
    "tell": "arguments of `GoalCurriculum.tell`",
    "ask": "arguments of `GoalCurriculum.ask`",
}
Part = Literal["kills", "fuzz", "tests", "checkpoints", "page", "table"]


@dataclass(frozen=True)
class ReliabilityConfig:
    """Measure, and write the table."""

    only: tuple[Part, ...] = ("kills", "fuzz", "tests", "checkpoints", "page", "table")
    """What to do; the figures of the rest stay as they are."""
    kills: int = 200
    """Trainings that are killed."""
    cases: int = 100_000
    """Inputs that are damaged."""


def command(*words: object) -> None:
    print("+", *words, flush=True)
    alone = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, *map(str, words)], cwd=ROOT, env=alone, check=False)


def tests() -> dict[str, dict[str, int]]:
    """How many tests of each kind pass, slow ones included."""
    counts = {}
    for name, files in TESTS.items():
        with tempfile.TemporaryDirectory() as place:
            report = Path(place) / "report.xml"
            command("-m", "pytest", "-q", "-m", "slow or not slow", f"--junit-xml={report}", *files)
            suite = xml.parse(report).getroot()[0]
        run, failures, errors, skipped = (
            int(suite.attrib[key]) for key in ("tests", "failures", "errors", "skipped")
        )
        counts[name] = {"tests": run - skipped, "failed": failures + errors}
    return counts


def checkpoints() -> dict[str, dict[str, float]]:
    """What checkpoints cost: megabytes, share of the training's time, seconds to go on from one."""
    found = {}
    for name, words in (
        ("ant_umaze", "--env ant_umaze --iterations 60"),
        ("ant_umaze with traces", "--env ant_umaze --method with_traces --iterations 60"),
        ("point_umaze", "--env point_umaze --iterations 40"),
    ):
        cfg = table.from_command_line([*words.split(), "--viz", "none"])
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            with maze.prepared(cfg) as world:
                run_folder.write_meta(folder, world.maze)
            maze.train(cfg, folder)
            begin = time.perf_counter()
            env = make_env(replace(cfg, resume=folder), cfg.rollout.num_envs)
            learner = MazeLearner(env, cfg)
            maze_learner.load(learner, folder, maze.collector_of(learner, env))
            found[name] = {
                "seconds_to_go_on": round(time.perf_counter() - begin, 2),
                "megabytes": round((folder / checkpoint.NAME).stat().st_size / 1e6, 1),
                "share": float(read_metrics(folder)[1][-1]["time/saving_share"]),
            }
    return found


def written(name: str, value: Any) -> None:
    (RUNS / name).write_text(json.dumps(value, indent=1) + "\n")


def known(name: str) -> Any:
    with contextlib.suppress(OSError):
        return json.loads((RUNS / name).read_text())
    return None


def rows() -> list[Sequence[object]]:
    """What was tried, how often, and how often it went wrong."""
    lines: list[Sequence[object]] = []
    if kills := known("kills.json"):
        wrong = kills["unreadable"] + kills["lost"] + kills["different"]
        saving = f"{kills['while_saving']} of them while a checkpoint was written"
        what = f"trainings killed with SIGKILL and gone on with, {saving}"
        lines.append((what, kills["kills"], wrong))
    for name, count in (known("reliability_tests.json") or {}).items():
        lines.append((f"{name} (tests)", count["tests"], count["failed"]))
    if fuzz := known("fuzz.json"):
        for kind, count in fuzz.items():
            lines.append((f"damaged or absurd: {KINDS[kind]}", count["cases"], count["wrong"]))
        total = [sum(count[key] for count in fuzz.values()) for key in ("cases", "wrong")]
        lines.append(("**all damaged inputs**", *total))
    return lines


def costs() -> list[str]:
    """Sentences about what it costs, and what a long run takes."""
    said = []
    for name, cost in (known("checkpoints.json") or {}).items():
        said.append(
            f"- A checkpoint of `{name}`: {cost['megabytes']} MB, {100 * cost['share']:.2f}% of "
            f"the training's time; going on from it takes {cost['seconds_to_go_on']} s."
        )
    for row in known("page_rude.json") or []:
        if row.get("rude"):
            said.append(
                f"- With {row['visitors']} visitors to the page, {row['rude']} of whom misbehave, "
                f"training keeps {row['ratio']} of its steps/s."
            )
    return said + long_run(known("long_run.json") or [])


def long_run(seen: list[dict[str, Any]]) -> list[str]:
    """A table of some moments of a long run."""
    if not seen:
        return []
    last = seen[-1]
    lines = [
        "",
        f"A run of {last['minutes']:.0f} minutes with {last['reports']:,} reports, page open:",
        "",
        "| minutes | training, MiB | files | threads | page, MiB | files | threads |",
        "|---|---|---|---|---|---|---|",
    ]
    for i in np.linspace(0, len(seen) - 1, 6).round().astype(int):
        row = seen[i]
        cells = round(row["minutes"]), *row["training"].values(), *row["page"].values()
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return lines


def document() -> None:
    """Put the counts into the document."""
    text = DOCUMENT.read_text()
    lines = [
        "| what | times | went wrong |",
        "|---|---|---|",
        *(f"| {what} | {times:,} | {wrong} |" for what, times, wrong in rows()),
        "",
        *costs(),
    ]
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    DOCUMENT.write_text(f"{before}{BEGIN}\n\n" + "\n".join(lines) + f"\n\n{END}{after}")


def main(cfg: ReliabilityConfig) -> None:
    if "checkpoints" in cfg.only:
        written("checkpoints.json", checkpoints())
    if "kills" in cfg.only:
        command("benchmarks/kills.py", "--kills", cfg.kills, "--json", RUNS / "kills.json")
    if "fuzz" in cfg.only:
        command("benchmarks/fuzz.py", "--cases", cfg.cases, "--json", RUNS / "fuzz.json")
    if "tests" in cfg.only:
        written("reliability_tests.json", tests())
    if "page" in cfg.only:
        page = RUNS / "page_rude.json"
        command("benchmarks/page.py", "--pages", 0, 20, "--rude", 5, "--reports", 0, "--json", page)
    if "table" in cfg.only:
        document()


if __name__ == "__main__":
    main(tyro.cli(ReliabilityConfig, description=__doc__))
