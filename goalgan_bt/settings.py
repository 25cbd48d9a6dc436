"""The settings of each part of the learner, which the file of the same name reads.

They stand here together, apart from what reads them, so that the command line answers at once:
importing the learner takes seconds.
"""

import math
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Literal

MOST_RECALLED = 1_000_000  # steps at a time: beyond it memory, not sense, is the limit


def too_much(trace_length: int, traces: int) -> str | None:
    """Why so many recall traces of this length cannot be unrolled at once; None if they can."""
    if int(trace_length) * int(traces) <= MOST_RECALLED:  # numpy's own integers would overflow
        return None
    return f"trace_length times traces must be at most {MOST_RECALLED} steps"


@dataclass(frozen=True)
class PolicyConfig:
    """The policy network."""

    hidden: tuple[int, ...] = (64, 64)
    """Units of the hidden layers (as the original)."""
    input_gain: float = 1.0
    """Scale of the first layer's first weights: more lets neighbouring places differ more."""
    init_std: float = 0.6
    """First standard deviation of the actions, in units of the action range [-1, 1]."""
    min_std: float = 0.05
    """The standard deviation never falls below this."""
    final_std: float | None = None
    """If given, the standard deviation is bounded by a line from init_std to this over the run;
    once on the line it follows it."""


@dataclass(frozen=True)
class ValueConfig:
    """The value function."""

    hidden: tuple[int, ...] = (128, 128)
    """Units of the hidden layers."""
    input_gain: float = 1.0
    """As the policy's."""
    learning_rate: float = 1e-3
    """Step size of Adam."""
    epochs: int = 2
    """Passes over the batch per update."""
    minibatch: int = 2048
    """Observations per gradient step."""


@dataclass(frozen=True)
class RolloutConfig:
    """Collection of experience."""

    num_envs: int = 512
    """Simulations side by side, in all processes together."""
    steps: int = 100
    """Actions in each simulation per policy update; the batch has num_envs * steps of them."""
    chain: float = 0.5
    """Chance that an episode that ended on its feet is followed by one from where it ended, with a
    new goal, instead of one from the start (the original: 0). Only episodes from the start make
    labels."""


@dataclass(frozen=True)
class GoalsConfig:
    """Proposal, labels and replay of goals."""

    source: Literal["gan", "gan_fit_all", "uniform", "feasible", "oracle", "alp_gmm"] = "gan"
    """What proposes goals: the GAN; a GAN of all places where the agent has been; the uniform
    distribution over the box, or over the free space; that of free goals which fresh episodes show
    to be of intermediate difficulty; ALP-GMM (extra `study`)."""
    r_min: float = 0.1
    """Goals reached less often are too hard (Florensa 2018)."""
    r_max: float = 0.9
    """Goals reached more often are mastered (Florensa 2018)."""
    new: int = 200
    """Proposed goals per iteration."""
    anywhere: float = 0.0
    """Share of them that is uniform over the box, so that a GAN which has closed in on mastered
    goals hears of others (the original: 0)."""
    old: int = 100
    """Goals from the replay per iteration."""
    labelled: int = 1000
    """Further goals, uniform in the box, that the success estimator labels for the GAN."""
    replay_distance: float = 0.3
    """Replayed goals keep this distance from each other, metres."""
    near: float = 0.4
    """A goal farther than this from all places where the agent has been is too hard, metres (the
    original: inf). Without it, walls around mastered places look intermediate."""
    label_rollouts: int = 0
    """Fresh episodes per goal for its label (the original: 3); 0 takes labels from training."""
    episodes: int = 1000
    """Recent training episodes from which success is estimated."""
    neighbours: int = 10
    """Episodes with the nearest goals whose successes are counted."""


@dataclass(frozen=True)
class GanConfig:
    """The goal GAN (Florensa et al. 2018)."""

    noise_dim: int = 4
    """Size of z."""
    generator_hidden: tuple[int, ...] = (256, 256)
    """Units of the generator's hidden layers (relu)."""
    discriminator_hidden: tuple[int, ...] = (128, 128)
    """Units of the discriminator's hidden layers (leaky relu 0.1)."""
    learning_rate: float = 1e-3
    """Step size of RMSProp (decay 0.9), both networks."""
    batch: int = 128
    """Real goals, and as many generated ones, per step."""
    steps: int = 60
    """Training steps per iteration (the original: 250 to 300 of a smaller batch)."""
    pretrain_steps: int = 100
    """Training steps on what the fresh policy visits."""
    generator_target: float = 1.0
    """c, what the generator wants D to say: 1 in the original code, 0 in the paper."""
    goal_noise: float = 0.3
    """Standard deviation of the noise added to generated goals, metres (the original: 0.5)."""


@dataclass(frozen=True)
class TrpoConfig:
    """Trust region policy optimisation (Schulman et al. 2015)."""

    max_kl: float = 0.03
    """Bound on the mean KL of one update, nats (the original: 0.01)."""
    cg_iters: int = 10
    """Conjugate gradient iterations."""
    cg_damping: float = 0.01
    """Added to the Fisher matrix's diagonal."""
    fisher_fraction: float = 0.1
    """Share of the batch on which Fisher-vector products are taken (the original: 1)."""
    line_search_steps: int = 10
    """Step lengths tried before the update is given up."""
    line_search_decay: float = 0.7
    """Factor between two step lengths."""


@dataclass(frozen=True)
class BacktrackingConfig:
    """The backtracking model and its recall traces (Goyal et al. 2019)."""

    trace_length: int = 20
    """Length of a recall trace in environment steps (paper: 20 point, 50 ant); 0 is plain Goal
    GAN. The model takes one backward step per action, `action_repeat` of them."""
    traces: int = 200
    """Recall traces per iteration, at most."""
    hidden: tuple[int, ...] = (128, 128)
    """Units of both networks' hidden layers (paper)."""
    steps: int = 5
    """Training steps per policy update (paper: 100 per 5 updates of four times our batch)."""
    batch: int = 128
    """Transitions per training step."""
    learning_rate: float = 1e-3
    """Step size of Adam."""
    experience: Literal["successes", "all"] = "all"
    """Episodes whose transitions are kept: those that reached their goal (the paper), or also those
    that ran out of time, for the place where they ended (hindsight)."""
    buffer: int = 100_000
    """Transitions that are kept, the newest."""
    min_transitions: int = 5_000
    """No training and no traces before the buffer holds this many."""
    max_shift: float = 0.5
    """The decoder moves an experienced state by at most this much to a goal, metres."""
    sample_actions: bool = True
    """Sample a ~ q(a | s'), as in the paper; otherwise its mean."""
    conditioned: bool = False
    """Tell q(a | s') for which goal the action was (the paper: no)."""
    seeds: Literal["goals", "values"] = "goals"
    """Where traces begin: at decoded goals, or at the experienced states of highest value
    (Algorithm 2)."""


@dataclass(frozen=True)
class ImitationConfig:
    """Imitation of recall traces."""

    source: Literal["traces", "experience", "forward"] = "traces"
    """What is imitated: recall traces; as many real steps, as long before the end of their episode
    (self-imitation); steps that a forward model imagines of the policy, where they reach the goal
    (after Dyna). The latter two are controls."""
    relabel: bool = True
    """Imitate each step for a random later place of its trace or episode (hindsight) instead of
    for the goal at its end (the paper)."""
    steps: int = 20
    """Gradient steps per iteration."""
    batch: int = 512
    """(state, action) pairs per step."""
    learning_rate: float = 1e-4
    """Step size of Adam, an optimiser of its own."""
    max_kl: float = 0.005
    """Imitation stops where the mean KL on the last rollouts passes this, nats."""
    fade: float | None = None
    """If given, that bound falls on a line to zero at this share of the run: what helps a novice
    holds back an expert."""


@dataclass(frozen=True)
class CoverageConfig:
    """How coverage is measured."""

    rollouts: int = 3
    """Episodes per test goal with the stochastic policy (the original: 2 point, 3 ant)."""
    every: int = 2_000_000
    """Training steps between two measurements; one more at the end."""


@dataclass(frozen=True)
class RecallConfig:
    """Recall traces beside an agent of Stable-Baselines3: what is recalled, how it is imitated."""

    model: Literal["backward", "forward"] = "backward"
    """What is learned: the backtracking model, or a control (the paper's appendix, after Dyna): a
    forward model, in which the policy acts; of four ways that it imagines from a state it imitates
    the one that ends best, by the critic's value."""
    trace_length: int = 20
    """Steps of a recall trace (paper: 20; with TRPO Hopper 10; Ant and Humanoid 50)."""
    traces: int = 64
    """Recall traces per turn."""
    top_percent: float = 10.0
    """Share of the remembered trajectories, those of highest return, that teach the model: their
    lowest return is the threshold L of the paper's section 4, which rises as the agent learns.
    While all returns are the same none is."""
    capacity: int = 100_000
    """Steps that are remembered, in whole trajectories, the newest."""
    min_steps: int = 500
    """Steps of the best trajectories before which nothing is recalled."""
    every: int = 500
    """Environment steps between two turns, or a rollout where that is more."""
    seeds: Literal["value", "reward"] = "value"
    """Traces begin at states of which the critic thinks highest, or that were rewarded most (the
    paper's proxy where there is no critic)."""
    model_steps: int = 20
    """Training steps of the backtracking model per turn."""
    imitation_steps: int = 5
    """Gradient steps of imitation per turn."""
    imitation_batch: int = 256
    """Steps of traces in each."""
    learning_rate: float = 1e-4
    """Step size of the imitation's Adam."""
    max_kl: float = 0.005
    """Imitation stops where the mean KL of a turn reaches this, nats. SAC changes its policy by
    several between two turns: less than 0.2 or so is nothing beside it."""
    fade_steps: int | None = None
    """If given, that bound falls on a line to zero at this many environment steps, after which
    nothing is recalled: what helps a novice holds back an expert. The imitation is the same until
    the bound comes down to it. Steps are the agent's `num_timesteps`: a `learn` that resets them
    begins anew."""

    def problem(self) -> str | None:
        """What is wrong with these settings, if anything is."""
        counts = "trace_length traces capacity min_steps every imitation_steps imitation_batch"
        for name in (*counts.split(), "model_steps"):
            value = getattr(self, name)
            if not isinstance(value, Integral) or isinstance(value, bool):
                return f"{name} must be a whole number, not {value!r}"
        for name in (*counts.split(), "learning_rate", "max_kl", "top_percent"):
            value = getattr(self, name)
            number = isinstance(value, Real) and not isinstance(value, bool)
            if not number or not 0 < value < math.inf:
                return f"{name} must be finite and greater than 0, not {value!r}"
        if long := too_much(self.trace_length, self.traces):
            return long
        if self.imitation_batch > MOST_RECALLED:
            return f"imitation_batch must be at most {MOST_RECALLED}, not {self.imitation_batch}"
        fade = self.fade_steps
        if fade is not None and (type(fade) is bool or not isinstance(fade, Integral) or fade < 1):
            return f"fade_steps must be a whole number from 1 on, or None, not {fade!r}"
        for name, choices in (("model", "backward forward"), ("seeds", "value reward")):
            if getattr(self, name) not in choices.split():
                return f"{name} must be one of {choices}, not {getattr(self, name)!r}"
        if self.top_percent > 100:
            return f"top_percent must be at most 100, not {self.top_percent}"
        if self.capacity * self.top_percent / 100 < self.min_steps:
            return "min_steps is more than top_percent of capacity: nothing would ever be recalled"
        least = 1 if self.model == "forward" else 0  # a random one is a control of the other only
        return None if self.model_steps >= least else f"model_steps must be {least} or more"
