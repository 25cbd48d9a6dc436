"""The decoder D: goal -> full valid state (Recall Traces, section 2.1 and Algorithm 2).

A recall trace starts from a state, and a goal is only a place. D takes a state that the agent has
really had near that place and moves it there:

- point mass: position g, with the velocity that the agent had close by;
- Ant: joint angles, height, orientation and all velocities of a moment close by, moved so that
  the centre of mass stands on g. States whose torso, knees or feet would be in a wall are refused.
"""

from typing import NamedTuple

import numpy as np

from goalgan_bt.envs.goal_env import GoalEnv
from goalgan_bt.envs.maze import FloatArray

NEIGHBOURS = 8  # states tried per goal


class Decoded(NamedTuple):
    """states: (m, state_dim); goals: (m, goal_dim), those that could be decoded, m <= n; shift:
    (m,) by how much an experienced state was moved, metres."""

    states: FloatArray
    goals: FloatArray
    shift: FloatArray


def decode(
    env: GoalEnv,
    goals: FloatArray,
    experienced: FloatArray,
    max_shift: float,
    rng: np.random.Generator,
) -> Decoded:
    """A full state for each goal that lies near experience.

    Args:
        env: knows the body.
        goals: (n, goal_dim).
        experienced: (m, state_dim) states that the agent has had.
        max_shift: a state is moved by at most this much, metres; goals farther from all
            experience are dropped, since nobody knows what it is like to be there.
        rng: picks among the nearest valid states.
    """
    if len(experienced) == 0 or len(goals) == 0:
        return Decoded(np.empty((0, env.state_dim)), goals[:0], np.empty(0))
    achieved = env.achieved_goals(experienced)
    k = min(NEIGHBOURS, len(experienced))
    # The squared distance less |goal|^2, which is the same for all of a row: (n, m).
    order = np.square(achieved).sum(axis=1) - 2 * goals @ achieved.T
    nearest = np.argpartition(order, k - 1, axis=1)[:, :k]  # (n, k)
    shift = np.linalg.norm(goals[:, None] - achieved[nearest], axis=2)
    candidates = env.place(experienced[nearest.ravel()], np.repeat(goals, k, axis=0))
    usable = (shift.ravel() <= max_shift) & env.valid(candidates)
    # A random usable neighbour of each goal: the largest of random keys.
    key = np.where(usable, rng.random(len(usable)), -1.0).reshape(len(goals), k)
    choice = key.argmax(axis=1)
    found = key.max(axis=1) >= 0
    each = np.arange(len(goals))
    states = candidates.reshape(len(goals), k, -1)[each, choice]
    return Decoded(states[found], goals[found], shift[each, choice][found])
