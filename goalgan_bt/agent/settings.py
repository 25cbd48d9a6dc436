"""The settings of the agent: networks, rollouts, TRPO, coverage.

Apart from the code that reads them, so that a command line answers before torch is imported.
"""

from dataclasses import dataclass
from typing import Annotated

from goalgan_bt.runs.ranges import ABOVE_ZERO, NOT_NEGATIVE, SHARE, SHARE_ABOVE_ZERO, Range


@dataclass(frozen=True)
class PolicyConfig:
    """The policy network."""

    hidden: Annotated[tuple[int, ...], ABOVE_ZERO] = (64, 64)
    """Units of the hidden layers (as the original)."""
    input_gain: Annotated[float, ABOVE_ZERO] = 1.0
    """Scale of the first layer's first weights: more lets neighbouring places differ more."""
    init_std: Annotated[float, ABOVE_ZERO] = 0.6
    """First standard deviation of the actions, in units of the action range [-1, 1]."""
    min_std: Annotated[float, ABOVE_ZERO] = 0.05
    """The standard deviation never falls below this."""
    final_std: Annotated[float | None, ABOVE_ZERO] = None
    """If given, the standard deviation is bounded by a line from init_std to this over the run;
    once on the line it follows it."""


@dataclass(frozen=True)
class ValueConfig:
    """The value function."""

    hidden: Annotated[tuple[int, ...], ABOVE_ZERO] = (128, 128)
    """Units of the hidden layers."""
    input_gain: Annotated[float, ABOVE_ZERO] = 1.0
    """As the policy's."""
    learning_rate: Annotated[float, ABOVE_ZERO] = 1e-3
    """Step size of Adam."""
    epochs: Annotated[int, ABOVE_ZERO] = 2
    """Passes over the batch per update."""
    minibatch: Annotated[int, ABOVE_ZERO] = 2048
    """Observations per gradient step."""


@dataclass(frozen=True)
class RolloutConfig:
    """Collection of experience."""

    num_envs: Annotated[int, Range("between 1 and 100000", 1, 100_000)] = 512
    """Simulations side by side, in all processes together."""
    steps: Annotated[int, ABOVE_ZERO] = 100
    """Actions in each simulation per policy update; the batch has num_envs * steps of them."""
    chain: Annotated[float, SHARE] = 0.5
    """Chance that an episode that ended on its feet is followed by one from where it ended, with a
    new goal, instead of one from the start (the original: 0). Only episodes from the start make
    labels."""
    patience: Annotated[int, NOT_NEGATIVE] = 0
    """An episode that has come no nearer to its goal along the way for so many steps is over, for
    most that are stuck stay so until their time is up; 0 waits for that (the original). Coverage
    always does. Without a heading no way is known, and no episode ends so."""


@dataclass(frozen=True)
class TrpoConfig:
    """Trust region policy optimisation (Schulman et al. 2015)."""

    max_kl: Annotated[float, ABOVE_ZERO] = 0.03
    """Bound on the mean KL of one update, nats (the original: 0.01)."""
    cg_iters: Annotated[int, ABOVE_ZERO] = 10
    """Conjugate gradient iterations."""
    cg_damping: Annotated[float, NOT_NEGATIVE] = 0.01
    """Added to the Fisher matrix's diagonal."""
    fisher_fraction: Annotated[float, SHARE_ABOVE_ZERO] = 0.1
    """Share of the batch on which Fisher-vector products are taken (the original: 1)."""
    line_search_steps: Annotated[int, NOT_NEGATIVE] = 10
    """Step lengths tried before the update is given up."""
    line_search_decay: Annotated[float, SHARE_ABOVE_ZERO] = 0.7
    """Factor between two step lengths."""


@dataclass(frozen=True)
class CoverageConfig:
    """How coverage is measured."""

    rollouts: Annotated[int, ABOVE_ZERO] = 3
    """Episodes per test goal with the stochastic policy (the original: 2 point, 3 ant)."""
    every: Annotated[int, ABOVE_ZERO] = 2_000_000
    """Training steps between two measurements; one more at the end. More where so many would take
    more than twice the steps of training."""
