"""What a study is: a grid of environments, methods and seeds, from a TOML file.

A study names environments (with flags of their own: "point_nd --dim 4"), a number of seeds, flags
for all, and methods, each with the flags of `goalgan_bt.train` that make it.
"""

import functools
import re
import shlex
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import tyro

from goalgan_bt.learners.maze_config import MazeConfig
from goalgan_bt.learners.table import from_command_line, learner_of
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.ranges import NOT_NEGATIVE

SHIPPED = Path(__file__).parent
UNSEEN = "--viz", "none"  # there is a page for each run of a maze, else


OURS = {"--env", "--seed", "--out", "--resume", "--viz", "--threads", "--help", "-h"}


@dataclass(frozen=True)
class StudyConfig:
    """Run a study, or what is missing of it, and write its tables, report and picture."""

    study: tyro.conf.Positional[str]
    """A TOML file, or one of those that come along: point_umaze, point_umaze_again, point_parts,
    ant_umaze, ant_umaze_again, long_ways, long_ways_point, official, point_nd, ablations,
    four_rooms, four_rooms_ablations, locomotion_trpo, locomotion_sac, locomotion_sac_again,
    locomotion_lengths, locomotion_forward, locomotion_random, locomotion_updates."""
    out: Path = Path("docs/studies")
    """Where tables and report go, in a folder with the study's name."""
    runs: Path = Path("runs/studies")
    """Where the run folders go."""
    processes: Annotated[int, NOT_NEGATIVE] = 0
    """Runs at a time; 0 is one per core."""
    engine: Literal["here", "submitit"] = "here"
    """Where runs run: on this machine, or as jobs of a SLURM cluster (submitit, extra `study`)."""
    partition: str | None = None
    """SLURM partition for submitit."""
    report: bool = False
    """Only write the report of what is there."""


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


class Trial(NamedTuple):
    """One run of a study: env, method, seed and the flags that make it."""

    env: str
    method: str
    seed: int
    flags: str

    @property
    def key(self) -> tuple[str, str, str]:
        """What tells it from the study's others, as in the tables."""
        return self.env, self.method, str(self.seed)


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


def grid(study: Study) -> list[Trial]:
    """Every run of a study, seed by seed, so that all methods have as many at any time."""
    return [
        Trial(env, method, seed, f"{study.flags} {flags}".strip())
        for seed in study.seeds
        for env in study.envs
        for method, flags in study.methods.items()
    ]


def words(run: Trial) -> list[str]:
    """The flags of `goalgan_bt.train` for a run."""
    named = ["--env", *shlex.split(run.env), "--seed", str(run.seed), *UNSEEN]
    alone = ["--threads", "1"] if learner_of(named[1]).config is MazeConfig else []
    return [*named, *alone, *shlex.split(run.flags)]


def measure(env: str) -> str:
    """What runs in an environment are judged by: "coverage" or "return".

    Raises:
        UsageError: if there is no such environment.
    """
    return learner_of((shlex.split(env) or [""])[0]).measure


def settings(run: Trial) -> Any:
    """The settings that its flags make.

    Raises:
        UsageError: for bad ones.
    """
    return replace(_settings(run._replace(seed=0)), seed=run.seed)


def _parsed(run: Trial) -> Any:
    return from_command_line(words(run))


# `load` has asked for all: threads, in which tyro is not safe, only look them up.
_settings = functools.cache(_parsed)
