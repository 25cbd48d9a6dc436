"""No body passes a wall, at any speed that a policy can reach, however hard it tries: 100 thousand
steps of each kind of trying in every run of the tests, a million with `pytest -m slow`."""

import numpy as np
import pytest

from goalgan_bt import envs
from goalgan_bt.envs.ant_maze import TORSO_RADIUS
from goalgan_bt.envs.point_maze import RADIUS


def depth_in_walls(maze, xy, radius):
    """How far discs reach into the walls, (n,), metres; negative where they are clear."""
    x0, y0, x1, y1 = maze.walls().T
    outside = np.stack([np.maximum(x0 - xy[:, :1], xy[:, :1] - x1),
                        np.maximum(y0 - xy[:, 1:], xy[:, 1:] - y1)], axis=-1)  # fmt: skip
    distance = np.where(
        (outside < 0).all(axis=-1),
        outside.max(axis=-1),
        np.linalg.norm(np.maximum(outside, 0), axis=-1),
    )
    return radius - distance.min(axis=1)


@pytest.mark.parametrize("steps", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("speed", [0.0, 3.0])
@pytest.mark.parametrize(("name", "radius"), [("point_umaze", RADIUS), ("ant_umaze", TORSO_RADIUS)])
def test_full_force_does_not_press_a_body_into_a_wall(name, radius, speed, steps):
    """Bang-bang actions held for random times, from every cell, with and without a run-up."""
    n = 500
    env = envs.make(name, n)
    rng = np.random.default_rng(int(speed))
    ids = np.arange(n)
    cells = env.maze.cell_centres()
    nq = 2 if name.startswith("point") else 15
    nowhere = np.full((n, 2), 99.0)  # infeasible: no episode ends by success

    def restart(some):
        states = np.tile(env.start_state, (len(some), 1))
        states[:, :2] = cells[rng.integers(len(cells), size=len(some))]
        angle = rng.uniform(0, 2 * np.pi, len(some))
        states[:, nq : nq + 2] = speed * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        env.reset(some, nowhere[some], states)

    restart(ids)
    actions = rng.choice([-1.0, 1.0], (n, env.act_dim))
    worst, fastest = -np.inf, 0.0
    for _ in range(steps // n):
        actions = np.where(rng.random(actions.shape) < 0.05, -actions, actions)
        step = env.step(ids, actions)
        states = step.states
        worst = max(worst, depth_in_walls(env.maze, states[:, :2], radius)[~step.terminated].max())
        fastest = max(fastest, np.abs(states[~step.terminated, nq : nq + 2]).max())
        done = step.terminated | step.truncated
        if done.any():
            restart(ids[done])
    assert fastest > 3.0  # it did try
    assert -0.1 < worst < 0.01  # it came there, and no farther
