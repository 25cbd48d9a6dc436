"""What recall traces cost an agent of Stable-Baselines3, in milliseconds per environment step.

    python benchmarks/recall.py --json docs/runs/recall.json

The Hopper, one core, each agent alone and with the callback as it comes, alternating; timed once
as many steps are remembered as there is room for.
"""

import json
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from sb3_contrib import TRPO
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env

from goalgan_bt.command_line import UsageError, parse
from goalgan_bt.progress import complain
from goalgan_bt.sb3 import RecallTraces
from goalgan_bt.settings import RecallConfig

STEPS = {SAC: 6_000, PPO: 20_000, TRPO: 20_000}


@dataclass(frozen=True)
class Settings:
    """Time agents with and without recall traces."""

    rounds: int = 2
    """How often each is timed."""
    json: Path | None = None
    """Where to write the rows."""


def timed(kind: Any, seed: int, traced: bool) -> tuple[int, float, float]:
    """Steps of a run with a full memory, its milliseconds per step, and the callback's own."""
    env = make_vec_env("Hopper-v5", n_envs=1 if kind is SAC else 4, seed=seed)
    waits = {"learning_starts": RecallConfig.capacity} if kind is SAC else {}  # that is faster
    agent = kind("MlpPolicy", env, seed=seed, device="cpu", **waits)
    callback = RecallTraces() if traced else None
    agent.learn(RecallConfig.capacity, callback=callback)
    filled, spent = agent.num_timesteps, 0.0 if callback is None else callback.seconds
    begin = time.perf_counter()
    agent.learn(STEPS[kind], callback=callback, reset_num_timesteps=False)
    seconds, steps = time.perf_counter() - begin, agent.num_timesteps - filled
    own = 0.0 if callback is None else callback.seconds - spent
    return steps, 1e3 * seconds / steps, 1e3 * own / steps


def main() -> int:
    """Measure and print."""
    try:
        settings = parse(Settings, None, "python benchmarks/recall.py")
        if settings.rounds < 1:
            raise UsageError("--rounds must be 1 or more")
    except UsageError as error:
        complain(str(error))
        return 2
    torch.set_num_threads(1)
    rows = []
    for kind in STEPS:
        runs = [(timed(kind, i, False), timed(kind, i, True)) for i in range(settings.rounds)]
        alone = statistics.median(run[0][1] for run in runs)
        own = statistics.median(run[1][2] for run in runs)
        rows.append(
            {
                "agent": kind.__name__,
                "steps": runs[0][0][0],
                "alone_ms_per_step": round(alone, 4),
                "recall_ms_per_step": round(own, 4),
                "share": round(own / alone, 4),
            }
        )
        print(rows[-1], flush=True)
    if settings.json is not None:
        settings.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
