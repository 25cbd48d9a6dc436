import numpy as np
import pytest

from goalgan_bt.agent.advantage import gae


def run(rewards, values, next_values, terminated=(0, 0, 0), truncated=(0, 0, 0), lam=0.5):
    column = [np.array(x, dtype=np.float32)[:, None] for x in (rewards, values, next_values)]
    ends = [np.array(x, dtype=bool)[:, None] for x in (terminated, truncated)]
    advantages, returns = gae(*column, *ends, discount=0.9, gae_lambda=lam)
    assert np.allclose(returns, advantages + column[1])
    return advantages[:, 0]


def test_three_steps_by_hand():
    # delta: 0 + .9*2 - 1 = .8;  0 + .9*3 - 2 = .7;  1 + .9*4 - 3 = 1.6;  carry .9*.5 = .45
    # A2 = 1.6;  A1 = .7 + .45*1.6 = 1.42;  A0 = .8 + .45*1.42 = 1.439
    assert run([0, 0, 1], [1, 2, 3], [2, 3, 4]) == pytest.approx([1.439, 1.42, 1.6])


def test_termination_has_no_future():
    # delta1 = 1 - 2 = -1 and nothing of step 2 leaks in: A0 = .8 + .45*-1 = .35
    advantages = run([0, 1, 0], [1, 2, 3], [2, 99, 4], terminated=[0, 1, 0])
    assert advantages[:2] == pytest.approx([0.35, -1.0])


def test_truncation_bootstraps_but_does_not_leak():
    # delta1 = 0 + .9*5 - 2 = 2.5 with the value of what followed; A0 = .8 + .45*2.5 = 1.925
    advantages = run([0, 0, 0], [1, 2, 3], [2, 5, 4], truncated=[0, 1, 0])
    assert advantages[:2] == pytest.approx([1.925, 2.5])


def test_lambda_one_is_the_discounted_return_minus_value():
    rng = np.random.default_rng(0)
    rewards, values = rng.random(3), rng.random(4)
    advantages = run(rewards, values[:3], values[1:], lam=1.0)
    ret = rewards[0] + 0.9 * rewards[1] + 0.81 * rewards[2] + 0.729 * values[3]
    assert advantages[0] == pytest.approx(ret - values[0], abs=1e-6)
