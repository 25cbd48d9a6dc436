"""Physics on a GPU: steps per second, and how far it is from MuJoCo's on the CPU.

    python benchmarks/gpu.py --env ant_umaze --json gpu.json

`warp` is mujoco-warp with random controls and nothing else. `warp_policy` adds what episodes need,
all on the device: a policy's actions, observations, rewards, new goals and resets. `error` is the
distance between the torsos under both physics after the same controls from the same states, in
metres; `coverage`, with `--run`, what the policy of a run reaches under each. Needs the extra
`gpu`.
"""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
import tyro
from device_episodes import DeviceEpisodes

from goalgan_bt.agent.coverage import coverage as both_policies
from goalgan_bt.agent.policy import GaussianPolicy
from goalgan_bt.learners import maze_config, maze_learner, table
from goalgan_bt.learners.maze_config import MazeConfig, make_env
from goalgan_bt.runs.run_folder import maze_of

HORIZONS = (1, 10, 50)  # steps after which errors are taken
STATES = 256  # simulations whose errors are taken


@dataclass(frozen=True)
class Settings:
    """Measure mujoco-warp."""

    env: tuple[str, ...] = ("ant_umaze", "point_umaze")
    """Environments."""
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    """Where mujoco-warp runs; here the default is what this machine has."""
    num_envs: tuple[int, ...] = (1024, 2048, 4096, 8192, 16384)
    """Numbers of simulations side by side."""
    seconds: float = 4.0
    """Duration of each measurement of speed."""
    run: Path | None = None
    """Also the coverage of this run's policy under both physics."""
    json: Path | None = None
    """Also write the rows to this file."""


def speed(act: Callable[[], None], cfg: MazeConfig, num_envs: int, seconds: float) -> float:
    """Steps/s of doing something over and over, after a warm-up."""

    def wait() -> None:
        if cfg.device.startswith("cuda"):
            torch.cuda.synchronize(cfg.device)

    act()
    act()
    wait()
    actions, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        for _ in range(10):
            act()
        wait()
        actions += 10
    return actions * cfg.action_repeat * num_envs / (time.perf_counter() - begin)


def warp(cfg: MazeConfig, num_envs: int, seconds: float) -> float:
    """Steps/s of mujoco-warp alone: random controls, back to the start every 100 steps."""
    episodes = DeviceEpisodes(make_env(cfg, num_envs))
    batch, ctrl = episodes.env.batch, episodes.env.batch.bind("ctrl")
    everyone = torch.ones_like(episodes.elapsed, dtype=torch.bool)
    controls = 2 * torch.rand((16, *ctrl.shape), device=ctrl.device) - 1
    taken = 0

    def act() -> None:
        nonlocal taken
        if taken % 100 < cfg.action_repeat:
            episodes.begin(everyone, episodes.goals)
        ctrl.copy_(controls[taken % 16])
        batch.step(nstep=cfg.action_repeat)
        taken += cfg.action_repeat

    return speed(act, cfg, num_envs, seconds)


@torch.inference_mode()
def warp_policy(cfg: MazeConfig, num_envs: int, seconds: float) -> float:
    """Steps/s of episodes of a fresh policy, each to a goal anywhere in the maze."""
    env = make_env(cfg, num_envs)
    episodes = DeviceEpisodes(env)
    device = episodes.goals.device
    policy = GaussianPolicy(env.obs_dim, env.act_dim, cfg.policy).to(device)
    std = policy(torch.zeros((1, env.obs_dim), device=device))[1].exp()
    low, high = (
        torch.as_tensor(x, dtype=torch.float32, device=device)
        for x in (env.goal_low, env.goal_high)
    )

    def new_goals() -> torch.Tensor:
        return low + (high - low) * torch.rand_like(episodes.goals)

    episodes.begin(torch.ones_like(episodes.elapsed, dtype=torch.bool), new_goals())
    rewards = torch.zeros((), device=device)

    def act() -> None:
        mean = policy.net(policy.normaliser(episodes.observe()))
        step = episodes.step(mean + std * torch.randn_like(mean))
        rewards.add_(step.rewards.sum())
        episodes.begin(step.terminated | step.truncated, new_goals())

    return speed(act, cfg, num_envs, seconds)


def errors(cfg: MazeConfig) -> list[dict[str, Any]]:
    """How far the torsos are apart after steps of random controls, from states in motion."""
    cfg = replace(cfg, action_repeat=1)
    cpu, gpu = (
        make_env(replace(cfg, physics="mujoco", device="auto"), STATES),
        make_env(cfg, STATES),
    )
    rng = np.random.default_rng(0)
    ids, nowhere = np.arange(STATES), np.full((STATES, 2), 99.0)
    cells = cpu.maze.cell_centres()
    states = np.tile(cpu.start_state, (STATES, 1))
    states[:, :2] = cells[rng.integers(len(cells), size=STATES)]
    cpu.reset(ids, nowhere, states)
    for _ in range(10):
        cpu.advance(ids, rng.uniform(-1, 1, (STATES, cpu.act_dim)))
    states = cpu.read_states(ids).astype(np.float32)  # what both can begin with
    for env in (cpu, gpu):
        env.reset(ids, nowhere, states)
    rows = []
    for step in range(1, max(HORIZONS) + 1):
        controls = rng.uniform(-1, 1, (STATES, cpu.act_dim)).astype(np.float32)
        for env in (cpu, gpu):
            env.advance(ids, controls)
        if step in HORIZONS:
            apart = np.linalg.norm((cpu.read_states(ids) - gpu.read_states(ids))[:, :2], axis=1)
            median, high = (float(f"{x:.3g}") for x in np.percentile(apart, [50, 95]))
            rows.append({"name": "error", "steps": step, "median": median, "percentile_95": high})
    return rows


def coverage(run: Path, device: str) -> list[dict[str, Any]]:
    """Coverage of a run's policy under MuJoCo and under mujoco-warp, stochastic and by its mean."""
    cfg, maze = table.load(run), maze_of(run)
    rows = []
    for physics, where in (("mujoco", "auto"), ("warp", device)):
        cfg = replace(cfg, physics=physics, device=where)
        test_goals = make_env(cfg, 1, maze).test_goals()
        env = make_env(cfg, len(test_goals) * (cfg.coverage.rollouts + 1), maze)
        policy, _ = maze_learner.load_policy(env, cfg, run)
        noise = torch.Generator().manual_seed(0)
        found = both_policies(env, policy, test_goals, cfg.coverage.rollouts, noise)
        row = {"name": "coverage", "env": cfg.env, "physics": physics, "run": run.name}
        by_mean = float(found.deterministic.mean())
        row["coverage"], row["coverage_deterministic"] = float(found.stochastic.mean()), by_mean
        rows.append(row)
    return rows


def main() -> None:
    settings = tyro.cli(Settings, description=__doc__)
    torch.set_num_threads(maze_config.ANT.learning_threads)  # as in training
    gpu = settings.device.startswith("cuda")
    machine = torch.cuda.get_device_name(settings.device) if gpu else "CPU"
    print(f"{machine}, mujoco {mujoco.__version__}, torch {torch.__version__}")
    rows: list[dict[str, Any]] = []

    def add(row: dict[str, Any]) -> None:
        rows.append(row)
        print("  ".join(f"{key} {value}" for key, value in row.items()), flush=True)

    for env in settings.env:
        cfg = replace(maze_config.preset(env), physics="warp", device=settings.device)
        where = {"env": env, "device": settings.device, "machine": machine}
        for row in errors(cfg):
            add(row | where)
        for num_envs in settings.num_envs:
            for measure in (warp, warp_policy):
                found = round(measure(cfg, num_envs, settings.seconds))
                row = {"name": measure.__name__, "num_envs": num_envs, "steps_per_second": found}
                add(row | where)
    if settings.run is not None:
        for row in coverage(settings.run, settings.device):
            add(row | {"device": settings.device, "machine": machine})
    if settings.json is not None:
        settings.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
