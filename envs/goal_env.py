"""The contract between the world and the learner: many simulations of one goal-reaching task."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from goalgan_bt.envs.arrays import Array, namespace, put
from goalgan_bt.envs.maze import BoolArray, FloatArray, Maze

Ids = NDArray[np.int64]
# Offsets from places to goals, (n, goal_dim) each, along the way there: as far as the way is long,
# in the direction in which it begins.
Heading = Callable[[FloatArray, FloatArray], FloatArray]


class PhysicsError(ValueError):
    """Physics that this machine or this environment does not have; the message says what to do."""


class Step(NamedTuple):
    """What one action in n simulations gave; its arrays are copies.

    states: (n, state_dim) afterwards.
    achieved: (n, goal_dim) the goals on which they stand.
    actions: (n, act_dim) what the body felt, in [-1, 1] (see `GoalEnv.to_body`).
    rewards: (n,) float32, 1 on reaching the goal, else 0.
    terminated: (n,) bool, the goal was reached or the body failed (an Ant that fell).
    truncated: (n,) bool, the time ran out without either.
    """

    states: FloatArray
    achieved: FloatArray
    actions: FloatArray
    rewards: NDArray[np.float32]
    terminated: BoolArray
    truncated: BoolArray


class GoalEnv:
    """N simulations of one body that must bring its achieved goal to a desired goal.

    The reward is sparse: 1 on coming within `success_radius` of a feasible desired goal, else 0;
    a goal inside a wall is never reached (Florensa et al. 2018, `only_feasible`). An episode ends
    on success, on failure of the body, or after `horizon` steps. Nothing resets by itself.

    A state is one float row that holds all that the physics needs; states can be read
    (`read_states`), written (`reset`) and mapped to observations and achieved goals in batches of
    any size, which the decoder and the backtracking model rely on.

    Attributes:
        name: for example `ant_umaze`.
        num_envs: N.
        horizon: steps of an episode; dt: seconds of a step.
        action_repeat: steps for which each action is held. Success, failure and the end of time
            are checked after each action; all counts are of steps.
        success_radius: metres.
        act_dim, goal_dim, state_dim, obs_dim: sizes of one row.
        heading: tells offsets to goals along the way, where somebody knows the ways. Observations
            then hold these, and not where the body is: with a way to follow it need not know, and
            what it learns at one place holds for all (docs/LOG.md).
        start_state: (state_dim,) where episodes begin; of those whose states are not `settable`,
            where one of them began.
        settable: whether states can be written.
        goal_low, goal_high: (goal_dim,) the box in which goals are proposed, metres.
        maze: the layout, or None where there are no walls.
        goals: (N, goal_dim) the desired goals; elapsed: (N,) steps since the last reset.
    """

    name: str
    dt: float
    success_radius: float
    act_dim: int
    start_state: FloatArray
    goal_low: FloatArray
    goal_high: FloatArray
    maze: Maze | None = None
    heading: Heading | None = None
    settable = True

    def __init__(self, num_envs: int, horizon: int, action_repeat: int) -> None:
        self.num_envs = num_envs
        self.horizon = horizon
        self.action_repeat = action_repeat
        self.goals = np.zeros((num_envs, self.goal_dim))
        self.elapsed = np.zeros(num_envs, dtype=np.int64)
        self._feasible = np.zeros(num_envs, dtype=bool)

    @property
    def goal_dim(self) -> int:
        """Size of a goal."""
        return len(self.goal_low)

    @property
    def obs_dim(self) -> int:
        """Size of an observation; that of `observed`."""
        return self.state_dim + self.goal_dim

    @property
    def state_dim(self) -> int:
        """Size of a state."""
        return len(self.start_state)

    # What a body defines. All take and return rows: (n, state_dim), (n, goal_dim), ... Those that
    # say `Array` compute on numpy arrays and on torch tensors alike, where there are both.

    def read_states(self, ids: Ids) -> FloatArray:
        """A copy of the states of those simulations, (n, state_dim)."""
        raise NotImplementedError

    def write_states(self, ids: Ids, states: FloatArray) -> None:
        """Put those simulations into those states, (n, state_dim)."""
        raise NotImplementedError

    def read_simulations(self) -> NDArray[np.floating]:
        """All that the simulations hold, (N, k): what it takes to go on bit for bit. Of those whose
        states are not `settable`, nothing to go on with."""
        return self.read_states(np.arange(self.num_envs))

    def write_simulations(self, rows: NDArray[np.floating]) -> None:
        """Take over what `read_simulations` gave."""
        self.write_states(np.arange(self.num_envs), np.asarray(rows, dtype=float))

    def advance(self, ids: Ids, actions: Array) -> None:
        """Hold actions in [-1, 1], (n, act_dim), for `action_repeat` steps."""
        raise NotImplementedError

    def observations(self, states: Array, goals: Array, achieved: Array | None = None) -> Array:
        """What the policy sees in those states with those desired goals, (n, obs_dim) float32.

        `achieved`, (n, goal_dim), saves computing the achieved goals where they are known.
        """
        raise NotImplementedError

    def achieved_goals(self, states: Array) -> Array:
        """The goal that each state stands on, (n, goal_dim)."""
        raise NotImplementedError

    def place(self, states: FloatArray, goals: FloatArray) -> FloatArray:
        """The same states moved so that they achieve those goals, (n, state_dim)."""
        raise NotImplementedError

    def healthy(self, states: Array) -> Array:
        """Whether an episode may go on in each state, (n,)."""
        raise NotImplementedError

    def valid(self, states: FloatArray) -> BoolArray:
        """Whether each state is healthy and outside the walls, (n,)."""
        raise NotImplementedError

    def feasible(self, goals: Array) -> Array:
        """Whether each goal lies where the body can be, (n,)."""
        raise NotImplementedError

    def free_goals(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Goals drawn uniformly from all that are feasible, (n, goal_dim)."""
        raise NotImplementedError

    def test_goals(self) -> FloatArray:
        """The feasible goals over which coverage is measured, (K, goal_dim)."""
        raise NotImplementedError

    def to_body(self, actions: Array, states: Array, goals: Array) -> Array:
        """What a policy's actions, given its observation, mean for the body, (n, act_dim).

        They differ where the observation is told in a frame of its own, as the Ant's is.
        """
        return actions

    def from_body(self, actions: Array, states: Array, goals: Array) -> Array:
        """The inverse of `to_body`: how a policy would have to say what the body did."""
        return actions

    def repair(self, states: FloatArray) -> FloatArray:
        """States with the constraints that a learned model breaks put right, (n, state_dim)."""
        return states

    # What all bodies share.

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """The simulations with their goals and clocks, by rows, (N, ...)."""
        return {
            "simulations": self.read_simulations(),
            "goals": self.goals.copy(),
            "elapsed": self.elapsed.copy(),
        }

    def load_state_dict(self, state: dict[str, NDArray[Any]]) -> None:
        """Take over what `state_dict` gave."""
        self.write_simulations(state["simulations"])
        self.set_goals(np.arange(self.num_envs), state["goals"])
        self.elapsed[:] = state["elapsed"]

    def along(self, achieved: Array, goals: Array) -> Array:
        """Offsets from places to goals, both (n, goal_dim), along the way where there is a
        `heading`, else on the straight line."""
        if self.heading is None:
            return goals - achieved
        if isinstance(achieved, np.ndarray):
            return self.heading(achieved, goals)
        return put(self.heading(achieved.cpu().numpy(), goals.cpu().numpy()), achieved)

    def squashed(self, offsets: Array) -> Array:
        """Offsets d, (n, goal_dim), as d / (success_radius + |d|): what is far looks like what is
        less far in the same direction."""
        length = namespace(offsets).sqrt((offsets * offsets).sum(axis=1))
        return offsets / (self.success_radius + length)[:, None]

    def reset(self, ids: Ids, goals: FloatArray, states: FloatArray | None = None) -> None:
        """Begin new episodes in some simulations.

        Args:
            ids: sorted indices of the simulations, (n,).
            goals: their desired goals, (n, goal_dim).
            states: where they begin, (n, state_dim); the start state if None.
        """
        if states is None:
            states = np.broadcast_to(self.start_state, (len(ids), self.state_dim))
        self.write_states(ids, states)
        self.set_goals(ids, goals)

    def set_goals(self, ids: Ids, goals: FloatArray) -> None:
        """New desired goals and a new clock for some simulations, which stay where they are."""
        self.goals[ids] = goals
        self._feasible[ids] = self.feasible(goals)
        self.elapsed[ids] = 0

    def observe(self, ids: Ids) -> NDArray[np.float32]:
        """The present observations of some simulations, (n, obs_dim)."""
        return self.observations(self.read_states(ids), self.goals[ids])

    def step(self, ids: Ids, actions: FloatArray) -> Step:
        """Take one action of a policy, `action_repeat` steps long, in some simulations.

        Args:
            ids: sorted indices of the simulations, (n,).
            actions: (n, act_dim), clipped to [-1, 1].
        """
        said = np.clip(actions, -1.0, 1.0)
        return self.step_body(ids, self.to_body(said, self.read_states(ids), self.goals[ids]))

    def step_body(self, ids: Ids, actions: Array) -> Step:
        """The same with what the body shall do, (n, act_dim) in [-1, 1] (see `to_body`)."""
        self.advance(ids, actions)
        self.elapsed[ids] += self.action_repeat
        states, goals = self.read_states(ids), self.goals[ids]
        return self.judge(states, actions, goals, self._feasible[ids], self.elapsed[ids])

    def reached(self, achieved: Array, goals: Array) -> Array:
        """Whether places are within `success_radius` of goals, both (n, goal_dim), (n,)."""
        squared = namespace(achieved).square(achieved - goals).sum(axis=1)
        return squared < self.success_radius**2

    def judge(
        self, states: Array, actions: Array, goals: Array, feasible: Array, elapsed: Array
    ) -> Step:
        """What an action gave that ended in those states.

        Args:
            states: (n, state_dim).
            actions: (n, act_dim) as the body felt them.
            goals: (n, goal_dim) desired; feasible: (n,) bool, see `feasible`.
            elapsed: (n,) steps since the episodes began.
        """
        xp = namespace(states)
        healthy = self.healthy(states)
        with np.errstate(invalid="ignore"):  # a diverged state is as far as can be
            achieved = self.achieved_goals(states)
            success = healthy & feasible & self.reached(achieved, goals)
        terminated = success | ~healthy
        truncated = ~terminated & (elapsed >= self.horizon)
        rewards = xp.asarray(success, dtype=xp.float32)
        return Step(states, achieved, actions, rewards, terminated, truncated)


def observed(env: GoalEnv, states: Array, goals: Array) -> Array:
    """What a point sees, or a body like it, whose state begins with its place: the state and the
    offset to the desired goal; with a heading the squashed offset along the way in place of its
    own; (n, obs_dim) float32."""
    xp, place = namespace(states), states[:, : env.goal_dim]
    offset, rest = goals - place, states[:, env.goal_dim :]
    way = place if env.heading is None else env.squashed(env.along(place, goals))
    return xp.asarray(xp.concat([way, rest, offset], axis=1), dtype=xp.float32)
