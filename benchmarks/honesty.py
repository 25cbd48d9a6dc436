"""What a trained policy is worth outside of the simulation that it was trained in.

    python benchmarks/honesty.py --ant RUN RUN ... --point RUN RUN ... --json FILE

The Ant's coverage is measured again under RK4, the original's integrator, with the same goals and
noise. The point's policy acts, unchanged, in gymnasium-robotics' own PointMaze_UMaze-v3: cells of
1 m instead of 2 m, 0.01 s steps, ten times the force for the mass, a damper, goals reached within
0.45 m; its observations are mapped to the frame that the policy knows.
"""

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from goalgan_bt.agent.coverage import coverage
from goalgan_bt.agent.policy import Actor
from goalgan_bt.learners import table
from goalgan_bt.learners.maze import TEST_ENVS
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.maze_learner import load_policy
from goalgan_bt.runs.command_line import parse
from goalgan_bt.runs.errors import RunError, UsageError
from goalgan_bt.runs.terminal import complain

START = (3, 1)  # in their map
CELLS = [(3, 2), (3, 3), (2, 3), (1, 3), (1, 2), (1, 1)]  # the other free ones


@dataclass(frozen=True)
class Settings:
    """Measure policies of finished runs in other physics."""

    ant: tuple[Path, ...] = ()
    """Run folders of Ants."""
    point: tuple[Path, ...] = ()
    """Run folders of points in the U-maze."""
    rollouts: int = 3
    """Episodes per test goal of the Ant."""
    episodes: int = 20
    """Episodes per goal cell of the point."""
    json: Path | None = None
    """Where to write the rows."""


def integrators(folder: Path, rollouts: int) -> dict[str, float]:
    """Coverage of a run's policy under each integrator."""
    cfg, found = table.load(folder), {}
    for integrator in ("implicitfast", "rk4"):
        env = make_env(replace(cfg, integrator=integrator), TEST_ENVS)
        noise = torch.Generator().manual_seed(cfg.seed)
        policy, _ = load_policy(env, cfg, folder)
        measured = coverage(env, policy, env.test_goals(), rollouts, noise)
        found[integrator] = float(measured.stochastic.mean())
        found[f"{integrator}_deterministic"] = float(measured.deterministic.mean())
    return found


def in_gymnasium(folder: Path, episodes: int) -> dict[str, float]:
    """Success of a run's deterministic policy in PointMaze_UMaze-v3, from our start cell."""
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    cfg = table.load(folder)
    ours = make_env(cfg, 1)
    theirs = gymnasium.make("PointMaze_UMaze-v3", continuing_task=False)
    policy, _ = load_policy(ours, cfg, folder)
    act, successes = Actor(policy), np.zeros((len(CELLS), episodes))
    for i, cell in enumerate(CELLS):
        for episode in range(episodes):
            options = {"reset_cell": np.array(START), "goal_cell": np.array(cell)}
            obs, info = theirs.reset(seed=cfg.seed * episodes + episode, options=options)
            assert not info["success"]
            ended = False
            while not ended:
                state = 2 * obs["observation"][None]  # our cells are twice as wide,
                state[:, :2] += 2  # and our origin is the start cell's centre
                goal = 2 * obs["desired_goal"][None] + 2
                action = np.clip(act(ours.observations(state, goal), None)[0], -1, 1)
                obs, _, terminated, truncated, info = theirs.step(action)
                ended = terminated or truncated
                successes[i, episode] = info["success"]
    by_cell = {f"cell {i}": float(rate) for i, rate in enumerate(successes.mean(axis=1))}
    return {"success": float(successes.mean())} | by_cell


def main() -> int:
    """Measure and print."""
    try:
        settings = parse(Settings, None, "python benchmarks/honesty.py")
        if not settings.ant and not settings.point:
            raise UsageError("name run folders with --ant or --point")
        rows = measured(settings)
    except (UsageError, RunError) as error:
        complain(str(error))
        return 2
    if settings.json is not None:
        settings.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


def measured(settings: Settings) -> list[dict[str, Any]]:
    """A row for each run, printed as it is known."""
    rows: list[dict[str, Any]] = []
    for folder in settings.ant:
        rows.append({"run": folder.name, **integrators(folder, settings.rollouts)})
        print(rows[-1], flush=True)
    for folder in settings.point:
        rows.append({"run": folder.name, **in_gymnasium(folder, settings.episodes)})
        print(rows[-1], flush=True)
    return rows


if __name__ == "__main__":
    sys.exit(main())
