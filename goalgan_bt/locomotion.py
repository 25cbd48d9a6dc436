"""Recall traces for TRPO and SAC on locomotion (Goyal et al. 2019, sections 5.4 and 5.5).

    python -m goalgan_bt.train --env hopper --method trpo --backtracking.trace-length 10

gymnasium's tasks and the agents of sb3-contrib and Stable-Baselines3, with the callback of
`goalgan_bt.sb3`; a trace length of 0 is the agent alone.
"""

import math
import sys
import time
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np

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
SEEDS = 1000  # more than a run has environments
REPLAY = "observations", "next_observations", "actions", "rewards", "dones", "timeouts"
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
    resume: Path | None = None
    """Go on with an unfinished run from its last measurement, with its settings."""
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
    """Whether a command line names one of these environments, or a run in one."""
    run = value_of(argv, "--resume")
    env = value_of(argv, "--env") if run is None else record.env_of(Path(run))
    return env in TASKS


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
            backtracking=RecallConfig(
                trace_length=TRACE_LENGTH[env], max_kl=0.2, fade_steps=100_000
            ),
        )
    recall = RecallConfig(trace_length=TRPO_TRACE_LENGTH[env], fade_steps=500_000)
    return LocomotionConfig(env, backtracking=recall)


def from_command_line(argv: list[str]) -> LocomotionConfig:
    """The settings that a command line asks for: with `--resume` the run's own.

    Raises:
        UsageError: for an unknown flag, a value of the wrong kind, or one that makes no sense.
        RunError: if there is no such run, or its settings cannot be read.
        SystemExit: after `--help`.
    """
    run = value_of(argv, "--resume")
    if run is None:
        env, method = value_of(argv, "--env"), value_of(argv, "--method")
        default = preset(env or "hopper", method or "trpo")
    else:
        default = replace(load(Path(run)), resume=Path(run))
    cfg = parse(LocomotionConfig, argv, "python -m goalgan_bt.train", default)
    if run is not None and cfg != default:
        raise UsageError("a run of this kind goes on as it was begun: --resume takes no other flag")
    if run is None:
        check(cfg)
    return cfg


def load(folder: Path) -> LocomotionConfig:
    """The settings of a run folder.

    Raises:
        RunError: if the folder is no run, or they cannot be read or make no sense.
    """
    cfg = record.read_settings(LocomotionConfig, folder)
    try:
        check(cfg)
    except (UsageError, TypeError) as error:
        raise record.RunError(f"cannot read {folder / 'config.json'}: {error}") from None
    return cfg


def check(cfg: LocomotionConfig) -> None:
    """Refuse settings that make no sense.

    Raises:
        UsageError: naming the first such setting.
    """
    preset(cfg.env, cfg.method)  # are there such ones?
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


def needed() -> None:
    """Refuse to run without the agents.

    Raises:
        UsageError: if the extra `sb3` is missing.
    """
    for package in ("stable_baselines3", "sb3_contrib"):
        if find_spec(package) is None:
            raise UsageError(f'locomotion needs {package}: pip install "goalgan_bt[sb3]"')


def make(cfg: LocomotionConfig) -> tuple[Any, Any]:
    """The agent, with the environments that it learns in, and an environment to measure it in.

    Raises:
        UsageError: if the extra `sb3` is missing.
    """
    needed()
    import torch
    from sb3_contrib import TRPO
    from stable_baselines3 import SAC
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    torch.set_num_threads(1)
    plain = PLAIN.get(cfg.env, {})
    env: Any = make_vec_env(TASKS[cfg.env], cfg.num_envs, cfg.seed, env_kwargs=plain)
    # Other first states than in training, whose environments have the seeds from cfg.seed on.
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
        return TRPO("MlpPolicy", env, n_steps=steps, **common), test_env
    return SAC("MlpPolicy", env, **common), test_env


def train(cfg: LocomotionConfig, folder: Path) -> float:
    """Learn to run; writes `metrics.csv` into the run folder, `checkpoint.pt` with every
    measurement, and at the end in its place `policy.pt` (the policy's state_dict, with TRPO also
    mean and variance that its observations are normalised by).

    Args:
        cfg: settings; goes on from the folder's checkpoint if they say so.
        folder: the run folder.

    Returns:
        The last measured return of the deterministic policy.

    Raises:
        UsageError: if the extra `sb3` is missing.
        RunError: if there is no checkpoint to go on from, or it cannot be used.
    """
    agent, test_env = make(cfg)  # it tells if what follows is missing
    import torch
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import sync_envs_normalization

    from goalgan_bt import checkpoint
    from goalgan_bt.sb3 import RecallTraces

    traced = cfg.backtracking.trace_length > 0
    recall = RecallTraces(cfg.backtracking, cfg.seed) if traced else None

    reports, tested, seconds, mean = 0, 0, 0.0, float("nan")
    if cfg.resume is not None:
        reports, tested, seconds, mean = resume(agent, recall, folder)
        fresh = np.random.SeedSequence((cfg.seed, reports)).generate_state(1)
        agent.set_random_seed(int(fresh[0]))  # or it would draw what it drew at first
    records = Record(folder, reports)
    began = time.perf_counter() - seconds
    while agent.num_timesteps < cfg.total_steps:
        reports += 1
        wanted = cfg.total_steps * reports // REPORTS - agent.num_timesteps
        agent.learn(max(1, wanted), callback=recall, reset_num_timesteps=False)
        if cfg.method == "trpo":
            sync_envs_normalization(agent.get_env(), test_env)
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
        done = {"done": (reports, tested, seconds, float(mean))}
        checkpoint.save(done | state_dict(agent, recall), folder / "checkpoint.pt")
        left = seconds * max(0.0, cfg.total_steps / agent.num_timesteps - 1)
        say(f"steps {agent.num_timesteps:,}  return {mean:.1f}  left {left / 60:.0f} min")
    learned = {"policy": agent.policy.state_dict()}
    if (normalising := agent.get_vec_normalize_env()) is not None:
        seen = normalising.obs_rms
        learned |= {"mean": torch.from_numpy(seen.mean), "var": torch.from_numpy(seen.var)}
    checkpoint.save(learned, folder / "policy.pt")
    records.close("complete")
    (folder / "checkpoint.pt").unlink(missing_ok=True)  # it holds all that SAC has seen
    return mean


def resume(agent: Any, recall: Any, folder: Path) -> tuple[int, int, float, float]:
    """Let an agent and its callback (or None) go on from a run's checkpoint.

    Returns:
        Measurements so far, their steps, seconds of the run, and the last return.

    Raises:
        RunError: if the run is finished, or there is no checkpoint, or it cannot be used.
    """
    from goalgan_bt import checkpoint

    if (folder / "policy.pt").exists() and not (folder / "checkpoint.pt").exists():
        raise record.RunError(f"{folder} is finished: there is nothing left to do")
    with checkpoint.saved(folder) as state:
        restore(agent, recall, state)
        reports, tested, seconds, mean = state["done"]
        done = int(reports), int(tested), float(seconds), float(mean)
        if not math.isfinite(sum(done)):
            raise ValueError("what was measured is not finite")
    return done


def state_dict(agent: Any, recall: Any) -> dict[str, Any]:
    """What an agent and its callback (or None) need to go on, as tensors and plain values."""
    import torch

    state = {"parameters": agent.get_parameters(), "steps": agent.num_timesteps}
    if (normalising := agent.get_vec_normalize_env()) is not None:
        for name, moments in _moments(normalising).items():
            mean, var = torch.as_tensor(moments.mean), torch.as_tensor(moments.var)
            state[name] = {"mean": mean, "var": var, "count": float(moments.count)}
    if (replay := getattr(agent, "replay_buffer", None)) is not None:
        seen = {name: torch.from_numpy(getattr(replay, name)[: replay.size()]) for name in REPLAY}
        state["replay"] = seen | {"pos": replay.pos, "full": replay.full}
        state["log_ent_coef"] = agent.log_ent_coef.detach()
    if recall is not None and recall.trajectories:
        state["recall"] = recall.state_dict()
    return state


def restore(agent: Any, recall: Any, state: dict[str, Any]) -> None:
    """Put what `state_dict` gave into an agent of the same settings and its callback (or None)."""
    agent.set_parameters(state["parameters"])
    if not all(weights.isfinite().all() for weights in agent.policy.parameters()):
        raise ValueError("a weight is not finite")
    agent.num_timesteps = int(state["steps"])
    if (normalising := agent.get_vec_normalize_env()) is not None:
        for name, moments in _moments(normalising).items():
            known = state[name]
            moments.mean, moments.var = known["mean"].numpy(), known["var"].numpy()
            moments.count = known["count"]
    if (replay := getattr(agent, "replay_buffer", None)) is not None:
        seen = state["replay"]
        for name in REPLAY:
            getattr(replay, name)[: len(seen[name])] = seen[name].numpy()
        replay.pos, replay.full = range(replay.buffer_size)[seen["pos"]], bool(seen["full"])
        agent.log_ent_coef.data.copy_(state["log_ent_coef"])
        if not agent.log_ent_coef.isfinite().all():
            raise ValueError("the temperature is not finite")
    if "recall" in state:
        recall.load_state_dict(state["recall"])


def _moments(normalising: Any) -> dict[str, Any]:
    return {"observations": normalising.obs_rms, "returns": normalising.ret_rms}


def main() -> int:
    """The command line; returns the exit code."""
    folder: Path | None = None

    def work() -> None:
        nonlocal folder
        cfg = from_command_line(sys.argv[1:])
        needed()  # before there is a folder
        folder = cfg.resume or record.new_run(cfg.out, cfg.env, cfg.seed, asdict(cfg))
        say(f"run folder: {folder}")
        found = train(cfg, folder)
        say(f"return {found:.1f} at the end of training: {folder}")

    def how_to_go_on() -> str:
        if folder is None or not (folder / "checkpoint.pt").exists():
            return "nothing new was saved, give the same command again"
        return f"go on from the last measurement with --resume {folder}"

    return exit_code(work, how_to_go_on)
