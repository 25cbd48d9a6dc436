"""The table of learners: which one an environment has, and how its settings come about."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

from goalgan_bt import envs
from goalgan_bt.envs.four_rooms import SIZES
from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.learners import four_rooms, locomotion, maze_config
from goalgan_bt.learners.run_config import RunConfig
from goalgan_bt.runs.command_line import check_ranges, parse, value_of
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.run_folder import env_of, read_settings
from goalgan_bt.runs.tracking import require_wandb

DEFAULT = "ant_umaze"
# What people set: `--help` explains these, of those that a learner has.
OFTEN = (
    *("env", "method", "seed", "total_steps", "minutes", "iterations"),
    *("map", "cell_size", "dim", "horizon", "num_envs", "threads", "physics"),
    *("report_every", "out", "resume", "viz", "viz_port", "track"),
)


class Learner(NamedTuple):
    """A learner.

    module: has `prepared(cfg)`, a context that gives a `World` or says what is missing, and
    `train(cfg, folder, stop)`; imported when it is needed, since torch takes seconds.
    config: the class of its settings; names: its environments; knows: whether one is among them;
    preset: the settings of an environment and a method; check: refuses what does not go together;
    may_change: settings that a resumed run may change; page: what there is to see of it, see
    `goalgan_bt.viz.layers`; measure: what it is judged by.
    """

    module: str
    config: type[RunConfig]
    names: tuple[str, ...]
    knows: Callable[[str], bool]
    preset: Callable[[str, str | None], RunConfig]
    check: Callable[[Any], None]
    may_change: frozenset[str]
    page: str
    measure: str


WATCHING = "viz", "viz_host", "viz_port", "track"
LOOKING = frozenset(("resume", *WATCHING))
LEARNERS = (
    Learner(
        "goalgan_bt.learners.maze",
        maze_config.MazeConfig,
        (*envs.NAMES, "module:factory (one's own)"),
        maze_config.knows,
        maze_config.preset,
        maze_config.check,
        LOOKING | maze_config.MAY_CHANGE,
        "goals",
        "coverage",
    ),
    Learner(
        "goalgan_bt.learners.four_rooms",
        four_rooms.FourRoomsConfig,
        (f"four_rooms_N (N from {SIZES[0]} to {SIZES[-1]})",),
        four_rooms.knows,
        four_rooms.preset,
        four_rooms.check,
        LOOKING | {"total_steps"},
        "rooms",
        "coverage",
    ),
    Learner(
        "goalgan_bt.learners.locomotion",
        locomotion.LocomotionConfig,
        tuple(locomotion.TASKS),
        locomotion.TASKS.__contains__,
        locomotion.preset,
        locomotion.check,
        LOOKING,
        "running",
        "return",
    ),
)


def register_env(
    name: str, make: Callable[..., GoalEnv], preset: Mapping[str, Any] | None = None
) -> None:
    """Let `name` be an environment with the maze learner, in this process: commands and the page
    know `module:factory` only.

    Args:
        name: a word of letters, digits and `_`.
        make: see `goalgan_bt.envs.own.Own`.
        preset: settings by name, as those of a method; by default that of `make`, if it has one.

    Raises:
        UsageError: for a name that is no word or taken, and for what cannot be called.
    """
    if any(learner.knows(str(name)) for learner in LEARNERS[1:]):
        raise UsageError(f"{name!r} cannot be an environment's name: it is taken")
    try:
        envs.own.register(name, make, preset)
    except envs.own.OwnEnvError as error:
        raise UsageError(str(error)) from None


def learner_of(env: str) -> Learner:
    """The learner of an environment.

    Raises:
        UsageError: if there is no such environment.
    """
    try:
        for learner in LEARNERS:
            if learner.knows(env):
                return learner
    except envs.own.OwnEnvError as error:
        raise UsageError(str(error)) from error.__cause__
    known = names()
    near = [name for name in known if name.endswith(f"_{env}")] or get_close_matches(env, known, 2)
    meant = f"did you mean {' or '.join(near)}? Otherwise " if near else ""
    raise UsageError(f"unknown environment {env!r}: {meant}choose one of {', '.join(known)}")


def names() -> list[str]:
    """The environments of all learners."""
    return [name for learner in LEARNERS for name in learner.names]


def check(cfg: RunConfig) -> None:
    """Refuse settings that make no sense.

    Raises:
        UsageError: naming the first such setting.
    """
    learner = learner_of(cfg.env)
    check_ranges(cfg)
    learner.check(cfg)


def from_command_line(argv: list[str]) -> Any:
    """The settings that a command line asks for: the preset of `--env` and `--method`, then every
    other flag; with `--resume RUN` the run's own settings take the preset's place.

    Raises:
        UsageError: for an unknown flag or a bad value.
        RunError: for a folder that is no run.
        SystemExit: after `--help`.
    """
    envs.own.allow(value_of(argv, "--env") or "")
    run = value_of(argv, "--resume")
    default: RunConfig
    if run is not None:
        # The folder may be somebody else's: who is told, and where, is for this command to say.
        looking = {name: getattr(RunConfig, name) for name in WATCHING}
        default = replace(load(Path(run)), resume=Path(run), **looking)
        learner = learner_of(default.env)
    else:
        env = value_of(argv, "--env") or DEFAULT
        learner = learner_of(env)
        default = learner.preset(env, value_of(argv, "--method"))
    command, known = "python -m goalgan_bt.train", ", ".join(names())
    cfg = parse(learner.config, argv, command, default, OFTEN, f"Environments: {known}.\n")
    if run is not None:
        for name in vars(default).keys() - learner.may_change:
            if getattr(cfg, name) != getattr(default, name):
                flag = "--" + name.replace("_", "-")
                raise UsageError(f"{flag} of a run cannot change when it is resumed: drop it")
    check(cfg)
    if cfg.track:
        require_wandb()
    return cfg


def load(folder: Path) -> Any:
    """The settings of a run folder.

    Raises:
        RunError: if the folder is no run, or its settings cannot be read or make no sense.
    """
    env = env_of(folder)
    try:
        kind = learner_of(env).config if env else RunConfig
        cfg = read_settings(kind, folder)
        check(cfg)
    except UsageError as error:
        raise RunError(f"cannot read {folder / 'config.json'}: {error}") from None
    return cfg
