"""Recall traces for TRPO and SAC on locomotion (Goyal et al. 2019, sections 5.4 and 5.5).

    python -m goalgan_bt.train --env hopper --method trpo --backtracking.trace-length 10

gymnasium's tasks and the agents of sb3-contrib and Stable-Baselines3, with the callback of
`goalgan_bt.sb3`; a trace length of 0 is the agent alone.
"""

import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from goalgan_bt import record
from goalgan_bt.command_line import UsageError, exit_code, fault, parse, value_of
from goalgan_bt.progress import say
from goalgan_bt.record import Record
from goalgan_bt.settings import RecallConfig

TASKS = {
    "half_cheetah": "HalfCheetah-v5",
    "ant": "Ant-v5",
    "walker2d": "Walker2d-v5",
    "hopper": "Hopper-v5",
    "humanoid": "Humanoid-v5",
}
# The paper's tables; it has no TRPO on the Humanoid.
TRACE_LENGTH = {"half_cheetah": 20, "walker2d": 20, "hopper": 20, "ant": 50, "humanoid": 50}
TRPO_TRACE_LENGTH = TRACE_LENGTH | {"hopper": 10}
REPORTS = 25  # per run
BATCH = 4096  # steps of a TRPO update
SEEDS = 1000  # environments of one run have seeds of their own, which no other run has
# Without contact forces: zero nearly always, they are no part of what a model can unroll.
PLAIN: dict[str, dict[str, Any]] = {
    "ant": {"include_cfrc_ext_in_observation": False},
    "humanoid": {"include_cfrc_ext_in_observation": False},
}


@dataclass(frozen=True)
class LocomotionConfig:
    """Learn to run with TRPO or SAC, with or without recall traces."""

    env: str = "hopper"
    """half_cheetah, ant, walker2d, hopper or humanoid (gymnasium's, version 5)."""
    method: Literal["trpo", "sac"] = "trpo"
    """The agent: sb3-contrib's TRPO or Stable-Baselines3's SAC."""
    seed: int = 0
    """Seed of everything random."""
    total_steps: int = 1_000_000
    """Environment steps of training."""
    out: Path = Path("runs")
    """Folder of runs; this run gets a folder of its own in it."""
    num_envs: int = 4
    """Environments side by side (SAC: 1)."""
    hidden: int = 64
    """Units of each of the agent's two hidden layers (TRPO: 64 as sb3-contrib; SAC: 128 as its
    authors' first code, half the time of Stable-Baselines3's 256)."""
    minibatch: int = 128
    """Steps of a gradient step of SAC, or of TRPO's value function."""
    episodes: int = 5
    """Episodes of the deterministic policy in each measurement."""
    backtracking: RecallConfig = field(default_factory=RecallConfig)


def asked_for(argv: list[str]) -> bool:
    """Whether a command line names one of these environments."""
    return value_of(argv, "--env") in TASKS


def preset(env: str, method: str) -> LocomotionConfig:
    """The default settings of a task and an agent.

    Raises:
        UsageError: if there is no such task or agent.
    """
    if env not in TASKS:
        raise UsageError(f"unknown environment {env!r}: choose one of {', '.join(TASKS)}")
    if method not in ("trpo", "sac"):
        raise UsageError(f"unknown method {method!r}: choose trpo or sac")
    if method == "sac":
        return LocomotionConfig(
            env,
            "sac",
            total_steps=200_000,
            num_envs=1,
            hidden=128,
            backtracking=RecallConfig(trace_length=TRACE_LENGTH[env], fade_steps=100_000),
        )
    recall = RecallConfig(trace_length=TRPO_TRACE_LENGTH[env], fade_steps=500_000)
    return LocomotionConfig(env, backtracking=recall)


def from_command_line(argv: list[str]) -> LocomotionConfig:
    """The settings that a command line asks for.

    Raises:
        UsageError: for an unknown flag, a value of the wrong kind, or one that makes no sense.
        SystemExit: after `--help`.
    """
    default = preset(value_of(argv, "--env") or "hopper", value_of(argv, "--method") or "trpo")
    cfg = parse(LocomotionConfig, argv, "python -m goalgan_bt.train", default)
    for names, good, what in (
        ("total_steps num_envs episodes hidden minibatch", lambda x: x >= 1, "1 or more"),
        ("hidden minibatch episodes", lambda x: x <= 10_000, "at most 10000"),
        ("num_envs", lambda x: x < SEEDS, f"less than {SEEDS}"),
        ("seed", lambda x: 0 <= x <= 10**6, "between 0 and 1000000"),
    ):
        if bad := fault(cfg, names, good, what):
            raise UsageError(bad)
    if cfg.backtracking.trace_length and (problem := cfg.backtracking.problem()):
        raise UsageError(f"--backtracking: {problem} (a trace_length of 0 is the agent alone)")
    return cfg


def train(cfg: LocomotionConfig, folder: Path) -> float:
    """Learn to run; writes `metrics.csv` and `policy.pt` (the policy's state_dict, with TRPO also
    mean and variance that its observations are normalised by) into the run folder.

    Args:
        cfg: settings.
        folder: the run folder.

    Returns:
        The last measured return of the deterministic policy.

    Raises:
        UsageError: if the extra `sb3` is missing.
    """
    try:
        import torch
        from sb3_contrib import TRPO
        from stable_baselines3 import SAC
        from stable_baselines3.common.env_util import make_vec_env
        from stable_baselines3.common.evaluation import evaluate_policy
        from stable_baselines3.common.vec_env import VecNormalize, sync_envs_normalization

        from goalgan_bt.sb3 import RecallTraces
    except ImportError:
        raise UsageError('locomotion needs the extra sb3: pip install "goalgan_bt[sb3]"') from None
    torch.set_num_threads(1)
    plain = PLAIN.get(cfg.env, {})
    env: Any = make_vec_env(TASKS[cfg.env], cfg.num_envs, SEEDS * cfg.seed, env_kwargs=plain)
    # The last of its seeds: other first states than in training.
    test_env: Any = make_vec_env(TASKS[cfg.env], 1, SEEDS * (cfg.seed + 1) - 1, env_kwargs=plain)
    common: Any = {
        "seed": cfg.seed,
        "device": "cpu",
        "batch_size": cfg.minibatch,
        "policy_kwargs": {
            "net_arch": [cfg.hidden, cfg.hidden],
            # Stable-Baselines3's own epsilon of each, which it forgets where anything is given.
            "optimizer_kwargs": {"fused": True, "eps": 1e-5 if cfg.method == "trpo" else 1e-8},
        },
    }
    if cfg.method == "trpo":  # as rllab's, it sees normalised observations
        env, test_env = VecNormalize(env), VecNormalize(test_env, training=False, norm_reward=False)
        steps = max(1, BATCH // cfg.num_envs)
        agent: Any = TRPO("MlpPolicy", env, n_steps=steps, **common)
    else:
        agent = SAC("MlpPolicy", env, **common)
    traced = cfg.backtracking.trace_length > 0
    recall = RecallTraces(cfg.backtracking, cfg.seed) if traced else None

    records = Record(folder)
    began, tested, reports, mean = time.perf_counter(), 0, 0, float("nan")
    while agent.num_timesteps < cfg.total_steps:
        reports += 1
        wanted = cfg.total_steps * reports // REPORTS - agent.num_timesteps
        agent.learn(max(1, wanted), callback=recall, reset_num_timesteps=False)
        if cfg.method == "trpo":
            sync_envs_normalization(env, test_env)
        found: Any = evaluate_policy(agent, test_env, cfg.episodes, return_episode_rewards=True)
        returns, lengths = found
        tested, mean = tested + sum(lengths), sum(returns) / len(returns)
        seconds = time.perf_counter() - began
        row: dict[str, float] = {
            "iteration": reports,
            "steps/train": agent.num_timesteps,
            "steps/label": 0,
            "steps/eval": tested,
            "time/total": round(seconds, 1),
            "time/fps": round(agent.num_timesteps / seconds),
            "eval/return": round(mean, 2),
        }
        if recall is not None:
            row |= {f"recall/{name}": value for name, value in recall.last.items()}
        records.metrics(row)
        left = seconds * max(0.0, cfg.total_steps / agent.num_timesteps - 1)
        say(f"steps {agent.num_timesteps:,}  return {mean:.1f}  left {left / 60:.0f} min")
    state = {"policy": agent.policy.state_dict()}
    if cfg.method == "trpo":  # what its observations are normalised by
        state |= {
            "mean": torch.from_numpy(env.obs_rms.mean),
            "var": torch.from_numpy(env.obs_rms.var),
        }
    record.write_atomically(folder / "policy.pt", lambda file: torch.save(state, file))
    records.close("complete")
    return mean


def main() -> int:
    """The command line; returns the exit code."""

    def work() -> None:
        cfg = from_command_line(sys.argv[1:])
        folder = record.new_run(cfg.out, cfg.env, cfg.seed, asdict(cfg))
        say(f"run folder: {folder}")
        found = train(cfg, folder)
        say(f"return {found:.1f} at the end of training: {folder}")

    return exit_code(work)
