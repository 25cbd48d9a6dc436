"""The settings of recall: the backtracking model, its traces, their imitation.

Apart from the code that reads them, so that a command line answers before torch is imported.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from goalgan_bt.runs.ranges import ABOVE_ZERO, NOT_NEGATIVE, Range, faults

DEPTHS = 10, 20, 50  # steps before the goal at which it is told how many traces still are valid
MOST_RECALLED = 1_000_000  # steps at a time: beyond it memory, not sense, is the limit


def too_much(trace_length: int, traces: int) -> str | None:
    """Why so many recall traces of this length cannot be unrolled at once; None if they can."""
    if int(trace_length) * int(traces) <= MOST_RECALLED:  # numpy's own integers would overflow
        return None
    return f"trace_length times traces must be at most {MOST_RECALLED} steps"


@dataclass(frozen=True)
class BacktrackingConfig:
    """The backtracking model and its recall traces (Goyal et al. 2019)."""

    trace_length: Annotated[int, NOT_NEGATIVE] = 20
    """Length of a recall trace in environment steps (paper: 20 point, 50 ant), where traces are
    imitated. The model takes one backward step per action, `action_repeat` of them."""
    traces: Annotated[int, NOT_NEGATIVE] = 200
    """Recall traces per iteration, at most."""
    hidden: Annotated[tuple[int, ...], ABOVE_ZERO] = (128, 128)
    """Units of both networks' hidden layers (paper)."""
    steps: Annotated[int, NOT_NEGATIVE] = 5
    """Training steps per policy update (paper: 100 per 5 updates of four times our batch)."""
    batch: Annotated[int, ABOVE_ZERO] = 128
    """Transitions per training step."""
    learning_rate: Annotated[float, ABOVE_ZERO] = 1e-3
    """Step size of Adam."""
    experience: Literal["successes", "all"] = "all"
    """Episodes whose transitions are kept: those that reached their goal (the paper), or also those
    that ran out of time, for the place where they ended (hindsight)."""
    buffer: Annotated[int, ABOVE_ZERO] = 100_000
    """Transitions that are kept, the newest."""
    min_transitions: Annotated[int, ABOVE_ZERO] = 5_000
    """No training and no traces before the buffer holds this many."""
    max_shift: Annotated[float, ABOVE_ZERO] = 0.5
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

    source: Literal["none", "traces", "experience", "forward"] = "none"
    """What is imitated: nothing; recall traces of full states (the paper); as many real steps, as
    long before the end of their episode (self-imitation); steps that a forward model imagines of
    the policy, where they reach the goal (after Dyna)."""
    relabel: bool = True
    """Imitate each step for a random later place of its trace or episode (hindsight) instead of
    for the goal at its end (the paper)."""
    steps: Annotated[int, NOT_NEGATIVE] = 20
    """Gradient steps per iteration."""
    batch: Annotated[int, ABOVE_ZERO] = 512
    """(state, action) pairs per step."""
    learning_rate: Annotated[float, ABOVE_ZERO] = 1e-4
    """Step size of Adam, an optimiser of its own."""
    max_kl: Annotated[float, ABOVE_ZERO] = 0.005
    """Imitation stops where the mean KL on the last rollouts passes this, nats."""
    fade: Annotated[float | None, ABOVE_ZERO] = None
    """If given, that bound falls on a line to zero at this share of the run: what helps a novice
    holds back an expert."""


@dataclass(frozen=True)
class PlacesConfig:
    """The backtracking model over places, and its two uses."""

    shaping: Annotated[float, NOT_NEGATIVE] = 1.0
    """Reward for each metre by which the way that is left gets shorter, beside the true reward; 0
    is off. Labels and coverage never see it."""
    heading: bool = True
    """Tell the policy the offset to the goal along the way, beside the straight one: as far as the
    way is long, in the direction in which it begins."""
    way: Literal["recalled", "straight"] = "recalled"
    """The way that is left: recalled from the moves made, or the straight line (a control)."""
    cell: Annotated[float, ABOVE_ZERO] = 0.25
    """Distance between two places, metres. Where walls meet at their corners it must be less than
    the body is wide: else either side of them is one place, and ways lead through."""
    reach: Annotated[float, ABOVE_ZERO] = 0.6
    """Length of a move at most, metres."""
    lags: Annotated[tuple[int, ...], ABOVE_ZERO] = (1, 2, 5, 10, 20)
    """Actions that a move takes; longer ones than a batch has are left out."""
    backward: Annotated[float, Range("1 or more", 1, endless=True)] = 3.0
    """How many times its length a move costs the other way, where it was made one way only: 1
    takes it for possible, inf for impossible."""
    forget: Annotated[float, NOT_NEGATIVE] = 0.0
    """After so many actions from either of its ends a move counts half as much, and less than half
    a move is forgotten: one that works no longer is not made again; 0 forgets none."""

    @property
    def used(self) -> bool:
        """Whether anybody asks for recalled ways."""
        return self.way == "recalled" and (self.shaping > 0 or self.heading)

    def problem(self) -> str | None:
        """What does not go together in these settings, if anything does not."""
        if not self.lags:
            return "lags must name at least one number of actions"
        if self.reach < self.cell:
            return "reach must not be less than cell: no move would reach another place"
        return None


@dataclass(frozen=True)
class RecallConfig:
    """Recall traces beside an agent of Stable-Baselines3: what is recalled, how it is imitated."""

    model: Literal["backward", "forward"] = "backward"
    """What is learned: the backtracking model, or a control (the paper's appendix, after Dyna): a
    forward model, in which the policy acts; of four ways that it imagines from a state it imitates
    the one that ends best, by the critic's value."""
    trace_length: Annotated[int, NOT_NEGATIVE] = 20
    """Steps of a recall trace (paper: 20; with TRPO Hopper 10; Ant and Humanoid 50)."""
    traces: Annotated[int, ABOVE_ZERO] = 64
    """Recall traces per turn."""
    top_percent: Annotated[float, Range("greater than 0 and at most 100", 0, 100, above=True)] = (
        10.0
    )
    """Share of the remembered trajectories, those of highest return, that teach the model: their
    lowest return is the threshold L of the paper's section 4, which rises as the agent learns.
    While all returns are the same none is."""
    capacity: Annotated[int, ABOVE_ZERO] = 100_000
    """Steps that are remembered, in whole trajectories, the newest."""
    min_steps: Annotated[int, ABOVE_ZERO] = 500
    """Steps of the best trajectories before which nothing is recalled."""
    every: Annotated[int, ABOVE_ZERO] = 500
    """Environment steps between two turns, or a rollout where that is more."""
    seeds: Literal["value", "reward"] = "value"
    """Traces begin at states of which the critic thinks highest, or that were rewarded most (the
    paper's proxy where there is no critic)."""
    model_steps: Annotated[int, NOT_NEGATIVE] = 20
    """Training steps of the backtracking model per turn."""
    imitation_steps: Annotated[int, ABOVE_ZERO] = 5
    """Gradient steps of imitation per turn."""
    imitation_batch: Annotated[int, Range(f"between 1 and {MOST_RECALLED}", 1, MOST_RECALLED)] = 256
    """Steps of traces in each."""
    learning_rate: Annotated[float, ABOVE_ZERO] = 1e-4
    """Step size of the imitation's Adam."""
    max_kl: Annotated[float, ABOVE_ZERO] = 0.005
    """Imitation stops where the mean KL of a turn reaches this, nats. SAC changes its policy by
    several between two turns: less than 0.2 or so is nothing beside it."""
    fade_steps: Annotated[int | None, ABOVE_ZERO] = None
    """If given, that bound falls on a line to zero at this many environment steps, after which
    nothing is recalled: what helps a novice holds back an expert. The imitation is the same until
    the bound comes down to it. Steps are the agent's `num_timesteps`: a `learn` that resets them
    begins anew."""

    def problem(self) -> str | None:
        """What is wrong with these settings, if anything is."""
        for name, wrong in faults(self):
            return f"{name} {wrong}"
        if long := too_much(self.trace_length, self.traces):
            return long
        if not self.trace_length:
            return "trace_length must be greater than 0, not 0"
        if self.capacity * self.top_percent / 100 < self.min_steps:
            return "min_steps is more than top_percent of capacity: nothing would ever be recalled"
        if self.model == "forward" and not self.model_steps:
            return "model_steps must be 1 or more for a forward model"
        return None
