"""Four rooms: the exact backward model, the learners by hand, and whole runs."""

import csv
import json
import signal
import subprocess
import time
from dataclasses import replace

import numpy as np
import pytest
from conftest import call, run_module, started
from hypothesis import given
from hypothesis import strategies as st

from goalgan_bt.envs.four_rooms import ACTIONS, FourRooms
from goalgan_bt.learners import four_rooms
from goalgan_bt.learners.four_rooms import (
    ActorCritic,
    Episode,
    Prioritised,
    Recall,
    TracesConfig,
)


@pytest.mark.parametrize("size", [7, 11, 12, 13, 14, 15, 19, 51])
def test_what_led_to_a_state_is_what_leads_to_it(size):
    """Every forward transition is found backward, and every backward one forward."""
    rooms = FourRooms(size)
    states, actions = rooms.next_state.shape
    forward = {
        (s, a, int(rooms.next_state[s, a]))
        for s in range(states)
        for a in range(actions)
        if s != rooms.goal  # where an episode ends, nothing is done
    }
    backward = set()
    for following in range(states):
        for a in range(actions):
            ways = rooms.ways[following, a]
            known, rest = np.split(rooms.predecessors[following, a], [ways])
            assert (rest == -1).all() and len(set(known)) == ways
            backward |= {(int(s), a, following) for s in known}
    assert forward == backward


@pytest.mark.parametrize("size", [11, 15, 19])
def test_rooms_walls_and_doorways(size):
    rooms = FourRooms(size)
    middle = size // 2
    assert rooms.free.shape == (size, size) and not rooms.free[[0, -1]].any()
    for wall in (rooms.free[middle], rooms.free[:, middle]):
        assert wall.sum() == 2 and not wall[middle]  # a doorway in each half
    assert rooms.cells[rooms.start].tolist() == [1, 1]
    assert rooms.cells[rooms.goal].tolist() == [size - 2, size - 2]
    for state, cell in enumerate(rooms.cells):
        for action, move in enumerate(ACTIONS):
            target = cell + move
            arrived = rooms.cells[rooms.next_state[state, action]]
            assert arrived.tolist() == (target if rooms.free[tuple(target)] else cell).tolist()
    # Everything can be reached from the start.
    seen = {rooms.start}
    while len(seen) < len(seen := seen | set(rooms.next_state[list(seen)].ravel().tolist())):
        pass
    assert len(seen) == len(rooms.cells)


@pytest.mark.parametrize("size", [-1, 6, 52])
def test_rooms_of_no_size_are_refused(size):
    with pytest.raises(ValueError, match="cells a side"):
        FourRooms(size)


@given(st.integers(0, 2**32 - 1))
def test_the_policy_gradient_is_the_gradient(seed):
    rng = np.random.default_rng(seed)
    learner = ActorCritic(5, 4)
    learner.logits = rng.normal(size=(5, 4))
    states, actions, weights = rng.integers(5, size=9), rng.integers(4, size=9), rng.normal(size=9)

    def objective(logits):
        learner.logits = logits
        return (weights * np.log(learner.probabilities())[states, actions]).sum()

    at, eps = learner.logits.copy(), 1e-6
    numeric = np.zeros_like(at)
    for i in np.ndindex(at.shape):
        step = np.zeros_like(at)
        step[i] = eps
        numeric[i] = (objective(at + step) - objective(at - step)) / (2 * eps)
    learner.logits = at.copy()
    learner.reinforce(states, actions, weights, 1.0)
    moved = learner.logits - at
    # The rows are centred again, which changes no probability; the gradient has mean zero.
    np.testing.assert_allclose(moved - moved.mean(axis=1, keepdims=True), numeric, atol=1e-6)


def walk_to_goal(rooms, rng):
    states, actions = [rooms.start], []
    while states[-1] != rooms.goal:
        actions.append(int(rng.integers(4)))
        states.append(int(rooms.next_state[states[-1], actions[-1]]))
    return Episode(np.array(states), np.array(actions), True)


def test_the_action_model_counts_what_led_there():
    """Maximum likelihood on one trajectory; what cannot have led to a state has no chance."""
    rooms, rng = FourRooms(7), np.random.default_rng(0)
    recall, uniform = (Recall(rooms, TracesConfig(), learned) for learned in (True, False))
    path = walk_to_goal(rooms, rng)
    for each in (recall, uniform):
        each.add([path])
    learned, flat = recall.action_model(), uniform.action_model()
    for model in (learned, flat):
        np.testing.assert_allclose(model.sum(axis=1), 1.0)
        assert (model[rooms.ways == 0] == 0).all() and (model[rooms.ways > 0] > 0).all()
    np.testing.assert_allclose(flat, (rooms.ways > 0) / (rooms.ways > 0).sum(1, keepdims=True))
    counts = np.zeros(rooms.ways.shape)
    np.add.at(counts, (path.states[1:], path.actions), 1)
    for state in np.flatnonzero(counts.sum(axis=1) > 20):
        share = counts[state] / counts[state].sum()
        np.testing.assert_allclose(learned[state], share, atol=0.01)


def test_the_best_trajectories_are_the_shortest():
    rooms, rng = FourRooms(7), np.random.default_rng(1)
    recall = Recall(rooms, TracesConfig(trajectories=5), True)
    paths = [walk_to_goal(rooms, rng) for _ in range(20)]
    for path in paths:
        recall.add([path])
        recall.add([path._replace(success=False)])  # never
    lengths = sorted(len(path.actions) for path in paths)
    assert [len(path.actions) for path in recall.best] == lengths[:5]


def test_traces_begin_at_the_goal_and_obey_the_world():
    rooms, rng = FourRooms(11), np.random.default_rng(2)
    recall = Recall(rooms, TracesConfig(length=30, number=50), True)
    recall.add([walk_to_goal(rooms, rng)])
    states, actions = recall.traces(rng)
    following = np.concatenate([np.full((1, 50), rooms.goal), states[:-1]])
    np.testing.assert_array_equal(rooms.next_state[states, actions], following)


def test_imitation_fades_with_success():
    """In proportion, to nothing at all; unless it is told not to."""
    rooms, rng = FourRooms(7), np.random.default_rng(4)
    recall, constant = (Recall(rooms, TracesConfig(fade=fade), True) for fade in (True, False))
    path = walk_to_goal(rooms, rng)
    moved = []
    for won in (1, 49, 50):
        for each in (recall, constant):
            for i in range(100):
                each.add([path._replace(success=i < won)])
        learner, steady = (ActorCritic(*rooms.next_state.shape) for _ in range(2))
        recall.teach(learner, np.random.default_rng(0))
        constant.teach(steady, np.random.default_rng(0))
        moved.append(np.abs(learner.logits).sum() / np.abs(steady.logits).sum())
        assert recall.rate() == pytest.approx(constant.rate() * (1 - won / 100))
    assert moved == pytest.approx([0.99, 0.51, 0.5])
    for _ in range(100):
        recall.add([path])
    recall.teach(learner := ActorCritic(*rooms.next_state.shape), rng)
    assert (learner.logits == 0).all()


def test_replay_prefers_what_turned_out_better_than_thought():
    cfg = four_rooms.ReplayConfig(batch=4000, alpha=1.0, beta=0.0, rate=0.0, capacity=8)
    replay, learner = Prioritised(cfg), ActorCritic(4, 4)
    replay.add([Episode(np.array([0, 1, 2, 3]), np.array([0, 1, 2]), True)], 0.5)
    learner.values[:] = 0.25, 0.25, 0.25, 0.0  # returns are 0.25, 0.5, 1: better by 0, 0.25, 0.75
    before = learner.values.copy()
    replay.teach(learner, 1.0, np.random.default_rng(0))
    np.testing.assert_allclose(learner.values - before, [0, 0.25, 0.75, 0], atol=1e-12)
    for _ in range(5):  # the ring forgets the oldest
        replay.add([Episode(np.array([3, 3, 3, 3]), np.array([0, 0, 0]), False)], 0.5)
    assert replay.added == 18
    before = learner.values.copy()
    replay.teach(learner, 1.0, np.random.default_rng(0))
    np.testing.assert_array_equal(learner.values, before)  # failures promise nothing


def test_a_run_from_its_flags_to_its_figures(tmp_path):
    flags = "--env", "four_rooms_11", "--total-steps", 30000, "--seed", 3
    done = run_module("train", *flags, "--out", tmp_path)
    assert done.returncode == 0 and not done.stderr, done.stderr
    (folder,) = tmp_path.iterdir()
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert int(rows[-1]["steps/train"]) >= 30000 and len(rows) > 20
    assert float(rows[0]["eval/coverage"]) < 0.5 < float(rows[-1]["eval/coverage"])
    assert json.loads((folder / "config.json").read_text())["seed"] == 3
    with np.load(folder / "visits.npz") as visits:
        assert visits["training"].shape == (11, 11) and visits["trained"][1, 1] >= 50
        assert np.nansum(visits["training"]) == int(rows[-1]["steps/train"])
    exported = call("viz", folder, "--export", tmp_path.parent / f"{tmp_path.name}.html")
    assert exported.returncode == 0, exported.stderr
    table = (folder / "metrics.csv").read_text()
    done = call("train", "--resume", folder, "--viz", "none")  # again, to the same end
    assert done.returncode == 0, done.stderr
    with (folder / "metrics.csv").open() as file:
        assert [row["eval/return"] for row in csv.DictReader(file)] == [
            row["eval/return"] for row in rows
        ]
    (folder / "metrics.csv").write_text(table)
    picture = call("plot", folder, "--out", tmp_path.parent / f"{tmp_path.name}.png")
    assert picture.returncode == 0, picture.stderr
    text = (folder / "metrics.csv").read_text()
    for broken, said in (
        (text.splitlines()[0] + "\n", "holds no report yet"),
        (text.replace(f"{rows[0]['eval/coverage']},{rows[0]['eval/return']},", "abc,1,", 1), "abc"),
    ):
        (folder / "metrics.csv").write_text(broken)
        refused = call("plot", folder)
        assert refused.returncode == 2 and said in refused.stderr
        assert str(folder) in refused.stderr and refused.stderr.count("\n") == 1
    again = call("train", *flags, "--out", tmp_path / "again")
    assert again.returncode == 0
    (other,) = (tmp_path / "again").iterdir()
    with (other / "metrics.csv").open() as file:
        assert [row["eval/return"] for row in csv.DictReader(file)] == [
            row["eval/return"] for row in rows
        ]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 2)])
def test_a_run_that_is_stopped_says_so(number, code, tmp_path):
    flags = "--env", "four_rooms_19", "--total-steps", "100000000", "--out", tmp_path
    with started("train", *flags, stderr=subprocess.PIPE) as running:
        while not list(tmp_path.glob("*/metrics.csv")):
            time.sleep(0.02)
        running.send_signal(number)
        _, said = running.communicate(timeout=20)
    assert running.returncode == code and said.startswith("error: stopped by")
    assert said.count("\n") == 1


def test_a_closed_standard_output_is_one_line(tmp_path):
    flags = "--env", "four_rooms_11", "--total-steps", "4000", "--out", tmp_path
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with started("train", *flags, **pipes) as running:
        running.stdout.close()
        said = running.stderr.read()
        running.wait(timeout=20)
    assert running.returncode == 2 and said.startswith("error: standard output was closed")
    assert said.count("\n") == 1


def test_larger_rooms_need_recall_traces(tmp_path):
    """The paper's claim at 19 x 19: actor-critic alone does not get there, with traces it does."""
    cfg = replace(four_rooms.preset("four_rooms_19"), total_steps=100_000)
    means = {}
    for method in ("actor_critic", "recall_traces"):
        runs = [replace(cfg, method=method, seed=seed) for seed in range(4)]
        means[method] = np.mean([four_rooms.train(run, tmp_path).value for run in runs])
    assert means["recall_traces"] > means["actor_critic"] + 0.5


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--env", "four_rooms_5"], "four_rooms_7"),
        (["--traces.length", "0"], "--traces.length must be between 1"),
        (["--discount", "1.5"], "--discount must be between 0 and 1"),
        (["--method", "alphago"], "unknown method 'alphago': choose one of actor_critic"),
        (["--traces.depth", "3"], "--traces.depth"),
        (["--replay.beta", "1000"], "--replay.beta must be between 0 and 1"),
        (["--horizon", "1000000"], "--horizon must be between 1"),
    ],
)
def test_bad_flags_end_in_one_line(flags, words, tmp_path):
    done = call("train", "--env", "four_rooms_11", "--out", tmp_path, *flags)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and words in done.stderr
    assert not list(tmp_path.iterdir())
