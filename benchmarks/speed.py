"""Environment steps per second: the raw simulator, collection, and whole training, in one run.

    python benchmarks/speed.py --env ant_umaze --threads 2

`raw_batch` is `mujoco.batch.Batch.step` on the same model with random controls and nothing else:
the physical limit. `collection` adds the policy, goals, resets and observations. `training` is
everything: learning, labels, GAN, backtracking, imitation, evaluation, recording. The three
alternate for some rounds after a warm-up; the table gives medians and ranges.
"""

import json
import platform
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch
import tyro

from goalgan_bt import config, record
from goalgan_bt.config import Config
from goalgan_bt.learner import Learner
from goalgan_bt.rollout import Collector
from goalgan_bt.train import make_env, train


@dataclass(frozen=True)
class Settings:
    """Measure environment steps per second."""

    env: tuple[str, ...] = ("ant_umaze", "point_umaze")
    """Environments."""
    threads: tuple[int, ...] = (2,)
    """Numbers of threads."""
    rounds: int = 3
    """Alternations of the three measurements."""
    seconds: float = 4.0
    """Duration of each raw and collection measurement."""
    train_steps: int = 3_000_000
    """Environment steps of each training run."""
    json: Path | None = None
    """Also write the rows to this file."""


def raw_batch(cfg: Config, seconds: float) -> float:
    """Steps/s of the simulator alone: random controls, back to the start every 100 steps."""
    env = make_env(cfg, cfg.rollout.num_envs)
    ids = np.arange(env.num_envs)
    controls = np.random.default_rng(0).uniform(-1, 1, (16, env.num_envs, env.act_dim))
    ctrl = env.batch.bind("ctrl")
    steps, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        env.reset(ids, env.goals)
        for i in range(100):
            ctrl[:] = controls[i % 16]
            env.batch.step()
        steps += 100
    return steps * env.num_envs / (time.perf_counter() - begin)


def collection(cfg: Config, seconds: float) -> float:
    """Steps/s of rollouts with a fresh policy."""
    env = make_env(cfg, cfg.rollout.num_envs)
    learner = Learner(env, cfg)
    collector = Collector(env, cfg.rollout, learner.rng, learner.noise["rollout"])
    goals = learner.gan.sample(300)
    collector.begin(goals)
    steps, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        rollouts, _ = collector.collect(learner.policy, goals)
        steps += rollouts.rewards.size * cfg.action_repeat
    return steps / (time.perf_counter() - begin)


def training(cfg: Config, total_steps: int) -> float:
    """Training steps/s of a whole run from its first step to its last, evaluation included."""
    with tempfile.TemporaryDirectory() as folder:
        train(replace(cfg, total_steps=total_steps), Path(folder))
        _, rows = record.read_metrics(Path(folder))
    return float(rows[-1]["time/fps"])


def main() -> None:
    settings = tyro.cli(Settings, description=__doc__)
    versions = f"mujoco {mujoco.__version__}, torch {torch.__version__}"
    print(f"{platform.processor() or platform.machine()}, {versions}")
    rows = []
    for env in settings.env:
        for threads in settings.threads:
            cfg = replace(config.preset(env), threads=threads)
            torch.set_num_threads(cfg.learning_threads)
            raw_batch(cfg, 1.0)  # warm-up
            collection(cfg, 1.0)
            measured: dict[str, list[float]] = {"raw_batch": [], "collection": [], "training": []}
            for _ in range(settings.rounds):
                measured["raw_batch"].append(raw_batch(cfg, settings.seconds))
                measured["collection"].append(collection(cfg, settings.seconds))
                measured["training"].append(training(cfg, settings.train_steps))
            limit = np.median(measured["raw_batch"])
            for name, values in measured.items():
                middle = float(np.median(values))
                rows.append(
                    {
                        "name": name,
                        "env": env,
                        "threads": threads,
                        "steps_per_second": round(middle),
                        "range": [round(min(values)), round(max(values))],
                        "share_of_raw": round(middle / limit, 3),
                    }
                )
                print(
                    f"{env:12} {threads} threads  {name:10} {middle:>9,.0f} steps/s  "
                    f"({min(values):,.0f} to {max(values):,.0f})  {middle / limit:.2f} of raw",
                    flush=True,
                )
    if settings.json is not None:
        settings.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
