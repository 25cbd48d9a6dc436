"""Recall traces for TRPO and SAC on locomotion (Goyal et al. 2019, sections 5.4 and 5.5).

    python -m goalgan_bt.train --env hopper --method trpo --backtracking.trace-length 10

gymnasium's tasks and the agents of sb3-contrib and Stable-Baselines3, with the callback of
`goalgan_bt.sb3`; a trace length of 0 is the agent alone.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np

from goalgan_bt.learners.run_config import RunConfig, Trained, World
from goalgan_bt.recall.settings import RecallConfig
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.ranges import between
from goalgan_bt.runs.run_folder import end_run
from goalgan_bt.runs.session import Limits, Schedule, Session, checked
from goalgan_bt.runs.signals import Stop
from goalgan_bt.runs.torchrun import refuse_company

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


Agent = Literal["trpo", "sac"]


@dataclass(frozen=True)
class LocomotionConfig(RunConfig):
    """Learn to run with TRPO or SAC, with or without recall traces."""

    env: str = "hopper"
    """half_cheetah, ant, walker2d, hopper or humanoid (gymnasium's, version 5)."""
    method: Agent = "trpo"
    """The agent: sb3-contrib's TRPO or Stable-Baselines3's SAC."""
    seed: Annotated[int, between(0, 10**6)] = 0
    """Seed of everything random."""
    total_steps: Annotated[int, between(1, 10**12)] = 1_000_000
    """Environment steps of training."""
    resume: Path | None = None
    """Go on with an unfinished run from its last measurement, with its settings."""
    num_envs: Annotated[int, between(1, SEEDS - 1)] = 4
    """Environments side by side (SAC: 1)."""
    hidden: Annotated[int, between(1, 10_000)] = 64
    """Units of each of the agent's two hidden layers (TRPO: 64 as sb3-contrib; SAC: 128 as its
    authors' first code, half the time of Stable-Baselines3's 256)."""
    minibatch: Annotated[int, between(1, 10_000)] = 128
    """Steps of a gradient step of SAC, or of TRPO's value function."""
    episodes: Annotated[int, between(1, 10_000)] = 5
    """Episodes of the deterministic policy in each measurement."""
    backtracking: RecallConfig = field(default_factory=RecallConfig)


def preset(env: str, method: str | None = None) -> LocomotionConfig:
    """The default settings of a task and an agent.

    Raises:
        UsageError: if there is no such task or agent.
    """
    if env not in TASKS:
        raise UsageError(f"unknown environment {env!r}: choose one of {', '.join(TASKS)}")
    if method not in (None, *get_args(Agent)):
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


def check(cfg: LocomotionConfig) -> None:
    """Refuse settings that make no sense together.

    Raises:
        UsageError: naming what is wrong.
    """
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


@contextmanager
def prepared(cfg: LocomotionConfig) -> Iterator[World]:
    """See that the agents are there.

    Raises:
        UsageError: if the extra `sb3` is missing, or for several processes.
    """
    refuse_company(cfg.env)
    needed()
    yield World(cfg.env, None)


def train(cfg: LocomotionConfig, folder: Path | None, stop: Stop | None = None) -> Trained:
    """Learn to run; writes `metrics.csv` into the run folder, and with every measurement
    `policy.pt` (the policy's state_dict, with TRPO also mean and variance that its observations are
    normalised by) and `checkpoint.pt`, which goes at the end.

    Args:
        cfg: settings; goes on from the folder's checkpoint if they say so.
        folder: the run folder.
        stop: asked at every step whether to end early; the run then goes on from its last
            measurement.

    Returns:
        With the last measured return of the deterministic policy.

    Raises:
        UsageError: if the extra `sb3` is missing.
        RunError: if there is no checkpoint to go on from, or it cannot be used.
    """
    agent, test_env = make(cfg)  # it tells if what follows is missing
    from goalgan_bt.learners.stable_baselines import RecallTraces, Until

    traced = cfg.backtracking.trace_length > 0
    recall = RecallTraces(cfg.backtracking, cfg.seed) if traced else None
    callbacks = [Until(stop), *([recall] if recall is not None else [])]
    state, mean = None, math.nan
    if cfg.resume is not None and folder is not None:
        state, mean = resume(agent, recall, folder)
        fresh = np.random.SeedSequence((cfg.seed, state["iteration"])).generate_state(1)
        agent.set_random_seed(int(fresh[0]))  # or it would draw what it drew at first
        if agent.num_timesteps >= cfg.total_steps:  # cut off just before it could end
            save_policy(agent, folder)
            end_run(folder, "complete")
            (folder / "checkpoint.pt").unlink()
            return Trained(folder, "return", mean, agent.num_timesteps)
    with Session(
        folder,
        asdict(cfg),
        Limits(cfg.total_steps),
        Schedule(float),
        f"{cfg.env}, {cfg.method}, seed {cfg.seed}",
        state=state,
        stop=stop,
    ) as run:
        while run.goes_on():
            wanted = cfg.total_steps * run.iteration // REPORTS - agent.num_timesteps
            agent.learn(max(1, wanted), callback=callbacks, reset_num_timesteps=False)
            run.steps["train"] = agent.num_timesteps
            if stop is not None and stop.requested:  # in the middle: it goes on from the last one
                break
            run.measures()
            mean, steps = measure(agent, test_env, cfg)
            run.count("eval", steps)
            run.note("eval", {"return": round(mean, 2)})
            run.note("recall", {} if recall is None else recall.last)
            learned = {"return": float(mean)} | state_dict(agent, recall)
            run.report({})
            run.save(learned)
            if folder is not None:
                save_policy(agent, folder)
    if run.complete and folder is not None:
        (folder / "checkpoint.pt").unlink(missing_ok=True)  # it holds all that SAC has seen
    return Trained(folder, "return", mean, run.steps["train"])


def measure(agent: Any, test_env: Any, cfg: LocomotionConfig) -> tuple[float, int]:
    """Mean return of some deterministic episodes, and their steps."""
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import sync_envs_normalization

    if cfg.method == "trpo":
        sync_envs_normalization(agent.get_env(), test_env)
    found: Any = evaluate_policy(agent, test_env, cfg.episodes, return_episode_rewards=True)
    returns, lengths = found
    return sum(returns) / len(returns), sum(lengths)


def save_policy(agent: Any, folder: Path) -> None:
    """Write the policy of a run, and what normalises its observations: without SAC's replay."""
    import torch

    from goalgan_bt.runs import checkpoint

    learned = {"policy": agent.policy.state_dict()}
    if (normalising := agent.get_vec_normalize_env()) is not None:
        seen = normalising.obs_rms
        learned |= {"mean": torch.from_numpy(seen.mean), "var": torch.from_numpy(seen.var)}
    checkpoint.save(learned, folder / "policy.pt")


def resume(agent: Any, recall: Any, folder: Path) -> tuple[dict[str, Any], float]:
    """Let an agent and its callback (or None) go on from a run's checkpoint.

    Returns:
        What the run's `Session` needs, and the last return.

    Raises:
        RunError: if the run is finished, or there is no checkpoint, or it cannot be used.
    """
    from goalgan_bt.runs import checkpoint

    if (folder / "policy.pt").exists() and not (folder / "checkpoint.pt").exists():
        raise RunError(f"{folder} has reached its limits: there is nothing left to do")
    with checkpoint.saved(folder) as state:
        restore(agent, recall, state)
        run, mean = checked(state["run"]), float(state["return"])
        counts = run["iteration"], run["seconds"], run["next_measurement"], *run["steps"].values()
        if not math.isfinite(sum(counts) + mean):
            raise ValueError("what was measured is not finite")
    return run, mean


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
