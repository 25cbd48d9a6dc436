"""Studies: methods against each other, many seeds, one table and one report.

    python -m goalgan_bt.study point_umaze

A study is a small TOML file: environments (with flags of their own: "point_nd --dim 4"), a number
of seeds, flags for all, and methods by name, each with the flags of `goalgan_bt.train` that make
it. Every run is a process of one thread. What is finished stands in `runs.csv` and is not run
again; what was cut off goes on from its checkpoint, where its learner leaves any.
"""

import os
import signal
import sys

if __name__ == "__main__":  # while it imports, nothing has begun
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))

import csv
import fcntl
import functools
import json
import math
import re
import shlex
import subprocess
import time
import tomllib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import tyro

from goalgan_bt import config, locomotion, record
from goalgan_bt.command_line import UsageError, exit_code, exit_with, parse
from goalgan_bt.progress import complain, say

SHIPPED = Path(__file__).parent / "studies"
KEY = ("env", "method", "seed")
OURS = {"--env", "--seed", "--out", "--resume", "--viz", "--threads", "--help", "-h"}
COSTS = (*KEY, "flags", "commit", "train", "label", "eval", "seconds")  # of costs.csv
UNSEEN = "--viz", "none"  # there is a page for each run of a maze, else
TRAININGS: list["subprocess.Popen[str]"] = []  # what this process runs at present


class Study(NamedTuple):
    """name: of the file; envs, methods (name -> flags), seeds: the grid; flags: of all; measure:
    what is compared, "coverage" or (locomotion) "return"; called: what the command calls it, a
    file without its folder. An environment may have flags of its own behind its name."""

    name: str
    envs: list[str]
    methods: dict[str, str]
    seeds: range
    flags: str
    measure: str
    called: str


class Run(NamedTuple):
    """One run of a study: env, method, seed and the flags that make it."""

    env: str
    method: str
    seed: int
    flags: str

    @property
    def key(self) -> tuple[str, str, str]:
        """What tells it from the study's others, as in the tables."""
        return self.env, self.method, str(self.seed)


@dataclass(frozen=True)
class StudyConfig:
    """Run a study, or what is missing of it, and write its tables, report and picture."""

    study: tyro.conf.Positional[str]
    """A TOML file, or one of those that come along: point_umaze, point_umaze_again, ant_umaze,
    ant_umaze_again, point_nd, ablations, four_rooms, four_rooms_ablations, locomotion_trpo,
    locomotion_sac, locomotion_sac_again, locomotion_lengths, locomotion_forward,
    locomotion_random, locomotion_updates."""
    out: Path = Path("docs/studies")
    """Where tables and report go, in a folder with the study's name."""
    runs: Path = Path("runs/studies")
    """Where the run folders go."""
    processes: int = 0
    """Runs at a time; 0 is one per core."""
    engine: Literal["here", "submitit"] = "here"
    """Where runs run: on this machine, or as jobs of a SLURM cluster (submitit, extra `study`)."""
    partition: str | None = None
    """SLURM partition for submitit."""
    report: bool = False
    """Only write the report of what is there."""


def load(name: str) -> Study:
    """A study by file or by the name of one that comes along.

    Raises:
        UsageError: if there is none, or it cannot be read; the message says what is wrong.
    """
    path = Path(name) if name.endswith(".toml") else SHIPPED / f"{name}.toml"
    try:
        table = tomllib.loads(path.read_text())
    except FileNotFoundError:
        known = ", ".join(sorted(file.stem for file in SHIPPED.glob("*.toml")))
        raise UsageError(
            f"there is no study {name!r}: name a TOML file or one of {known}"
        ) from None
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read {path}: {error}") from None
    wrong = f"{path} is no study: "
    kinds: dict[str, type] = {"envs": list, "seeds": int, "methods": dict}
    for key, kind in kinds.items():
        if not isinstance(table.get(key), kind) or not table[key]:
            raise UsageError(f"{wrong}it needs {key} (envs = [...], seeds = 5, [methods])")
    if unknown := set(table) - {*kinds, "flags", "first_seed"}:
        raise UsageError(f"{wrong}it has an unknown key {unknown.pop()!r}")
    flags, first = table.get("flags", ""), table.get("first_seed", 0)
    texts = [*table["envs"], *table["methods"].values(), flags]
    if not all(isinstance(text, str) for text in texts):
        raise UsageError(f"{wrong}environments and flags are texts")
    if len(set(table["envs"])) < len(table["envs"]):
        raise UsageError(f"{wrong}it names an environment twice")
    if type(table["seeds"]) is not int or table["seeds"] < 1 or type(first) is not int or first < 0:
        raise UsageError(f"{wrong}seeds is a number from 1 on, first_seed from 0 on")
    if bad := [name for name in table["methods"] if not re.fullmatch(r"\w[\w.+-]*", name)]:
        raise UsageError(f"{wrong}a method's name is letters, digits, _ . + -, not {bad[0]!r}")
    seeds = range(first, first + table["seeds"])
    try:
        measures = {measure(env) for env in table["envs"]}
    except ValueError as error:
        raise UsageError(f"{wrong}{error}") from None
    if len(measures) > 1:
        raise UsageError(f"{wrong}some of its environments have a coverage, others a return")
    called = Path(name).name
    envs, methods, judged_by = table["envs"], table["methods"], measures.pop()
    study = Study(path.stem, envs, methods, seeds, flags, judged_by, called)
    *_, last = grid(study)
    for run in grid(study._replace(seeds=seeds[-1:])):
        try:
            given = {word.split("=")[0] for word in shlex.split(f"{run.env} {run.flags}")}
            if given := given & OURS:
                raise UsageError(f"{given.pop()} is the study's own")
            settings(run)
            if run == last:
                _parsed(run)  # with its seed
        except ValueError as error:  # UsageError is one
            raise UsageError(f"{wrong}{run.env}, {run.method}: {error}") from None
    return study


def grid(study: Study) -> list[Run]:
    """Every run of a study, seed by seed, so that all methods have as many at any time."""
    return [
        Run(env, method, seed, f"{study.flags} {flags}".strip())
        for seed in study.seeds
        for env in study.envs
        for method, flags in study.methods.items()
    ]


def words(run: Run) -> list[str]:
    """The flags of `goalgan_bt.train` for a run."""
    named = ["--env", *shlex.split(run.env), "--seed", str(run.seed)]
    alone = [] if config.other_learner(named) else ["--threads", "1", *UNSEEN]
    return [*named, *alone, *shlex.split(run.flags)]


def measure(env: str) -> str:
    """What runs in an environment are judged by: "coverage" or "return"."""
    other = config.other_learner(["--env", *shlex.split(env)])
    return "return" if other is locomotion else "coverage"


def settings(run: Run) -> Any:
    """The settings that its flags make.

    Raises:
        UsageError: for bad ones.
    """
    return replace(_settings(run._replace(seed=0)), seed=run.seed)


def _parsed(run: Run) -> Any:
    asked = words(run)
    return (config.other_learner(asked) or config).from_command_line(asked)


# `load` has asked for all: threads, in which tyro is not safe, only look them up.
_settings = functools.cache(_parsed)


def perform(run: Run, folder: Path) -> Path:
    """Train in a process of its own with one simulation thread, or go on with what was cut off.

    Args:
        run: what to train.
        folder: of this run alone; its run folder is made in it.

    Returns:
        The run folder.

    Raises:
        RunError: if training failed, with its last words, or was begun with other settings.
    """
    flags = [*words(run), "--out", str(folder)]
    if whole := [end.parent for end in folder.glob(f"*/{record.ENDED}") if _of(end.parent, run)]:
        return whole[-1]
    begun = max((kept.parent for kept in folder.glob("*/checkpoint.pt")), default=None)
    if begun is not None:
        asked, resume = settings(run), ["--resume", str(begun)]
        other = config.other_learner(resume)
        if replace((other or config).load(begun), out=asked.out, resume=None) != asked:
            raise record.RunError(f"{begun} was begun with other settings: remove it")
        flags = resume if other else [*resume, *UNSEEN]
    folder.mkdir(parents=True, exist_ok=True)
    with subprocess.Popen(
        [sys.executable, "-m", "goalgan_bt.train", *flags],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as training:
        TRAININGS.append(training)
        _, errors = training.communicate()
    TRAININGS.remove(training)
    finished = begun and "has reached its limits" in errors  # killed just before it said so
    if training.returncode != 0 and not finished:
        last = (errors.strip().splitlines() or ["it said nothing"])[-1]
        raise record.RunError(f"{run.env}, {run.method}, seed {run.seed} failed: {last}")
    return begun or max(folder.glob("*/config.json"), key=os.path.getmtime).parent


def _of(place: Path, run: Run) -> bool:
    """Whether a run folder is complete and was made with the settings of a run."""
    try:
        made = json.loads((place / "config.json").read_text())
        complete = (place / record.ENDED).read_text().startswith("complete")
    except (OSError, ValueError):
        return False
    asked = json.loads(json.dumps(asdict(settings(run)), default=str))
    free = {"out": None, "resume": None}
    return complete and isinstance(made, dict) and {**made, **free} == {**asked, **free}


class Tables:
    """`runs.csv` (a row per report) and `costs.csv` (a row per run) of a study.

    Args:
        folder: where they are or shall be.
        measure: what runs are judged by; the name of its column.

    Attributes:
        curves, costs: their rows.
    """

    def __init__(self, folder: Path, measure: str) -> None:
        self.folder, self.measure = folder, measure
        self._columns = (*KEY, "steps", measure)
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = (folder / ".lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise record.RunError(f"{folder} is another study's at work: wait for it") from None
        curves = _read(folder / "runs.csv", self._columns)
        # What is not in both was cut off between the two, or is damaged: it is run again.
        begun = {_key(row) for row in curves}
        self.costs = [row for row in _read(folder / "costs.csv", COSTS) if _key(row) in begun]
        known = {_key(row) for row in self.costs}
        self.curves = [row for row in curves if _key(row) in known]

    def has(self, run: Run) -> bool:
        """Whether a run is finished.

        Raises:
            UsageError: if it was made with other flags.
        """
        for row in self.costs:
            if _key(row) == run.key:
                if row["flags"] != run.flags:
                    raise UsageError(
                        f"{self.folder} holds {run.method} of {run.env} with the flags "
                        f"{row['flags']!r}, not {run.flags!r}: rename the method or the study"
                    )
                return True
        return False

    def add(self, run: Run, folder: Path) -> float:
        """Take in a finished run; what it measured last."""
        _, rows = record.read_metrics(folder)
        key = dict(zip(KEY, run.key, strict=True))
        found = [(row["steps/train"], row.get(f"eval/{self.measure}")) for row in rows]
        reports = [(steps, value) for steps, value in found if value]
        if not reports:
            raise record.RunError(f"{folder} has measured no {self.measure}: remove it")
        self.curves += [key | {"steps": steps, self.measure: value} for steps, value in reports]
        last = rows[-1]
        self.costs.append(
            key
            | {"flags": run.flags, "commit": record.commits(folder)}
            | {kind: last[f"steps/{kind}"] for kind in ("train", "label", "eval")}
            | {"seconds": f"{float(last['time/total']):.0f}"}
        )
        record.write_table(self.folder / "runs.csv", self._columns, self.curves)
        record.write_table(self.folder / "costs.csv", COSTS, self.costs)
        return float(reports[-1][1])


def _key(row: dict[str, str]) -> tuple[str, ...]:
    return tuple(row[name] for name in KEY)


def _read(path: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    if not path.exists():
        return []
    numbers = [name for name in columns if name not in ("env", "method", "flags", "commit")]
    try:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
        if any(set(row) != set(columns) or None in row.values() for row in rows):
            raise ValueError(f"its columns must be {', '.join(columns)}")
        for row in rows:
            if not all(math.isfinite(float(row[name])) for name in numbers):
                raise ValueError(f"a number in the row of {', '.join(_key(row))} is not finite")
            int(row["seed"])
    except ValueError as error:  # UnicodeDecodeError is one
        raise record.RunError(f"{path} is damaged: {error}") from None
    return rows


def finished(
    cfg: StudyConfig, runs: list[Run], folder: Path
) -> Iterator[tuple[Run, "Future[Path]"]]:
    """Perform runs, several at a time; gives each as it ends."""
    places = [folder / run.env.replace(" ", "_") / f"{run.method}-s{run.seed}" for run in runs]
    if cfg.engine == "here":
        pool = ThreadPoolExecutor(cfg.processes or len(os.sched_getaffinity(0)))
        jobs: dict[Any, Run] = {
            pool.submit(perform, run, place): run for run, place in zip(runs, places, strict=True)
        }
        try:
            for job in as_completed(jobs):
                yield jobs[job], job
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            ended: list[Any] = []
            while not all(job.done() for job in jobs):  # where this was interrupted
                for training in [one for one in TRAININGS if one not in ended]:
                    training.terminate()  # each saves what it can
                    ended.append(training)
                time.sleep(0.02)  # another may be about to begin
            pool.shutdown()
        return
    try:
        import submitit
    except ImportError:
        raise UsageError('submitit is missing: pip install "goalgan_bt[study]"') from None
    executor = submitit.AutoExecutor(folder=folder / "submitit")
    if executor.cluster != "slurm":
        raise UsageError("there is no SLURM here: leave --engine away")
    slurm = {} if cfg.partition is None else {"slurm_partition": cfg.partition}
    limits = {} if not cfg.processes else {"slurm_array_parallelism": cfg.processes}
    executor.update_parameters(cpus_per_task=1, timeout_min=24 * 60, **slurm, **limits)
    jobs = dict(zip(executor.map_array(perform, runs, places), runs, strict=True))
    for job in submitit.helpers.as_completed(list(jobs)):
        yield jobs[job], job


def work() -> None:
    """What the command line asks for.

    Raises:
        UsageError, RunError: saying what is wrong with it, or what is left to do.
    """
    cfg = parse(StudyConfig, None, "python -m goalgan_bt.study")
    if cfg.processes < 0:
        raise UsageError(f"--processes must be 0 or more, not {cfg.processes}")
    try:
        from goalgan_bt import evidence
    except ImportError:
        raise UsageError(
            'the report needs matplotlib and scipy: pip install "goalgan_bt[study]"'
        ) from None
    study = load(cfg.study)
    tables = Tables(cfg.out / study.name, study.measure)
    missing = [run for run in grid(study) if not tables.has(run)]
    failed = 0
    if missing and not cfg.report:
        say(f"{study.name}: {len(missing)} runs of {len(grid(study))} to go")
        began = time.monotonic()
        places = cfg.runs / study.name
        for i, (run, job) in enumerate(finished(cfg, missing, places), 1):
            try:
                last = tables.add(run, job.result())
            except Exception as error:  # whatever became of one run, the others go on
                failed += 1
                complain((str(error).strip().splitlines() or [type(error).__name__])[-1])
                continue
            left = (time.monotonic() - began) / i * (len(missing) - i) / 60
            say(
                f"{time.strftime('%H:%M:%S')} {i}/{len(missing)} {run.env} {run.method} "
                f"s{run.seed}: {study.measure} {last:.3f}  left {left:.0f} min"
            )
    if not tables.costs:
        raise UsageError(f"{tables.folder} holds no finished run yet: run the study first")
    evidence.report(study, tables)
    say(str(tables.folder / "README.md"))
    if failed:
        raise record.RunError(f"{failed} runs failed: the same command tries them again")


def main() -> int:
    """The command line; returns the exit code."""
    return exit_code(work, lambda: "the same command goes on with what is missing")


if __name__ == "__main__":
    exit_with(main())
