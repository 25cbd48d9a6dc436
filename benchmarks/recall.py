"""What recall traces cost an agent of Stable-Baselines3, in milliseconds per environment step.

    python benchmarks/recall.py --json docs/runs/recall.json

The Hopper, one core, one environment, agents and callback as they come, timed once as many steps
are remembered as there is room for. The agent's own time is that of the same run without what the
callback says that it took: a machine that is busy slows both alike.
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

from goalgan_bt.learners.stable_baselines import RecallTraces
from goalgan_bt.recall.settings import RecallConfig
from goalgan_bt.runs.command_line import parse
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.terminal import complain

STEPS = {SAC: 6_000, PPO: 24_576, TRPO: 24_576}  # twelve turns each


@dataclass(frozen=True)
class Settings:
    """Time agents that imitate recall traces."""

    rounds: int = 1
    """Runs of each, with seeds 0, 1, ...; medians are told."""
    json: Path | None = None
    """Where to write the rows."""


def timed(kind: Any, seed: int) -> dict[str, float]:
    """What a run with a full memory takes, in milliseconds: the agent's own per step, that of the
    recall traces per step, and of these a turn."""
    env = make_vec_env("Hopper-v5", seed=seed)
    waits = {"learning_starts": RecallConfig.capacity} if kind is SAC else {}  # that is faster
    agent = kind("MlpPolicy", env, seed=seed, device="cpu", **waits)
    callback = Stopwatch(seed=seed)
    agent.learn(RecallConfig.capacity, callback=callback)
    filled, spent = agent.num_timesteps, callback.seconds
    callback.turns.clear()
    begin = time.perf_counter()
    agent.learn(STEPS[kind], callback=callback, reset_num_timesteps=False)
    own, steps = callback.seconds - spent, agent.num_timesteps - filled
    alone = time.perf_counter() - begin - own
    return {
        "alone_ms_per_step": 1e3 * alone / steps,
        "recall_ms_per_step": 1e3 * own / steps,
        "turn_ms": 1e3 * statistics.fmean(callback.turns),
        "share": own / alone,
    }


class Stopwatch(RecallTraces):
    """Recall traces that know what each turn took."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed=seed)
        self.turns: list[float] = []

    def turn(self) -> dict[str, float]:
        """One turn, timed."""
        begin = time.perf_counter()
        try:
            return super().turn()
        finally:
            self.turns.append(time.perf_counter() - begin)


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
        runs = [timed(kind, seed) for seed in range(settings.rounds)]
        found = {name: statistics.median(run[name] for run in runs) for name in runs[0]}
        rows.append(
            {"agent": kind.__name__, "steps": STEPS[kind]}
            | {name: round(value, 4) for name, value in found.items()}
        )
        print(rows[-1], flush=True)
    if settings.json is not None:
        settings.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
