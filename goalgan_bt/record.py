"""A film of a trained policy at work, drawn by MuJoCo.

python -m goalgan_bt.record runs/ant_umaze-20261122-101500-s0 --video ant.mp4 --goal 0 4
"""

from goalgan_bt.runs.signals import exit_with, leave_at_once

if __name__ == "__main__":  # nothing to lose: it goes at once, without a word
    leave_at_once()

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

from goalgan_bt.runs.command_line import check_ranges, check_target, parse, run_command
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.ranges import NOT_NEGATIVE, between
from goalgan_bt.runs.terminal import say
from goalgan_bt.viz import video

if TYPE_CHECKING:
    from goalgan_bt.envs.picture import Picture
    from goalgan_bt.learners.trained_policy import TrainedPolicy

BY_ITSELF = 3  # goals that are filmed where none is named
HOLD = 0.5  # seconds for which the end of an episode is shown
MOST = 4e9  # bytes of pictures in memory until they are written


@dataclass(frozen=True)
class RecordConfig:
    """Film the policy of a run's last checkpoint on its way to goals, from the start each time."""

    run: tyro.conf.Positional[Path]
    """Run folder of a maze."""
    video: Path
    """File to write: .mp4 (extra `movie`) or .gif (extra `plots`)."""
    goal: tuple[float, ...] = ()
    """Where to, x and y in metres from the start; several goals one after the other, as in
    --goal 4 0 4 4. By default three of the maze."""
    stochastic: bool = False
    """Act with the noise of exploration."""
    seed: Annotated[int, NOT_NEGATIVE] = 0
    """Seed of that noise."""
    size: Annotated[int, between(64, 2048)] = 480
    """Pixels of a side."""


def main(argv: list[str] | None = None) -> int:
    """The command line; returns the exit code."""
    return run_command(lambda: work(argv))


def work(argv: list[str] | None) -> None:
    """What the command line asks for.

    Raises:
        UsageError, RunError, PhysicsError: saying what is wrong.
    """
    cfg = parse(RecordConfig, argv, "python -m goalgan_bt.record")
    check_ranges(cfg)
    check_target(cfg.video, video.KINDS)
    video.check_libraries(cfg.video)
    if cfg.size % 2:
        raise UsageError(f"--size must be even, not {cfg.size}")
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it when it is imported
    from goalgan_bt.envs.picture import Picture
    from goalgan_bt.learners.trained_policy import TrainedPolicy

    policy = TrainedPolicy(cfg.run, cfg.seed)
    goals = goals_of(cfg, policy)
    longest = len(goals) * (2 + policy.env.horizon // policy.env.action_repeat)
    if 3 * cfg.size**2 * longest > MOST:
        raise UsageError("that film may be too long for memory: choose fewer goals or less --size")
    picture = Picture(policy.env, cfg.size, cfg.size)
    images: list[NDArray[np.uint8]] = []
    per_second = 1 / (policy.env.dt * policy.env.action_repeat)
    for goal in goals:
        end = film(policy, picture, goal, not cfg.stochastic, images)
        say(f"to {' '.join(f'{x:g}' for x in goal)}: {end}")
        images += [images[-1]] * round(HOLD * per_second)
    picture.close()
    video.save(images, cfg.video, per_second)
    say(f"{cfg.video} ({cfg.video.stat().st_size / 1e6:.1f} MB)")


def goals_of(cfg: RecordConfig, policy: "TrainedPolicy") -> NDArray[np.float64]:
    """The goals to film, (n, goal_dim).

    Raises:
        UsageError: for goals that there are not, or a run without pictures.
    """
    env = policy.env
    if env.maze is None:
        raise UsageError(f"{env.name} is no MuJoCo model: there is nothing to film")
    if not cfg.goal:
        tested = env.test_goals()
        return tested[np.linspace(0, len(tested) - 1, BY_ITSELF + 1).astype(int)[1:]]
    if len(cfg.goal) % env.goal_dim:
        raise UsageError(f"--goal takes {env.goal_dim} numbers for each goal, not {len(cfg.goal)}")
    goals = np.array(cfg.goal).reshape(-1, env.goal_dim)
    if not env.feasible(goals).all():
        x, y = goals[~env.feasible(goals)][0]
        raise UsageError(f"--goal {x:g} {y:g} is inside a wall or outside of the maze")
    return goals


def film(
    policy: "TrainedPolicy",
    picture: "Picture",
    goal: NDArray[np.float64],
    deterministic: bool,
    images: list[NDArray[np.uint8]],
) -> str:
    """One episode, a picture after each action; returns how it ended."""
    env, one = policy.env, np.arange(1)
    env.reset(one, goal[None])
    images.append(picture.draw(env.read_states(one)[0], goal))
    while True:
        states = env.read_states(one)
        step = env.step_body(one, policy.act(states, goal[None], deterministic))
        images.append(picture.draw(step.states[0], goal))
        seconds = f"{env.elapsed[0] * env.dt:.1f} s"
        if step.rewards[0] > 0:
            return f"reached after {seconds}"
        if step.terminated[0]:
            return f"fell after {seconds}"
        if step.truncated[0]:
            return f"not reached within {seconds}"


if __name__ == "__main__":
    exit_with(main())
