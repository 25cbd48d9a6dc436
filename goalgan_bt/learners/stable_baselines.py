"""Recall traces for those agents of Stable-Baselines3 and sb3-contrib that have a Gaussian policy:
SAC, TRPO, PPO and A2C (extra `sb3`).

    from stable_baselines3 import SAC
    from goalgan_bt.sb3 import RecallConfig, RecallTraces
    recall = RecallTraces(RecallConfig(max_kl=0.2))  # the default suits TRPO and PPO
    SAC("MlpPolicy", "Hopper-v5").learn(200_000, callback=recall)

Goyal et al. 2019, Algorithm 1 with Algorithm 2: the best trajectories teach a backtracking model,
which is unrolled from the most valuable states; the policy imitates those traces. The state is the
observation: the environment need know nothing of us.
"""

import ast
import time
from collections import deque
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from goalgan_bt.agent.networks import first_weights
from goalgan_bt.agent.rollout import Float32
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.learners.gaussian_agent import AgentImitation, GaussianAgent
from goalgan_bt.recall.backtracking import BacktrackingModel
from goalgan_bt.recall.forward import ForwardModel
from goalgan_bt.recall.imitation import faded
from goalgan_bt.recall.settings import BacktrackingConfig, RecallConfig
from goalgan_bt.recall.traces import recall_traces
from goalgan_bt.runs import checkpoint
from goalgan_bt.runs.signals import Stop
from goalgan_bt.runs.terminal import say

MOST = 5.0  # standard deviations from the mean at which a number of an observation is cut off
FAR = 3.0  # root mean square of the standard deviations from what was seen at which a trace ends
WAYS = 4  # that a forward model imagines from a state; the best is imitated


class Trajectory(NamedTuple):
    """One episode: observations as the environment gave them (T + 1, obs_dim), actions
    (T, act_dim) in [-1, 1], rewards (T,), and whether its last state ended it, or time ran out."""

    obs: FloatArray
    actions: FloatArray
    rewards: FloatArray
    terminated: bool


class Seen:
    """The observations of an agent as states: valid is what is not far from those seen. Numbers
    far out are cut off: contact forces, zero nearly always, would break the model."""

    def __init__(self, obs: FloatArray, act_dim: int) -> None:
        self.state_dim, self.act_dim = obs.shape[1], act_dim
        self._mean, self._std = obs.mean(axis=0), obs.std(axis=0) + 1e-3
        self._low, self._high = self._mean - MOST * self._std, self._mean + MOST * self._std

    def repair(self, states: FloatArray) -> FloatArray:
        """The same with numbers far out cut off."""
        return np.clip(states, self._low, self._high)

    def valid(self, states: FloatArray) -> BoolArray:
        """Whether each state (n, state_dim) is finite and not far away, (n,)."""
        away = np.square((states - self._mean) / self._std).mean(axis=1)
        return np.asarray(np.isfinite(away) & (away < FAR**2))


class Until(BaseCallback):
    """Ends `learn` as soon as somebody wants a run to stop."""

    def __init__(self, stop: Stop | None) -> None:
        super().__init__()
        self._stop = stop

    def _on_step(self) -> bool:
        return self._stop is None or not self._stop.requested


class RecallTraces(BaseCallback):
    """Lets an agent imitate recall traces while it learns. It may be given to `learn` again, and
    saved and loaded beside the agent.

    Args:
        cfg: settings.
        seed: of the model and the traces.
        verbose: as of every callback.

    Attributes:
        trajectories: what is remembered, the newest last; dynamics: the backtracking model (or the
            forward one, see `RecallConfig.model`), once learning has begun; last: what the last
            turn gave (see `turn`); seconds: what all of it took, the turns and what is remembered
            at each step; agent, imitation: of the agent that learns, and how it imitates.

    Raises:
        ValueError: for settings that make no sense.
        ValueError: when learning begins, if what is remembered is of another task's sizes.
        TypeError: when learning begins, if the agent's policy is no Gaussian (without memory or
            state-dependent exploration), its observations or actions are not vectors, or they are
            wrapped once more after they have been normalised.
    """

    def __init__(self, cfg: RecallConfig | None = None, seed: int = 0, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.cfg = cfg or RecallConfig()
        if problem := self.cfg.problem():
            raise ValueError(problem)
        self.trajectories: deque[Trajectory] = deque()
        self.dynamics: BacktrackingModel | ForwardModel | None = None
        self._seed = seed
        self._rng, self._noise = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
        self._remembered, self._turned = 0, 0
        self._moments: dict[str, Any] | None = None  # of a saved optimiser
        self.agent: GaussianAgent | None = None
        self.imitation: AgentImitation | None = None
        self._sizes = (0, 0)  # of observations and actions of the model
        self._now: FloatArray = np.empty(0)  # observations before the next step
        self._learning = False  # until `learn` has come to its end
        # Of each environment's episode that goes on: observation, action, reward of each step; and
        # whether it was seen from its beginning.
        self._paths: list[list[tuple[Any, Any, float]]] = []
        self._whole = np.empty(0, dtype=bool)
        self._loaded = False  # and not gone on with yet
        self._waited = False  # for episodes to learn from, which is told once
        self.last: dict[str, float] = {}
        self.seconds = 0.0

    def _new_model(self, obs_dim: int, act_dim: int) -> BacktrackingModel | ForwardModel:
        self._sizes = obs_dim, act_dim
        cfg = BacktrackingConfig(batch=256, steps=self.cfg.model_steps)
        with first_weights(self._seed):  # the agent's own noise stays as it would be alone
            if self.cfg.model == "forward":
                return ForwardModel(obs_dim, act_dim, cfg, self._noise)
            return BacktrackingModel(obs_dim, act_dim, cfg=cfg, generator=self._noise)

    def _init_callback(self) -> None:
        agent = GaussianAgent(self.model)
        if self.dynamics is None or (agent.sizes != self._sizes and not self.trajectories):
            self.dynamics = self._new_model(*agent.sizes)
        if agent.sizes != self._sizes:
            raise ValueError(
                f"this RecallTraces remembers observations and actions of {self._sizes} numbers, "
                f"the agent's have {agent.sizes}: take a new one"
            )
        if self.agent is None or self.agent.model is not self.model:
            self.agent, self.imitation = agent, AgentImitation(agent, self.cfg, self._rng)
            if not self._loaded:
                self._turned = self.model.num_timesteps
            if not self._loaded or len(self._paths) != self.model.n_envs:
                self._paths = [[] for _ in range(self.model.n_envs)]
                self._whole = np.zeros(self.model.n_envs, dtype=bool)
            self._loaded = False
        if self._moments is not None and _fit(self._moments, self._imitating.optimiser):
            checkpoint.restore(self._imitating.optimiser, self._moments)
        self._moments = None

    @property
    def _acting(self) -> GaussianAgent:
        assert self.agent is not None
        return self.agent

    @property
    def _imitating(self) -> AgentImitation:
        assert self.imitation is not None
        return self.imitation

    def _on_training_start(self) -> None:
        self._normalising = self.model.get_vec_normalize_env()
        begin, anew = self._original(self.model._last_obs), self.locals["reset_num_timesteps"]
        expected = self._acting.sizes[:1]
        if begin.shape[1:] != expected:
            raise TypeError(
                f"RecallTraces cannot see the observations {expected} of the agent before they are "
                f"normalised, only {begin.shape[1:]}: let VecNormalize be the outermost wrapper"
            )
        if anew:
            self._turned = 0
        anew = anew or not self.model.num_timesteps
        if anew or self._learning or not np.array_equal(begin, self._now):
            # The environments have been reset, or went on without us, for a step perhaps where
            # `learn` did not come to its end: what they are in the middle of is not remembered.
            for path in self._paths:
                path.clear()
            self._whole[:] = anew
        self._now, self._learning = begin, True

    def _on_training_end(self) -> None:
        self._learning = False

    def _original(self, obs: Any) -> FloatArray:
        """The last observations as the environments gave them: what an agent that normalises has
        seen would look different by the time that it is recalled."""
        known = obs if self._normalising is None else self._normalising.get_original_obs()
        return self._acting.rows.of(known)

    def _normalised(self, obs: FloatArray) -> FloatArray:
        """Observations (n, obs_dim) as the agent sees them at present."""
        if self._normalising is None:
            return obs
        rows = self._acting.rows
        return rows.of(self._normalising.normalize_obs(rows.back(obs)))

    def _on_step(self) -> bool:
        begin = time.perf_counter()
        given = self.locals
        actions = given.get("clipped_actions", given["actions"])
        told = self._acting.in_unit(actions)
        normalising, rewards = self._normalising, given["rewards"]
        if normalising is not None:
            rewards = normalising.get_original_reward()
        for i, path in enumerate(self._paths):
            path.append((self._now[i], told[i], float(rewards[i])))
            if not given["dones"][i]:
                continue
            if self._whole[i]:
                info = given["infos"][i]
                last, timeout = info["terminal_observation"], info.get("TimeLimit.truncated", False)
                if normalising is not None:
                    last = normalising.unnormalize_obs(last)
                last = self._acting.rows.of(last)
                obs, actions, rewards_of = map(np.array, zip(*path, strict=True))
                whole = np.concatenate([obs, last[None]])
                self.remember(Trajectory(whole, actions, rewards_of, not timeout))
            path.clear()
            self._whole[i] = True
        self._now = self._original(given["new_obs"])
        self.seconds += time.perf_counter() - begin
        return True

    @property
    def unfinished(self) -> list[int]:
        """Steps of each environment's episode so far that is going on."""
        return [len(path) for path in self._paths]

    def remember(self, ended: Trajectory) -> None:
        """Take in an episode; the oldest make room."""
        self.trajectories.append(ended)
        self._remembered += len(ended.rewards)
        while self._remembered - len(self.trajectories[0].rewards) >= self.cfg.capacity:
            self._remembered -= len(self.trajectories.popleft().rewards)

    def _on_rollout_start(self) -> None:
        # The agent has just learned, and what it collects next is collected by the policy as it
        # will be then: the moment to change it.
        if self.num_timesteps - self._turned >= self.cfg.every:
            self._turned = self.num_timesteps
            begin = time.perf_counter()
            self.last = self.turn() if self.max_kl() > 0 else {}
            for name, value in self.last.items():
                self.logger.record(f"recall/{name}", value)
            self.seconds += time.perf_counter() - begin
            self.logger.record("recall/seconds", self.seconds)

    def max_kl(self) -> float:
        """The bound on the KL at present, nats."""
        return faded(self.cfg.max_kl, self.num_timesteps, self.cfg.fade_steps)

    def best(self) -> tuple[list[Trajectory], float]:
        """The trajectories whose return is in the top percent, and the lowest of those returns. The
        lowest of all is never among them: where few reach a goal, it is what all others get."""
        returns = np.array([trajectory.rewards.sum() for trajectory in self.trajectories])
        if not len(returns) or returns.min() == returns.max():
            return [], np.nan  # none is better than another
        most = max(1, round(len(returns) * self.cfg.top_percent / 100))
        threshold = max(np.sort(returns)[-most], returns[returns > returns.min()].min())
        chosen = zip(self.trajectories, returns, strict=True)
        return [one for one, total in chosen if total >= threshold], float(threshold)

    def turn(self) -> dict[str, float]:
        """One turn of Algorithm 1 besides the agent's own: train the model, recall, imitate.

        Returns:
            threshold: L; length, best_length: mean actions of all remembered trajectories, and of
            those that teach; action_nll, state_nll, or forward_nll: see the models; valid: share
            of the steps of the traces before they ended; loss, kl, log_pi: see `AgentImitation`;
            log_ratio: log pi(a | s) - log q(a | s') before it, nats per step: of the paper's lower
            bound of log p(R > L) (section 4) the part that is known; the world's transitions are
            not. Nothing while there is too little to learn from.
        """
        chosen, threshold = self.best()
        total = sum(len(one.rewards) for one in chosen)
        if total < self.cfg.min_steps:
            if not self._waited:
                say(
                    f"RecallTraces waits: {total} of {self.cfg.min_steps} steps of episodes that "
                    "are better than others"
                )
            self._waited = True
            return {}
        states, following = (
            self._normalised(np.concatenate([one.obs[rows] for one in chosen]))
            for rows in (slice(-1), slice(1, None))
        )
        actions = np.concatenate([one.actions for one in chosen])
        rewards = np.concatenate([one.rewards for one in chosen])
        if self._normalising is not None:  # as the critic's
            rewards = self._normalising.normalize_reward(rewards)
        lengths = {
            "length": float(np.mean([len(one.rewards) for one in self.trajectories])),
            "best_length": total / len(chosen),
        }
        space = Seen(states, actions.shape[1])
        known, after = space.repair(states), space.repair(following)
        model = self.dynamics
        assert model is not None
        imitate = partial(self._imitating.update, max_kl=self.max_kl())
        metrics = {"threshold": threshold, **lengths, **model.fit(known, actions, after)}
        if isinstance(model, ForwardModel):
            told, done, valid = self.imagine(model, space, known)
            metrics["valid"] = float(valid.mean())
            return metrics | (imitate(told, done, states) if len(told) else {})

        worth = rewards
        if self.cfg.seeds == "value":  # of reaching a state: where it ends, nothing follows
            ends = np.cumsum([len(one.rewards) for one in chosen]) - 1
            future = self._acting.values(following)
            future[ends[[one.terminated for one in chosen]]] = 0.0
            gamma: float = self.model.gamma  # type: ignore[attr-defined]
            worth = rewards + gamma * future
        seeds = after[np.argsort(worth)[-self.cfg.traces :]].astype(float)
        traces = recall_traces(
            model, seeds, self.cfg.trace_length, valid=space.valid, repair=space.repair
        )
        metrics["valid"] = float(traces.valid.mean())
        if traces.valid.any():
            later = np.concatenate([seeds[None], traces.states[:-1]])[traces.valid]
            recalled = traces.states[traces.valid], traces.actions[traces.valid]
            happened = (torch.from_numpy(x).float() for x in (later, recalled[1]))
            log_q = model.action_log_density(*happened).mean().item()
            metrics |= imitate(*recalled, states)
            metrics["log_ratio"] = metrics["log_pi"] - log_q
        return metrics

    def imagine(
        self, model: ForwardModel, space: Seen, states: FloatArray
    ) -> tuple[Float32, Float32, BoolArray]:
        """Let the policy act in a forward model, `WAYS` times from each of some of the states
        (m, obs_dim). The best is kept of those that have the same beginning: otherwise it would be
        the beginnings that are chosen.

        Returns:
            States and actions in [-1, 1] of those that end best, (n, obs_dim), (n, act_dim); which
            of all steps were valid, (trace_length, WAYS * traces).
        """
        begins = states[self._rng.integers(len(states), size=self.cfg.traces)]
        now = np.tile(begins, (WAYS, 1))
        told = np.empty((self.cfg.trace_length, *now.shape), np.float32)
        done = np.empty((*told.shape[:2], space.act_dim), np.float32)
        valid = np.empty(told.shape[:2], dtype=bool)
        going = np.ones(len(now), dtype=bool)
        for t in range(self.cfg.trace_length):
            told[t], done[t] = now, self._acting.sample(now, self._noise)
            following = model.successors(*map(torch.from_numpy, (told[t], done[t]))).numpy()
            going &= space.valid(following)
            valid[t] = going
            now = np.where(going[:, None], space.repair(following), now)
        worth = self._acting.values(now).reshape(WAYS, -1)
        best = np.arange(WAYS)[:, None] == worth.argmax(axis=0)
        kept = valid & best.ravel()
        return told[kept], done[kept], valid

    def state_dict(self) -> dict[str, Any]:
        """Settings, model, trajectories, episodes that go on and random generators: what it takes
        to go on with a saved agent as if nothing had been saved.

        Raises:
            ValueError: if no episode has ended yet.
        """
        if self.dynamics is None or not self.trajectories:
            raise ValueError("nothing was learned yet: save after the first episode of `learn`")
        moments = self._moments if self.imitation is None else self.imitation.optimiser.state_dict()
        return {
            "cfg": asdict(self.cfg),
            "model": self.dynamics.state_dict(),
            "optimiser": moments,
            "trajectories": [
                [*(torch.from_numpy(x) for x in one[:3]), one.terminated]
                for one in self.trajectories
            ],
            "paths": [
                [torch.from_numpy(np.array(part)) for part in zip(*path, strict=True)]
                for path in self._paths
            ],
            "whole": torch.from_numpy(self._whole),
            "now": torch.from_numpy(np.array(self._now)),
            "turned": self._turned,
            "rng": repr(self._rng.bit_generator.state),  # integers too long for a tensor
            "noise": self._noise.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave, but for the settings; before `learn`. The optimiser of
        the imitation begins anew where the agent is another than it was.

        Raises:
            ValueError: if there is no trajectory, or one that is none, or a number is not finite.
        """
        if not isinstance(state["optimiser"], dict | None):
            raise ValueError("the optimiser's part is none")
        self.trajectories.clear()
        self._remembered, sizes = 0, set()
        for obs, actions, rewards, terminated in state["trajectories"]:
            one = Trajectory(obs.numpy(), actions.numpy(), rewards.numpy(), terminated)
            sizes.add((one.obs.shape[1], one.actions.shape[1]))
            if not len(one.obs) - 1 == len(one.actions) == len(one.rewards):
                raise ValueError("a trajectory's parts differ in length")
            if not all(np.isfinite(part).all() for part in one[:3]):
                raise ValueError("a trajectory has numbers that are not finite")
            self.trajectories.append(one)
            self._remembered += len(one.rewards)
        if len(sizes) != 1:
            raise ValueError(f"it must hold trajectories of one task, not of {len(sizes)}")
        self.dynamics = self._new_model(*sizes.pop())
        self.dynamics.load_state_dict(state["model"])
        if not all(param.isfinite().all() for param in self.dynamics.parameters()):
            raise ValueError("the model has numbers that are not finite")
        self._moments = state["optimiser"]
        self._paths = [
            list(zip(path[0].numpy(), path[1].numpy(), path[2].tolist(), strict=True))
            for path in (path or (torch.empty(0),) * 3 for path in state["paths"])
        ]
        self._whole, self._now = state["whole"].numpy().copy(), state["now"].numpy().copy()
        self._turned, self._loaded = int(state["turned"]), True
        self._rng.bit_generator.state = ast.literal_eval(state["rng"])
        self._noise.set_state(state["noise"])

    def save(self, path: Path | str) -> None:
        """Write the `state_dict`, to go on with a saved agent (`load`).

        Raises:
            ValueError: if no episode has ended yet.
            OSError: if the file cannot be written; an old one is left as it was.
        """
        checkpoint.save(self.state_dict(), Path(path))

    @classmethod
    def load(cls, path: Path | str, cfg: RecallConfig | None = None) -> "RecallTraces":
        """What `save` wrote, to be given to `learn` of the loaded agent.

        Args:
            path: of the file.
            cfg: settings; those that were saved if None.

        Raises:
            OSError: if the file cannot be opened.
            ValueError: if it is damaged, or made with another `RecallConfig.model`.
        """
        with checkpoint.loaded(Path(path)) as state:
            callback = cls(cfg or RecallConfig(**state["cfg"]))
            if (kind := state["cfg"]["model"]) != callback.cfg.model:
                raise ValueError(f"its model is {kind}, not {callback.cfg.model}")
            callback.load_state_dict(state)
        return callback


def _fit(moments: dict[str, Any], optimiser: torch.optim.Optimizer) -> bool:
    """Whether an optimiser's saved state is of parameters as those that it has now."""
    (group,) = optimiser.param_groups
    shapes = [param.shape for param in group["params"]]
    known = moments.get("state", {})
    return len(moments.get("param_groups", [{}])[0].get("params", [])) == len(shapes) and all(
        known[i]["exp_avg"].shape == shapes[i] for i in known
    )
