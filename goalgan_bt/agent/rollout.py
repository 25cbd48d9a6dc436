"""Rollouts: what the policy did in N simulations over T actions, and which episodes ended.

Simulations go on from one batch to the next, so that a batch of 50 actions and episodes of 250 fit
together. Where several processes train together, each runs its share of the simulations, with the
same random numbers that one process alone would give them.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from goalgan_bt.agent.policy import Actor, GaussianPolicy
from goalgan_bt.agent.settings import RolloutConfig
from goalgan_bt.envs.goal_env import GoalEnv, Ids, Step
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.runs import ranks
from goalgan_bt.runs.terminal import complain

Float32 = NDArray[np.float32]
NEARER = 0.25  # success radii by which the way left must be less to be nearer to the goal


@dataclass
class Rollouts:
    """A batch, time first (in memory, simulation first: see `flat`).

    obs: (T, N, obs_dim); actions: (T, N, act_dim) as sampled; rewards, terminated, truncated:
    (T, N); last_obs: (N, obs_dim) what followed the last step; truncated_obs: (K, obs_dim) what
    followed each truncated step, in the order of np.nonzero(truncated); goals: (T, N, goal_dim)
    the desired ones; origins, achieved: (T, N, goal_dim) the goals on which each step began and
    ended.
    """

    obs: Float32
    actions: Float32
    rewards: Float32
    terminated: BoolArray
    truncated: BoolArray
    last_obs: Float32
    truncated_obs: Float32
    goals: Float32
    origins: Float32
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


def flat(array: np.ndarray) -> Tensor:
    """(T, N, ...) as a tensor (N * T, ...), simulation by simulation, sharing its memory if it is
    one of the rollouts'. The rows of one process are then a piece of those of all processes."""
    return torch.from_numpy(array.swapaxes(0, 1)).flatten(0, 1)


@dataclass
class Episodes:
    """Episodes that ended in a batch, E of them, simulation by simulation.

    goals: (E, goal_dim); success: (E,) whether the goal was reached; from_start: (E,) whether the
    episode began in the start state; lengths: (E,) actions; ends: (E, goal_dim) where it ended;
    kept: (E,) whether its transitions are here.
    Transitions of those, M in all, in the order in which they happened: states, next_states
    (M, state_dim), actions (M, act_dim) as the body felt them.
    """

    goals: FloatArray
    success: BoolArray
    from_start: BoolArray
    lengths: NDArray[np.int64]
    ends: FloatArray
    kept: BoolArray
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
        keep: the transitions of which episodes: of none, of those that succeeded, or also of those
            that ran out of time.
    """

    def __init__(
        self,
        env: GoalEnv,
        cfg: RolloutConfig,
        rng: np.random.Generator,
        noise: torch.Generator,
        keep: Literal["none", "successes", "all"] = "successes",
    ) -> None:
        self._keep = keep
        self.env, self.cfg, self._rng, self._noise = env, cfg, rng, noise
        n = env.num_envs
        self._all = np.arange(n)
        self._total = ranks.size() * n
        self._mine = slice(ranks.rank() * n, (ranks.rank() + 1) * n)
        self._from_start = np.zeros(n, dtype=bool)
        self._start_achieved = env.achieved_goals(env.start_state[None])
        # Every unfinished episode, action by action: successes are known only when they end.
        self._age = np.zeros(n, dtype=np.int64)  # actions since the episode began
        # The least way left in the episode so far, metres, and the age at which that was.
        self._least = np.full(n, np.inf)
        self._nearest = np.zeros(n, dtype=np.int64)
        longest = math.ceil(env.horizon / env.action_repeat) if keep != "none" else 0
        self._states = np.zeros((longest + 1, n, env.state_dim), dtype=np.float32)
        self._actions = np.zeros((longest, n, env.act_dim), dtype=np.float32)
        self._obs = self._table(np.float32, env.obs_dim)
        self._sampled = self._table(np.float32, env.act_dim)
        self._rewards = self._table(np.float32)
        self._goals = self._table(np.float32, env.goal_dim)
        self._origins = self._table(np.float32, env.goal_dim)
        self._achieved = self._table(np.float32, env.goal_dim)
        self._terminated = self._table(np.bool_)
        self._truncated = self._table(np.bool_)

    def _table(self, dtype: type[np.generic], *row: int) -> NDArray[Any]:
        """Zeros, (T, N, *row), with the steps of one simulation side by side in memory."""
        return np.zeros((self.env.num_envs, self.cfg.steps, *row), dtype).swapaxes(0, 1)

    def state_dict(self) -> dict[str, Tensor]:
        """The simulations of all ranks, however many, and their unfinished episodes. All ranks
        must ask."""
        rows = self.env.state_dict() | {
            "age": self._age,
            "from_start": self._from_start,
            "least": self._least,
            "nearest": self._nearest,
        }
        for name, table, used, _ in self._so_far():
            rows[name] = table[used]
        return {name: torch.from_numpy(ranks.gather(row)) for name, row in rows.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take over what `state_dict` gave, to go on bit for bit; where that cannot be, because
        there are more simulations now, or fewer, or their states cannot be set, begin anew with
        goals of then.

        Raises:
            ValueError: if it is of another body or other times.
        """
        rows = {name: row.numpy() for name, row in state.items()}
        age, longest = rows["age"], math.ceil(self.env.horizon / self.env.action_repeat)
        if not self.env.settable or len(age) != self._total:
            complain("the simulations begin anew: this is not the same run, bit for bit", "note")
            self.begin(rows["goals"])
            return
        here = self.env.state_dict()
        for name, table in here.items():
            if rows[name].shape != (self._total, *table.shape[1:]):
                raise ValueError(f"the {name} of its simulations are of other sizes")
        if age.min() < 0 or age.max() >= longest:
            raise ValueError("its episodes are too long")
        if ((rows["nearest"] < 0) | (rows["nearest"] > age)).any():
            raise ValueError("its episodes came nearest to their goals when they were not there")
        if (rows["elapsed"] != age * self.env.action_repeat).any():
            raise ValueError("the clocks of its simulations do not fit their episodes")
        self.env.load_state_dict({name: rows[name][self._mine] for name in here})
        self._age[:], self._from_start[:] = age[self._mine], rows["from_start"][self._mine]
        self._least[:], self._nearest[:] = rows["least"][self._mine], rows["nearest"][self._mine]
        before = age[: self._mine.start]  # of other ranks
        for name, table, used, more in self._so_far():
            first = (before + more).clip(max=table.shape[1]).sum()
            table[used] = rows[name][first : first + used.sum()]

    def _so_far(self) -> Iterator[tuple[str, Float32, BoolArray, int]]:
        """The tables of actions and states, (N, T, ...), which of their rows are those of
        unfinished episodes, (N, T), and how many more an episode has than actions."""
        for name, table, more in ("actions", self._actions, 0), ("states", self._states, 1):
            used = np.arange(len(table)) < (self._age + more)[:, None]
            yield name, table.swapaxes(0, 1), used, more

    def begin(self, goals: FloatArray) -> None:
        """Start every simulation anew, each with one of the goals (G, goal_dim)."""
        self._reset(self._all, pick(goals, self._rng.random(self._total)[self._mine]))

    def achieved_goals(self) -> FloatArray:
        """Where the simulations of all ranks are, (N, goal_dim)."""
        return ranks.gather(self.env.achieved_goals(self.env.read_states(self._all)))

    def collect(self, policy: GaussianPolicy, goals: FloatArray) -> tuple[Rollouts, Episodes]:
        """Take `cfg.steps` actions in every simulation; new episodes draw from goals (G, goal_dim).
        The rollouts are this rank's, the episodes those of all ranks.

        The arrays of the rollouts are reused by the next call.
        """
        env, ids, steps = self.env, self._all, self.cfg.steps
        act = Actor(policy)
        noise = torch.randn(steps, self._total, env.act_dim, generator=self._noise)[:, self._mine]
        # For each step: a draw of whether the next episode is chained and of its goal.
        draws = self._rng.random((steps, 2, self._total))[..., self._mine]
        # Where truncated steps led, and where to they should have.
        late_states: list[FloatArray] = [np.empty((0, env.state_dim))]
        late_goals: list[FloatArray] = [np.empty((0, env.goal_dim))]
        ended: list[tuple[np.ndarray, ...]] = []  # Episodes' columns, with ids before them
        paths: list[tuple[int, Float32, Float32]] = []
        states = env.read_states(ids)
        achieved = env.achieved_goals(states)
        obs = env.observations(states, env.goals, achieved)
        for t in range(steps):
            actions = act(obs, noise[t])
            self._obs[t], self._sampled[t] = obs, actions
            self._goals[t], self._origins[t] = env.goals, achieved
            step = env.step(ids, actions)
            if self._keep != "none":
                self._actions[self._age, ids] = step.actions
                self._states[self._age + 1, ids] = step.states
            self._age += 1
            self._give_up(step)
            self._rewards[t], self._achieved[t] = step.rewards, step.achieved
            self._terminated[t], self._truncated[t] = step.terminated, step.truncated

            done = np.flatnonzero(step.terminated | step.truncated)
            states, achieved = step.states, step.achieved
            if len(done):
                reached = step.rewards[done] > 0
                fell = step.terminated[done] & ~reached
                kept = {"none": reached & ~reached, "successes": reached, "all": ~fell}[self._keep]
                lengths = self._age[done]
                goals_then, ends = env.goals[done], step.achieved[done]
                first = self._from_start[done]
                ended.append((done, goals_then, reached, first, lengths, ends, kept))
                for i, length in zip(done[kept], lengths[kept], strict=True):
                    paths.append(
                        (i, self._states[: length + 1, i].copy(), self._actions[:length, i].copy())
                    )
                late_states.append(states[step.truncated])
                late_goals.append(env.goals[step.truncated])
                chained = ~fell & (draws[t, 0, done] < self.cfg.chain)
                following = pick(goals, draws[t, 1, done])
                self._chain(done[chained], following[chained])
                anew = done[~chained]
                self._reset(anew, following[~chained])
                # Both are copies of this step; what was reached is computed only once.
                states[anew], achieved[anew] = self._begun(anew)
            obs = env.observations(states, env.goals, achieved)

        rollouts = Rollouts(
            self._obs,
            self._sampled,
            self._rewards,
            self._terminated,
            self._truncated,
            obs,
            env.observations(np.concatenate(late_states), np.concatenate(late_goals)),
            self._goals,
            self._origins,
            self._achieved,
        )
        return rollouts, self._episodes(ended, paths)

    def _give_up(self, step: Step) -> None:
        """Truncate those episodes that have come no nearer to their goals for too long."""
        env, patience = self.env, self.cfg.patience
        if not patience or env.heading is None:
            return
        left = np.linalg.norm(env.along(step.achieved, env.goals), axis=1)
        nearer = left < self._least - NEARER * env.success_radius
        self._least[nearer], self._nearest[nearer] = left[nearer], self._age[nearer]
        stuck = (self._age - self._nearest) * env.action_repeat >= patience
        step.truncated[stuck & ~step.terminated] = True

    def _reset(self, ids: Ids, goals: FloatArray) -> None:
        if len(ids) == 0:
            return
        self.env.reset(ids, goals)
        self._from_start[ids] = True
        self._begin_clock(ids)
        self._states[0, ids] = self._begun(ids)[0]

    def _begun(self, ids: Ids) -> tuple[FloatArray, FloatArray]:
        """States in which episodes have begun and where those are, of each or of all of them."""
        if self.env.settable:
            return self.env.start_state, self._start_achieved
        states = self.env.read_states(ids)
        return states, self.env.achieved_goals(states)

    def _chain(self, ids: Ids, goals: FloatArray) -> None:
        if len(ids) == 0:
            return
        if self._keep != "none":
            self._states[0, ids] = self._states[self._age[ids], ids]
        self._begin_clock(ids)
        self.env.set_goals(ids, goals)
        self._from_start[ids] = False

    def _begin_clock(self, ids: Ids) -> None:
        self._age[ids], self._least[ids], self._nearest[ids] = 0, np.inf, 0

    def _episodes(
        self, ended: list[tuple[np.ndarray, ...]], paths: list[tuple[int, Float32, Float32]]
    ) -> Episodes:
        env = self.env
        nowhere, no = np.empty((0, env.goal_dim)), np.empty(0, dtype=bool)
        none = np.empty(0, dtype=np.int64)
        nothing = (none, nowhere, no, no, none, nowhere, no)
        ids, *rows = (np.concatenate(column) for column in zip(nothing, *ended, strict=True))
        order = np.argsort(ids, kind="stable")
        goals, success, from_start, lengths, ends, kept = (ranks.gather(row[order]) for row in rows)
        paths.sort(key=itemgetter(0))
        no_states = np.empty((0, env.state_dim), np.float32)
        no_actions = np.empty((0, env.act_dim), np.float32)
        return Episodes(
            goals,
            success,
            from_start,
            lengths,
            ends,
            kept,
            ranks.gather(np.concatenate([no_states, *(s[:-1] for _, s, _ in paths)])),
            ranks.gather(np.concatenate([no_actions, *(a for *_, a in paths)])),
            ranks.gather(np.concatenate([no_states, *(s[1:] for _, s, _ in paths)])),
        )


def pick(goals: FloatArray, draws: FloatArray) -> FloatArray:
    """Goals (G, goal_dim) chosen by uniform draws from [0, 1), (n,) -> (n, goal_dim)."""
    return goals[(draws * len(goals)).astype(np.int64)]
