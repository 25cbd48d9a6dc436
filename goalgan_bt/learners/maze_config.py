"""The settings of a maze run: those of each part, composed, and a preset per environment."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from goalgan_bt import envs
from goalgan_bt.agent.settings import (
    CoverageConfig,
    PolicyConfig,
    RolloutConfig,
    TrpoConfig,
    ValueConfig,
)
from goalgan_bt.curriculum.settings import GanConfig, GoalsConfig, conflicts
from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.envs.maze import Maze
from goalgan_bt.learners.methods import METHODS
from goalgan_bt.learners.run_config import RunConfig
from goalgan_bt.recall.settings import BacktrackingConfig, ImitationConfig, PlacesConfig, too_much
from goalgan_bt.runs.errors import RunError, UsageError, require_installed
from goalgan_bt.runs.ranges import ABOVE_ZERO, NOT_NEGATIVE, SHARE, Range, between
from goalgan_bt.runs.run_folder import maze_of


@dataclass(frozen=True)
class MazeConfig(RunConfig):
    """Learn to reach every free point of a maze: Goal GAN, recall traces, TRPO. The defaults shown
    are those of the environment given with --env, or of ant_umaze."""

    env: str = "ant_umaze"
    """Environment, of those listed at the end. Picks the learner and its preset."""
    method: str = "recall_traces"
    """What to learn with: recall_traces (over places), recall_traces_paper (over full states);
    without recall goal_gan, gan_fit_all, uniform, feasible, oracle, alp_gmm; controls of the first:
    shaping_only, heading_only, goals_only, straight_line, with_traces, with_hindsight,
    feasible_places; of traces over full states: traces_only, no_imitation, random_model,
    self_imitation, hindsight, value_seeds, forward_model. Picks settings; other flags come on
    top."""
    resume: Path | None = None
    """Go on with this run (its folder): its settings are the defaults, and its limits, which count
    from its beginning, hold unless others are given. With later limits the exploration noise goes
    back up to where it would be in so long a run."""
    iterations: Annotated[int | None, ABOVE_ZERO] = None
    """Stop after this many iterations."""
    minutes: Annotated[float | None, ABOVE_ZERO] = None
    """Stop after this much wall time, minutes. What anneals then follows the clock, so that a seed
    alone does not repeat the run."""
    map: Path | None = None
    """Text map that replaces the maze: '#' wall, '.' free, 'S' start."""
    cell_size: Annotated[float, between(0.5, 20.0)] = 2.0
    """Side of a cell of the maze, metres."""
    dim: Annotated[int, Range("2 to 6", 2, 6)] = 2
    """Dimensions of point_nd, 2 to 6."""
    horizon: Annotated[int | None, between(1, 10**6)] = None
    """Steps of an episode; None: 200 (point) or 500 (ant), more in long or official mazes."""
    integrator: Literal["implicitfast", "rk4", "own"] = "implicitfast"
    """MuJoCo's integrator; rk4 is the original's and costs four times as much; own is that of the
    body's model, which the official tasks (..._gym) have."""
    physics: Literal["mujoco", "warp"] = "mujoco"
    """What simulates: MuJoCo on the CPU, or mujoco-warp, in single precision (extra `gpu`)."""
    device: str = "auto"
    """Where mujoco-warp runs: cpu, cuda, cuda:1, ...; auto is a GPU where there is one."""
    action_repeat: Annotated[int, between(1, 1000)] = 1
    """Steps for which the policy holds each action (the original: 1); one is 0.02 s, in official
    tasks 0.05 s (ant) or 0.01 s (point)."""
    threads: Annotated[int, NOT_NEGATIVE] = 0
    """Simulation threads of each process; 0 is one per core."""
    learning_threads: Annotated[int, ABOVE_ZERO] = 1
    """Threads of torch. More than one pays only on idle cores: they wait for each other busily."""
    discount: Annotated[float, SHARE] = 0.995
    """Discount factor per action (the original: 0.99)."""
    gae_lambda: Annotated[float, SHARE] = 0.95
    """Lambda of generalised advantage estimation (the original: 1)."""
    updates: Annotated[int, ABOVE_ZERO] = 1
    """Policy updates per iteration (the original: 5)."""
    report_every: Annotated[int, ABOVE_ZERO] = 1
    """Iterations between two reports (a line on the terminal, a frame in the run folder)."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    value: ValueConfig = field(default_factory=ValueConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    goals: GoalsConfig = field(default_factory=GoalsConfig)
    gan: GanConfig = field(default_factory=GanConfig)
    trpo: TrpoConfig = field(default_factory=TrpoConfig)
    places: PlacesConfig = field(default_factory=PlacesConfig)
    backtracking: BacktrackingConfig = field(default_factory=BacktrackingConfig)
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    coverage: CoverageConfig = field(default_factory=CoverageConfig)

    @property
    def num_threads(self) -> int:
        """Threads, with 0 resolved to this process's share of the cores that it may use."""
        processes = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))  # torchrun's, on this machine
        return self.threads or max(1, len(os.sched_getaffinity(0)) // processes)


# What a resumed run may change: another world or other randomness would be another run.
FIXED = {
    *("env", "method", "seed", "map", "cell_size", "dim", "horizon", "action_repeat"),
    *("integrator", "physics", "out"),
}
MAY_CHANGE = frozenset(field.name for field in fields(MazeConfig)) - FIXED

ANT = MazeConfig(
    env="ant_umaze",
    total_steps=12_000_000,
    action_repeat=2,
    discount=0.993,
    gae_lambda=0.9,
    updates=4,
    policy=PolicyConfig(init_std=0.2, final_std=0.07),
    rollout=RolloutConfig(num_envs=256, steps=50, patience=300),
    goals=GoalsConfig(frontier=1.4, imagined=4),
    gan=GanConfig(steps=50, generator_hidden=(128, 128)),
    backtracking=BacktrackingConfig(trace_length=50),
    imitation=ImitationConfig(steps=10, learning_rate=5e-5, max_kl=0.003, fade=0.3),
)
POINT = MazeConfig(
    env="point_umaze",
    total_steps=2_000_000,
    action_repeat=4,
    discount=0.97,
    updates=8,
    policy=PolicyConfig(input_gain=3.0, init_std=1.0, final_std=0.3),
    value=ValueConfig(input_gain=3.0, minibatch=128),
    rollout=RolloutConfig(num_envs=64, steps=20),
    goals=GoalsConfig(old=40, r_min=0.05, frontier=0.7, imagined=4),
    trpo=TrpoConfig(max_kl=0.015),
    places=PlacesConfig(shaping=0.3, cell=0.15),
    backtracking=BacktrackingConfig(trace_length=20),
    imitation=ImitationConfig(steps=40, max_kl=0.05, fade=0.15),
    coverage=CoverageConfig(rollouts=2, every=250_000),
)


def knows(env: str) -> bool:
    """Whether it is an environment with this learner.

    Raises:
        OwnEnvError: for one's own that is none, or that nobody has allowed.
    """
    return env in envs.NAMES or envs.own.find(env) is not None


def preset(env: str, method: str | None = None) -> MazeConfig:
    """The default settings for an environment and a method.

    Raises:
        UsageError: if there is no such environment or method.
    """
    if mine := envs.own.find(env):
        cfg = own_preset(env, mine)
        return cfg if method is None else with_method(cfg, method)
    if env not in envs.NAMES:
        raise UsageError(f"unknown environment {env!r}: choose one of {', '.join(envs.NAMES)}")
    cfg = replace(ANT if env.startswith("ant") else POINT, env=env)
    if env == "ant_large":  # many and long ways take more steps, and measuring them more time
        measured = replace(cfg.coverage, every=10_000_000)
        cfg = replace(cfg, total_steps=20_000_000, coverage=measured)
    if env == "point_nd":
        # The box is 0.6 m thin: among its neighbours' outcomes a goal's own is lost, and noise
        # throws it out of the box. No walls to be misled by: `near` is not needed.
        goals = replace(cfg.goals, near=math.inf, label_rollouts=3, old=100, anywhere=0.1)
        # What lies beyond the frontier has too many sides to be tried. All ways are straight, and
        # traces of full states help to go them.
        cfg = replace(
            cfg,
            goals=replace(goals, frontier=0.0, imagined=1),
            gan=replace(cfg.gan, goal_noise=0.1, steps=100),
            places=replace(cfg.places, way="straight"),
            imitation=replace(cfg.imitation, source="traces"),
        )
    if env in envs.OFFICIAL:
        # A step of the Ant is 0.05 s there, one of the point 0.01 s.
        cfg = replace(cfg, integrator="own", action_repeat=5)
        if env.startswith("ant"):  # the same seconds of patience; episodes are long, so try fewer
            cfg = replace(
                cfg,
                total_steps=6_000_000,
                action_repeat=1,
                rollout=replace(cfg.rollout, patience=120),
                coverage=replace(cfg.coverage, rollouts=1),
            )
    return cfg if method is None else with_method(cfg, method)


def own_preset(env: str, mine: envs.own.Own) -> MazeConfig:
    """The default settings for an environment of one's own.

    Raises:
        UsageError: for settings in its preset that there are not.
    """
    settings = dict(mine.preset)
    base = settings.pop("like", "ant_umaze")
    for name in ("env", "method", "resume", "out"):
        if name in settings:
            raise UsageError(f"the preset of {env} cannot say {name}")
    if base not in envs.NAMES:
        raise UsageError(f"the preset of {env} is like {base!r}, which is no environment of ours")
    try:
        return replace(with_settings(preset(base), settings), env=env)
    except (AttributeError, TypeError) as error:
        raise UsageError(f"the preset of {env} has settings that there are not: {error}") from None


def with_method(cfg: MazeConfig, method: str) -> MazeConfig:
    """The same with the settings of a method.

    Raises:
        UsageError: if there is no such method.
    """
    if method not in METHODS:
        raise UsageError(f"unknown method {method!r}: choose one of {', '.join(METHODS)}")
    return replace(with_settings(cfg, METHODS[method]), method=method)


def with_settings(cfg: MazeConfig, settings: Mapping[str, Any]) -> MazeConfig:
    """The same with other values for settings by name, those of a part as `trpo.max_kl`.

    Raises:
        AttributeError, TypeError: for a setting that there is not.
    """
    for name, value in settings.items():
        part, dot, key = name.partition(".")
        if not dot and is_dataclass(getattr(cfg, part, None)):
            raise TypeError(f"{part} is a part: say {part}.NAME")
        there = replace(getattr(cfg, part), **{key: value}) if dot else value
        cfg = replace(cfg, **{part: there})
    return cfg


def check(cfg: MazeConfig) -> None:
    """Refuse settings that make no sense.

    Raises:
        UsageError: naming the first such setting.
    """
    with_method(cfg, cfg.method)  # is there such a one?
    most = 8 * len(os.sched_getaffinity(0))
    if cfg.threads > most:
        raise UsageError(f"--threads must be at most {most} on this machine, not {cfg.threads}")
    if cfg.learning_threads > most:
        raise UsageError(
            f"--learning-threads must be at most {most} on this machine, not {cfg.learning_threads}"
        )
    if cfg.policy.final_std is not None and cfg.policy.final_std < cfg.policy.min_std:
        raise UsageError("--policy.final-std must not be less than --policy.min-std")
    if problem := cfg.places.problem():
        raise UsageError(f"--places.{problem}")
    for name, wrong in conflicts(cfg.goals):
        raise UsageError(f"--goals.{name.replace('_', '-')} {wrong}")
    if cfg.backtracking.min_transitions > cfg.backtracking.buffer:
        raise UsageError(
            "--backtracking.min-transitions must not be more than --backtracking.buffer"
        )
    if problem := too_much(cfg.backtracking.trace_length, cfg.backtracking.traces):
        raise UsageError(f"--backtracking: {problem}")
    if cfg.horizon is not None and cfg.horizon % cfg.action_repeat:
        raise UsageError("--horizon must be a multiple of --action-repeat")
    if cfg.map is not None and cfg.env == "point_nd":
        raise UsageError("point_nd has no walls: --map goes with point_... and ant_... mazes")
    if cfg.env in envs.OFFICIAL and (cfg.map is not None or cfg.cell_size != 2.0):
        raise UsageError(f"{cfg.env} is an official maze: it takes no --map and no --cell-size")
    if cfg.cell_size != 2.0 and cfg.env == "point_nd":
        raise UsageError("point_nd has no cells: --cell-size goes with mazes")
    if cfg.physics == "warp" and cfg.env == "point_nd":
        raise UsageError(
            "point_nd is no MuJoCo model: --physics warp goes with point_... and ant_..."
        )
    if cfg.device != "auto" and cfg.physics != "warp":
        raise UsageError("--device is mujoco-warp's: it goes with --physics warp")
    if cfg.goals.source == "alp_gmm":
        require_installed("study", "sklearn")
    if cfg.dim != 2 and cfg.env != "point_nd":
        raise UsageError(f"--dim goes with point_nd: {cfg.env} has two dimensions")


def make_env(cfg: MazeConfig, num_envs: int, maze: Maze | None = None) -> GoalEnv:
    """The environment that the settings name, in another maze if one is given. A run that goes on
    does so in the maze that its folder has recorded: a map's file may be another by now, or gone.

    Raises:
        MapError: for a map that is not a maze.
        RunError: if the maze that was recorded cannot be read.
    """
    if maze is None and cfg.resume is not None:
        try:
            maze = maze_of(cfg.resume)
        except RunError as error:
            if cfg.map is not None:
                raise RunError(f"{error}, and the run's maze was in it") from None
        if maze is None and cfg.map is not None:
            raise RunError(
                f"{cfg.resume / 'meta.json'} holds no maze: the run cannot go on in its own"
            )
    return envs.make(
        cfg.env,
        num_envs,
        threads=cfg.num_threads,
        horizon=cfg.horizon,
        action_repeat=cfg.action_repeat,
        integrator=cfg.integrator,
        dim=cfg.dim,
        cell_size=cfg.cell_size,
        map_file=cfg.map,
        maze=maze,
        physics=cfg.physics,
        device=cfg.device,
    )
