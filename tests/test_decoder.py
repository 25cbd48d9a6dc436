import numpy as np
import pytest

from goalgan_bt import envs
from goalgan_bt.recall.decoder import decode


def walked(name):
    """States that a body under random actions has had."""
    env = envs.make(name, 100, threads=1)
    rng = np.random.default_rng(0)
    ids = np.arange(100)
    env.reset(ids, np.full((100, env.goal_dim), 6.0))
    states = []
    for _ in range(60):
        step = env.step(ids, rng.uniform(-1, 1, (100, env.act_dim)))
        after = step.states
        states.append(after[~step.terminated])
        env.reset(ids[step.terminated], env.goals[step.terminated])
    return env, np.concatenate(states)


@pytest.mark.parametrize("name", ["point_umaze", "ant_umaze", "point_nd"])
def test_decoded_states_are_valid_experienced_and_on_their_goal(name):
    env, experienced = walked(name)
    rng = np.random.default_rng(1)
    goals = env.achieved_goals(experienced)[::200] + rng.normal(0, 0.02, (30, env.goal_dim))
    states, decoded, shift = decode(env, goals, experienced, 0.5, rng)
    assert len(states) == len(decoded) > 20
    assert np.allclose(env.achieved_goals(states), decoded)
    assert env.valid(states).all()
    assert shift.shape == (len(states),) and (shift > 0).all() and shift.max() < 0.5
    # All but the place is a state that the agent has really had.
    fixed = [i for i in range(env.state_dim) if i >= env.goal_dim]
    gaps = np.abs(states[:, None][..., fixed] - experienced[..., fixed]).max(axis=2).min(axis=1)
    assert gaps.max() < 1e-9


def test_goals_far_from_experience_or_in_walls_are_dropped():
    env, experienced = walked("ant_umaze")
    goals = np.array([[4.0, 4.0], [0.0, 1.5], [0.05, 0.0]])
    _, decoded, _ = decode(env, goals, experienced, 0.5, np.random.default_rng(0))
    assert decoded.tolist() == [[0.05, 0.0]]


def test_nothing_experienced_nothing_decoded():
    env = envs.make("point_umaze", 1)
    rng = np.random.default_rng(0)
    assert len(decode(env, np.zeros((3, 2)), np.empty((0, 4)), 1.0, rng).goals) == 0
    assert len(decode(env, np.empty((0, 2)), np.zeros((3, 4)), 1.0, rng).goals) == 0
