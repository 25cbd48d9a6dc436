"""Environment steps per second: ours and others', in one run and one table.

    python benchmarks/speed.py                            # all of it
    python benchmarks/speed.py --threads 1 2 4 8 16       # how it scales
    python benchmarks/speed.py --env ant_umaze --only raw_batch collection training

Ours: `raw_batch` is `mujoco.batch.Batch.step` on the same model with random controls and nothing
else, the physical limit. `collection` adds the policy, goals, resets and observations. `training`
is a whole run of the default preset: learning, labels, GAN, backtracking, imitation, evaluation,
recording; `training_ranks` is the same as so many processes of one thread each. `make_vec` is
`gymnasium.make_vec`, for learners of one's own, with random actions.

Others' (rivals.py), for which the extra `bench` is needed: `sb3_contrib_trpo` trains on the same
task and physics as usual, an action per step, with 8 simulations in turn or in processes
(`_subproc`); `_repeat` holds each action as long as we do, with 8 simulations or 32.
`gymnasium_robotics` is its own U-maze with random actions, as shipped and with our time step and
integrator, and the latter in Gymnasium's `AsyncVectorEnv`, a process per thread. `envpool` is
EnvPool's Ant (no maze) or PointMaze with random actions.

After one warm-up each, every round takes one sample of everything, all environments and numbers of
threads. The table gives medians and ranges. Factors are over the fastest row of sb3-contrib for the
same environment with as many threads or fewer, as usual and with our action repeat, and over
gymnasium-robotics as shipped. A step of ours and of sb3-contrib simulates 0.02 s; where it is
longer or shorter, compare `simulated s/s`.
`threads` are the simulation's, for sb3-contrib torch's; what learns beside may keep another core
busy, as `cores` tells: CPU time per wall time. Run it on an idle machine.
"""

import contextlib
import io
import itertools
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import rivals
import torch
import tyro
from common import Sample, Unavailable, clocked, cores, cpu_seconds, machine

from goalgan_bt.agent.rollout import Collector
from goalgan_bt.gym import env_id
from goalgan_bt.learners import maze_config
from goalgan_bt.learners.maze import train
from goalgan_bt.learners.maze_config import MazeConfig, make_env
from goalgan_bt.learners.maze_learner import MazeLearner
from goalgan_bt.runs.metrics_csv import read_metrics


@dataclass(frozen=True)
class Settings:
    """Measure environment steps per second."""

    env: tuple[str, ...] = ("point_umaze", "ant_umaze")
    """Environments: mazes of the point and the Ant."""
    threads: tuple[int, ...] = tuple(sorted({1, min(2, cores())}))
    """Numbers of threads."""
    rounds: int = 3
    """Samples of each measurement, after its warm-up."""
    seconds: float = 4.0
    """Duration of a sample, except of training; what has begun is finished."""
    train_steps: int = 3_000_000
    """Environment steps of a training run."""
    only: tuple[str, ...] = ()
    """Measurements to take, by name; if none is given, all."""
    num_envs: int | None = None
    """Simulations side by side; if None, as the preset has it. Where sb3-contrib has 8 of them, it
    gets no more than this."""
    sb3_steps: int = 2048
    """Actions per simulation and iteration of sb3-contrib's TRPO, with 8 simulations."""
    json: Path | None = None
    """Also write the rows to this file."""


@dataclass
class Measurement:
    """One row of the table as it grows."""

    name: str
    env: str
    threads: int
    samples: Iterator[Sample]
    taken: list[Sample] = field(default_factory=list)

    def speeds(self) -> list[float]:
        """Environment steps per second of each sample."""
        return [sample.steps / sample.seconds for sample in self.taken]


def raw_batch(cfg: MazeConfig, durations: Iterable[float]) -> Iterator[Sample]:
    """The simulator alone: random controls, back to the start every 100 steps."""
    env: Any = make_env(cfg, cfg.rollout.num_envs)
    ids = np.arange(env.num_envs)
    controls = np.random.default_rng(0).uniform(-1, 1, (16, env.num_envs, env.act_dim))
    ctrl = env.batch.bind("ctrl")

    def episode() -> int:
        env.reset(ids, env.goals)
        for i in range(100):
            ctrl[:] = controls[i % 16]
            env.batch.step()
        return 100 * env.num_envs

    return clocked(episode, durations, env.dt)


def make_vec(cfg: MazeConfig, durations: Iterable[float]) -> Iterator[Sample]:
    """The vector environment for learners of one's own: random actions."""
    env: Any = gymnasium.make_vec(
        env_id(cfg.env), cfg.rollout.num_envs, "vector_entry_point", threads=cfg.num_threads
    )
    return rivals.vectorised(env, env.sims.dt, durations)


def collection(cfg: MazeConfig, durations: Iterable[float]) -> Iterator[Sample]:
    """Rollouts with a fresh policy."""
    env = make_env(cfg, cfg.rollout.num_envs)
    learner = MazeLearner(env, cfg)
    collector = Collector(env, cfg.rollout, learner.rng, learner.noise["rollout"])
    goals = learner.curriculum.gan.sample(300)
    collector.begin(goals)

    def batch() -> int:
        torch.set_num_threads(cfg.learning_threads)
        rollouts, _ = collector.collect(learner.policy, goals)
        return rollouts.rewards.size * cfg.action_repeat

    return clocked(batch, durations, env.dt)


def training(cfg: MazeConfig, durations: Iterable[float], total_steps: int) -> Iterator[Sample]:
    """Whole runs, from building the environment to the last evaluation; the first, as a warm-up,
    of one iteration. The durations are not heeded."""
    limits = itertools.chain([1], itertools.repeat(total_steps))

    def run() -> int:
        quiet = contextlib.redirect_stdout(io.StringIO())
        with tempfile.TemporaryDirectory() as folder, quiet:
            return train(replace(cfg, total_steps=next(limits)), Path(folder)).steps

    once = (0.0 for _ in durations)
    return clocked(run, once, make_env(cfg, 1).dt)


def training_ranks(
    cfg: MazeConfig, durations: Iterable[float], total_steps: int
) -> Iterator[Sample]:
    """Whole runs by as many processes as there are threads, of one thread each; timed from the
    moment at which they begin to train. The durations are not heeded."""
    if cfg.num_threads == 1:
        raise Unavailable("one rank is `training`")
    if cfg.rollout.num_envs % cfg.num_threads:
        raise Unavailable(f"{cfg.num_threads} ranks cannot share {cfg.rollout.num_envs} envs")
    limits = itertools.chain([1], itertools.repeat(total_steps))
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node"]
    for _, limit in zip(durations, limits, strict=False):
        with tempfile.TemporaryDirectory() as out:
            what = f"--env {cfg.env} --threads 1 --viz none --total-steps {limit} --out {out}"
            what += f" --rollout.num-envs {cfg.rollout.num_envs}"
            words = [*launch, str(cfg.num_threads), "-m", "goalgan_bt.train", *what.split()]
            cpu = cpu_seconds()
            env = os.environ | {"OMP_NUM_THREADS": "1"}  # torchrun's choice, without its advice
            subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL, env=env)
            (folder,) = Path(out).iterdir()
            last = read_metrics(folder)[1][-1]
            seconds = float(last["time/total"])
            yield Sample(int(last["steps/train"]), seconds, cpu_seconds() - cpu, 0.02)


Kind = Callable[[MazeConfig, Iterable[float]], Iterator[Sample]]


def as_usual(kind: Kind) -> Kind:
    """The same with an action per step."""
    return lambda cfg, durations: kind(replace(cfg, action_repeat=1), durations)


def kinds(settings: Settings) -> dict[str, Kind]:
    """What can be measured, by name."""
    sb3 = partial(rivals.sb3_contrib_trpo, vector="DummyVecEnv", n_steps=settings.sb3_steps)
    sb3 = partial(sb3, num_envs=min(8, settings.num_envs or 8))
    return {
        "raw_batch": raw_batch,
        "make_vec": make_vec,
        "collection": collection,
        "training": partial(training, total_steps=settings.train_steps),
        "training_ranks": partial(training_ranks, total_steps=settings.train_steps),
        "sb3_contrib_trpo": as_usual(sb3),
        "sb3_contrib_trpo_subproc": as_usual(partial(sb3, vector="SubprocVecEnv")),
        "sb3_contrib_trpo_repeat": sb3,
        "sb3_contrib_trpo_repeat_32": partial(
            sb3, num_envs=32, n_steps=max(1, settings.sb3_steps // 4)
        ),
        "gymnasium_robotics": partial(rivals.gymnasium_robotics, our_physics=False),
        "gymnasium_robotics_our_physics": partial(rivals.gymnasium_robotics, our_physics=True),
        "gymnasium_robotics_async": rivals.gymnasium_robotics_async,
        "envpool": rivals.envpool,
    }


def measurements(settings: Settings) -> list[Measurement]:
    """Everything that shall be measured, not yet begun."""
    known = kinds(settings)
    if unknown := set(settings.only) - set(known):
        sys.exit(f"no measurement is called {', '.join(sorted(unknown))}: {', '.join(known)}")
    found = []
    for env, (name, kind) in itertools.product(settings.env, known.items()):
        one_thread = name in ("gymnasium_robotics", "gymnasium_robotics_our_physics")
        for threads in (1,) if one_thread else settings.threads:
            if settings.only and name not in settings.only:
                continue
            cfg = replace(maze_config.preset(env), threads=threads)
            if settings.num_envs is not None:
                cfg = replace(cfg, rollout=replace(cfg.rollout, num_envs=settings.num_envs))
            warm_up = min(1.0, settings.seconds)
            durations = itertools.chain([warm_up], itertools.repeat(settings.seconds))
            found.append(Measurement(name, env, threads, kind(cfg, durations)))
    return found


def warm_up(planned: list[Measurement]) -> list[Measurement]:
    """Take a sample of each that does not count; leave out what cannot be had here."""
    ready = []
    for measurement in planned:
        try:
            tell("warm-up", measurement, next(measurement.samples))
        except (ImportError, Unavailable) as error:
            print(f"no {measurement.name} for {measurement.env}: {error}", flush=True)
        else:
            ready.append(measurement)
    return ready


def tell(when: str, of: Measurement, sample: Sample) -> None:
    """Say on standard error how it goes."""
    speed = f"{sample.steps / sample.seconds:,.0f} steps/s"
    print(
        f"{when}: {of.env}, {of.threads} threads, {of.name}: {speed}", file=sys.stderr, flush=True
    )


def rows_of(measured: list[Measurement]) -> list[dict[str, Any]]:
    """The table as plain values: medians over the rounds, and what they are compared with."""
    where, rows = machine(), []
    for m in measured:
        speeds = m.speeds()
        middle = float(np.median(speeds))
        rows.append(
            {
                "name": m.name,
                "env": m.env,
                "threads": m.threads,
                "steps_per_second": round(middle),
                "range": [round(min(speeds)), round(max(speeds))],
                "sim_seconds_per_second": round(middle * m.taken[0].dt, 1),
                "cores_busy": round(
                    float(np.median([sample.cpu / sample.seconds for sample in m.taken])), 2
                ),
            }
        )
    for row in rows:
        same = [other for other in rows if other["env"] == row["env"]]
        peers = [other for other in same if other["threads"] == row["threads"]]
        shipped = [other for other in same if other["name"] == "gymnasium_robotics"]
        alone = [o for o in same if (o["name"], o["threads"]) == (row["name"], 1)]
        raw = [other for other in peers if other["name"] == "raw_batch"]
        # Torch's threads may cost more than they bring: sb3-contrib need not use all that we do.
        sb3 = [o for o in same if o["name"].startswith("sb3") and o["threads"] <= row["threads"]]
        row["factor_over_one_thread"] = factor(row, alone)
        row["share_of_raw"] = factor(row, raw)
        usual = [other for other in sb3 if "repeat" not in other["name"]]
        row["factor_over_sb3"] = factor(row, usual)
        row["factor_over_sb3_repeat"] = factor(row, sb3)
        row["factor_over_robotics"] = factor(row, shipped)
        row["factor_over_robotics_simulated"] = factor(row, shipped, "sim_seconds_per_second")
        row["rounds"], row["machine"] = len(measured[0].taken), where
    return rows


def factor(
    row: dict[str, Any], others: list[dict[str, Any]], key: str = "steps_per_second"
) -> float | None:
    """How many times as fast a row is as the fastest of others; None if there are no others."""
    fastest = max((other[key] for other in others), default=0)
    return float(f"{row[key] / fastest:.3g}") if fastest else None


COLUMNS = {  # heading: key of a row
    "environment": "env",
    "threads": "threads",
    "what": "name",
    "steps/s": "steps_per_second",
    "range": "range",
    "simulated s/s": "sim_seconds_per_second",
    "cores": "cores_busy",
    "x 1 thread": "factor_over_one_thread",
    "of raw": "share_of_raw",
    "x sb3": "factor_over_sb3",
    "x sb3, repeat": "factor_over_sb3_repeat",
    "x robotics": "factor_over_robotics",
    "x robotics, simulated": "factor_over_robotics_simulated",
}


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown, by environment and threads."""
    lines = [list(COLUMNS)]
    for row in sorted(rows, key=lambda row: (row["env"], row["threads"])):  # keeps their order else
        lines.append([cell(row[key]) for key in COLUMNS.values()])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(
        f"| {' | '.join(text.ljust(n) for text, n in zip(line, widths, strict=True))} |"
        for line in lines
    )


def cell(value: Any) -> str:
    """A value of a row as a person reads it."""
    if value is None:
        return ""
    if isinstance(value, list):
        return " to ".join(f"{x:,}" for x in value)
    return f"{value:,}" if isinstance(value, int | float) else str(value)


def main() -> None:
    settings = tyro.cli(Settings, description=__doc__)
    print(machine(), flush=True)
    # Once for all of the processes to come, or else each of them takes seconds to begin.
    multiprocessing.set_forkserver_preload(["goalgan_bt.train", "stable_baselines3"])
    ready = warm_up(measurements(settings))
    for number in range(settings.rounds):
        for measurement in ready:
            measurement.taken.append(next(measurement.samples))
            tell(f"round {number + 1}", measurement, measurement.taken[-1])
    rows = rows_of(ready)
    print(table(rows))
    if settings.json is not None:
        settings.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
