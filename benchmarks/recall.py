"""What recall traces cost an agent of Stable-Baselines3, in milliseconds per environment step.

    python benchmarks/recall.py --json docs/runs/recall.json

The Hopper, one core, each agent alone and with the callback as it comes, alternating.
"""

import json
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

STEPS = {SAC: 6_000, PPO: 20_000, TRPO: 20_000}


@dataclass(frozen=True)
class Settings:
    """Time agents with and without recall traces."""

    rounds: int = 2
    """How often each is timed."""
    json: Path | None = None
    """Where to write the rows."""


def timed(kind: Any, seed: int, traced: bool) -> tuple[float, float]:
    """Seconds of a run, and of those the callback's own."""
    env = make_vec_env("Hopper-v5", n_envs=1 if kind is SAC else 4, seed=seed)
    agent = kind("MlpPolicy", env, seed=seed, device="cpu")
    callback = RecallTraces() if traced else None
    begin = time.perf_counter()
    agent.learn(STEPS[kind], callback=callback)
    return time.perf_counter() - begin, 0.0 if callback is None else callback.seconds


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
    for kind, steps in STEPS.items():
        runs = [(timed(kind, i, False), timed(kind, i, True)) for i in range(settings.rounds)]
        alone = sorted(run[0][0] for run in runs)[settings.rounds // 2]
        own = sorted(run[1][1] for run in runs)[settings.rounds // 2]
        rows.append(
            {
                "agent": kind.__name__,
                "steps": steps,
                "alone_ms_per_step": round(1e3 * alone / steps, 4),
                "recall_ms_per_step": round(1e3 * own / steps, 4),
                "share": round(own / alone, 4),
            }
        )
        print(rows[-1], flush=True)
    if settings.json is not None:
        settings.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
