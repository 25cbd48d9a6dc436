"""The settings of the curriculum: goals and their GAN.

Apart from the code that reads them, so that a command line answers before torch is imported.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

from goalgan_bt.runs.ranges import ABOVE_ZERO, ABOVE_ZERO_OR_INFINITE, NOT_NEGATIVE, SHARE


@dataclass(frozen=True)
class GoalsConfig:
    """Proposal, labels and replay of goals."""

    source: Literal["gan", "gan_fit_all", "uniform", "feasible", "oracle", "alp_gmm"] = "gan"
    """What proposes goals: the GAN; a GAN of all places where the agent has been; the uniform
    distribution over the box, or over the free space; that of free goals which fresh episodes show
    to be of intermediate difficulty; ALP-GMM (extra `study`)."""
    r_min: Annotated[float, SHARE] = 0.1
    """Goals reached less often are too hard (Florensa 2018)."""
    r_max: Annotated[float, SHARE] = 0.9
    """Goals reached more often are mastered (Florensa 2018)."""
    new: Annotated[int, ABOVE_ZERO] = 200
    """Proposed goals per iteration."""
    anywhere: Annotated[float, SHARE] = 0.0
    """Share of them that is uniform over the box, so that a GAN which has closed in on mastered
    goals hears of others (the original: 0)."""
    old: Annotated[int, NOT_NEGATIVE] = 100
    """Goals from the replay per iteration."""
    labelled: Annotated[int, NOT_NEGATIVE] = 1000
    """Further goals, uniform in the box, that the success estimator labels for the GAN."""
    replay_distance: Annotated[float, NOT_NEGATIVE] = 0.3
    """Replayed goals keep this distance from each other, metres."""
    near: Annotated[float, ABOVE_ZERO_OR_INFINITE] = 0.4
    """A goal farther than this from all places where the agent has been is too hard, metres (the
    original: inf). Without it, walls around mastered places look intermediate."""
    frontier: Annotated[float, NOT_NEGATIVE] = 0.0
    """If above 0, a goal is worth trying until it is mastered wherever the agent has been and this
    far beyond, metres, unless tries near it have all failed; r_min then counts for nothing (the
    original: 0)."""
    hopeless: Annotated[int, ABOVE_ZERO] = 5
    """How many of the nearest tries, all within `near`, must have failed: of the last 5,000, or of
    `episodes` where those are more."""
    imagined: Annotated[int, ABOVE_ZERO] = 1
    """Goals imagined for each that is proposed: those of intermediate difficulty come first (the
    original: 1)."""
    label_rollouts: Annotated[int, NOT_NEGATIVE] = 0
    """Fresh episodes per goal for its label (the original: 3); 0 takes labels from training."""
    episodes: Annotated[int, ABOVE_ZERO] = 1000
    """Recent training episodes from which success is estimated."""
    neighbours: Annotated[int, ABOVE_ZERO] = 10
    """Episodes with the nearest goals whose successes are counted."""


def conflicts(cfg: GoalsConfig) -> Iterator[tuple[str, str]]:
    """What does not go together: a setting and what is wrong with it."""
    if cfg.neighbours > cfg.episodes:
        yield "neighbours", "must not be more than episodes"
    if cfg.r_min >= cfg.r_max:
        yield "r_min", "must be less than r_max"
    if cfg.frontier and cfg.frontier < cfg.near:
        yield "frontier", "must not be less than near, or 0"
    if cfg.source == "gan_fit_all" and cfg.near == math.inf:
        yield "near", "must be finite for gan_fit_all, which needs to know the places visited"


@dataclass(frozen=True)
class GanConfig:
    """The goal GAN (Florensa et al. 2018)."""

    noise_dim: Annotated[int, ABOVE_ZERO] = 4
    """Size of z."""
    generator_hidden: Annotated[tuple[int, ...], ABOVE_ZERO] = (256, 256)
    """Units of the generator's hidden layers (relu)."""
    discriminator_hidden: Annotated[tuple[int, ...], ABOVE_ZERO] = (128, 128)
    """Units of the discriminator's hidden layers (leaky relu 0.1)."""
    learning_rate: Annotated[float, ABOVE_ZERO] = 1e-3
    """Step size of RMSProp (decay 0.9), both networks."""
    batch: Annotated[int, ABOVE_ZERO] = 128
    """Real goals, and as many generated ones, per step."""
    steps: Annotated[int, ABOVE_ZERO] = 60
    """Training steps per iteration (the original: 250 to 300 of a smaller batch)."""
    pretrain_steps: Annotated[int, ABOVE_ZERO] = 100
    """Training steps on what the fresh policy visits."""
    generator_target: float = 1.0
    """c, what the generator wants D to say: 1 in the original code, 0 in the paper."""
    goal_noise: Annotated[float, NOT_NEGATIVE] = 0.3
    """Standard deviation of the noise added to generated goals, metres (the original: 0.5)."""
