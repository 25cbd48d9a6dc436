"""The training loop: from goals to picture, one iteration at a time.

    python -m goalgan_bt.train --env ant_umaze

Florensa et al. 2018, Algorithm 1 (goals, policy update, labels, GAN) with Goyal et al. 2019,
Algorithm 1 inside of it (backtracking model, recall traces, imitation).
"""

import os
import signal
import sys

if __name__ == "__main__":
    # What follows takes seconds to import. Ctrl-C or `kill` meanwhile has nothing to save.
    def _leave(number: int, _: object) -> None:
        os.write(2, b"error: interrupted: nothing new was saved, give the same command again\n")
        os._exit(130 if number == signal.SIGINT else 2)

    signal.signal(signal.SIGINT, _leave)
    signal.signal(signal.SIGTERM, _leave)
    from goalgan_bt import command_line, config, record

    if other := config.other_learner(sys.argv):  # it needs none of what follows
        command_line.exit_with(other.main())
    if {"-h", "--help"} & set(sys.argv):
        try:
            config.from_command_line()  # ends here
        except (command_line.UsageError, record.RunError) as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(2)

import errno
import math
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from goalgan_bt import checkpoint, config, envs, ranks, record, trpo
from goalgan_bt.advantage import gae
from goalgan_bt.backtracking import RecallTraces, Steps, consistency, recall_traces
from goalgan_bt.beside import Beside, group
from goalgan_bt.clock import Clock
from goalgan_bt.command_line import UsageError
from goalgan_bt.config import Config
from goalgan_bt.coverage import coverage, success_rate
from goalgan_bt.decoder import Decoded, decode
from goalgan_bt.envs.batch import GoalEnv, PhysicsError
from goalgan_bt.envs.maze import MapError, Maze
from goalgan_bt.forward import imagine
from goalgan_bt.learner import Learner
from goalgan_bt.progress import Progress, complain, say
from goalgan_bt.record import Record
from goalgan_bt.rollout import Collector, Float32, Rollouts, flat
from goalgan_bt.viz.child import Page, free_port

TEST_ENVS = 512  # simulations side by side when coverage is measured
FRAME_TRACES = 64  # traces kept in a frame
FRAME_PATHS = 32  # simulations whose paths are kept in a frame
SEED_STATES = 2000  # experienced states among which the decoder looks
KL_SAMPLE = 1024  # observations on which imitation's KL is bounded


class Trained(NamedTuple):
    """coverage: the last measured, stochastic policy; steps: environment steps of training."""

    coverage: float
    steps: int


def train(cfg: Config, folder: Path | None, stop: "Stop | None" = None) -> Trained:
    """Learn to reach every free point of the maze.

    Args:
        cfg: settings; with `resume`, the learner goes on from the folder's checkpoint.
        folder: the run folder (see `goalgan_bt.record`); None on ranks that do not record.
        stop: asked after every iteration whether to end early.
    """
    torch.set_num_threads(cfg.learning_threads)
    if cfg.rollout.num_envs % ranks.size():
        raise config.ConfigError(
            f"--rollout.num-envs must be a multiple of the {ranks.size()} ranks, "
            f"not {cfg.rollout.num_envs}"
        )
    env = make_env(cfg, cfg.rollout.num_envs // ranks.size())
    test_env = make_env(cfg, TEST_ENVS)
    learner = Learner(env, cfg)
    if cfg.resume is not None and folder is not None:
        checkpoint.load(learner, folder)
        if finished(cfg, learner, learner.seconds) >= 1:
            raise config.ConfigError(
                f"{folder} has reached its limits ({learner.iteration} iterations, "
                f"{learner.steps['train']} steps): ask for more, for example with --total-steps"
            )
    records = None
    if folder is not None and ranks.rank() == 0:
        records = Record(folder, learner.iteration)
        config.save(cfg, folder)
    policy, rng, noise = learner.policy, learner.rng, learner.noise
    failures = cfg.backtracking.experience == "all"
    collector = Collector(env, cfg.rollout, rng, noise["rollout"], failures)
    batch_steps = cfg.rollout.num_envs * cfg.rollout.steps * cfg.action_repeat
    test_goals = env.test_goals()
    clock = Clock(learner.seconds)
    covered = float("nan")

    # Before any curriculum exists, goals anywhere tell what is out of reach, and the GAN begins
    # with wherever a fresh policy happens to wander.
    if learner.iteration == 0:
        anywhere = rng.uniform(env.goal_low, env.goal_high, (1000, env.goal_dim))
        collector.begin(anywhere)
        rollouts, episodes = collector.collect(policy, anywhere)
        learner.remember(episodes)
        learner.steps["train"] += batch_steps
        policy.normaliser.update(flat(rollouts.obs))
        visited = collector.achieved_goals()
        learner.visited.add(visited)
        learner.gan.fit(visited, np.ones(len(visited), dtype=bool), cfg.gan.pretrain_steps)
    else:
        anew, steps = learner.propose(test_env)
        learner.steps["label"] += steps
        collector.begin(anew)

    with Progress(f"{env.name}, seed {cfg.seed}") as terminal, Beside() as beside:
        last = False
        while not last:
            learner.iteration += 1
            progress = agreed(finished(cfg, learner, clock.total()))
            policy.cap_std(progress)

            # Goals: most imagined by the generator, some remembered so that old skills stay.
            imagined, steps = learner.propose(test_env)
            learner.steps["label"] += steps
            goals = np.concatenate([imagined, learner.replay.sample(cfg.goals.old, rng)])

            for update in range(cfg.updates):
                # Rollouts: every simulation goes on where it was. The backtracking model learns
                # from what they add to the agent's experience.
                with clock.measure("simulation"):
                    rollouts, episodes = collector.collect(policy, goals)
                learner.steps["train"] += batch_steps
                with clock.measure("learning"):
                    beside.wait("value", "backtracking")
                    learner.remember(episodes)
                    beside.start("backtracking", learner.fit_model)

                # Labels: goals neither hopeless nor mastered teach the generator what to propose
                # next. It learns beside the last policy update and what follows.
                if update == cfg.updates - 1:
                    if cfg.goals.label_rollouts:
                        with clock.measure("label"):
                            success, steps = success_rate(
                                test_env,
                                policy,
                                goals,
                                cfg.goals.label_rollouts,
                                noise["evaluation"],
                            )
                        learner.steps["label"] += steps
                    else:
                        success = learner.estimator(goals)
                    with clock.measure("learning"):
                        learner.visited.add(collector.achieved_goals())
                        labels, *lesson = learner.label(goals, success)
                        if cfg.goals.source in ("gan", "gan_fit_all"):
                            beside.start("gan", learner.gan.fit, *lesson)

                with clock.measure("learning"):
                    # Policy: a trust-region step on what happened. The value function learns
                    # beside it, and beside the next rollouts: only after those it is needed again.
                    obs = policy.normaliser(flat(rollouts.obs))
                    advantages, returns = advantages_and_returns(learner, rollouts, obs, cfg)
                    beside.start("value", learner.value.fit, obs, flat(returns), noise["value"])
                    step = trpo.update(
                        policy,
                        obs,
                        flat(rollouts.actions),
                        flat(advantages),
                        cfg.trpo,
                        noise["trpo"],
                    )

            with clock.measure("learning"):
                # Recall traces: imagine more ways of getting to those goals, and imitate them.
                most = cfg.backtracking.traces if learner.recalls else 0
                wanted = rng.permutation(goals[labels])[:most]
                if cfg.backtracking.seeds == "values":
                    beside.wait("value")
                    seeds = most_valuable(learner, env, most)
                    wanted = seeds.goals
                else:
                    experienced, _ = learner.transitions.sample(SEED_STATES, rng)
                    seeds = decode(env, wanted, experienced, cfg.backtracking.max_shift, rng)
                beside.wait("backtracking")
                length = math.ceil(cfg.backtracking.trace_length / cfg.action_repeat)
                traces = recall_traces(learner.backtracking, env, seeds.states, seeds.goals, length)
                trace_obs, trace_actions = to_imitate(learner, env, traces, cfg).lesson(env)
                every = max(1, ranks.size() * len(obs) // KL_SAMPLE)
                rows = torch.arange(0, ranks.size() * len(obs), every)
                reference = obs[ranks.mine(rows, len(obs))]
                imitated = learner.imitation.update(
                    policy.normaliser(trace_obs), trace_actions, reference, progress
                )
                # Only now: the policy must not change under data that it made. The last batch
                # stands for all of the iteration's.
                policy.normaliser.update(flat(rollouts.obs))

            # Coverage, once in a while; then everything that a viewer reads.
            done = agreed(finished(cfg, learner, clock.total()))
            last = ranks.any_of(done >= 1 or (stop is not None and stop.requested))
            measured = np.full(len(test_goals), np.nan)
            # Not in the first iteration: its line shall tell at once that all is well.
            due = learner.iteration > 1 and learner.steps["train"] >= learner.next_coverage
            measure = due or last
            evaluation: dict[str, float] = {}
            if measure:
                with clock.measure("evaluation"):
                    measured, by_mean, steps = coverage(
                        test_env, policy, test_goals, cfg.coverage.rollouts, noise["evaluation"]
                    )
                    checked = consistency(test_env, traces)
                learner.steps["eval"] += steps + checked.steps
                learner.next_coverage = learner.steps["train"] + cfg.coverage.every
                covered = float(measured.mean())
                evaluation = {"coverage": covered, "coverage_deterministic": by_mean.mean()}
                evaluation = group("eval", evaluation) | group("backtracking", checked.metrics())
            with clock.measure("learning"):
                beside.wait("gan")
                if measure or ranks.size() > 1:  # else the value function has until the next batch
                    beside.wait("value")
                ranks.agree(learner.tensors())
            learner.seconds = clock.total()

            if records is None:
                continue
            estimate = learner.estimated_success(test_goals)
            metrics = (
                {"iteration": learner.iteration}
                | group("trpo", step)
                | beside.metrics
                | group("imitation", imitated)
                | evaluation
                | group("steps", learner.steps)
                | group("time", clock.metrics(learner.steps["train"]))
                | {
                    "memory/resident": resident_mib(),
                    "rollout/success": mean(episodes.success),
                    "rollout/std": float(policy.bounded_log_std().detach().exp().mean()),
                    "curriculum/intermediate": mean(labels),
                    "curriculum/too_easy": mean(success >= cfg.goals.r_max),
                    "curriculum/replay": len(learner.replay),
                    "curriculum/estimated_coverage": mean(estimate),
                    "backtracking/traces": traces.valid.shape[1],
                    "backtracking/valid": mean(traces.valid),
                    "backtracking/decoded": len(seeds.goals) / max(1, len(wanted)),
                    "backtracking/shift": mean(seeds.shift),
                }
            )
            if measure:
                checkpoint.save(learner.state_dict(), records.folder / "checkpoint.pt")
            records.metrics(metrics)
            if measure or learner.iteration % cfg.report_every == 0:
                left = clock.total() * max(1 / done - 1, 0) if done else np.inf
                terminal.report(metrics, left)
                records.frame(
                    learner.iteration,
                    goals=goals,
                    success=success,
                    label=np.where(labels, 0, np.where(success >= cfg.goals.r_max, 1, -1)),
                    replayed=np.arange(len(goals)) >= len(imagined),
                    replay=learner.replay.goals,
                    traces=traces.paths(env)[:, :FRAME_TRACES],
                    trace_goals=traces.goals[:FRAME_TRACES],
                    paths=rollouts.paths(FRAME_PATHS),
                    test_goals=test_goals,
                    estimate=estimate,
                    coverage=measured,
                )
    if records is not None:
        records.close("complete" if done >= 1 else "stopped early: --resume goes on")
    return Trained(covered, learner.steps["train"])


def advantages_and_returns(
    learner: Learner, rollouts: Rollouts, obs: Tensor, cfg: Config
) -> tuple[Float32, Float32]:
    """Generalised advantages and what the value function shall predict, each (T, N).

    Args:
        learner: whose value function judges.
        rollouts: the batch, (T, N, ...).
        obs: (N * T, obs_dim) its normalised observations, flat.
        cfg: settings.
    """
    policy, value = learner.policy, learner.value

    def values_of(raw: Float32) -> Float32:
        return value(policy.normaliser(torch.from_numpy(raw))).numpy()

    values = value(obs).view(rollouts.rewards.T.shape).numpy().T
    return gae(
        rollouts.rewards,
        values,
        rollouts.next_values(values, values_of),
        rollouts.terminated,
        rollouts.truncated,
        cfg.discount,
        cfg.gae_lambda,
    )


def most_valuable(learner: Learner, env: GoalEnv, n: int) -> Decoded:
    """Of some experienced states the n of highest value for the goals that they led to (Goyal et
    al. 2019, Algorithm 2, for states that are not generated)."""
    states, goals = learner.transitions.sample(SEED_STATES, learner.rng)
    obs = learner.policy.normaliser(torch.from_numpy(env.observations(states, goals)))
    best = learner.value(obs).argsort(descending=True)[:n].numpy()
    return Decoded(states[best], goals[best], np.zeros(len(best)))


def to_imitate(learner: Learner, env: GoalEnv, traces: RecallTraces, cfg: Config) -> Steps:
    """The steps of recall traces, or what a control imitates in their place."""
    data, rng, relabel = learner.transitions, learner.rng, cfg.imitation.relabel
    most, length = cfg.backtracking.traces, len(traces.valid)
    if learner.forward is not None:
        states, goals = data.sample(most, rng)
        noise = learner.noise["imitation"]
        return imagine(learner.forward, learner.policy, env, states, goals, length, noise)
    if cfg.imitation.source == "experience":
        return data.last_steps(env, most * length, length, relabel, rng)
    return traces.steps(env, relabel, rng)


def finished(cfg: Config, learner: Learner, seconds: float) -> float:
    """How far a run is towards the first of its limits: 1 or more at its end, 0 without limits."""
    return max(
        learner.iteration / cfg.iterations if cfg.iterations else 0.0,
        learner.steps["train"] / cfg.total_steps if cfg.total_steps else 0.0,
        seconds / (60 * cfg.minutes) if cfg.minutes else 0.0,
    )


def agreed(progress: float) -> float:
    """The same progress on all ranks, whose clocks differ: their mean."""
    return ranks.mean(torch.tensor(progress, dtype=torch.float64)).item()


def mean(values: np.ndarray) -> float:
    """The mean; NaN of nothing."""
    return float(values.mean()) if values.size else float("nan")


def resident_mib() -> float:
    """Memory that this process has in use, MiB; NaN where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def make_env(cfg: Config, num_envs: int, maze: Maze | None = None) -> GoalEnv:
    """The environment that the settings name, in another maze if one is given. A run that goes on
    does so in the maze that its folder has recorded: a map's file may be another by now, or gone.

    Raises:
        MapError: for a map that is not a maze.
        RunError: if the maze that was recorded cannot be read.
    """
    if maze is None and cfg.resume is not None:
        maze = record.maze_of(cfg.resume)
    return envs.make(
        cfg.env,
        num_envs,
        threads=cfg.num_threads,
        horizon=cfg.horizon,
        action_repeat=cfg.action_repeat,
        integrator=cfg.integrator,
        dim=cfg.dim,
        map_file=cfg.map,
        maze=maze,
        physics=cfg.physics,
        device=cfg.device,
    )


class Stop:
    """Turns Ctrl-C and `kill` into a wish that the loop grants after its iteration.

    A second Ctrl-C ends at once. Installs its handlers on entry and puts the old ones back.
    """

    def __init__(self) -> None:
        self.signal: int | None = None

    @property
    def requested(self) -> bool:
        """Whether the run shall end."""
        return self.signal is not None

    def __enter__(self) -> "Stop":
        self._old = {s: signal.signal(s, self._note) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for number, handler in self._old.items():
            # After an error only the goodbye is left, which a launcher's `kill` shall not cut off.
            last_words = kind is not None and number == signal.SIGTERM
            signal.signal(number, signal.SIG_IGN if last_words else handler)

    def _note(self, number: int, _: FrameType | None) -> None:
        if self.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal = number


def main() -> int:
    """The command line; returns the exit code."""
    for number in (signal.SIGINT, signal.SIGTERM):  # from here on somebody catches it
        signal.signal(number, signal.default_int_handler)
    folder, page, ended_well = None, None, False
    try:
        with Stop() as stop:
            cfg = config.from_command_line()
            ranks.begin()
            if ranks.rank() == 0:
                env = make_env(cfg, 1)
                if cfg.viz == "browser":
                    free_port(cfg.viz_host, cfg.viz_port)  # or there will be no run
                # With its settings: the page reads them before training begins.
                begin = cfg.out, env.name, cfg.seed, asdict(cfg), env.maze
                folder = cfg.resume or record.new_run(*begin)
                say(f"run folder: {folder}")
                if cfg.viz == "browser":
                    page = Page(folder, cfg.viz_host, cfg.viz_port)
            trained = train(cfg, folder or cfg.resume, stop)
    except KeyboardInterrupt:
        complain(f"interrupted{how_to_go_on(folder)}")
        return 130
    except (ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            complain(f"the disk is full: free some space{how_to_go_on(folder)}")
        elif isinstance(error, BrokenPipeError):
            sys.stdout = sys.stderr  # nobody reads standard output any more
            complain(f"standard output was closed{how_to_go_on(folder)}")
        elif isinstance(error, FileNotFoundError) and folder is not None and not folder.exists():
            complain(f"the run folder {folder} has vanished: start again")
        elif isinstance(error, ranks.RankError):
            complain(f"rank {ranks.rank()}: {error}{how_to_go_on(folder)}")
        elif isinstance(error, (UsageError, record.RunError, MapError, PhysicsError, OSError)):
            if ranks.speaks():  # one word is enough
                complain(str(error))
        else:
            raise
        return 2
    except MemoryError:
        complain("out of memory: use a smaller --rollout.num-envs")
        return 2
    else:
        if stop.signal is not None:
            name = signal.Signals(stop.signal).name
            if folder is not None:
                complain(f"stopped by {name}: go on with --resume {folder}")
            return 130 if stop.signal == signal.SIGINT else 2
        if folder is not None:
            say(f"coverage {trained.coverage:.3f} after {trained.steps:,} training steps: {folder}")
        ended_well = True
        return 0
    finally:
        ranks.end()
        if page is not None:
            page.close(ended_well)


def how_to_go_on(folder: Path | None) -> str:
    """The end of a message about a run that stopped early."""
    if folder is None and ranks.rank() > 0:
        return ""  # only rank 0 knows
    if folder is None or not (folder / "checkpoint.pt").exists():
        return ": nothing new was saved, give the same command again"
    return f": go on from the last checkpoint with --resume {folder}"


if __name__ == "__main__":
    command_line.exit_with(main())
