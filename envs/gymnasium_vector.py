"""Many of them at once as a Gymnasium vector environment, on the batched simulator."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from goalgan_bt.envs.goal_env import Ids
from goalgan_bt.envs.gymnasium_env import (
    Rules,
    action_space,
    begin,
    clipped,
)
from goalgan_bt.envs.maze import BoolArray, FloatArray

Obs = dict[str, FloatArray]


class GoalVectorEnv(Rules, gymnasium.vector.VectorEnv[Obs, NDArray[np.float32], Any]):
    """As many `GoalGymEnv`s, which behave like Gymnasium's own vectors of them: simulation i is
    seeded with seed + i and draws its own goals.

    Args:
        num_envs: how many.
        name: of the environment, as `--env` takes it.
        render_mode: `rgb_array` or None.
        autoreset_mode: of `gymnasium.vector.AutoresetMode`: when an ended episode is followed by
            another: with the next step (Gymnasium's default), with the same (`final_obs` and
            `final_info` tell how it ended), or when `reset` is asked to.
        threads: simulation threads, 0 for one per core. Results do not depend on it.
        settings: map_file, horizon, action_repeat, integrator, dim, cell_size, width, height: see
            `Rules`.

    Raises:
        ValueError: for an environment or settings that there are not.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int,
        name: str,
        render_mode: str | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int = 0,
        **settings: Any,
    ) -> None:
        super().__init__(name, num_envs, threads, render_mode, **settings)
        self.num_envs, self._mode = num_envs, AutoresetMode(autoreset_mode)
        self.metadata = self.metadata | {"autoreset_mode": self._mode}
        self.single_observation_space = self._bounds
        self.single_action_space = action_space(self.sims)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._all = np.arange(num_envs)
        self._ended = np.zeros(num_envs, dtype=bool)
        self._rngs: list[np.random.Generator] = [seeding.np_random()[0] for _ in self._all]
        self._begun = False

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Obs, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: of the first simulation, or one for each.
            options: `reset_mask`, (n,) which simulations, all if there is none; `goal` and
                `state` as those of a single environment, or with a row for each simulation.

        Raises:
            ValueError: for seeds or options that do not fit; nothing has begun then.
        """
        options = dict(options or {})
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"reset_mask has {self.num_envs} booleans, of which one is true, not {mask!r}"
            )
        seeds = (
            [None if seed is None else seed + i for i in range(self.num_envs)]
            if (seed is None or isinstance(seed, int))
            else list(seed)
        )
        if len(seeds) != self.num_envs:
            raise ValueError(f"{self.num_envs} simulations take as many seeds, not {len(seeds)}")
        rngs = [
            rng if one is None else seeding.np_random(one)[0]
            for rng, one in zip(self._rngs, seeds, strict=True)
        ]
        ids = np.flatnonzero(mask)
        starts = [begin(self.sims, self._options_of(options, i), rngs[i]) for i in ids]
        for i in ids:
            self._rngs[i] = rngs[i]
        self._begin(ids, starts)
        self._begun = True
        return self._told(), _infos({"success": False, "is_success": False, "healthy": True}, mask)

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Obs, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Take one action in each simulation, or begin its next episode.

        Raises:
            ResetNeeded: before the first `reset`.
            ValueError: for a simulation whose episode has ended, where nothing resets by itself.
        """
        if not self._begun:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        if self._mode is AutoresetMode.DISABLED and self._ended.any():
            raise ValueError(
                f"the episodes of simulations {np.flatnonzero(self._ended).tolist()} have ended: "
                "call reset with a reset_mask of them first"
            )
        moved, anew = np.flatnonzero(~self._ended), np.flatnonzero(self._ended)
        success, healthy = np.zeros(self.num_envs, dtype=bool), np.ones(self.num_envs, dtype=bool)
        terminated, truncated = np.zeros((2, self.num_envs), dtype=bool)
        if len(moved):
            step = self.sims.step_body(moved, clipped(actions)[moved])
            success[moved] = step.rewards > 0
            terminated[moved], truncated[moved] = step.terminated, step.truncated
            healthy[moved] = ~step.terminated | success[moved]
        if len(anew):
            self._begin(anew, [begin(self.sims, None, self._rngs[i]) for i in anew])
        self._ended = terminated | truncated
        everywhere = np.ones(self.num_envs, dtype=bool)
        told = {"success": success, "is_success": success.copy(), "healthy": healthy}
        infos = _infos(told, everywhere)
        if self._mode is AutoresetMode.SAME_STEP and self._ended.any():
            ended = self._ended.copy()
            final = self._told()
            infos["final_obs"] = np.array(
                [
                    {name: rows[i] for name, rows in final.items()} if ended[i] else None
                    for i in self._all
                ],
                dtype=object,
            )
            infos["final_info"] = _infos(
                {name: np.where(ended, column, False) for name, column in told.items()}, ended
            )
            infos["_final_obs"] = infos["_final_info"] = ended
            ids = np.flatnonzero(ended)
            self._begin(ids, [begin(self.sims, None, self._rngs[i]) for i in ids])
            for name, value in (("success", False), ("is_success", False), ("healthy", True)):
                infos[name] = np.where(ended, value, infos[name])
        return self._told(), success.astype(float), terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Pictures of all simulations.

        Raises:
            PhysicsError: where there is no OpenGL.
        """
        if self.render_mode is None:
            return None
        states = self.sims.read_states(self._all)
        return tuple(map(self.picture().draw, states, self.sims.goals))

    def close_extras(self, **kwargs: Any) -> None:
        """Let go of the picture."""
        self.put_away()

    def _options_of(self, options: dict[str, Any], i: Any) -> dict[str, Any]:
        """Those of one simulation."""
        rows = {name: np.asarray(value) for name, value in options.items()}
        return {
            name: value[i] if value.ndim > 1 and len(value) == self.num_envs else value
            for name, value in rows.items()
        }

    def _begin(self, ids: Ids, starts: list[tuple[FloatArray, FloatArray]]) -> None:
        goals, states = (np.stack(rows) for rows in zip(*starts, strict=True))
        self.sims.reset(ids, goals, states)
        self._ended[ids] = False

    def _told(self) -> Obs:
        states = self.sims.read_states(self._all)
        return self.told(states, self.sims.achieved_goals(states), self.sims.goals)


def _infos(columns: dict[str, Any], mask: BoolArray) -> dict[str, Any]:
    """As Gymnasium's vectors tell them: a column, and in whose info it stands."""
    told: dict[str, Any] = {}
    for name, column in columns.items():
        told[name] = np.where(mask, column, False)
        told[f"_{name}"] = mask.copy()
    return told
