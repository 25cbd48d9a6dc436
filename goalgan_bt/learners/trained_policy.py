"""A policy that was trained, to be used: by a program of one's own, and by the page.

policy = goalgan_bt.load_policy("runs/ant_umaze-...")
action = policy.act(observation, goal)
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from goalgan_bt.agent.policy import Actor
from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.learners import maze_learner
from goalgan_bt.learners.maze_config import MazeConfig, make_env
from goalgan_bt.learners.table import load
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.run_folder import maze_of


def settings_of(folder: Path) -> MazeConfig:
    """The settings of a run, on MuJoCo, where it may have been on mujoco-warp.

    Raises:
        RunError: if the folder is no run of a maze.
    """
    cfg = load(folder)
    if not isinstance(cfg, MazeConfig):
        raise RunError(f"{folder} is a run of {cfg.env}, no maze: nothing of it can be loaded here")
    return replace(cfg, threads=1, physics="mujoco", device="auto", resume=None)


def world_of(
    folder: Path, num_envs: int, threads: int = 1, horizon: int | None = None
) -> tuple[MazeConfig, GoalEnv]:
    """The settings of a run and simulations of its world, by so many threads (0: one per core).

    Args:
        folder: the run folder.
        num_envs, threads: of the simulations.
        horizon: steps of an episode; None: as many as in the run.

    Raises:
        RunError: if the folder is no run of a maze.
    """
    cfg = settings_of(folder)
    cfg = replace(cfg, threads=threads, horizon=horizon or cfg.horizon)
    return cfg, make_env(cfg, num_envs, maze_of(folder))


class TrainedPolicy:
    """The policy of a run of a maze or a box.

    Args:
        folder: the run folder; its last checkpoint counts.
        seed: of the policy's noise, where it acts with any.

    Attributes:
        env: one simulation of its world, which knows sizes, goals, and what a state is.
        iteration: the one that made the policy.

    Raises:
        RunError: if the folder is no such run, or has no checkpoint that can be read.
    """

    def __init__(self, folder: Path | str, seed: int = 0) -> None:
        folder = Path(folder)
        cfg, self.env = world_of(folder, 1)
        policy, self.iteration = maze_learner.load_policy(self.env, cfg, folder)
        self._act = Actor(policy)
        self._noise = torch.Generator().manual_seed(seed)

    def act(
        self, observation: ArrayLike, goal: ArrayLike, deterministic: bool = True
    ) -> NDArray[np.float64]:
        """What the body shall do, (act_dim,) or (n, act_dim) in [-1, 1]: for `GoalEnv.advance`, or
        the motors of a body like it. (`GoalEnv.step` takes what the policy says instead, which for
        the Ant is in another numbering of its legs.)

        Args:
            observation: the state of the body, (state_dim,) or (n, state_dim): for the point its
                place and velocity, for the Ant `qpos` and `qvel` (see the classes in
                `goalgan_bt.envs`).
            goal: where it shall go, (goal_dim,) or (n, goal_dim), metres.
            deterministic: without the noise of exploration.

        Raises:
            UsageError: for arrays that do not fit.
        """
        env, state = self.env, np.asarray(observation, dtype=float)
        states, goals = np.atleast_2d(state), np.atleast_2d(np.asarray(goal, dtype=float))
        if states.shape[1:] != (env.state_dim,) or goals.shape != (len(states), env.goal_dim):
            raise UsageError(
                f"an observation is {env.state_dim} numbers and a goal {env.goal_dim}, or as many "
                f"rows of both, not {state.shape} and {np.shape(goal)}"
            )
        noise = None
        if not deterministic:
            noise = torch.randn(len(states), env.act_dim, generator=self._noise)
        said = np.clip(self._act(env.observations(states, goals), noise), -1.0, 1.0)
        actions = np.asarray(env.to_body(said, states, goals), dtype=float)
        return actions if state.ndim == 2 else actions[0]


def load_policy(folder: Path | str, seed: int = 0) -> TrainedPolicy:
    """The policy of a run of a maze or a box, as its last checkpoint has it (see `TrainedPolicy`).

    Args:
        folder: the run folder.
        seed: of the policy's noise, where it acts with any.

    Raises:
        RunError: if the folder is no such run, or has no checkpoint that can be read.
    """
    return TrainedPolicy(folder, seed)
