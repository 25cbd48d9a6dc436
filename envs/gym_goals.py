"""A goal environment of Gymnasium's as a `GoalEnv`, to be trained like ours.

    reach = gym_goals("gymnasium_robotics:FetchReach-v4")     # in my_tasks.py

    python -m goalgan_bt.train --env my_tasks:reach

What such an environment cannot do is left out: its states cannot be set, so that nothing is decoded
into full states, no recall traces of those are imagined, and every episode begins where its `reset`
puts it. It is stepped one copy after the other. All else is as for our bodies: the curriculum,
recall over places, TRPO, coverage of the goals that the environment itself draws.
"""

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from goalgan_bt.envs.arrays import Array, namespace
from goalgan_bt.envs.goal_env import GoalEnv, Ids, PhysicsError, Step, observed
from goalgan_bt.envs.maze import BoolArray, FloatArray

OWN_GOALS = 200  # goals of the environment's own, of which the first half are test goals
AROUND = 0.1  # by how much of their box the goals that are proposed may leave it, on each side
PRESET = {
    "like": "point_nd",
    "action_repeat": 1,
    "rollout.num_envs": 16,
    "rollout.steps": 50,
    "rollout.chain": 0.0,
    "goals.label_rollouts": 0,
    "imitation.source": "none",
}

# Begins an episode with a goal: environment, goal (goal_dim,), seed -> observation, info.
Begin = Callable[[gymnasium.Env[Any, Any], FloatArray, int | None], tuple[Any, dict[str, Any]]]


def goal_as_option(
    env: gymnasium.Env[Any, Any], goal: FloatArray, seed: int | None
) -> tuple[Any, dict[str, Any]]:
    """For environments whose `reset` takes a `goal` among its options, as ours do."""
    return env.reset(seed=seed, options={"goal": goal})


def goal_as_attribute(
    env: gymnasium.Env[Any, Any], goal: FloatArray, seed: int | None
) -> tuple[Any, dict[str, Any]]:
    """For environments that hold the goal of an episode as `goal`, as gymnasium-robotics' do."""
    obs, info = env.reset(seed=seed)
    inner: Any = env.unwrapped
    inner.goal = np.asarray(goal, dtype=np.asarray(obs["desired_goal"]).dtype).copy()
    if hasattr(inner, "update_target_site_pos"):  # mazes show it
        inner.update_target_site_pos()
    return obs | {"desired_goal": inner.goal.copy()}, info


class GymGoals(GoalEnv):
    """N copies of an environment whose observations have `observation`, `achieved_goal` and
    `desired_goal`.

    State: the achieved goal and the observation. Observation: see `goal_env.observed`. Success is
    what `info` says (`is_success` or `success`), else the radius. An episode that the environment
    terminates without success has failed.

    Args:
        make: gives one copy.
        num_envs: N.
        horizon: steps of an episode; that of the environment's registration if None.
        action_repeat: steps for which each action is held.
        success_radius: in units of the goals; the environment's `distance_threshold` if None.
        low, high: (goal_dim,) the box in which goals are proposed; a little more than that of the
            environment's own goals if None.
        begin: how an episode begins with a goal.

    Raises:
        PhysicsError: for an environment that is none of those, or needs more to be told.
    """

    settable = False

    def __init__(
        self,
        make: Callable[[], gymnasium.Env[Any, Any]],
        num_envs: int,
        horizon: int | None,
        action_repeat: int,
        success_radius: float | None = None,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        begin: Begin | None = None,
    ) -> None:
        self._copies = [make() for _ in range(num_envs)]
        first = self._copies[0]
        self.name = str(first.spec.id if first.spec else type(first.unwrapped).__name__)
        names = "observation", "achieved_goal", "desired_goal"
        if not {*names} <= {*getattr(first.observation_space, "spaces", {})}:
            raise PhysicsError(f"{self.name}: its observations must be of {', '.join(names)}")
        space = first.action_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise PhysicsError(f"{self.name}: its actions must be a row of numbers, not {space}")
        if not space.is_bounded():
            raise PhysicsError(f"{self.name}: its actions must have bounds, not {space}")
        horizon = horizon or (first.spec.max_episode_steps if first.spec else None)
        if horizon is None:
            raise PhysicsError(f"{self.name} does not say how long an episode is: give --horizon")
        radius = success_radius or getattr(first.unwrapped, "distance_threshold", None)
        if radius is None:
            raise PhysicsError(f"{self.name} has no distance_threshold: give a success_radius")
        self.success_radius = float(radius)
        self._middle, self._half = (space.low + space.high) / 2, (space.high - space.low) / 2
        self.act_dim = len(self._half)
        told = [first.reset(seed=seed)[0] for seed in range(OWN_GOALS)]
        self._own_goals = np.array([obs["desired_goal"] for obs in told], dtype=float)
        if self._own_goals.ndim != 2:
            raise PhysicsError(f"{self.name}: a goal must be a row of numbers")
        has_goal = hasattr(first.unwrapped, "goal")  # some have it only after a reset
        self._begin = begin or (goal_as_attribute if has_goal else goal_as_option)
        self.start_state = _state(told[0])
        least, most = self._own_goals.min(axis=0), self._own_goals.max(axis=0)
        margin = np.maximum(AROUND * (most - least), self.success_radius)
        self.goal_low = np.asarray(least - margin if low is None else low, dtype=float)
        self.goal_high = np.asarray(most + margin if high is None else high, dtype=float)
        self.dt = 1 / float(first.metadata.get("render_fps") or 50)
        super().__init__(num_envs, horizon, action_repeat)
        self._states = np.tile(self.start_state, (num_envs, 1))
        for seed, copy in enumerate(self._copies):
            copy.reset(seed=seed)

    def read_states(self, ids: Ids) -> FloatArray:
        return self._states[ids]

    def reset(self, ids: Ids, goals: FloatArray, states: FloatArray | None = None) -> None:
        """Begin new episodes where the environment wants them to.

        Raises:
            PhysicsError: for states of one's own.
        """
        if states is not None:
            raise PhysicsError(f"the states of {self.name} cannot be set")
        for i, goal in zip(ids, goals, strict=True):
            self._states[i] = _state(self._begin(self._copies[i], goal, None)[0])
        self.set_goals(ids, goals)

    def step_body(self, ids: Ids, actions: Array) -> Step:
        success, ended, late = np.zeros((3, len(ids)), dtype=bool)
        for row, i in enumerate(ids):
            for _ in range(self.action_repeat):
                action = (self._middle + self._half * actions[row]).astype(self._half.dtype)
                obs, _, ended[row], late[row], info = self._copies[i].step(action)
                won = info.get("is_success", info.get("success"))
                near = self.reached(np.array([obs["achieved_goal"]]), self.goals[i : i + 1])[0]
                success[row] = near if won is None else won
                if success[row] or ended[row] or late[row]:
                    break
            # One that has won may have another goal already.
            if not (success[row] or np.allclose(obs["desired_goal"], self.goals[i], atol=1e-4)):
                raise PhysicsError(
                    f"{self.name} does not take the goals that it is given: say how with `begin`"
                )
            self._states[i] = _state(obs)
        self.elapsed[ids] += self.action_repeat
        states = self.read_states(ids)
        terminated = success | ended | ~self.healthy(states)
        truncated = ~terminated & (late | (self.elapsed[ids] >= self.horizon))
        rewards = success.astype(np.float32)
        achieved = self.achieved_goals(states)
        return Step(states, achieved, actions, rewards, terminated, truncated)

    def observations(self, states: Array, goals: Array, achieved: Array | None = None) -> Array:
        return observed(self, states, goals)

    def achieved_goals(self, states: Array) -> Array:
        return states[:, : self.goal_dim]

    def healthy(self, states: Array) -> Array:
        return namespace(states).isfinite(states).all(axis=1)

    def valid(self, states: FloatArray) -> BoolArray:
        return np.asarray(self.healthy(states))

    def feasible(self, goals: Array) -> Array:
        """Any may be: only trying tells."""
        return np.ones(len(goals), dtype=bool)

    def free_goals(self, n: int, rng: np.random.Generator) -> FloatArray:
        return self._own_goals[rng.integers(len(self._own_goals), size=n)]

    def test_goals(self) -> FloatArray:
        return self._own_goals[: OWN_GOALS // 2]


def _state(obs: Mapping[str, Any]) -> NDArray[np.float64]:
    rows = obs["achieved_goal"], obs["observation"]
    return np.concatenate([np.asarray(row, dtype=float).ravel() for row in rows])


class gym_goals:
    """A factory for `--env module:factory` and `register_env`.

    Args:
        id: as `gymnasium.make` takes it, for example `gymnasium_robotics:FetchReach-v4`.
        success_radius, low, high, begin: see `GymGoals`.
        preset: settings by name, on top of those for environments like it.
        make: further arguments of `gymnasium.make`.
    """

    def __init__(
        self,
        id: str,
        *,
        success_radius: float | None = None,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        begin: Begin | None = None,
        preset: Mapping[str, Any] | None = None,
        **make: Any,
    ) -> None:
        self._id, self._make = id, make
        self._told = {"success_radius": success_radius, "low": low, "high": high, "begin": begin}
        self.preset = PRESET | dict(preset or {})

    def __call__(
        self, num_envs: int, horizon: int | None, action_repeat: int, threads: int
    ) -> GymGoals:
        """So many copies of it."""
        longest = {} if horizon is None else {"max_episode_steps": horizon}

        def make() -> gymnasium.Env[Any, Any]:
            settings: Any = {"disable_env_checker": True, **self._make, **longest}
            try:
                return gymnasium.make(self._id, **settings)
            except Exception as error:  # of code that is not ours
                kind = type(error).__name__
                raise PhysicsError(f"{self._id} cannot be made: {kind}: {error}") from error

        told: dict[str, Any] = self._told
        return GymGoals(make, num_envs, horizon, action_repeat, **told)
