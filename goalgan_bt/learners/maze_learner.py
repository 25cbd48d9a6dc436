"""All that learns or remembers in a maze run, in one place: what a checkpoint holds stands here."""

import ast
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from goalgan_bt.agent.policy import GaussianPolicy, ValueFunction
from goalgan_bt.agent.rollout import Collector, Episodes, Rollouts
from goalgan_bt.curriculum.baselines import feasible, oracle
from goalgan_bt.curriculum.curriculum import GoalCurriculum
from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.learners.maze_config import MazeConfig
from goalgan_bt.recall.backtracking import BacktrackingModel
from goalgan_bt.recall.forward import ForwardModel
from goalgan_bt.recall.imitation import Imitation
from goalgan_bt.recall.places import Places
from goalgan_bt.recall.transitions import Transitions
from goalgan_bt.runs import checkpoint, ranks
from goalgan_bt.runs.session import checked
from goalgan_bt.runs.sound import finite

NOISY = ("rollout", "evaluation", "trpo", "value", "gan", "backtracking", "imitation")


class MazeLearner:
    """The training state, random generators included. Where the policy goes by a heading, the
    environment gets it here.

    Attributes:
        rng: numpy's generator; noise: torch's, one per part, since parts learn side by side.
        policy, value, curriculum, places, transitions, backtracking, imitation: the parts; forward:
            the one that only a control has, else None.
        recalls: whether there are recall traces; dropped: batches in a row that were left out.
    """

    def __init__(self, env: GoalEnv, cfg: MazeConfig) -> None:
        torch.manual_seed(cfg.seed)  # first weights
        self.cfg = cfg
        self.recalls = cfg.backtracking.trace_length > 0 and cfg.imitation.source == "traces"
        self.rng = np.random.default_rng(cfg.seed)
        seeds = np.random.SeedSequence(cfg.seed).generate_state(len(NOISY)).tolist()
        self.noise = {
            part: torch.Generator().manual_seed(seed)
            for part, seed in zip(NOISY, seeds, strict=True)
        }
        self.places = places_of(env, cfg)
        env.heading = self.places.heading if cfg.places.heading else None
        sizes = env.state_dim, env.act_dim
        self.policy = GaussianPolicy(env.obs_dim, env.act_dim, cfg.policy)
        self.value = ValueFunction(env.obs_dim, cfg.value)
        self.curriculum = GoalCurriculum(
            env.goal_low,
            env.goal_high,
            goals=cfg.goals,
            gan=cfg.gan,
            rng=self.rng,
            noise=self.noise["gan"],
        )
        noise = self.noise["backtracking"]
        self.backtracking = BacktrackingModel(
            *sizes, env.goal_dim, cfg.backtracking, generator=noise
        )
        self.forward = None
        if cfg.imitation.source == "forward":
            self.forward = ForwardModel(*sizes, cfg.backtracking, noise)
        self.transitions = Transitions(*sizes, env.goal_dim, cfg.backtracking)
        self.imitation = Imitation(self.policy, cfg.imitation, self.noise["imitation"])
        self.dropped = 0

    def propose(self, env: GoalEnv) -> tuple[FloatArray, int]:
        """New goals, (n, goal_dim), and the environment steps that it took to find them.

        Args:
            env: simulations in which the oracle tries goals.
        """
        goals = self.cfg.goals
        if goals.source == "feasible":
            return feasible(env, goals.new, self.rng), 0
        if goals.source == "oracle":
            return oracle(env, self.policy, goals, self.rng, self.noise["evaluation"])
        return self.curriculum.propose(goals.new), 0

    def remember(self, episodes: Episodes) -> None:
        """Take in finished episodes: outcomes for the curriculum, transitions for the model."""
        first, won = episodes.from_start, episodes.success
        self.curriculum.remember(episodes.goals[first], won[first])
        # Where time ran out, the agent has got to where it is.
        goals = np.where(won[:, None], episodes.goals, episodes.ends)[episodes.kept]
        lengths = episodes.lengths[episodes.kept]
        left = np.repeat(np.cumsum(lengths), lengths) - np.arange(lengths.sum()) - 1
        goals = np.repeat(goals, lengths, axis=0)
        rows = episodes.states, episodes.actions, episodes.next_states, goals
        whole = np.all([np.isfinite(row).all(axis=1) for row in rows], axis=0)
        if not whole.all():  # one number that is none would end what learns from its episode
            episode = np.repeat(np.arange(len(lengths)), lengths)
            whole = ~np.isin(episode, episode[~whole])
        self.transitions.add(*(row[whole] for row in rows), left[whole])

    def learn_places(self, rollouts: Rollouts) -> None:
        """Count the moves from place to place in the rollouts of all ranks, if anybody asks for
        ways."""
        if self.cfg.places.used:
            steps = rollouts.origins, rollouts.achieved
            self.places.learn(*(ranks.gather(at.swapaxes(0, 1)) for at in steps))

    def fit_model(self) -> dict[str, float]:
        """Let the model whose steps are imitated learn from the transitions."""
        rows = self.transitions
        if not rows.enough or not (self.recalls or self.forward is not None):
            return {}
        known = slice(rows.size)
        data = rows.states[known], rows.actions[known], rows.next_states[known]
        if self.forward is not None:
            return self.forward.fit(*data)
        return self.backtracking.fit(*data, rows.goals[known], unseen=rows.unseen())

    def tensors(self) -> list[Tensor]:
        """Every network's parameters and buffers, as they are held."""
        gan = self.curriculum.gan
        networks: list[nn.Module | None] = [
            self.policy,
            self.value,
            gan.generator,
            gan.discriminator,
            self.backtracking,
            self.forward,
        ]
        return [
            tensor.detach()
            for network in networks
            if network is not None
            for tensor in (*network.parameters(), *network.buffers())
        ]

    def broken(self) -> str | None:
        """The first part with a weight that is not finite, from which it cannot learn any more."""
        parts = self._parts() | {"GAN": self.curriculum.gan}
        for name, part in parts.items():
            normaliser = [self.policy.normaliser.mean] if name == "policy" else []
            if hasattr(part, "parameters") and not finite(*part.parameters(), *normaliser):
                return name.replace("value", "value function")
        return None

    def _parts(self) -> dict[str, Any]:
        """Everything with a `state_dict` and a `load_state_dict`."""
        parts: dict[str, Any] = {
            "policy": self.policy,
            "value": self.value,
            "curriculum": self.curriculum,
            "places": self.places,
            "transitions": self.transitions,
            "backtracking": self.backtracking,
            "imitation": self.imitation,
        }
        return parts if self.forward is None else parts | {"forward": self.forward}

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain values only, so that it loads with `weights_only=True`."""
        return {name: part.state_dict() for name, part in self._parts().items()} | {
            "rng": repr(self.rng.bit_generator.state),  # integers too long for a tensor
            "noise": {part: noise.get_state() for part, noise in self.noise.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave.

        Raises:
            KeyError, RuntimeError, ValueError, TypeError: if it is not such a state or of other
                sizes.
        """
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        self.rng.bit_generator.state = ast.literal_eval(state["rng"])
        for name, noise in self.noise.items():
            noise.set_state(state["noise"][name])


def load(learner: MazeLearner, folder: Path, collector: Collector | None = None) -> dict[str, Any]:
    """Put a run's `checkpoint.pt` into a learner of the same settings, and into its simulations.

    Returns:
        What the run's `Session` needs to go on.

    Raises:
        RunError: if there is none, or it is damaged or of other settings.
    """
    with checkpoint.saved(folder) as state:
        if "value" not in state["learner"]:
            raise ValueError("it holds a policy to be used, as those that are shipped")
        learner.load_state_dict(state["learner"])
        if broken := learner.broken():
            raise ValueError(f"a weight of the {broken} is not finite")
        if collector is not None:
            collector.load_state_dict(state["collector"])
        run = checked(state["run"])
    return run


def load_policy(
    env: GoalEnv, cfg: MazeConfig, folder: Path, kept: Path | None = None
) -> tuple[GaussianPolicy, int]:
    """The policy of a run's `checkpoint.pt`, and to the environment the heading that it goes by.

    Args:
        env: where it will act.
        cfg: the run's settings.
        folder: the run folder.
        kept: one that the run has kept in the checkpoint's place (`goalgan_bt.runs.policies`).

    Returns:
        The policy, and the iteration that made it.

    Raises:
        RunError: as `load`; of a kept one OSError or ValueError. The environment is left as it was.
    """
    places, before = places_of(env, cfg), env.heading
    env.heading = places.heading if cfg.places.heading else None  # the policy's size is with it
    try:
        policy = GaussianPolicy(env.obs_dim, env.act_dim, cfg.policy)
        with checkpoint.saved(folder) if kept is None else checkpoint.loaded(kept) as state:
            places.load_state_dict(state["learner"]["places"])
            policy.load_state_dict(state["learner"]["policy"])
            iteration = int(state["run"]["iteration"])
    except (OSError, ValueError):
        env.heading = before
        raise
    return policy, iteration


def places_of(env: GoalEnv, cfg: MazeConfig) -> Places:
    """Places for the goals of an environment."""
    return Places(env.goal_low, env.goal_high, env.success_radius, cfg.places)
