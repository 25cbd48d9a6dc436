"""Episodes of a run in locomotion, for the page: the body walks under the newest policy."""

import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.learners import locomotion
from goalgan_bt.learners.table import load
from goalgan_bt.runs import checkpoint
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.viz.player import Attempt

LONGEST = 400  # actions of an episode that is shown


class Walker:
    """Plays the newest policy of a run in locomotion.

    Args:
        folder: the run folder.

    Attributes:
        returned: the return of the last episode.

    Raises:
        RunError: if the run's settings cannot be read, or the extra `sb3` is missing.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._cfg = folder, load(folder)
        try:
            self._agent, env = locomotion.make(self._cfg)
        except UsageError as error:
            raise RunError(str(error)) from None
        self._env: Any = env.unwrapped.envs[0]  # by itself, without normalising
        self._moments: tuple[FloatArray, FloatArray] | None = None
        self._tried: int | None = None  # the file last looked at, by its time
        self._ready, self._episodes, self.returned = False, 0, 0.0

    @property
    def model(self) -> mujoco.MjModel:
        """The MuJoCo model."""
        model: mujoco.MjModel = self._env.unwrapped.model
        return model

    def take(self, iteration: int | None) -> bool:
        """Load the newest policy if it is new; whether there is one to play. Older ones are not
        kept."""
        path = self._folder / "policy.pt"
        try:
            stamp = os.stat(path).st_mtime_ns
            if stamp != self._tried:
                self._tried = stamp
                with checkpoint.loaded(path) as saved:
                    self._agent.policy.load_state_dict(saved["policy"])
                    if "mean" in saved:
                        self._moments = saved["mean"].numpy(), saved["var"].numpy()
                self._ready = True
        except (OSError, ValueError):
            pass  # none yet, or another version: the last one will do
        return self._ready

    def attempt(self, goals: FloatArray) -> Attempt:
        """An episode. `goals`, (1, 0), say nothing; its outcome is the return."""
        env, base = self._env, self._env.unwrapped
        observation, _ = env.reset(seed=self._episodes)
        self._episodes += 1
        states, self.returned, over = [base.data.qpos.copy()], 0.0, False
        while len(states) <= LONGEST and not over:
            action, _ = self._agent.predict(self._seen(observation), deterministic=True)
            observation, reward, over, _, _ = env.step(action)
            self.returned += float(reward)
            states.append(base.data.qpos.copy())
        ends, fell = np.array([len(states) - 1]), np.array([over])
        return Attempt(goals, np.array(states)[:, None], ends, ~fell, fell, float(base.dt))

    def some_goal(self) -> FloatArray:
        """There are no goals."""
        return np.empty((1, 0))

    def _seen(self, observation: FloatArray) -> FloatArray:
        """What the policy sees: normalised, where it has learned so."""
        if self._moments is None:
            return observation
        mean, var = self._moments
        return np.asarray(np.clip((observation - mean) / np.sqrt(var + 1e-8), -10, 10))
