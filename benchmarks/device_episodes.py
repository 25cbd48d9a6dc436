"""Episodes that stay on the device: tensors in, tensors out, nothing copied to the host."""

import numpy as np
import torch
from torch import Tensor

from goalgan_bt.envs.goal_env import Step
from goalgan_bt.envs.mujoco_env import MujocoEnv


class DeviceEpisodes:
    """The episodes of an environment on mujoco-warp, all simulations side by side.

    What `GoalEnv` does for some simulations by their indices, this does for those that a mask
    picks: shapes never depend on what happens, so that the host need not wait for the device.

    Args:
        env: made with `physics="warp"`; it belongs to this object from now on.

    Attributes:
        goals: (N, goal_dim) the desired goals; elapsed: (N,) steps since each episode began.
    """

    def __init__(self, env: MujocoEnv) -> None:
        self.env = env
        batch = env.batch
        self._qpos, self._qvel = batch.bind("qpos"), batch.bind("qvel")
        self._warm_start = batch.bind("qacc_warmstart")
        start = torch.as_tensor(env.start_state, dtype=torch.float32, device=self._qpos.device)
        self._start = start.split([self._qpos.shape[1], self._qvel.shape[1]])
        self._everyone = np.arange(env.num_envs)
        self.goals = self._qpos.new_zeros((env.num_envs, env.goal_dim))
        self.elapsed = self._qpos.new_zeros(env.num_envs, dtype=torch.int64)
        self.begin(torch.ones_like(self.elapsed, dtype=torch.bool), self.goals)

    def states(self) -> Tensor:
        """A copy of the states, (N, state_dim)."""
        return torch.cat([self._qpos, self._qvel], dim=1)

    def begin(self, some: Tensor, goals: Tensor) -> None:
        """New episodes from the start in some simulations, (N,) bool, each to its row of `goals`,
        (N, goal_dim)."""
        rows = some[:, None]
        for field, start in zip((self._qpos, self._qvel), self._start, strict=True):
            field.copy_(torch.where(rows, start, field))
        self._warm_start.masked_fill_(rows, 0.0)
        self.elapsed.masked_fill_(some, 0)
        self.goals = torch.where(rows, goals, self.goals)
        self._feasible = self.env.feasible(self.goals)

    def observe(self) -> Tensor:
        """The present observations, (N, obs_dim) float32."""
        return self.env.observations(self.states(), self.goals)

    def step(self, actions: Tensor) -> Step:
        """Take one action, `action_repeat` steps long, in every simulation.

        Args:
            actions: (N, act_dim), clipped to [-1, 1].

        Returns:
            As `GoalEnv.step`, of tensors.
        """
        actions = self.env.to_body(actions.clamp(-1.0, 1.0), self.states(), self.goals)
        self.env.advance(self._everyone, actions)
        self.elapsed += self.env.action_repeat
        return self.env.judge(self.states(), actions, self.goals, self._feasible, self.elapsed)
