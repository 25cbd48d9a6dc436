"""All that learns or remembers, in one place: what a checkpoint holds is what is listed here."""

import ast
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from goalgan_bt.backtracking import BacktrackingModel, Transitions
from goalgan_bt.checkpoint import restore
from goalgan_bt.config import Config
from goalgan_bt.envs.batch import GoalEnv
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.forward import ForwardModel
from goalgan_bt.gan import GoalGAN
from goalgan_bt.goals import GoalMemory, SuccessEstimator, intermediate
from goalgan_bt.imitation import Imitation
from goalgan_bt.policy import GaussianPolicy, ValueFunction
from goalgan_bt.proposals import AlpGmm, feasible, oracle
from goalgan_bt.rollout import Episodes

NOISY = ("rollout", "evaluation", "trpo", "value", "gan", "backtracking", "imitation")


class Learner:
    """The training state, random generators included.

    Attributes:
        iteration: finished iterations; steps: environment steps by purpose (`train`, `label`,
            `eval`); seconds: wall time so far.
        rng: numpy's generator; noise: torch's, one per part, since parts learn side by side.
        policy, value, gan, estimator, replay, visited, backtracking, transitions, imitation: the
            parts; alp_gmm, forward: those that only some controls have, else None.
        recalls: whether there are recall traces.
    """

    def __init__(self, env: GoalEnv, cfg: Config) -> None:
        torch.manual_seed(cfg.seed)  # first weights
        self.cfg = cfg.goals
        self._reach = max(env.success_radius, cfg.goals.near)  # metres
        self.recalls = cfg.backtracking.trace_length > 0 and cfg.imitation.source == "traces"
        self.iteration = 0
        self.steps = {"train": 0, "label": 0, "eval": 0}
        self.seconds = 0.0
        self.next_coverage = 0
        self.rng = np.random.default_rng(cfg.seed)
        seeds = np.random.SeedSequence(cfg.seed).generate_state(len(NOISY)).tolist()
        self.noise = {
            part: torch.Generator().manual_seed(seed)
            for part, seed in zip(NOISY, seeds, strict=True)
        }
        self._box = env.goal_low, env.goal_high
        self.policy = GaussianPolicy(env.obs_dim, env.act_dim, cfg.policy)
        self.value = ValueFunction(env.obs_dim, cfg.value)
        self.gan = GoalGAN(*self._box, cfg.gan, self.noise["gan"])
        self.alp_gmm = AlpGmm(*self._box, self.rng) if cfg.goals.source == "alp_gmm" else None
        self.estimator = SuccessEstimator(env.goal_dim, cfg.goals)
        self.replay = GoalMemory(env.goal_dim, cfg.goals.replay_distance)
        self.visited = GoalMemory(env.goal_dim, cfg.goals.near / 2)
        self.backtracking = BacktrackingModel(
            env.state_dim, env.act_dim, env.goal_dim, cfg.backtracking, self.noise["backtracking"]
        )
        self.forward = None
        if cfg.imitation.source == "forward":
            self.forward = ForwardModel(
                env.state_dim, env.act_dim, cfg.backtracking, self.noise["backtracking"]
            )
        self.transitions = Transitions(env.state_dim, env.act_dim, env.goal_dim, cfg.backtracking)
        self.imitation = Imitation(self.policy, cfg.imitation, self.noise["imitation"])

    def propose(self, env: GoalEnv) -> tuple[FloatArray, int]:
        """New goals, (n, goal_dim), and the environment steps that it took to find them.

        Args:
            env: simulations in which the oracle tries goals.
        """
        n = self.cfg.new
        if self.alp_gmm is not None:
            return self.alp_gmm.sample(n), 0
        match self.cfg.source:
            case "uniform":
                return self.rng.uniform(*self._box, (n, env.goal_dim)), 0
            case "feasible":
                return feasible(env, n, self.rng), 0
            case "oracle":
                return oracle(env, self.policy, self.cfg, self.rng, self.noise["evaluation"])
        goals = self.gan.sample(n)
        if k := round(self.cfg.anywhere * n):
            goals[:k] = self.rng.uniform(*self._box, (k, env.goal_dim))
        return goals, 0

    def fit_model(self) -> dict[str, float]:
        """Let the model whose steps are imitated learn from the transitions."""
        if self.forward is not None:
            return self.forward.fit(self.transitions)
        return self.backtracking.fit(self.transitions) if self.recalls else {}

    def remember(self, episodes: Episodes) -> None:
        """Take in finished episodes: outcomes for the estimator, transitions for the model."""
        first, won = episodes.from_start, episodes.success
        self.estimator.add(episodes.goals[first], won[first])
        if self.alp_gmm is not None:
            self.alp_gmm.add(episodes.goals[first], won[first])
        # Where time ran out, the agent has got to where it is.
        goals = np.where(won[:, None], episodes.goals, episodes.ends)[episodes.kept]
        lengths = episodes.lengths[episodes.kept]
        left = np.repeat(np.cumsum(lengths), lengths) - np.arange(lengths.sum()) - 1
        goals = np.repeat(goals, lengths, axis=0)
        self.transitions.add(episodes.states, episodes.actions, episodes.next_states, goals, left)

    def intermediate(self, goals: FloatArray, success: FloatArray) -> BoolArray:
        """Labels of goals (n, goal_dim) with that success (n,): intermediate difficulty, (n,).

        Besides the bounds on success, a goal must be near a place where the agent has been: the
        estimator averages over neighbours, and beside a mastered place there may be a wall.
        """
        near = self.visited.distance_to(goals) <= self.cfg.near
        return intermediate(success, self.cfg.r_min, self.cfg.r_max) & near

    def label(
        self, goals: FloatArray, success: FloatArray
    ) -> tuple[BoolArray, FloatArray, BoolArray]:
        """Label goals that were tried, and keep the intermediate ones for replay.

        Args:
            goals: (n, goal_dim).
            success: (n,) how often each is reached.

        Returns:
            Their labels (n,), and what the GAN shall learn from: these goals and their labels,
            followed by goals that nobody tried, since the estimator's labels are free.
        """
        labels = self.intermediate(goals, success)
        self.replay.add(goals[labels])
        if self.cfg.source == "gan_fit_all":
            return labels, self.visited.goals, np.ones(len(self.visited), dtype=bool)
        extra = 0 if self.cfg.label_rollouts else self.cfg.labelled
        others = self.rng.uniform(*self._box, (extra, goals.shape[1]))
        other_labels = self.intermediate(others, self.estimator(others))
        return labels, np.concatenate([goals, others]), np.concatenate([labels, other_labels])

    def estimated_success(self, goals: FloatArray) -> FloatArray:
        """What a map shows: estimated success at goals (n, goal_dim), (n,), but 0 where the agent
        has never been near enough to reach them."""
        reached = self.visited.distance_to(goals) <= self._reach
        return np.where(reached, self.estimator(goals), 0.0)

    def _modules(self) -> dict[str, Any]:
        """Everything with torch's `state_dict` and `load_state_dict`: networks, optimisers."""
        modules: dict[str, Any] = {
            "policy": self.policy,
            "value": self.value,
            "value_optimiser": self.value.optimiser,
            "generator": self.gan.generator,
            "generator_optimiser": self.gan.generator_optimiser,
            "discriminator": self.gan.discriminator,
            "discriminator_optimiser": self.gan.discriminator_optimiser,
            "backtracking": self.backtracking,
            "backtracking_optimiser": self.backtracking.optimiser,
            "imitation_optimiser": self.imitation.optimiser,
        }
        if self.forward is not None:
            modules |= {"forward": self.forward, "forward_optimiser": self.forward.optimiser}
        return modules

    def tensors(self) -> list[Tensor]:
        """Every network's parameters and buffers, as they are held."""
        networks = (module for module in self._modules().values() if isinstance(module, nn.Module))
        return [tensor for network in networks for tensor in network.state_dict().values()]

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain values only, so that it loads with `weights_only=True`."""
        rows = self.transitions
        return {
            "modules": {name: module.state_dict() for name, module in self._modules().items()},
            "iteration": self.iteration,
            "steps": dict(self.steps),
            "seconds": self.seconds,
            "next_coverage": self.next_coverage,
            "rng": repr(self.rng.bit_generator.state),  # integers too long for a tensor
            "noise": {part: noise.get_state() for part, noise in self.noise.items()},
            "replay": torch.from_numpy(self.replay.goals),
            "visited": torch.from_numpy(self.visited.goals),
            "estimator_goals": torch.from_numpy(self.estimator.goals),
            "estimator_success": torch.from_numpy(self.estimator.success),
            "alp_gmm": {} if self.alp_gmm is None else self.alp_gmm.state_dict(),
            "transitions": {
                name: torch.from_numpy(getattr(rows, name)[rows.newest(rows.size)])
                for name in rows.COLUMNS
            },
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave.

        Raises:
            KeyError, RuntimeError, ValueError, TypeError: if it is not such a state or of other
                sizes.
        """
        for name, module in self._modules().items():
            restore(module, state["modules"][name])
        self.iteration = int(state["iteration"])
        self.steps = {name: int(state["steps"][name]) for name in self.steps}
        self.seconds = float(state["seconds"])
        self.next_coverage = int(state["next_coverage"])
        self.rng.bit_generator.state = ast.literal_eval(state["rng"])
        for part, noise in self.noise.items():
            noise.set_state(state["noise"][part])
        self.replay.goals = state["replay"].numpy().copy()
        self.visited.goals = state["visited"].numpy().copy()
        self.estimator.goals = state["estimator_goals"].numpy().copy()
        self.estimator.success = state["estimator_success"].numpy().copy()
        if self.alp_gmm is not None:
            self.alp_gmm.load_state_dict(state["alp_gmm"])
        rows = self.transitions
        rows.size = rows.cursor = rows.added = 0
        rows.add(*(state["transitions"][name].numpy() for name in rows.COLUMNS))
        self.backtracking.seen = rows.added
