"""Rollouts: what the policy did in N simulations over T actions, and which episodes ended.

Simulations go on from one batch to the next, so that a batch of 50 actions and episodes of 250 fit
together.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from goalgan_bt.envs.batch import GoalEnv, Ids
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.policy import GaussianPolicy

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class RolloutConfig:
    """Collection of experience."""

    num_envs: int = 512
    """Simulations side by side."""
    steps: int = 100
    """Actions in each simulation per policy update; the batch has num_envs * steps of them."""
    chain: float = 0.5
    """Chance that an episode that ended on its feet is followed by one from where it ended, with a
    new goal, instead of one from the start (the original: 0). Only episodes from the start make
    labels."""


@dataclass
class Rollouts:
    """A batch, time first.

    obs: (T, N, obs_dim); actions: (T, N, act_dim) as sampled; rewards, terminated, truncated:
    (T, N); last_obs: (N, obs_dim) what followed the last step; truncated_obs: (K, obs_dim) what
    followed each truncated step, in the order of np.nonzero(truncated); achieved: (T, N, goal_dim)
    the goal on which each step ended.
    """

    obs: Float32
    actions: Float32
    rewards: Float32
    terminated: BoolArray
    truncated: BoolArray
    last_obs: Float32
    truncated_obs: Float32
    achieved: Float32

    def paths(self, n: int) -> Float32:
        """Where the first n simulations went, (T, n, goal_dim), NaN at the first step of another
        episode."""
        ended = (self.terminated | self.truncated)[:, :n, None]
        begun = np.concatenate([np.zeros_like(ended[:1]), ended[:-1]])
        return np.where(begun, np.float32(np.nan), self.achieved[:, :n])

    def next_values(self, values: Float32, value: Callable[[Float32], Float32]) -> Float32:
        """V of the state that followed each step, (T, N), given V of `obs`, (T, N)."""
        following = np.concatenate([values[1:], value(self.last_obs)[None]])
        if len(self.truncated_obs):
            following[self.truncated] = value(self.truncated_obs)
        return following


@dataclass
class Episodes:
    """Episodes that ended in a batch, E of them.

    goals: (E, goal_dim); success: (E,) whether the goal was reached; from_start: (E,) whether the
    episode began in the start state; lengths: (E,) actions.
    Transitions of the successful ones, M in all, in the order in which they happened: states,
    next_states (M, state_dim), actions (M, act_dim) as the body felt them.
    """

    goals: FloatArray
    success: BoolArray
    from_start: BoolArray
    lengths: NDArray[np.int64]
    states: Float32
    actions: Float32
    next_states: Float32


class Collector:
    """Runs the policy in the environment and remembers the unfinished episodes.

    Args:
        env: the simulations, all of which belong to this collector from now on.
        cfg: settings.
        rng: draws goals and chains.
        noise: draws actions.
    """

    def __init__(
        self,
        env: GoalEnv,
        cfg: RolloutConfig,
        rng: np.random.Generator,
        noise: torch.Generator,
    ) -> None:
        self.env, self.cfg, self._rng, self._noise = env, cfg, rng, noise
        n = env.num_envs
        self._all = np.arange(n)
        self._from_start = np.zeros(n, dtype=bool)
        # Every unfinished episode, action by action: successes are known only when they end.
        self._age = np.zeros(n, dtype=np.int64)  # actions since the episode began
        longest = math.ceil(env.horizon / env.action_repeat)
        self._states = np.zeros((longest + 1, n, env.state_dim), dtype=np.float32)
        self._actions = np.zeros((longest, n, env.act_dim), dtype=np.float32)
        shape = (cfg.steps, n)
        self._obs = np.zeros((*shape, env.obs_dim), dtype=np.float32)
        self._sampled = np.zeros((*shape, env.act_dim), dtype=np.float32)
        self._rewards = np.zeros(shape, dtype=np.float32)
        self._achieved = np.zeros((*shape, env.goal_dim), dtype=np.float32)
        self._terminated = np.zeros(shape, dtype=bool)
        self._truncated = np.zeros(shape, dtype=bool)

    def begin(self, goals: FloatArray) -> None:
        """Start every simulation anew, each with one of the goals (G, goal_dim)."""
        self._reset(self._all, goals)

    def collect(self, policy: GaussianPolicy, goals: FloatArray) -> tuple[Rollouts, Episodes]:
        """Take `cfg.steps` actions in every simulation; new episodes draw from goals (G, goal_dim).

        The arrays of the rollouts are reused by the next call.
        """
        env, ids = self.env, self._all
        truncated_obs = []
        ended: list[tuple[Ids, BoolArray, FloatArray, BoolArray, NDArray[np.int64]]] = []
        successes: list[tuple[Float32, Float32]] = []
        obs = env.observe(ids)
        for t in range(self.cfg.steps):
            actions = policy.act(obs, self._noise)
            self._obs[t], self._sampled[t] = obs, actions
            step = env.step(ids, actions)
            self._actions[self._age, ids] = step.actions
            self._age += 1
            self._states[self._age, ids] = step.states
            self._rewards[t], self._achieved[t] = step.rewards, step.achieved
            self._terminated[t], self._truncated[t] = step.terminated, step.truncated

            done = np.flatnonzero(step.terminated | step.truncated)
            obs = step.obs
            if len(done):
                reached = step.rewards[done] > 0
                lengths = self._age[done]
                ended.append((done, reached, env.goals[done], self._from_start[done], lengths))
                for i, length in zip(done[reached], lengths[reached], strict=True):
                    successes.append(
                        (self._states[: length + 1, i].copy(), self._actions[:length, i].copy())
                    )
                truncated_obs.append(obs[step.truncated])
                fell = step.terminated[done] & ~reached
                chained = ~fell & (self._rng.random(len(done)) < self.cfg.chain)
                self._chain(done[chained], goals)
                self._reset(done[~chained], goals)
                obs[done] = env.observe(done)

        rollouts = Rollouts(
            self._obs,
            self._sampled,
            self._rewards,
            self._terminated,
            self._truncated,
            obs,
            np.concatenate([np.empty((0, env.obs_dim), np.float32), *truncated_obs]),
            self._achieved,
        )
        return rollouts, self._episodes(ended, successes)

    def _draw(self, goals: FloatArray, n: int) -> FloatArray:
        return goals[self._rng.integers(len(goals), size=n)]

    def _reset(self, ids: Ids, goals: FloatArray) -> None:
        if len(ids) == 0:
            return
        self.env.reset(ids, self._draw(goals, len(ids)))
        self._from_start[ids] = True
        self._age[ids] = 0
        self._states[0, ids] = self.env.start_state

    def _chain(self, ids: Ids, goals: FloatArray) -> None:
        self._states[0, ids] = self._states[self._age[ids], ids]
        self._age[ids] = 0
        self.env.set_goals(ids, self._draw(goals, len(ids)))
        self._from_start[ids] = False

    def _episodes(self, ended: list[Any], successes: list[tuple[Float32, Float32]]) -> Episodes:
        env = self.env
        _, reached, goals, from_start, lengths = (
            [np.concatenate(column) for column in zip(*ended, strict=True)]
            if ended
            else [np.empty(0)] * 2 + [np.empty((0, env.goal_dim))] + [np.empty(0)] * 2
        )
        no_states = np.empty((0, env.state_dim), np.float32)
        return Episodes(
            goals,
            reached.astype(bool),
            from_start.astype(bool),
            lengths.astype(np.int64),
            np.concatenate([no_states, *(s[:-1] for s, _ in successes)]),
            np.concatenate([np.empty((0, env.act_dim), np.float32), *(a for _, a in successes)]),
            np.concatenate([no_states, *(s[1:] for s, _ in successes)]),
        )
