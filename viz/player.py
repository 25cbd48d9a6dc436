"""Episodes of a run's policies, in simulations of the view's own."""

import os
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch

from goalgan_bt.agent.coverage import attempts
from goalgan_bt.agent.policy import GaussianPolicy
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.envs.mujoco_env import MujocoEnv
from goalgan_bt.learners.maze_learner import load_policy
from goalgan_bt.learners.trained_policy import settings_of, world_of
from goalgan_bt.recall.places import unit
from goalgan_bt.runs import checkpoint
from goalgan_bt.runs.policies import kept_policy


@dataclass(frozen=True)
class Attempt:
    """Episodes side by side.

    goals: (n, goal_dim); states: (T + 1, n, state_dim), each held still after its end;
    ends: (n,) the action after which each ended; reached: (n,); fell: (n,), or failed otherwise;
    dt: seconds between two states.
    """

    goals: FloatArray
    states: FloatArray
    ends: np.ndarray
    reached: BoolArray
    fell: BoolArray
    dt: float

    def outcome(self, i: int) -> str:
        """How an episode ended, in a word or two."""
        return "reached" if self.reached[i] else "fell" if self.fell[i] else "not reached"

    @property
    def seconds(self) -> float:
        """How long the longest episode took."""
        return float(self.ends.max() * self.dt)


class Player:
    """Plays the policies of a run that learns to reach goals.

    Args:
        folder: the run folder.
        seed: of the goals that it picks by itself and of the policy's noise.

    Attributes:
        env: its simulations; iteration: of the policy, 0 while there is none.

    Raises:
        RunError: if the run's settings cannot be read.
    """

    def __init__(self, folder: Path, seed: int = 0) -> None:
        torch.set_num_threads(1)  # the trainer needs the cores
        self._folder = folder
        goals = len(world_of(folder, 1)[1].test_goals())
        _, self.env = world_of(folder, goals)
        self._policy: GaussianPolicy | None = None
        self._tried: tuple[str, int] | None = None  # the file last looked at, and its time
        self.iteration = 0
        self.rng = np.random.default_rng(seed)

    @property
    def model(self) -> mujoco.MjModel | None:
        """The MuJoCo model, or None for the N-dimensional point mass."""
        return self.env.model if isinstance(self.env, MujocoEnv) else None

    def take_newest(self) -> bool:
        """Load the checkpoint if it is new and whole; whether there is a policy to play."""
        return self.take(None)

    def take(self, iteration: int | None) -> bool:
        """Load the policy of an iteration, or the last one before it that the run has kept; the
        newest if None, or where none was kept. Whether there is a policy to play."""
        kept = kept_policy(self._folder, iteration)
        self._load(kept)
        if self._policy is None and kept is not None:  # it is damaged: rather another than none
            self._load(None)
        return self._policy is not None

    def _load(self, kept: Path | None) -> None:
        """Take up a policy that was kept, or that of the checkpoint, unless it is the last one
        that was looked at."""
        path = kept or self._folder / checkpoint.NAME
        try:
            asked = path.name, os.stat(path).st_mtime_ns
            if asked != self._tried:
                self._tried = asked
                cfg = settings_of(self._folder)  # a resumed run may have others
                self._policy, self.iteration = load_policy(self.env, cfg, self._folder, kept)
        except (OSError, ValueError):
            pass  # none yet, or another version: the last one will do

    def attempt(self, goals: FloatArray, deterministic: bool = False) -> Attempt:
        """Try each goal once from the start.

        Args:
            goals: (n, goal_dim) metres, at most as many as there are test goals.
            deterministic: without the policy's noise.
        """
        assert self._policy is not None, "take_newest() says whether there is a policy"
        env, n = self.env, len(goals)
        seed = int(self.rng.integers(2**31))
        noise = None if deterministic else torch.Generator().manual_seed(seed)
        states = [np.tile(env.start_state, (n, 1))]
        reached, fell = np.zeros((2, n), dtype=bool)
        ends = np.zeros(n, dtype=np.int64)
        for active, step in attempts(env, self._policy, goals, noise):
            states.append(states[-1].copy())
            states[-1][active] = step.states
            ends[active] = len(states) - 1
            reached[active] = step.rewards > 0
            fell[active] = step.terminated & (step.rewards == 0)
        return Attempt(goals, np.array(states), ends, reached, fell, env.dt * env.action_repeat)

    def ways(self, goal: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Which way leads to a goal, (1, goal_dim), from each test goal: those places, and
        directions of length 1, (K, goal_dim) each. None where the policy goes by no heading."""
        places = self.env.test_goals()
        if self.env.heading is None:
            return places[:0], places[:0]
        return places, unit(self.env.heading(places, np.repeat(goal, len(places), axis=0)))

    def trail(self, attempt: Attempt) -> FloatArray:
        """Where the first body of an attempt was, (T + 1, goal_dim)."""
        return np.asarray(self.env.achieved_goals(attempt.states[:, 0]))

    def some_goal(self) -> FloatArray:
        """A feasible goal at random, (1, goal_dim)."""
        return self.rng.choice(self.env.test_goals(), size=1)
