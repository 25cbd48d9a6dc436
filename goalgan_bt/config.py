"""The settings of a run: those of each part, composed, and a preset per environment."""

import math
import os
import sys
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Literal

from goalgan_bt import envs, four_rooms, locomotion
from goalgan_bt.command_line import UsageError, fault, parse, value_of
from goalgan_bt.methods import METHODS
from goalgan_bt.record import env_of, read_settings, write_settings
from goalgan_bt.settings import (
    BacktrackingConfig,
    CoverageConfig,
    GanConfig,
    GoalsConfig,
    ImitationConfig,
    PolicyConfig,
    RolloutConfig,
    TrpoConfig,
    ValueConfig,
    too_much,
)

# What a resumed run must keep: another world or other randomness would be another run.
FIXED = (
    "env",
    "method",
    "seed",
    "map",
    "dim",
    "horizon",
    "action_repeat",
    "integrator",
    "physics",
    "out",
)


class ConfigError(UsageError):
    """Settings that cannot be run; the message says which and what to do."""


@dataclass(frozen=True)
class Config:
    """Learn to reach every free point of a maze: Goal GAN, recall traces, TRPO. The defaults shown
    are those of the environment given with --env, or of ant_umaze."""

    env: str = "ant_umaze"
    """Environment: {point,ant}_{umaze,spiral,medium,large} or point_nd. Picks the preset."""
    method: str = "recall_traces"
    """What to learn with: recall_traces, or one of the baselines and controls of methods.py. Picks
    settings; other flags come on top."""
    seed: int = 0
    """Seed of everything random."""
    iterations: int | None = None
    """Stop after this many iterations."""
    total_steps: int | None = None
    """Stop after this many environment steps of training."""
    minutes: float | None = None
    """Stop after this much wall time, minutes. What anneals then follows the clock, so that a seed
    alone does not repeat the run."""
    out: Path = Path("runs")
    """Folder of runs; this run gets a folder of its own in it."""
    resume: Path | None = None
    """Go on with this run (its folder): its settings are the defaults, and its limits, which count
    from its beginning, hold unless others are given. With later limits the exploration noise goes
    back up to where it would be in so long a run."""
    map: Path | None = None
    """Text map that replaces the maze: '#' wall, '.' free, 'S' start."""
    dim: int = 2
    """Dimensions of point_nd, 2 to 6."""
    horizon: int | None = None
    """Steps of an episode; by default 200 (point) or 500 (ant), more in longer mazes."""
    integrator: Literal["implicitfast", "rk4"] = "implicitfast"
    """MuJoCo's integrator; rk4 is the original's and costs four times as much."""
    physics: Literal["mujoco", "warp"] = "mujoco"
    """What simulates: MuJoCo on the CPU, or mujoco-warp, in single precision (extra `gpu`)."""
    device: str = "auto"
    """Where mujoco-warp runs: cpu, cuda, cuda:1, ...; auto is a GPU where there is one."""
    action_repeat: int = 1
    """Steps of 0.02 s for which the policy holds each action (the original: 1)."""
    threads: int = 0
    """Simulation threads of each process; 0 is one per core."""
    learning_threads: int = 1
    """Threads of torch. More than one pays only on idle cores: they wait for each other busily."""
    discount: float = 0.995
    """Discount factor per action (the original: 0.99)."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation (the original: 1)."""
    updates: int = 1
    """Policy updates per iteration (the original: 5)."""
    viz: Literal["browser", "none"] = "browser"
    """Where to watch: a page in the browser, in a process of its own, or nowhere."""
    viz_host: str = "127.0.0.1"
    """Where the page listens; 0.0.0.0 lets everybody on the network in, without a password."""
    viz_port: int = 8080
    """The page's port; if it is busy, the next free one is taken and printed."""
    report_every: int = 1
    """Iterations between two reports (a line on the terminal, a frame in the run folder)."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    value: ValueConfig = field(default_factory=ValueConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    goals: GoalsConfig = field(default_factory=GoalsConfig)
    gan: GanConfig = field(default_factory=GanConfig)
    trpo: TrpoConfig = field(default_factory=TrpoConfig)
    backtracking: BacktrackingConfig = field(default_factory=BacktrackingConfig)
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    coverage: CoverageConfig = field(default_factory=CoverageConfig)

    @property
    def num_threads(self) -> int:
        """Threads, with 0 resolved to this process's share of the cores that it may use."""
        processes = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # torchrun's, on this machine
        return self.threads or max(1, len(os.sched_getaffinity(0)) // processes)


ANT = Config(
    env="ant_umaze",
    total_steps=12_000_000,
    action_repeat=2,
    discount=0.993,
    updates=4,
    policy=PolicyConfig(init_std=0.2, final_std=0.07),
    rollout=RolloutConfig(num_envs=256, steps=50),
    gan=GanConfig(steps=50, generator_hidden=(128, 128)),
    backtracking=BacktrackingConfig(trace_length=50),
    imitation=ImitationConfig(steps=10, learning_rate=5e-5, max_kl=0.003, fade=0.3),
)
POINT = Config(
    env="point_umaze",
    total_steps=4_000_000,
    action_repeat=4,
    discount=0.97,
    updates=8,
    policy=PolicyConfig(input_gain=3.0, init_std=1.0, final_std=0.3),
    value=ValueConfig(input_gain=3.0, minibatch=128),
    rollout=RolloutConfig(num_envs=64, steps=20),
    goals=GoalsConfig(old=40, r_min=0.05),
    trpo=TrpoConfig(max_kl=0.015),
    backtracking=BacktrackingConfig(trace_length=20),
    imitation=ImitationConfig(steps=40, max_kl=0.05, fade=0.15),
    coverage=CoverageConfig(rollouts=2, every=250_000),
)


def preset(env: str) -> Config:
    """The default settings for an environment.

    Raises:
        ConfigError: if there is no such environment.
    """
    if env not in envs.NAMES:
        names = ", ".join([*envs.NAMES, "four_rooms_N", *locomotion.TASKS])
        raise ConfigError(f"unknown environment {env!r}: choose one of {names}")
    cfg = replace(ANT if env.startswith("ant") else POINT, env=env)
    if env == "point_nd":
        # The box is 0.6 m thin: among its neighbours' outcomes a goal's own is lost, and noise
        # throws it out of the box. No walls to be misled by: `near` is not needed.
        goals = replace(cfg.goals, near=math.inf, label_rollouts=3, old=100, anywhere=0.1)
        cfg = replace(cfg, goals=goals, gan=replace(cfg.gan, goal_noise=0.1, steps=100))
    return cfg


def with_method(cfg: Config, method: str) -> Config:
    """The same with the settings of a method.

    Raises:
        ConfigError: if there is no such method.
    """
    if method not in METHODS:
        raise ConfigError(f"unknown method {method!r}: choose one of {', '.join(METHODS)}")
    for name, value in METHODS[method].items():
        part, key = name.split(".")
        cfg = replace(cfg, **{part: replace(getattr(cfg, part), **{key: value})})
    return replace(cfg, method=method)


def check(cfg: Config) -> None:
    """Refuse settings that make no sense.

    Raises:
        ConfigError: naming the first such setting.
    """
    preset(cfg.env)  # is there such an environment?
    with_method(cfg, cfg.method)  # and such a method?
    above_zero = (
        "iterations total_steps minutes horizon action_repeat learning_threads updates "
        "report_every rollout.num_envs rollout.steps goals.new goals.near goals.episodes "
        "goals.neighbours policy.init_std policy.final_std policy.min_std policy.hidden "
        "policy.input_gain value.hidden value.input_gain value.learning_rate value.epochs "
        "value.minibatch gan.learning_rate gan.batch gan.steps gan.noise_dim gan.pretrain_steps "
        "gan.generator_hidden gan.discriminator_hidden trpo.max_kl trpo.cg_iters "
        "trpo.fisher_fraction trpo.line_search_decay backtracking.batch backtracking.buffer "
        "backtracking.learning_rate backtracking.hidden backtracking.min_transitions "
        "backtracking.max_shift imitation.batch imitation.learning_rate imitation.max_kl "
        "imitation.fade coverage.rollouts coverage.every"
    )
    not_negative = (
        "seed threads goals.old goals.labelled goals.replay_distance goals.label_rollouts "
        "gan.goal_noise backtracking.trace_length backtracking.steps backtracking.traces "
        "imitation.steps trpo.cg_damping trpo.line_search_steps"
    )
    shares = (
        "discount gae_lambda rollout.chain goals.anywhere goals.r_min goals.r_max "
        "trpo.fisher_fraction trpo.line_search_decay"
    )
    numbers = f"{above_zero} {not_negative}".split()
    bounded = " ".join(name for name in numbers if name != "goals.near")
    for names, good, what in (
        (above_zero, lambda x: x > 0, "greater than 0"),
        (not_negative, lambda x: x >= 0, "0 or more"),
        (shares, lambda x: 0 <= x <= 1, "between 0 and 1"),
        (" ".join(numbers), lambda x: x <= 1e12 or x == math.inf, "a sane number"),
        (bounded, lambda x: x < math.inf, "finite"),
    ):
        if bad := fault(cfg, names, good, what):
            raise ConfigError(bad)
    most = 8 * len(os.sched_getaffinity(0))
    if cfg.threads > most:
        raise ConfigError(f"--threads must be at most {most} on this machine, not {cfg.threads}")
    if not 0 <= cfg.viz_port <= 65535:
        raise ConfigError(f"--viz-port must be between 0 and 65535, not {cfg.viz_port}")
    if cfg.rollout.num_envs > 100_000:
        raise ConfigError(f"--rollout.num-envs must be at most 100000, not {cfg.rollout.num_envs}")
    if cfg.policy.final_std is not None and cfg.policy.final_std < cfg.policy.min_std:
        raise ConfigError("--policy.final-std must not be less than --policy.min-std")
    if cfg.goals.neighbours > cfg.goals.episodes:
        raise ConfigError("--goals.neighbours must not be more than --goals.episodes")
    if cfg.backtracking.min_transitions > cfg.backtracking.buffer:
        raise ConfigError(
            "--backtracking.min-transitions must not be more than --backtracking.buffer"
        )
    if problem := too_much(cfg.backtracking.trace_length, cfg.backtracking.traces):
        raise ConfigError(f"--backtracking: {problem}")
    if cfg.horizon is not None and cfg.horizon % cfg.action_repeat:
        raise ConfigError("--horizon must be a multiple of --action-repeat")
    if cfg.map is not None and cfg.env == "point_nd":
        raise ConfigError("point_nd has no walls: --map goes with point_... and ant_... mazes")
    if cfg.physics == "warp" and cfg.env == "point_nd":
        raise ConfigError(
            "point_nd is no MuJoCo model: --physics warp goes with point_... and ant_..."
        )
    if cfg.device != "auto" and cfg.physics != "warp":
        raise ConfigError("--device is mujoco-warp's: it goes with --physics warp")
    if not 2 <= cfg.dim <= 6:
        raise ConfigError(f"--dim must be 2 to 6, not {cfg.dim}")
    if cfg.dim != 2 and cfg.env != "point_nd":
        raise ConfigError(f"--dim goes with point_nd: {cfg.env} has two dimensions")
    if cfg.goals.source == "gan_fit_all" and cfg.goals.near == math.inf:
        raise ConfigError(
            "gan_fit_all needs to know the places visited: give a finite --goals.near"
        )
    if cfg.goals.r_min >= cfg.goals.r_max:
        raise ConfigError("--goals.r-min must be less than --goals.r-max")


def other_learner(argv: list[str]) -> ModuleType | None:
    """The learner, with settings of its own, of the environment that a command line names, unless
    it is one of those that this module knows."""
    others = four_rooms, locomotion
    return next((other for other in others if other.asked_for(argv)), None)


def from_command_line(argv: list[str] | None = None) -> Config:
    """The settings that the command line asks for: the preset of `--env`, then every other flag.

    With `--resume RUN` the run's own settings take the preset's place.

    Raises:
        UsageError: for an unknown flag or a value of the wrong kind.
        ConfigError: for a bad value.
        RunError: for a folder that is no run.
        SystemExit: after `--help`.
    """
    argv = sys.argv[1:] if argv is None else argv
    default = ANT
    if (run := value_of(argv, "--resume")) is not None:
        default = load(Path(run))
    elif (env := value_of(argv, "--env")) is not None:
        default = preset(env)
    if run is None and (method := value_of(argv, "--method")) is not None:
        default = with_method(default, method)
    cfg = parse(Config, argv, "python -m goalgan_bt.train", default)
    if run is not None:
        for name in FIXED:
            if getattr(cfg, name) != getattr(default, name):
                flag = "--" + name.replace("_", "-")
                raise ConfigError(f"{flag} of a run cannot change when it is resumed: drop it")
    check(cfg)
    return cfg


def save(cfg: Config, folder: Path) -> None:
    """Write the settings to `config.json` in a run folder."""
    write_settings(folder, asdict(cfg))


def load(folder: Path) -> Config:
    """The settings of a run folder.

    Raises:
        ConfigError: if its settings make no sense, or it is a run of another learner.
        RunError: if the folder is no run or its settings cannot be read.
    """
    if other_learner(["--env", env := env_of(folder)]):
        raise ConfigError(f"{folder} is a run of {env}, no maze: nothing of it can be loaded here")
    cfg = read_settings(Config, folder)
    try:
        check(cfg)
    except (UsageError, TypeError) as error:
        raise ConfigError(f"cannot read {folder / 'config.json'}: {error}") from None
    return cfg
