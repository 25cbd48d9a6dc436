"""The same steps as others take them: sb3-contrib's TRPO, gymnasium-robotics, EnvPool.

Each is set up in the way that is fastest for the other side, within its usual interface. Packages
are imported late, so that one that is missing costs its own rows only.
"""

import contextlib
import io
import itertools
import warnings
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from common import Sample, Unavailable, clocked
from numpy.typing import NDArray

from goalgan_bt.envs.ant_maze import HEALTHY_Z
from goalgan_bt.envs.maze import Maze
from goalgan_bt.envs.mujoco_env import INTEGRATORS
from goalgan_bt.envs.point_maze import RADIUS
from goalgan_bt.learners.maze_config import MazeConfig, make_env

Float32 = NDArray[np.float32]

ROBOTICS = {"ant": "AntMaze_UMaze-v5", "point": "PointMaze_UMaze-v3"}
ENVPOOL = {"ant": ("Ant-v5", 0.05), "point": ("PointMaze_UMaze-v3", 0.01)}  # s per step


class SingleMaze(gymnasium.Env[Float32, Float32]):
    """One simulation of a task of ours, written for speed as single simulations go.

    It steps the model of our environment by plain `mujoco.mj_step`, with none of our batched code:
    the same bodies, time step, integrator, walls, reward, ends of episodes and `action_repeat`;
    goals are drawn from the free space. The observation has as many numbers as ours, but those
    that MuJoCo has at hand: the Ant's rotation matrix stands for what we compute from it, and the
    centre of mass is that of the beginning of the step.

    Args:
        cfg: settings that name the environment.
    """

    def __init__(self, cfg: MazeConfig) -> None:
        ours: Any = make_env(cfg, 1)
        self._ant = cfg.env.startswith("ant")
        self._repeat, self._horizon = ours.action_repeat, ours.horizon
        self._radius2 = ours.success_radius**2
        self._goals, self._goal, self._elapsed = ours.test_goals(), np.zeros(2), 0
        self._model = ours.model
        self._data = mujoco.MjData(self._model)
        self._start = ours.start_state[: self._model.nq]
        self._slide = Slide(ours.maze, RADIUS)
        # Views, made once: each access through `MjData` would cost as much as a small step.
        self._qpos, self._qvel, self._ctrl = self._data.qpos, self._data.qvel, self._data.ctrl
        self._achieved = self._data.subtree_com[1, :2] if self._ant else self._qpos
        self._rotation = self._data.xmat[1, :8] if self._ant else np.empty(0)
        box = gymnasium.spaces.Box
        self.observation_space = box(-np.inf, np.inf, (ours.obs_dim,), np.float32)
        self.action_space = box(-1.0, 1.0, (ours.act_dim,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, dict[str, Any]]:
        super().reset(seed=seed)
        mujoco.mj_resetData(self._model, self._data)
        self._qpos[:] = self._start
        mujoco.mj_forward(self._model, self._data)
        self._goal = self._goals[self.np_random.integers(len(self._goals))]
        self._elapsed = 0
        return self._observation(self._goal - self._achieved), {}

    def step(self, action: Float32) -> tuple[Float32, float, bool, bool, dict[str, Any]]:
        self._ctrl[:] = action  # stable-baselines3 has clipped it
        if self._ant:
            mujoco.mj_step(self._model, self._data, self._repeat)
        else:
            self._step_point()
        self._elapsed += self._repeat
        low, high = HEALTHY_Z
        fell = self._ant and not low <= self._qpos[2] <= high
        offset = self._goal - self._achieved
        success = not fell and bool(offset @ offset < self._radius2)
        over = self._elapsed >= self._horizon
        return self._observation(offset), float(success), success or fell, over, {}

    def _step_point(self) -> None:
        for _ in range(self._repeat):
            before = self._qpos.tolist()
            mujoco.mj_step(self._model, self._data)
            self._qpos[:], stopped = self._slide(before, self._qpos.tolist())
            for axis in stopped:
                self._qvel[axis] = 0.0

    def _observation(self, offset: NDArray[np.float64]) -> Float32:
        parts = (self._qpos, self._qvel, offset, self._rotation)
        return np.concatenate(parts, dtype=np.float32)


class Slide:
    """`Maze.slide` for a single body in plain Python, which for one is much faster than numpy.

    Args:
        maze: the layout.
        radius: half-width of the body, metres.
    """

    def __init__(self, maze: Maze, radius: float) -> None:
        self._low, self._size = maze.low.tolist(), maze.cell_size
        self._free, self._radius = maze.free.tolist(), radius

    def __call__(self, before: list[float], after: list[float]) -> tuple[list[float], list[int]]:
        """Where a body comes to be that would go from `before` to `after`, (x, y) in metres, and
        which axes a wall stopped."""
        low, size, inner = self._low, self._size, self._radius * (1 - 1e-9)
        position, stopped = list(before), []
        for axis in (0, 1):
            move = after[axis] - before[axis]
            side = -1.0 if move < 0 else 1.0
            lead = after[axis] + side * self._radius - low[axis]
            edges = [position[1 - axis] + edge - low[1 - axis] for edge in (-inner, inner)]
            cells = [(int(lead // size), int(edge // size)) for edge in edges]
            back = 0.0
            if not all(self._free[r][c] if axis == 0 else self._free[c][r] for c, r in cells):
                into = lead % size if side > 0 else size - lead % size
                back = min(into + 1e-9, abs(move))
                stopped.append(axis)
            position[axis] = after[axis] - side * back
        return position, stopped


def sb3_contrib_trpo(
    cfg: MazeConfig, durations: Iterable[float], vector: str, num_envs: int, n_steps: int
) -> Iterator[Sample]:
    """Training by sb3-contrib's TRPO as it comes: two networks of 64-64, ten epochs of the critic.

    A sample is whole iterations, learning included; nothing else is trained, measured or recorded.
    Environment steps count as ours do, 0.02 s each: an action counts `action_repeat` times, which
    spares the other side as many calls of policy and wrappers as it spares us. Each sample has
    environments of its own and an iteration of warm-up, so that none sit in memory meanwhile.

    Args:
        cfg: the environment; its threads are torch's here.
        durations: seconds.
        vector: `DummyVecEnv` (simulations in turn, in this process) or `SubprocVecEnv` (a process
            each).
        num_envs: simulations.
        n_steps: actions in each per iteration.
    """
    from sb3_contrib import TRPO
    from stable_baselines3.common import vec_env

    for duration in durations:
        with contextlib.closing(
            getattr(vec_env, vector)([partial(SingleMaze, cfg)] * num_envs)
        ) as envs:
            with warnings.catch_warnings(action="ignore"):  # a batch that 128 does not divide
                model = TRPO("MlpPolicy", envs, n_steps=n_steps, device="cpu", seed=cfg.seed)

            def iteration(model: Any = model) -> int:
                torch.set_num_threads(cfg.num_threads)
                model.learn(n_steps * num_envs, reset_num_timesteps=False)
                return n_steps * num_envs * cfg.action_repeat

            iteration()
            sample = next(clocked(iteration, [duration], dt=0.02))
        yield sample


def gymnasium_robotics(
    cfg: MazeConfig, durations: Iterable[float], our_physics: bool
) -> Iterator[Sample]:
    """Random actions in gymnasium-robotics' U-maze, as `gymnasium.make` gives it: one simulation.

    It has no threads. gymnasium's `AsyncVectorEnv`, a process per simulation, took fewer steps
    with two of them than one simulation does alone.

    Args:
        cfg: names the body.
        durations: seconds.
        our_physics: one implicitfast step of 0.02 s per action. As shipped it is five RK4 steps of
            0.01 s for the Ant and one Euler step of 0.01 s for the point.
    """
    env = robotics_env(cfg.env.split("_")[0], our_physics)
    drawn = np.random.default_rng(0).uniform(-1, 1, (1000, *env.action_space.shape))
    actions = itertools.cycle(drawn.astype(np.float32))
    env.reset(seed=0)

    def act() -> int:
        _, _, terminated, truncated, _ = env.step(next(actions))
        if terminated or truncated:
            env.reset()
        return 1

    with contextlib.closing(env):
        yield from clocked(act, durations, mujoco_env(env).dt)


def gymnasium_robotics_async(cfg: MazeConfig, durations: Iterable[float]) -> Iterator[Sample]:
    """The same with our step and integrator in gymnasium's `AsyncVectorEnv`: a process per
    simulation, as many as `cfg.num_threads`."""
    one = partial(robotics_env, cfg.env.split("_")[0], True)
    env = gymnasium.vector.AsyncVectorEnv([one] * cfg.num_threads)
    yield from vectorised(env, 0.02, durations)


def vectorised(
    env: gymnasium.vector.VectorEnv[Any, Any, Any], dt: float, durations: Iterable[float]
) -> Iterator[Sample]:
    """Random actions in a vector of Gymnasium's, whose steps take `dt` seconds."""
    drawn = np.random.default_rng(0).uniform(-1, 1, (100, *(env.action_space.shape or ())))
    actions = itertools.cycle(drawn.astype(np.float32))
    env.reset(seed=0)

    def act() -> int:
        env.step(next(actions))
        return env.num_envs

    with contextlib.closing(env):
        yield from clocked(act, durations, dt)


def robotics_env(body: str, our_physics: bool) -> gymnasium.Env[Any, Any]:
    """gymnasium-robotics' U-maze for `ant` or `point`."""
    with contextlib.redirect_stderr(io.StringIO()):  # it prints a notice
        import gymnasium_robotics
    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(ROBOTICS[body])
    if our_physics:
        inner: Any = mujoco_env(env)
        inner.frame_skip = 1
        inner.model.opt.timestep = 0.02
        inner.model.opt.integrator = INTEGRATORS["implicitfast"]
    return env


def mujoco_env(env: gymnasium.Env[Any, Any]) -> Any:
    """gymnasium's `MujocoEnv` inside of a maze of gymnasium-robotics."""
    maze: Any = env.unwrapped
    return maze.ant_env if hasattr(maze, "ant_env") else maze.point_env


def envpool(cfg: MazeConfig, durations: Iterable[float]) -> Iterator[Sample]:
    """Random actions in EnvPool's Ant (five RK4 steps of 0.01 s each, no maze: it has none for the
    Ant) or PointMaze (one Euler step of 0.01 s), with as many simulations and threads as ours."""
    import envpool as package

    name, dt = ENVPOOL[cfg.env.split("_")[0]]
    if name not in package.list_all_envs():
        raise Unavailable(f"this EnvPool has no {name}")
    n = cfg.rollout.num_envs
    env = package.make_gymnasium(name, num_envs=n, num_threads=cfg.num_threads, seed=0)
    drawn = np.random.default_rng(0).uniform(-1, 1, (16, n, *env.action_space.shape))
    actions = itertools.cycle(drawn)
    env.reset()

    def act() -> int:
        env.step(next(actions))
        return n

    with contextlib.closing(env):
        yield from clocked(act, durations, dt)
