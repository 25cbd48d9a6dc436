"""The maze learner: one iteration at a time, from goals to picture. Read `train` first.

Florensa et al. 2018, Algorithm 1 (goals, policy update, labels, GAN) with Goyal et al. 2019,
Algorithm 1 inside of it (backtracking model, recall traces, imitation).
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from goalgan_bt.agent import trpo
from goalgan_bt.agent.advantage import gae
from goalgan_bt.agent.coverage import coverage, success_rate
from goalgan_bt.agent.rollout import Collector, Episodes, Float32, Rollouts, flat
from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.envs.maze import BoolArray, FloatArray
from goalgan_bt.learners.maze_config import MazeConfig, make_env
from goalgan_bt.learners.maze_learner import MazeLearner, load
from goalgan_bt.learners.run_config import Trained, World
from goalgan_bt.recall.consistency import consistency
from goalgan_bt.recall.decoder import Decoded, decode
from goalgan_bt.recall.forward import imagine
from goalgan_bt.recall.settings import DEPTHS
from goalgan_bt.recall.traces import Traces, recall_traces
from goalgan_bt.recall.transitions import Steps
from goalgan_bt.runs import ranks
from goalgan_bt.runs.background import group
from goalgan_bt.runs.errors import InterruptedRun, UsageError
from goalgan_bt.runs.policies import keep_policy
from goalgan_bt.runs.session import Limits, Schedule, Session
from goalgan_bt.runs.signals import Stop
from goalgan_bt.runs.sound import finite, soundly
from goalgan_bt.runs.terminal import complain, say

TEST_ENVS = 512  # simulations side by side when coverage is measured
ANYWHERE = 1000  # goals of the first batch, uniform in the box
FRAME_TRACES = 64  # traces kept in a frame
FRAME_PATHS = 32  # simulations whose paths are kept in a frame
SEED_STATES = 2000  # experienced states among which the decoder looks
KL_SAMPLE = 1024  # observations on which imitation's KL is bounded
HOPELESS = 20  # batches in a row that taught nothing, after which no other will


def train(cfg: MazeConfig, folder: Path | None, stop: Stop | None = None) -> Trained:
    """Learn to reach every free point of the maze.

    Args:
        cfg: settings; with `resume`, the learner goes on from the folder's checkpoint.
        folder: the run folder (see `goalgan_bt.runs.run_folder`), that of a resumed run on every
            rank, else None on ranks that do not record.
        stop: asked after every iteration whether to end early.
    """
    torch.set_num_threads(cfg.learning_threads)
    env = make_env(cfg, envs_per_rank(cfg))
    test_env = make_env(cfg, TEST_ENVS if env.settable else env.num_envs)
    learner = MazeLearner(env, cfg)
    test_env.heading = env.heading
    collector = collector_of(learner, env)
    covered = math.nan
    with session(cfg, folder, learner, collector, stop) as run:
        if run.iteration == 0:
            begin(learner, collector, run)
        while run.goes_on():
            learner.policy.cap_std(run.progress)

            # Goals: most imagined by the generator, some remembered so that old skills stay.
            goals = propose(learner, test_env, run)

            # Practice: rollouts, from which the backtracking model learns, and trust-region steps.
            batch = practise(learner, collector, goals, run)
            for _ in range(cfg.updates - 1):
                improve(learner, batch, run)
                batch = practise(learner, collector, goals, run)

            # Labels: goals neither hopeless nor mastered teach the generator what to propose next.
            # It learns beside the last trust-region step and what follows.
            judged = label(learner, test_env, goals, run)
            obs = improve(learner, batch, run)

            # Recall traces: imagine more ways of getting to those goals, and imitate them.
            recalled = recall(learner, env, goals.all[judged.labels], run)
            imitate(learner, env, recalled.traces, batch, obs, run)

            # Coverage, once in a while and at the end; then everything that a viewer reads.
            measured = measure(learner, test_env, recalled.traces, run)
            covered = covered if measured is None else float(measured.mean())
            report(learner, env, goals, judged, batch, recalled, measured, run)
            save(learner, collector, run)
    return Trained(folder, "coverage", covered, run.steps["train"])


class Goals(NamedTuple):
    """all: (n, goal_dim) the goals of an iteration, the first `imagined` of them new, the others
    remembered."""

    all: FloatArray
    imagined: int


class Batch(NamedTuple):
    """What practice gave: the rollouts of this rank, the episodes of all that ended in them."""

    rollouts: Rollouts
    episodes: Episodes


class Labelled(NamedTuple):
    """success: (n,) how often each goal of an iteration is reached; labels: (n,) whether it is of
    intermediate difficulty."""

    success: FloatArray
    labels: BoolArray


class Recalled(NamedTuple):
    """traces; seeds: where they begin; wanted: how many goals there were to recall ways to."""

    traces: Traces
    seeds: Decoded
    wanted: int


@contextmanager
def prepared(cfg: MazeConfig) -> Iterator[World]:
    """Join the other ranks, if there are any, and see that there is such a world.

    Raises:
        UsageError, MapError, PhysicsError, RunError: saying what is wrong.
        InterruptedRun: if the other ranks cannot be reached.
    """
    ranks.begin()
    try:
        envs_per_rank(cfg)  # or there will be no run
        env = make_env(cfg, 1)
        if env.horizon % cfg.action_repeat:
            raise UsageError(
                f"--action-repeat {cfg.action_repeat} does not divide the {env.horizon} steps of "
                "an episode: give another, or --horizon"
            )
        set_states = cfg.rollout.chain > 0 or cfg.imitation.source in ("traces", "forward")
        if set_states and not env.settable:
            raise UsageError(
                f"the states of {env.name} cannot be set, as chained episodes and traces of full "
                "states need it: --rollout.chain 0 and another --method"
            )
        yield World(env.name, env.maze)
    finally:
        ranks.end()


def envs_per_rank(cfg: MazeConfig) -> int:
    """Simulations of each rank.

    Raises:
        UsageError: if they cannot be divided.
    """
    if cfg.rollout.num_envs % ranks.size():
        raise UsageError(
            f"--rollout.num-envs must be a multiple of the {ranks.size()} ranks, "
            f"not {cfg.rollout.num_envs}"
        )
    return cfg.rollout.num_envs // ranks.size()


def session(
    cfg: MazeConfig,
    folder: Path | None,
    learner: MazeLearner,
    collector: Collector,
    stop: Stop | None,
) -> Session:
    """The run, and learner and simulations as they were where the run goes on."""
    state = None if cfg.resume is None or folder is None else load(learner, folder, collector)
    env, every = collector.env, between_measurements(cfg, collector.env)
    bounded = every > cfg.coverage.every
    second = 2 * every if bounded else 0  # the first one comes early, and has to be made up for
    if bounded and ranks.rank() == 0:
        say(
            f"coverage of {len(env.test_goals())} goals is measured every {every:,} training "
            f"steps, not every {cfg.coverage.every:,}: it takes up to {2 * every:,}"
        )
    return Session(
        folder if ranks.rank() == 0 else None,
        asdict(cfg),
        Limits(cfg.total_steps, cfg.iterations, cfg.minutes),
        # Not in the first iteration: its line shall tell at once that all is well.
        Schedule(lambda steps: max(steps + every, second), 2, cfg.report_every),
        f"{env.name}, seed {cfg.seed}",
        state=state,
        stop=stop,
        agreed=ranks.agreed,
    )


def between_measurements(cfg: MazeConfig, env: GoalEnv) -> int:
    """Training steps between two measurements of coverage: as the settings say, but so many that
    measuring takes at most twice the steps of training."""
    most = len(env.test_goals()) * (cfg.coverage.rollouts + 1) * env.horizon
    return max(cfg.coverage.every, most // 2)


def collector_of(learner: MazeLearner, env: GoalEnv) -> Collector:
    """The simulations, for practice."""
    cfg = learner.cfg
    keep = cfg.backtracking.experience if cfg.imitation.source != "none" else "none"
    return Collector(env, cfg.rollout, learner.rng, learner.noise["rollout"], keep)


def begin(learner: MazeLearner, collector: Collector, run: Session) -> None:
    """Before any curriculum exists, goals anywhere tell what is out of reach, and the GAN begins
    with wherever a fresh policy happens to wander."""
    cfg, curriculum = learner.cfg, learner.curriculum
    anywhere = curriculum.uniform(ANYWHERE)
    collector.begin(anywhere)
    rollouts, episodes = collector.collect(learner.policy, anywhere)
    learner.remember(episodes)
    learner.learn_places(rollouts)
    run.count("train", batch_steps(cfg))
    learner.policy.normaliser.update(flat(rollouts.obs))
    visited = collector.achieved_goals()
    curriculum.see(visited)
    curriculum.begin(visited)


def batch_steps(cfg: MazeConfig) -> int:
    """Environment steps of a batch of all ranks."""
    return cfg.rollout.num_envs * cfg.rollout.steps * cfg.action_repeat


def propose(learner: MazeLearner, test_env: GoalEnv, run: Session) -> Goals:
    """The goals of an iteration."""
    imagined, steps = learner.propose(test_env)
    run.count("label", steps)
    remembered = learner.curriculum.recollect(learner.cfg.goals.old)
    goals = Goals(np.concatenate([imagined, remembered]), len(imagined))
    with run.clock.measure("learning"):
        learner.places.refresh(goals.all)
    return goals


def practise(learner: MazeLearner, collector: Collector, goals: Goals, run: Session) -> Batch:
    """Rollouts: every simulation goes on where it was. The backtracking model learns from what they
    add to the agent's experience."""
    with run.clock.measure("simulation"):
        rollouts, episodes = collector.collect(learner.policy, goals.all)
    run.count("train", batch_steps(learner.cfg))
    diverged = ~np.isfinite(rollouts.achieved).all(axis=2)
    run.tally("rollout/diverged", ranks.count(int(diverged.sum())))
    with run.clock.measure("learning"):
        run.background.wait("value", "backtracking")
        learner.remember(episodes)
        learner.learn_places(rollouts)
        seen = ranks.gather(rollouts.achieved.swapaxes(0, 1))
        learner.curriculum.see(seen.reshape(-1, seen.shape[2]))
        model = learner.forward or learner.backtracking
        run.background.start("backtracking", soundly, model, learner.fit_model)
    return Batch(rollouts, episodes)


def improve(learner: MazeLearner, batch: Batch, run: Session) -> Tensor:
    """A trust-region step on what happened. The value function learns beside it, and beside the
    next rollouts: only after those it is needed again. A batch in which any number is not finite
    teaches nothing.

    Returns:
        The normalised observations of the batch, (N * T, obs_dim).
    """
    policy, rollouts, noise = learner.policy, batch.rollouts, learner.noise
    with run.clock.measure("learning"):
        obs = policy.normaliser(flat(rollouts.obs))
        shaped = shaping(learner, rollouts)
        rewards = rollouts.rewards + shaped
        if not teaches(learner, rollouts, rewards, run):
            return obs
        advantages, returns = advantages_and_returns(learner, rollouts, rewards, obs)
        run.background.start(
            "value", soundly, learner.value, learner.value.fit, obs, flat(returns), noise["value"]
        )
        step = trpo.update(
            policy, obs, flat(rollouts.actions), flat(advantages), learner.cfg.trpo, noise["trpo"]
        )
    run.note("trpo", step)
    run.note("rollout", {"reward": mean(rollouts.rewards), "shaping": mean(shaped)})
    return obs


def teaches(learner: MazeLearner, rollouts: Rollouts, rewards: Float32, run: Session) -> bool:
    """Whether all numbers of a batch, (T, N, ...), are finite on every rank. If not, tell so.

    Raises:
        InterruptedRun: if this goes on and on.
    """
    obs = rollouts.obs, rollouts.last_obs, rollouts.truncated_obs
    sound = ranks.count(not finite(rewards, rollouts.actions, *obs)) == 0
    learner.dropped = 0 if sound else learner.dropped + 1
    run.tally("rollout/dropped", not sound)
    if learner.dropped == 1:
        at = f"iteration {run.iteration}"
        complain(f"{at}: a batch is left out, since not all of it is finite", "warning")
    if learner.dropped == HOPELESS:
        raise InterruptedRun(
            f"none of the last {HOPELESS} batches was finite: the environment or the policy is "
            "broken"
        )
    return sound


def advantages_and_returns(
    learner: MazeLearner, rollouts: Rollouts, rewards: Float32, obs: Tensor
) -> tuple[Float32, Float32]:
    """Generalised advantages and what the value function shall predict, each (T, N).

    Args:
        learner: whose value function judges.
        rollouts: the batch, (T, N, ...).
        rewards: (T, N) the true ones and what shaping adds to them.
        obs: (N * T, obs_dim) its normalised observations, flat.
    """
    policy, value, cfg = learner.policy, learner.value, learner.cfg

    def values_of(raw: Float32) -> Float32:
        return value(policy.normaliser(torch.from_numpy(raw))).numpy()

    values = value(obs).view(rollouts.rewards.T.shape).numpy().T
    return gae(
        rewards,
        values,
        rollouts.next_values(values, values_of),
        rollouts.terminated,
        rollouts.truncated,
        cfg.discount,
        cfg.gae_lambda,
    )


def shaping(learner: MazeLearner, rollouts: Rollouts) -> Float32:
    """Reward for the way that each action has made shorter, (T, N): what is left before less what
    is left after it. None for an action on which the body failed. That is the difference of Ng,
    Harada and Russell's potentials (1999) without their discount, which would pay for standing
    still far from the goal (docs/LOG.md)."""
    cfg, (steps, n, dim) = learner.cfg.places, rollouts.achieved.shape
    if not cfg.shaping:
        return np.zeros_like(rollouts.rewards)
    goals = rollouts.goals.reshape(-1, dim)

    after = learner.places.ways(rollouts.achieved.reshape(-1, dim), goals).left.reshape(steps, n)
    # An action begins where the last one ended, but for those that begin an episode.
    before, begun = np.empty_like(after), np.ones((steps, n), dtype=bool)
    before[1:] = after[:-1]
    begun[1:] = (rollouts.terminated | rollouts.truncated)[:-1]
    anew = rollouts.origins[begun], rollouts.goals[begun]
    before[begun] = learner.places.ways(*anew).left
    shorter = before - after
    failed = rollouts.terminated & (rollouts.rewards == 0)
    return np.where(failed, 0.0, cfg.shaping * shorter).astype(np.float32)


def label(learner: MazeLearner, test_env: GoalEnv, goals: Goals, run: Session) -> Labelled:
    """How hard the goals are, and a lesson for the GAN from it."""
    cfg, curriculum, noise = learner.cfg.goals, learner.curriculum, learner.noise["evaluation"]
    if cfg.label_rollouts:
        with run.clock.measure("label"):
            success, steps = success_rate(
                test_env, learner.policy, goals.all, cfg.label_rollouts, noise
            )
        run.count("label", steps)
    else:
        success = curriculum.estimator(goals.all)
    with run.clock.measure("learning"):
        labels, lesson = curriculum.judge(goals.all, success)
        if cfg.source in ("gan", "gan_fit_all"):
            run.background.start("gan", soundly, curriculum.gan, curriculum.gan.fit, *lesson)
    return Labelled(success, labels)


def recall(learner: MazeLearner, env: GoalEnv, goals: FloatArray, run: Session) -> Recalled:
    """Recall traces that lead to some of those goals, or, where the settings say so, to states of
    high value."""
    cfg, rng = learner.cfg.backtracking, learner.rng
    with run.clock.measure("learning"):
        most = cfg.traces if learner.recalls else 0
        wanted = rng.permutation(goals)[:most]
        if cfg.seeds == "values":
            run.background.wait("value")
            seeds = most_valuable(learner, env, most)
            wanted = seeds.goals
        else:
            experienced, _ = learner.transitions.sample(SEED_STATES, rng)
            seeds = decode(env, wanted, experienced, cfg.max_shift, rng)
        run.background.wait("backtracking")
        length = math.ceil(cfg.trace_length / learner.cfg.action_repeat)
        traces = recall_traces(
            learner.backtracking,
            seeds.states,
            length,
            seeds.goals,
            valid=env.valid,
            repair=env.repair,
        )
    return Recalled(traces, seeds, len(wanted))


def most_valuable(learner: MazeLearner, env: GoalEnv, n: int) -> Decoded:
    """Of some experienced states the n of highest value for the goals that they led to (Goyal et
    al. 2019, Algorithm 2, for states that are not generated)."""
    states, goals = learner.transitions.sample(SEED_STATES, learner.rng)
    obs = learner.policy.normaliser(torch.from_numpy(env.observations(states, goals)))
    best = learner.value(obs).argsort(descending=True)[:n].numpy()
    return Decoded(states[best], goals[best], np.zeros(len(best)))


def imitate(
    learner: MazeLearner, env: GoalEnv, traces: Traces, batch: Batch, obs: Tensor, run: Session
) -> None:
    """Imitate the traces, or what a control has in their place.

    Args:
        learner: whose policy changes.
        env: tells states as the policy sees them.
        traces: recall traces.
        batch: the last rollouts; obs: their normalised observations, where the KL is bounded.
        run: progress and metrics.
    """
    with run.clock.measure("learning"):
        trace_obs, trace_actions = to_imitate(learner, env, traces).lesson(env)
        everybodys = ranks.size() * len(obs)
        rows = torch.arange(0, everybodys, max(1, everybodys // KL_SAMPLE))
        reference = obs[ranks.mine(rows, len(obs))]
        imitated = learner.imitation.update(
            learner.policy.normaliser(trace_obs), trace_actions, reference, run.progress
        )
        # Only now: the policy must not change under data that it made. The last batch stands for
        # all of the iteration's.
        if not learner.dropped:
            learner.policy.normaliser.update(flat(batch.rollouts.obs))
    run.note("imitation", imitated)


def to_imitate(learner: MazeLearner, env: GoalEnv, traces: Traces) -> Steps:
    """The steps of recall traces, or what a control imitates in their place."""
    cfg, data, rng = learner.cfg, learner.transitions, learner.rng
    most, length = cfg.backtracking.traces, len(traces.valid)
    if learner.forward is not None:
        states, goals = data.sample(most, rng)
        noise = learner.noise["imitation"]
        return imagine(learner.forward, learner.policy, env, states, goals, length, noise)
    if cfg.imitation.source == "experience":
        return data.last_steps(env, most * length, length, cfg.imitation.relabel, rng)
    return traces.steps(env, cfg.imitation.relabel, rng)


def measure(
    learner: MazeLearner, test_env: GoalEnv, traces: Traces, run: Session
) -> FloatArray | None:
    """Coverage per test goal of the stochastic policy, (K,), if that is due; and the end of what
    several ranks learn in the background, so that all have the same."""
    measured = None
    if run.measures():
        with run.clock.measure("evaluation"):
            learner.places.refresh()  # as whoever loads the policy has them
            measured, by_mean, steps = coverage(
                test_env,
                learner.policy,
                test_env.test_goals(),
                learner.cfg.coverage.rollouts,
                learner.noise["evaluation"],
            )
            checked = consistency(test_env, traces)
        run.count("eval", steps + checked.steps)
        both = {"coverage": float(measured.mean()), "coverage_deterministic": by_mean.mean()}
        run.note("eval", both | {"floor": still(test_env)})
        run.note("backtracking", checked.metrics())
    with run.clock.measure("learning"):
        run.background.wait("gan")
        if ranks.size() > 1:  # else it has until the next batch
            run.background.wait("value")
        ranks.agree(learner.tensors())
    return measured


def still(env: GoalEnv) -> float:
    """The coverage of a body that does not move from where episodes begin."""
    goals = env.test_goals()
    start = env.achieved_goals(env.start_state[None])
    return float(env.reached(np.repeat(start, len(goals), axis=0), goals).mean())


def report(
    learner: MazeLearner,
    env: GoalEnv,
    goals: Goals,
    judged: Labelled,
    batch: Batch,
    recalled: Recalled,
    measured: FloatArray | None,
    run: Session,
) -> None:
    """Everything that a viewer reads of an iteration."""
    if not run.records:
        return
    cfg, curriculum, policy = learner.cfg, learner.curriculum, learner.policy
    test_goals = env.test_goals()
    estimate = curriculum.mapped(test_goals, max(env.success_radius, cfg.goals.near))
    too_easy = judged.success >= cfg.goals.r_max
    traces, seeds, wanted = recalled

    def frame() -> dict[str, Any]:
        return {
            "goals": goals.all,
            "success": judged.success,
            "label": np.where(judged.labels, 0, np.where(too_easy, 1, -1)),
            "replayed": np.arange(len(goals.all)) >= goals.imagined,
            "replay": curriculum.replay.goals,
            "traces": traces.paths(env)[:, :FRAME_TRACES],
            "trace_goals": traces.goals[:FRAME_TRACES],
            "paths": batch.rollouts.paths(FRAME_PATHS),
            "test_goals": test_goals,
            "estimate": estimate,
            "coverage": np.full(len(test_goals), np.nan) if measured is None else measured,
        }

    told = {
        "success": mean(batch.episodes.success),
        "std": float(policy.bounded_log_std().detach().exp().mean()),
    }
    about_goals = {
        "intermediate": mean(judged.labels),
        "too_easy": mean(too_easy),
        "replay": len(curriculum.replay),
        "estimated_coverage": mean(estimate),
    }
    about_traces = {
        "traces": traces.valid.shape[1],
        "valid": mean(traces.valid),
        **{f"valid_{n}": traces.survival(-(-n // cfg.action_repeat)) for n in DEPTHS},
        "decoded": len(seeds.goals) / max(1, wanted),
        "shift": mean(seeds.shift),
    }
    about_places = {"known": len(learner.places), "moves": learner.places.moves.nnz}
    run.report(
        group("rollout", told)
        | group("curriculum", about_goals)
        | group("places", about_places)
        | group("backtracking", about_traces),
        frame,
    )


def save(learner: MazeLearner, collector: Collector, run: Session) -> None:
    """A checkpoint with each measurement and at the end, of what is sound. All ranks take part.

    Raises:
        InterruptedRun: if it is not: the last checkpoint then stays.
    """
    broken = learner.broken()
    if broken:  # what learns beside may pass through what is not finite, and is then undone
        run.background.finish()
        broken = learner.broken()
    if broken:
        raise InterruptedRun(
            f"iteration {run.iteration}: a weight of the {broken} is not finite, so that it cannot "
            "learn any more"
        )
    if not run.saves:
        return
    with run.clock.measure("saving"):
        run.background.finish()
        run.save(
            {"learner": learner.state_dict(), "collector": collector.state_dict()}, keep_policy
        )


def mean(values: np.ndarray) -> float:
    """The mean; NaN of nothing."""
    return float(values.mean()) if values.size else math.nan
