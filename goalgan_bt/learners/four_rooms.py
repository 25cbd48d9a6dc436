"""Recall traces with the true backward model: four rooms (Goyal et al. 2019, sections 5.1, 5.2).

    python -m goalgan_bt.train --env four_rooms_15 --method recall_traces

A tabular actor-critic with generalised advantages, the same with prioritised experience replay,
and the same with recall traces: the backward state model q(s_t | a_t, s_{t+1}) knows exactly from
which states an action leads to another, and holds them for equally likely; the backward action
model q(a_t | s_{t+1}) is learned from the best trajectories, or uniform.
"""

import math
import re
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, cast, get_args

import numpy as np

from goalgan_bt.agent.advantage import gae
from goalgan_bt.envs.four_rooms import ACTIONS, SIZES, FourRooms, Ints
from goalgan_bt.envs.maze import BoolArray, FloatArray, Maze
from goalgan_bt.learners.run_config import RunConfig, Trained, World
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.files import write_atomically
from goalgan_bt.runs.ranges import SHARE, between
from goalgan_bt.runs.session import Limits, Schedule, Session
from goalgan_bt.runs.signals import Stop
from goalgan_bt.runs.torchrun import refuse_company

NAME = re.compile(r"four_rooms_(\d{1,2})")
FAINT = 0.01  # times that each possible action counts as seen, so that none is impossible
FLOOR = 1e-4  # of a priority, so that nothing is never replayed
BETWEEN = 1.05  # factor of the steps between two reports: early on much changes in a few
RECENT = 100  # episodes of training by whose success the imitation fades
EPISODES = 50  # with which a policy is measured
Method = Literal["actor_critic", "per", "recall_traces", "random_model"]
METHODS = get_args(Method)


@dataclass(frozen=True)
class ReplayConfig:
    """Prioritised experience replay, as self-imitation has it (Oh et al. 2018). The default depends
    on the size: the paper's table."""

    batch: Annotated[int, between(1, 10**5)] = 1000
    """Transitions per replay update."""
    every: Annotated[int, between(1, 10**9)] = 3
    """Actor-critic updates per replay update."""
    alpha: Annotated[float, SHARE] = 0.95
    """Priorities are raised to this power."""
    beta: Annotated[float, SHARE] = 0.1
    """Importance weights are raised to this power."""
    capacity: Annotated[int, between(1, 10**5)] = 100_000
    """Transitions that are kept, the newest."""
    rate: Annotated[float, between(0, 10**9)] = 0.5
    """Step size of the policy, per replayed step: a larger batch also makes a larger update."""


@dataclass(frozen=True)
class TracesConfig:
    """Recall traces and their imitation."""

    length: Annotated[int, between(1, 10**5)] = 60
    """Steps of a recall trace; from the start to the goal it is 2 N - 6 in four_rooms_N."""
    number: Annotated[int, between(1, 10**5)] = 16
    """Recall traces per update."""
    every: Annotated[int, between(1, 10**9)] = 1
    """Actor-critic updates per turn of recall traces."""
    updates: Annotated[int, between(0, 10**9)] = 1
    """Updates from recall traces per turn."""
    trajectories: Annotated[int, between(1, 10**9)] = 100
    """Best trajectories from which the backward action model learns (the paper's k_traj)."""
    rate: Annotated[float, between(0, 10**9)] = 0.1
    """Step size of the imitation."""
    fade: bool = True
    """Whether the step size of the imitation shrinks with the share of the last 100 episodes that
    reached the goal (the paper: no): what helps a novice holds back an expert."""


@dataclass(frozen=True)
class FourRoomsConfig(RunConfig):
    """Learn to find the goal in four rooms from sparse reward: 1 on reaching it, else 0."""

    env: str = "four_rooms_15"
    """four_rooms_N, N cells a side."""
    method: Method = "recall_traces"
    """Actor-critic; with prioritised replay; with recall traces; with traces of random actions."""
    total_steps: Annotated[int, between(1, 10**9)] = 300_000
    """Environment steps of training."""
    resume: Path | None = None
    """Do this run (its folder) again to its end, with its settings: it takes seconds, and the same
    seed makes the same steps."""
    num_envs: Annotated[int, between(1, 10**5)] = 16
    """Simulations side by side."""
    steps: Annotated[int, between(1, 10**9)] = 20
    """Steps of each simulation per update."""
    horizon: Annotated[int, between(1, 10**5)] = 200
    """Steps of an episode."""
    discount: Annotated[float, SHARE] = 0.98
    """Discount factor."""
    gae_lambda: Annotated[float, SHARE] = 0.95
    """Lambda of generalised advantage estimation."""
    policy_rate: Annotated[float, between(0, 10**9)] = 1.0
    """Step size of the policy's logits, per step of the batch."""
    value_rate: Annotated[float, SHARE] = 0.2
    """Step size of the values, towards the mean return of a state in the batch."""
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    traces: TracesConfig = field(default_factory=TracesConfig)

    @property
    def size(self) -> int:
        """Cells of a side."""
        named = NAME.fullmatch(self.env)
        if named is None or int(named[1]) not in SIZES:
            raise UsageError(
                f"unknown environment {self.env!r}: four_rooms_{SIZES[0]} to _{SIZES[-1]}, say"
            )
        return int(named[1])


class ActorCritic:
    """A policy and a value for each state, as tables.

    Attributes:
        logits: (S, A); values: (S,).
    """

    def __init__(self, states: int, actions: int) -> None:
        self.logits, self.values = np.zeros((states, actions)), np.zeros(states)

    def probabilities(self) -> FloatArray:
        """pi(a | s), (S, A)."""
        weights = np.exp(self.logits - self.logits.max(axis=1, keepdims=True))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def reinforce(self, states: Ints, actions: Ints, weights: FloatArray, rate: float) -> None:
        """Ascend sum_i weights_i log pi(a_i | s_i): the policy gradient with advantages for
        weights, imitation with ones. All (n,)."""
        gradient = np.zeros_like(self.logits)
        np.add.at(gradient, (states, actions), weights)
        of_state = np.bincount(states, weights, len(gradient))
        self.logits += rate * (gradient - of_state[:, None] * self.probabilities())
        self.logits -= self.logits.mean(axis=1, keepdims=True)

    def evaluate(self, states: Ints, errors: FloatArray, rate: float) -> None:
        """Move values by the mean of their errors, both (n,)."""
        n = np.bincount(states, minlength=len(self.values))
        self.values += rate * np.bincount(states, errors, len(self.values)) / np.maximum(n, 1)


class Episode(NamedTuple):
    """states (T + 1,), actions (T,), and whether the goal was reached."""

    states: Ints
    actions: Ints
    success: bool


class Prioritised:
    """A ring of steps (s, a, discounted return), replayed by what they promise.

    As self-imitation learning has it for actor-critics (Oh et al. 2018): the priority is how much
    better a step turned out than the critic says, max(0, R - V(s)).
    """

    def __init__(self, cfg: ReplayConfig) -> None:
        self.cfg = cfg
        self._states, self._actions = np.zeros((2, cfg.capacity), dtype=np.int64)
        self._returns = np.zeros(cfg.capacity)
        self.added = 0

    def add(self, episodes: list[Episode], discount: float) -> None:
        """Remember finished episodes."""
        for episode in episodes:
            n = len(episode.actions)
            rows = (self.added + np.arange(n)) % len(self._returns)
            self._states[rows], self._actions[rows] = episode.states[:-1], episode.actions
            self._returns[rows] = discount ** np.arange(n - 1, -1, -1) * episode.success
            self.added += n

    def teach(self, learner: ActorCritic, value_rate: float, rng: np.random.Generator) -> None:
        """One update of policy and values from replayed steps."""
        size = min(self.added, len(self._returns))
        if size == 0:
            return
        better = np.maximum(self._returns[:size] - learner.values[self._states[:size]], 0)
        priority = (better + FLOOR) ** self.cfg.alpha
        chance = priority / priority.sum()
        rows = rng.choice(size, self.cfg.batch, p=chance)
        weights = (size * chance[rows]) ** -self.cfg.beta
        promise = better[rows] * weights / weights.max()
        learner.reinforce(self._states[rows], self._actions[rows], promise, self.cfg.rate)
        learner.evaluate(self._states[rows], promise, value_rate)


class Recall:
    """The best trajectories so far, the backward action model that they make, and its traces.

    Args:
        rooms: the world, whose backward transitions are known.
        cfg: settings.
        learned: whether q(a | s') is learned, or uniform over what can have led to s'.
    """

    def __init__(self, rooms: FourRooms, cfg: TracesConfig, learned: bool) -> None:
        self._rooms, self.cfg, self._learned = rooms, cfg, learned
        self.best: list[Episode] = []  # the shortest first, which have the highest return
        self._won: deque[bool] = deque(maxlen=RECENT)
        self._model: FloatArray | None = None  # q(a | s') as long as they stay the same

    def add(self, episodes: list[Episode]) -> None:
        """Keep those finished episodes that reached the goal and are among the best."""
        for episode in episodes:
            self._won.append(episode.success)
            if episode.success:
                self.best.append(episode)
                self.best.sort(key=lambda known: len(known.actions))
                del self.best[self.cfg.trajectories :]
                self._model = None

    def rate(self) -> float:
        """Step size of the imitation at present."""
        success = sum(self._won) / max(1, len(self._won))
        return self.cfg.rate * (1 - success if self.cfg.fade else 1.0)

    def action_model(self) -> FloatArray:
        """q(a | s'), (S, A): how often each action led to s' in the best trajectories, which is
        its maximum likelihood; 0 for what cannot have led there."""
        if self._model is not None:
            return self._model
        times = np.full(self._rooms.ways.shape, FAINT)
        if self._learned:
            for states, actions, _ in self.best:
                np.add.at(times, (states[1:], actions), 1.0)
        times = times * (self._rooms.ways > 0)
        self._model = np.asarray(times / times.sum(axis=1, keepdims=True))
        return self._model

    def traces(self, rng: np.random.Generator) -> tuple[Ints, Ints]:
        """Recall traces from the goal, than whose reward nothing is worth more (Algorithm 2), the
        step nearest to it first: states and actions, both (length, number)."""
        model, rooms = self.action_model(), self._rooms
        states, actions = np.zeros((2, self.cfg.length, self.cfg.number), dtype=np.int64)
        following = np.full(self.cfg.number, rooms.goal)
        for t in range(self.cfg.length):
            actions[t] = draw_columns(model[following], rng)
            way = rng.random(self.cfg.number) * rooms.ways[following, actions[t]]
            states[t] = rooms.predecessors[following, actions[t], way.astype(np.int64)]
            following = states[t]
        return states, actions

    def teach(self, learner: ActorCritic, rng: np.random.Generator) -> None:
        """Let the policy imitate recall traces, once there is a trajectory to learn from."""
        rate = self.rate()
        for _ in range(self.cfg.updates if self.best and rate > 0 else 0):
            states, actions = self.traces(rng)
            ones = np.ones(states.size)
            learner.reinforce(states.ravel(), actions.ravel(), ones, rate)


class Batch(NamedTuple):
    """T steps of N simulations, all (T, N); `ended` holds the finished episodes."""

    states: Ints
    actions: Ints
    next_states: Ints
    terminated: BoolArray
    truncated: BoolArray
    ended: list[Episode]


class Walkers:
    """N simulations side by side, which go on from one batch to the next.

    Args:
        rooms: the world.
        n: N.
        horizon: steps of an episode.
    """

    def __init__(self, rooms: FourRooms, n: int, horizon: int) -> None:
        self._rooms, self._horizon, self._all = rooms, horizon, np.arange(n)
        self._age = np.zeros(n, dtype=np.int64)
        self._states = np.full((n, horizon + 1), rooms.start)
        self._actions = np.zeros((n, horizon), dtype=np.int64)

    def walk(self, policy: FloatArray, steps: int, rng: np.random.Generator) -> Batch:
        """Take some steps with pi(a | s), (S, A)."""
        rooms, n = self._rooms, len(self._all)
        states, actions, following = np.zeros((3, steps, n), dtype=np.int64)
        terminated, truncated = np.zeros((2, steps, n), dtype=bool)
        ended: list[Episode] = []
        for t in range(steps):
            states[t] = self._states[self._all, self._age]
            actions[t] = draw_columns(policy[states[t]], rng)
            following[t] = rooms.next_state[states[t], actions[t]]
            self._actions[self._all, self._age] = actions[t]
            self._age += 1
            self._states[self._all, self._age] = following[t]
            terminated[t] = following[t] == rooms.goal
            truncated[t] = ~terminated[t] & (self._age == self._horizon)
            for i in np.flatnonzero(terminated[t] | truncated[t]):
                path, acts = self._states[i, : self._age[i] + 1], self._actions[i, : self._age[i]]
                ended.append(Episode(path.copy(), acts.copy(), bool(terminated[t, i])))
                self._age[i], self._states[i, 0] = 0, rooms.start
        return Batch(states, actions, following, terminated, truncated, ended)


def draw_columns(chances: FloatArray, rng: np.random.Generator) -> Ints:
    """A column for each row of probabilities, (n, A) -> (n,)."""
    drawn = rng.random(len(chances))[:, None] * chances.sum(axis=1, keepdims=True)
    return np.asarray((chances.cumsum(axis=1) > drawn).argmax(axis=1))


class Measured(NamedTuple):
    """Of the stochastic policy from the start: success, discounted return, visits (S,) of each
    state, and the environment steps that it took."""

    success: float
    discounted: float
    visits: Ints
    steps: int


def measure(
    rooms: FourRooms, learner: ActorCritic, cfg: FourRoomsConfig, rng: np.random.Generator
) -> Measured:
    """Let the policy try the goal `EPISODES` times."""
    batch = Walkers(rooms, EPISODES, cfg.horizon).walk(learner.probabilities(), cfg.horizon, rng)
    first = np.cumsum(batch.terminated | batch.truncated, axis=0) == 0
    first[1:], first[0] = first[:-1].copy(), True  # up to and with the step that ends an episode
    won = (batch.terminated & first).any(axis=0)
    lengths = first.sum(axis=0)
    discounted = float((won * cfg.discount ** (lengths - 1)).mean())
    visits = np.bincount(batch.states[first], minlength=len(rooms.cells))
    visits[rooms.goal] = won.sum()
    return Measured(float(won.mean()), discounted, visits, batch.states.size)


def train(cfg: FourRoomsConfig, folder: Path | None, stop: Stop | None = None) -> Trained:
    """Learn to find the goal; writes `metrics.csv`, frames and `visits.npz` into the run folder.

    Args:
        cfg: settings.
        folder: the run folder; what it holds of before is done again.
        stop: asked after every update whether to end early.
    """
    rooms = FourRooms(cfg.size)
    rng, test_rng = (np.random.default_rng([cfg.seed, i]) for i in range(2))
    learner = ActorCritic(*rooms.next_state.shape)
    walkers = Walkers(rooms, cfg.num_envs, cfg.horizon)
    replay = Prioritised(cfg.replay)
    recall = Recall(rooms, cfg.traces, learned=cfg.method != "random_model")
    visited = np.zeros(len(rooms.cells), dtype=np.int64)
    success, visits = math.nan, visited
    limits, schedule = Limits(cfg.total_steps), Schedule(lambda steps: BETWEEN * steps)
    # TensorBoard would import torch, for longer than the run.
    again = cfg.resume is not None
    with Session(
        folder, asdict(cfg), limits, schedule, stop=stop, events=False, again=again
    ) as run:
        while run.goes_on():
            # Practice: actor-critic, a step on what happened.
            batch = walkers.walk(learner.probabilities(), cfg.steps, rng)
            run.count("train", batch.states.size)
            visited += np.bincount(batch.states.ravel(), minlength=len(visited))
            improve(learner, batch, cfg)

            # Replay or recall traces: more from the same episodes.
            if cfg.method == "per":
                replay.add(batch.ended, cfg.discount)
                if run.iteration % cfg.replay.every == 0:
                    replay.teach(learner, cfg.value_rate, rng)
            elif cfg.method != "actor_critic":
                recall.add(batch.ended)
                if run.iteration % cfg.traces.every == 0:
                    recall.teach(learner, rng)

            # What it is worth by now.
            if run.measures():
                success, discounted, visits, steps = measure(rooms, learner, cfg, test_rng)
                run.count("eval", steps)
                run.note("eval", {"coverage": success, "return": round(discounted, 6)})
                run.note("eval", {"states": int((visits > 0).sum())})
                known = {"train/states": int((visited > 0).sum())}
                run.report(known, partial(frame, rooms, learner, visited))
        if folder is not None:
            grids = {"training": visited, "trained": visits}
            pictures: dict[str, Any] = {name: rooms.picture(n) for name, n in grids.items()}
            write_atomically(folder / "visits.npz", lambda file: np.savez(file, **pictures))
    return Trained(folder, "coverage", success, run.steps["train"])


def frame(rooms: FourRooms, learner: ActorCritic, visited: Ints) -> dict[str, Any]:
    """What the page shows of a report (see `RunWriter.frame`), with visits (S,) of training so far,
    and policy (S, 2): where it goes from each cell on average, cells per step."""
    moves = np.array(ACTIONS)[:, ::-1] * [1, -1]  # (row, column) as (x, y): y is up
    places = (rooms.cells - rooms.cells[rooms.start])[:, ::-1] * [1.0, -1.0]
    return {
        "goals": places[[rooms.goal]],
        "test_goals": places,
        "coverage": np.full(len(places), np.nan),
        "visits": visited,
        "policy": learner.probabilities() @ moves,
    }


def improve(learner: ActorCritic, batch: Batch, cfg: FourRoomsConfig) -> None:
    """A step of policy and values on a batch."""
    known = learner.values.astype(np.float32)
    values = known[batch.states]
    advantages, returns = gae(
        batch.terminated.astype(np.float32),  # the reward
        values,
        known[batch.next_states],
        batch.terminated,
        batch.truncated,
        cfg.discount,
        cfg.gae_lambda,
    )
    at = batch.states.ravel(), batch.actions.ravel()
    learner.reinforce(*at, advantages.ravel(), cfg.policy_rate)
    learner.evaluate(at[0], (returns - values).ravel(), cfg.value_rate)


@contextmanager
def prepared(cfg: FourRoomsConfig) -> Iterator[World]:
    """It needs nothing but to be alone.

    Raises:
        UsageError: for several processes.
    """
    refuse_company(cfg.env)
    yield World(cfg.env, Maze(FourRooms(cfg.size).rows, 1.0))


TABLE = {  # the paper's settings of prioritised replay by size: batch, every, alpha, beta
    11: ReplayConfig(200, 3, 0.8, 0.1),
    13: ReplayConfig(2000, 3, 0.8, 0.1),
    15: ReplayConfig(1000, 3, 0.95, 0.1),
}


def knows(env: str) -> bool:
    """Whether an environment is one of these."""
    return NAME.fullmatch(env) is not None


def preset(env: str, method: str | None = None) -> FourRoomsConfig:
    """The default settings for a size; larger rooms than the paper's table has replay as in 15.

    Raises:
        UsageError: if there is no such environment or method.
    """
    cfg = FourRoomsConfig(env=env)
    nearest = min(TABLE, key=lambda size: abs(size - cfg.size))
    cfg = replace(cfg, replay=TABLE[nearest])
    if method is None:
        return cfg
    if method not in METHODS:
        raise UsageError(f"unknown method {method!r}: choose one of {', '.join(METHODS)}")
    return replace(cfg, method=cast(Method, method))


def check(cfg: FourRoomsConfig) -> None:
    """There is nothing that ranges do not tell, but for the size."""
    preset(cfg.env)
