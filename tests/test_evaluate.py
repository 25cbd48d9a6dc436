"""`python -m goalgan_bt.evaluate`: a trained policy's figures, at home and in Gymnasium."""

import json

import gymnasium
import numpy as np
import pytest
from conftest import call
from hypothesis import given
from hypothesis import strategies as some

import goalgan_bt.gym  # noqa: F401
from goalgan_bt.learners import evaluation
from goalgan_bt.learners.trained_policy import TrainedPolicy


def test_episodes_are_counted_and_told_in_a_sentence_and_a_file(folder, tmp_path):
    out = tmp_path / "x.json"
    done = call("evaluate", folder, "--episodes", 224, "--json", out)
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    assert done.stdout.startswith("point_umaze, iteration 4, stochastic: success 0.")
    assert done.stdout.splitlines()[1] == str(out)
    assert found["episodes"] == 224 and found["policy"] == "stochastic"
    low, high = found["interval_95"]
    assert 0 <= low < found["success"] < high <= 1
    assert found["fell"] == 0 and found["success"] + found["out_of_time"] == pytest.approx(1)
    times = found["seconds_to_goal"]
    assert 0 < times["median"] <= times["nine_of_ten"] <= TrainedPolicy(folder).env.horizon * 0.02
    again = call("evaluate", folder, "--episodes", 224, "--threads", 2)
    assert again.stdout.splitlines()[0] == done.stdout.splitlines()[0]
    other = call("evaluate", folder, "--episodes", 224, "--seed", 1)
    assert other.stdout != again.stdout


def test_shorter_episodes_are_the_same_ones_cut_off(folder):
    whole, cut = (evaluation.at_home(folder, 112, True, 0, 1, horizon) for horizon in (None, 40))
    assert cut["success"] < whole["success"]
    assert cut["seconds_to_goal"]["nine_of_ten"] <= 40 * 0.02
    assert evaluation.at_home(folder, 112, True, 0, 1, 200) == whole  # that of the run


def test_at_home_is_what_coverage_measures(folder):
    found = evaluation.at_home(folder, None, True, 0, 1)
    policy = TrainedPolicy(folder)
    goals = policy.env.test_goals()
    reached = []
    for goal in goals[::8]:
        env, one = policy.env, np.arange(1)
        env.reset(one, goal[None])
        step = None
        while step is None or not (step.terminated | step.truncated).any():
            step = env.step_body(one, policy.act(env.read_states(one), goal[None]))
        reached.append(step.rewards[0])
    assert found["episodes"] == len(goals)  # without noise others would be the same
    assert evaluation.at_home(folder, None, False, 0, 1)["episodes"] == 3 * len(goals)
    some_goals = evaluation.at_home(folder, len(goals) // 8, True, 0, 1)
    assert some_goals["success"] == pytest.approx(np.mean(reached))


def test_in_gymnasium_it_does_what_it_does_at_home(folder):
    """The same goals from the same start, with its own action repeat."""
    policy = TrainedPolicy(folder)
    env = gymnasium.make("goalgan_bt/PointUMaze-v0").unwrapped
    for goal in policy.env.test_goals()[::16]:
        one = np.arange(1)
        policy.env.reset(one, goal[None])
        obs, _ = env.reset(options={"goal": goal})
        for _ in range(10):
            action = policy.act(obs["observation"], obs["desired_goal"])
            policy.env.advance(one, action[None])
            for _ in range(policy.env.action_repeat):
                obs = env.step(action)[0]
        assert np.array_equal(obs["observation"], policy.env.read_states(one)[0])
    found = evaluation.elsewhere(folder, "goalgan_bt/PointUMaze-v0", 40, True, 0)
    assert found["return"] == found["success"] > 0
    # Another policy than the noisy one.
    noisy = evaluation.elsewhere(folder, "goalgan_bt/PointUMaze-v0", 40, False, 0)
    assert noisy["seconds_to_goal"] != found["seconds_to_goal"]


def test_the_seconds_of_a_step_are_those_of_the_environment(folder):
    robotics = pytest.importorskip("gymnasium_robotics")
    gymnasium.register_envs(robotics)
    body = TrainedPolicy(folder).env
    for name, seconds in (
        ("goalgan_bt/PointUMaze-v0", 0.02),
        ("PointMaze_UMaze-v3", 0.01),
        ("AntMaze_UMaze-v5", 0.05),
    ):
        assert evaluation.step_seconds(gymnasium.make(name), body) == pytest.approx(seconds)


def test_another_maze_is_told(folder):
    """A policy goes by the ways of its own maze."""
    for name, other in (("goalgan_bt/PointSpiral-v0", True), ("goalgan_bt/PointUMaze-v0", False)):
        done = call("evaluate", folder, "--on", name, "--episodes", 1)
        assert done.returncode == 0 and ("another maze than the run" in done.stderr) == other
    done = call(
        "evaluate", folder, "--on", "gymnasium_robotics:PointMaze_UMaze-v3", "--episodes", 1
    )
    assert done.returncode == 0 and len(done.stderr.splitlines()) == 1  # cells of 1 m


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--episodes", "0"], "--episodes must be between 1 and 1000000, not 0"),
        (["--on", "Nothing-v9"], "--on Nothing-v9: "),
        (["--on", "CartPole-v1"], "its actions are of shape ()"),
        (["--on", "Pusher-v5"], "the run's body takes 2 numbers"),
        (["--on", "Reacher-v5"], "it must tell goals and the 4 numbers of the body's state"),
        (["--on", "goalgan_bt/AntUMaze-v0"], "the run's body takes 2 numbers"),
        (["--on", "AntMaze_UMaze-v5"], "the run's body takes 2 numbers"),
        (["--on", "PointMaze_UMaze-v99"], "--on PointMaze_UMaze-v99: "),
        (["--json", "/nowhere/x.json"], "cannot write '/nowhere/x.json'"),
        (["--horizon", "50"], "--horizon must be a multiple of the run's 4 steps"),
        (["--on", "PointMaze_UMaze-v3", "--horizon", "40"], "--horizon: an environment given with"),
    ],
)
def test_bad_words_end_in_one_line(folder, words, problem):
    done = call("evaluate", folder, *words)
    assert done.returncode == 2 and problem in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_folder_that_is_no_run_is_named(tmp_path):
    done = call("evaluate", tmp_path)
    assert done.returncode == 2 and "is no run" in done.stderr


@given(n=some.integers(1, 500), goals=some.integers(1, 120))
def test_episodes_are_spread_evenly(n, goals):
    counts = np.bincount(evaluation.spread(n, goals), minlength=goals)
    assert counts.sum() == n and counts.max() - counts.min() <= 1
