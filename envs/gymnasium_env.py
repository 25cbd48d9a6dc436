"""The goal-reaching tasks as Gymnasium environments, one at a time.

The same bodies, mazes and physics as the trainer's simulations, bit for bit, with the interface
that gymnasium-robotics gave goals: an observation is a dictionary of `observation` (the state),
`achieved_goal` and `desired_goal`, and rewards can be computed anew for other goals.
"""

from collections.abc import Sequence
from numbers import Integral
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from goalgan_bt.envs import make
from goalgan_bt.envs.goal_env import GoalEnv, Step
from goalgan_bt.envs.maze import BoolArray, FloatArray, Maze
from goalgan_bt.envs.mujoco_env import INTEGRATORS
from goalgan_bt.envs.picture import Picture

FAST = 1000.0  # m/s or rad/s, m or rad: what only a diverged body exceeds
MARGIN = 1.0  # metres by which a body may leave the box of the goals
FRAME = 480  # pixels of a side of a picture
ONE = np.arange(1)


class Rules:
    """What holds for one simulation and for many: the world, spaces, what a goal means, pictures.

    Args:
        name: of the environment, as `--env` takes it.
        num_envs, threads: simulations and their threads.
        render_mode: one of the metadata's, or None.
        map_file, horizon, action_repeat, integrator, dim, cell_size: see `goalgan_bt.envs.make`.
        map_rows: a map's rows, top row first, in the place of its file: what is written into a
            data set holds on other machines too.
        width, height: of pictures, pixels.

    Attributes:
        sims: the simulations.

    Raises:
        ValueError: for an environment or settings that there are not.
    """

    metadata: dict[str, Any]

    def __init__(
        self,
        name: str,
        num_envs: int,
        threads: int,
        render_mode: str | None,
        *,
        map_file: Path | str | None = None,
        map_rows: Sequence[str] | None = None,
        horizon: int | None = None,
        action_repeat: int = 1,
        integrator: str | None = None,
        dim: int = 2,
        cell_size: float = 2.0,
        width: int = FRAME,
        height: int = FRAME,
    ) -> None:
        for setting, number, least in (
            ("num_envs", num_envs, 1),
            ("threads", threads, 0),
            ("horizon", 1 if horizon is None else horizon, 1),
            ("action_repeat", action_repeat, 1),
            ("width", width, 1),
            ("height", height, 1),
        ):
            if isinstance(number, bool) or not isinstance(number, Integral) or number < least:
                raise ValueError(
                    f"{setting} must be a whole number from {least} on, not {number!r}"
                )
        if integrator is not None and integrator not in INTEGRATORS:
            raise ValueError(f"integrator is {' or '.join(INTEGRATORS)}, not {integrator!r}")
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            raise ValueError(f"render_mode is {', '.join(modes)} or None, not {render_mode!r}")
        if map_file is not None and map_rows is not None:
            raise ValueError("a map is given by map_file or by map_rows, not by both")
        self.sims = make(
            name,
            num_envs,
            threads=threads,
            map_file=None if map_file is None else Path(map_file),
            maze=None if map_rows is None else Maze(tuple(map_rows), cell_size),
            horizon=horizon,
            action_repeat=action_repeat,
            integrator=integrator,
            dim=dim,
            cell_size=cell_size,
        )
        if render_mode is not None and not hasattr(self.sims, "model"):
            raise ValueError(f"{name} is no MuJoCo model: it has no pictures")
        per_second = round(1 / self.sims.dt / action_repeat)
        self.metadata = self.metadata | {"render_fps": per_second}
        self.render_mode, self._size = render_mode, (width, height)
        self._picture: Picture | None = None
        self._bounds: Any = observation_space(self.sims)

    def picture(self) -> Picture:
        """What draws, made when it is first asked for."""
        if self._picture is None:
            self._picture = Picture(self.sims, *self._size)
        return self._picture

    def put_away(self) -> None:
        """Let go of the picture or window."""
        if self._picture is not None:
            self._picture.close()
            self._picture = None

    def compute_reward(
        self, achieved_goal: FloatArray, desired_goal: FloatArray, info: Any
    ) -> FloatArray | float:
        """1 where an achieved goal is within the success radius of a desired one that is free and
        the body is healthy, else 0.

        Args:
            achieved_goal, desired_goal: (goal_dim,), or (n, goal_dim) for n at a time.
            info: of the step, or n of them; `healthy` is read, where it is missing it is true.
        """
        achieved, desired = np.atleast_2d(achieved_goal), np.atleast_2d(desired_goal)
        success = self.sims.reached(achieved, desired) & self.sims.feasible(desired)
        success &= _healthy(info)
        return success.astype(float) if np.ndim(achieved_goal) > 1 else float(success[0])

    def compute_terminated(
        self, achieved_goal: FloatArray, desired_goal: FloatArray, info: Any
    ) -> BoolArray | bool:
        """Whether the goal is reached or the body has failed; arguments as of `compute_reward`."""
        reached = np.asarray(self.compute_reward(achieved_goal, desired_goal, info)) > 0
        ended = reached | ~_healthy(info)
        return ended if np.ndim(achieved_goal) > 1 else bool(ended.item())

    def compute_truncated(
        self, achieved_goal: FloatArray, desired_goal: FloatArray, info: Any
    ) -> BoolArray | bool:
        """Never: time is no matter of goals."""
        never = np.zeros(len(np.atleast_2d(achieved_goal)), dtype=bool)
        return never if np.ndim(achieved_goal) > 1 else False

    def told(
        self, states: FloatArray, achieved: FloatArray, goals: FloatArray
    ) -> dict[str, FloatArray]:
        """Observations of n simulations, new arrays within the bounds of their space."""
        rows = {"observation": states, "achieved_goal": achieved, "desired_goal": goals}
        return {
            name: np.clip(np.nan_to_num(row), self._bounds[name].low, self._bounds[name].high)
            for name, row in rows.items()
        }


def _healthy(info: Any) -> BoolArray:
    """Whether bodies are healthy, of one info, of a vector's, or of one for each of n."""
    if isinstance(info, dict):
        return np.asarray(info.get("healthy", True), dtype=bool)
    return np.array([one.get("healthy", True) for one in info], dtype=bool)


def observation_space(env: GoalEnv) -> spaces.Dict:
    """Boxes with finite bounds."""
    high = np.full(env.state_dim, FAST)
    low = -high
    place = slice(env.goal_dim)  # every body's state begins with where it is
    low[place], high[place] = env.goal_low - MARGIN, env.goal_high + MARGIN
    return spaces.Dict(
        {
            "observation": spaces.Box(low, high, dtype=np.float64),
            "achieved_goal": spaces.Box(low[place], high[place], dtype=np.float64),
            "desired_goal": spaces.Box(low[place], high[place], dtype=np.float64),
        }
    )


def action_space(env: GoalEnv) -> spaces.Box:
    """Actions in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, (env.act_dim,), dtype=np.float32)


def clipped(actions: NDArray[np.float32]) -> FloatArray:
    """Actions within their bounds."""
    return np.clip(np.asarray(actions, dtype=float), -1.0, 1.0)


def begin(
    env: GoalEnv, options: dict[str, Any] | None, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Goal and state with which an episode begins.

    Args:
        env: simulations.
        options: `goal`, (goal_dim,), if it shall not be a free place that one does not stand on;
            `state`, (state_dim,), if it shall not be the start.
        rng: draws the goal.

    Raises:
        ValueError: for other options, and for a goal or a state that cannot be.
    """
    options = options or {}
    if unknown := set(options) - {"goal", "state"}:
        raise ValueError(f"unknown options {sorted(unknown)}: reset takes 'goal' and 'state'")
    state = _row("state", options.get("state", env.start_state), env.state_dim)
    if not env.valid(state[None]).all():
        raise ValueError("that state is not healthy or inside a wall")
    if "goal" in options:
        goal = _row("goal", options["goal"], env.goal_dim)
        if not ((goal >= env.goal_low) & (goal <= env.goal_high)).all():
            low, high = env.goal_low.tolist(), env.goal_high.tolist()
            raise ValueError(f"that goal is outside of the box from {low} to {high}")
        return goal, state
    standing = env.achieved_goals(state[None])
    while env.reached(standing, goal := env.free_goals(1, rng)).all():
        pass
    return goal[0], state


def _row(name: str, value: Any, size: int) -> FloatArray:
    row = np.asarray(value, dtype=float)
    if row.shape != (size,) or not np.isfinite(row).all():
        raise ValueError(f"a {name} has {size} finite numbers, not {value!r}")
    return row


class GoalGymEnv(Rules, gymnasium.Env[Any, Any]):
    """Bring one body to a goal. An episode ends when it is reached (terminated, reward 1), when
    the body fails (terminated, reward 0), or after `horizon` steps (truncated).

    Args:
        name: of the environment, as `--env` takes it.
        render_mode: `rgb_array` (MuJoCo's renderer), `human` (its window), or None.
        settings: map_file, map_rows, horizon, action_repeat, integrator, dim, width, height: see
            `Rules`.

    Raises:
        ValueError: for an environment or settings that there are not.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array", "human"],
        "render_fps": 50,
    }

    def __init__(self, name: str, render_mode: str | None = None, **settings: Any) -> None:
        super().__init__(name, 1, 1, render_mode, **settings)
        self.observation_space, self.action_space = self._bounds, action_space(self.sims)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, FloatArray], dict[str, Any]]:
        """Begin an episode; see `begin` for the options."""
        super().reset(seed=seed)
        goal, state = begin(self.sims, options, self.np_random)
        self.sims.reset(ONE, goal[None], state[None])
        if self.render_mode == "human":
            self.render()
        return self._told(), {"success": False, "is_success": False, "healthy": True}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, FloatArray], float, bool, bool, dict[str, Any]]:
        """Take one action, which is what the motors do. `info` has `success`, the same as
        `is_success`, and `healthy`."""
        step = self.sims.step_body(ONE, clipped(action)[None])
        if self.render_mode == "human":
            self.render()
        success, terminated = bool(step.rewards[0] > 0), bool(step.terminated[0])
        info = {"success": success, "is_success": success, "healthy": success or not terminated}
        return self._told(step), float(success), terminated, bool(step.truncated[0]), info

    def _told(self, step: Step | None = None) -> dict[str, FloatArray]:
        states = self.sims.read_states(ONE) if step is None else step.states
        achieved = self.sims.achieved_goals(states) if step is None else step.achieved
        return {
            name: rows[0] for name, rows in self.told(states, achieved, self.sims.goals).items()
        }

    def render(self) -> NDArray[np.uint8] | None:
        """A picture of it, (height, width, 3), or a window brought up to date.

        Raises:
            PhysicsError: where there is no OpenGL.
        """
        if self.render_mode is None:
            return None
        state, goal = self.sims.read_states(ONE)[0], self.sims.goals[0]
        if self.render_mode == "human":
            self.picture().show(state, goal, 1 / self.metadata["render_fps"])
            return None
        return self.picture().draw(state, goal)

    def close(self) -> None:
        """Let go of the picture or window."""
        self.put_away()
