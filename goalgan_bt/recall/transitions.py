"""The transitions that the agent has had, and the steps that it may imitate."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.recall.settings import BacktrackingConfig

Float32 = NDArray[np.float32]


class Steps(NamedTuple):
    """n steps to imitate: states (n, state_dim), actions (n, act_dim) in [-1, 1] as the body felt
    them, goals (n, goal_dim) that they led to."""

    states: FloatArray
    actions: FloatArray
    goals: FloatArray

    def lesson(self, env: GoalEnv) -> tuple[Tensor, Tensor]:
        """Those steps as the policy would see and say them: observations (n, obs_dim), actions
        (n, act_dim)."""
        actions = env.from_body(self.actions, self.states, self.goals)
        obs = env.observations(self.states, self.goals)
        return torch.from_numpy(obs), torch.from_numpy(actions).float()


class Transitions:
    """A ring of transitions (s, a, s') of episodes (see `cfg.experience`), each one's in order.

    Attributes:
        states, next_states: (capacity, state_dim); actions: (capacity, act_dim); goals:
            (capacity, goal_dim) what the episode reached; left: (capacity,) how many more actions
            it took after this one. The first `size` rows count.
        cursor: where the next row goes; added: rows so far; learned: those that a model has seen.
    """

    COLUMNS = ("states", "actions", "next_states", "goals", "left")

    def __init__(
        self, state_dim: int, act_dim: int, goal_dim: int, cfg: BacktrackingConfig
    ) -> None:
        capacity, self._minimum = cfg.buffer, cfg.min_transitions
        self.states = np.zeros((capacity, state_dim), np.float32)
        self.actions = np.zeros((capacity, act_dim), np.float32)
        self.next_states = np.zeros((capacity, state_dim), np.float32)
        self.goals = np.zeros((capacity, goal_dim), np.float32)
        self.left = np.zeros(capacity, np.int32)
        self.size, self.cursor, self.added, self.learned = 0, 0, 0, 0

    def add(self, *columns: np.ndarray) -> None:
        """Append rows of all `COLUMNS`; the oldest make room."""
        capacity = len(self.states)
        n = len(columns[0])
        rows = (self.cursor + np.arange(max(0, n - capacity), n)) % capacity
        for name, column in zip(self.COLUMNS, columns, strict=True):
            getattr(self, name)[rows] = column[-capacity:]
        self.cursor = (self.cursor + n) % capacity
        self.size, self.added = min(self.size + n, capacity), self.added + n

    def newest(self, n: int) -> NDArray[np.int64]:
        """Numbers of the last n rows, or of all if there are fewer, the oldest first."""
        return np.arange(self.cursor - min(n, self.size), self.cursor) % len(self.states)

    def unseen(self) -> NDArray[np.int64]:
        """Numbers of rows that are new since this was last asked, none the first time; from now on
        they count as learned from."""
        new = self.newest(self.added - self.learned if self.learned else 0)
        self.learned = self.added
        return new

    def state_dict(self) -> dict[str, Tensor]:
        """The rows as they lie in the ring, whose order decides what is drawn."""
        rows = {name: torch.from_numpy(getattr(self, name)[: self.size]) for name in self.COLUMNS}
        counts = self.cursor, self.added, self.learned
        return rows | {"counts": torch.tensor(counts)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take over what `state_dict` gave, into a ring of another size the newest rows.

        Raises:
            ValueError: if that is no ring.
        """
        cursor, added, learned = map(int, state["counts"])
        rows = [state[name].numpy() for name in self.COLUMNS]
        n = len(rows[0])
        if not (0 <= cursor <= n and n <= added >= learned >= 0):
            raise ValueError("the counts of its transitions do not fit")
        capacity = len(self.states)
        if n != capacity and cursor < n:  # the oldest first
            rows = [np.roll(row, -cursor, axis=0) for row in rows]
        self.size = self.cursor = self.added = 0
        self.add(*rows)
        self.cursor = cursor % capacity if n == capacity else self.cursor
        self.added, self.learned = added, learned

    @property
    def enough(self) -> bool:
        """Whether there are transitions enough to learn from."""
        return self.size >= self._minimum

    def sample(self, n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """At most n random states that the agent has had, (<= n, state_dim), and the goals that
        they led to, (<= n, goal_dim); none too early."""
        rows = rng.permutation(self.size)[:n] if self.enough else np.empty(0, dtype=np.int64)
        return self.next_states[rows].astype(np.float64), self.goals[rows].astype(np.float64)

    def last_steps(
        self, env: GoalEnv, n: int, length: int, relabel: bool, rng: np.random.Generator
    ) -> Steps:
        """At most n random steps of those at most `length` actions before a success; with
        `relabel` each for a random later place of its episode, else for the goal reached."""
        rows = np.flatnonzero(self.left[: self.size] < length) if self.enough else np.arange(0)
        rows = rng.permutation(rows)[:n]
        goals = self.goals[rows].astype(np.float64)
        if relabel:
            later = rng.integers(self.left[rows] + 1) if len(rows) else rows
            ends = self.next_states[(rows + later) % len(self.states)]
            goals = env.achieved_goals(ends.astype(np.float64))
        return Steps(self.states[rows].astype(np.float64), self.actions[rows], goals)
