"""Recall over places: the ways left are those that were walked, however the walks were made."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import call
from hypothesis import given, settings
from hypothesis import strategies as st

from goalgan_bt.agent.rollout import Collector
from goalgan_bt.learners import table
from goalgan_bt.learners.maze import shaping, train
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.maze_learner import MazeLearner
from goalgan_bt.learners.trained_policy import load_policy
from goalgan_bt.recall.places import Places
from goalgan_bt.recall.settings import PlacesConfig
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import read_metrics

LOW, HIGH = np.array([-2.0, -2.0]), np.array([6.0, 6.0])
CFG = PlacesConfig()


def walked(*paths, cfg=CFG, radius=0.3, low=LOW, high=HIGH):
    """Places after walks, each (n, dim) points, one action from point to point."""
    places = Places(low, high, radius, cfg)
    for path in paths:
        path = np.asarray(path, dtype=float)
        places.learn(path[None, :-1], path[None, 1:])
    places.refresh()
    return places


def line(*corners, step=0.1):
    """A walk along straight lines."""
    parts = [np.array(corners[:1], float)]
    for a, b in itertools.pairwise(corners):
        a, b = np.array(a, float), np.array(b, float)
        n = max(1, round(np.linalg.norm(b - a) / step))
        parts.append(a + (b - a) * np.arange(1, n + 1)[:, None] / n)
    return np.concatenate(parts)


def way(places, start, goal):
    ways = places.ways(np.array([start], float), np.array([goal], float))
    return float(ways.left[0]), ways.directions[0]


U = line((0, 0), (4, 0), (4, 2), (0, 2))  # around a wall at y = 1 that nobody crossed


def test_before_anything_is_known_ways_are_straight_lines():
    places = Places(LOW, HIGH, 0.3, CFG)
    left, direction = way(places, (0, 0), (3, 4))
    assert left == pytest.approx(5) and direction == pytest.approx([0.6, 0.8])
    assert places.heading(np.zeros((1, 2)), np.array([[3.0, 4.0]])) == pytest.approx(
        np.array([[3.0, 4.0]])
    )


def test_no_way_crosses_a_wall_that_nobody_crossed():
    left, direction = way(walked(U), (0, 0), (0, 2))
    assert left == pytest.approx(10, rel=0.1)  # 4 + 2 + 4 m, corners cut by a lattice step
    assert direction @ (1, 0) > 0.98  # away from the goal, which is straight up


@pytest.mark.parametrize("x", [0.5, 1.3, 2.0, 3.2])
def test_one_action_of_progress_shows(x):
    places = walked(U)
    before, _ = way(places, (x, 0.0), (0, 2))
    after, _ = way(places, (x + 0.05, 0.0), (0, 2))
    assert before - after == pytest.approx(0.05, abs=0.01)


def test_a_move_made_one_way_only_is_not_assumed_the_other_way_where_the_setting_says_so():
    forth = replace(CFG, backward=math.inf)
    alike = walked(U, cfg=replace(CFG, backward=1.0))
    assert way(alike, (0, 2), (0, 0))[0] == pytest.approx(10, rel=0.1)
    left, direction = way(walked(U, cfg=replace(CFG, backward=2.0)), (0, 2), (0, 0))
    assert left == pytest.approx(20, rel=0.1) and direction @ (1, 0) > 0.98
    one_way = walked(U, cfg=forth)
    assert way(one_way, (0, 0), (0, 2))[0] == pytest.approx(10, rel=0.1)
    assert way(one_way, (0, 2), (0, 0))[0] == pytest.approx(2)  # unknown: the straight line
    both = walked(U, U[::-1], cfg=forth)
    assert way(both, (0, 2), (0, 0))[0] == pytest.approx(10, rel=0.1)


def test_the_beginning_of_another_episode_is_no_move():
    """A body that is put elsewhere has not gone there, however near it is."""
    origins = np.array([[[0.0, 0.0], [0.5, 0.5], [1.0, 0.5]]])
    ends = np.array([[[0.0, 0.1], [1.0, 0.5], [1.5, 0.5]]])
    places = Places(LOW, HIGH, 0.3, CFG)
    places.learn(origins, ends)
    made = {
        (tuple(places.places[a]), tuple(places.places[b]))
        for a, b in zip(*places.moves.nonzero(), strict=True)
    }
    assert made == {((0.5, 0.5), (1.0, 0.5)), ((1.0, 0.5), (1.5, 0.5))}


def test_what_is_farther_than_the_reach_is_no_move():
    assert walked([(0, 0), (0, 0.5)]).moves.nnz == 1
    assert walked([(0, 0), (0, 0.7)]).moves.nnz == 0


def test_moves_are_counted():
    places = walked([(0, 0), (0.5, 0), (0, 0), (0.5, 0)], cfg=replace(CFG, lags=(1,)))
    first, second = (
        int(np.flatnonzero((places.places == p).all(axis=1))[0]) for p in [(0, 0), (0.5, 0)]
    )
    assert places.moves[first, second] == 2 and places.moves[second, first] == 1


@pytest.mark.parametrize("both_ways", [False, True])
def test_a_move_that_works_no_longer_is_forgotten_and_one_that_is_made_is_not(both_ways):
    cfg = replace(CFG, forget=100.0)
    shut, open_ = line((0, 0), (0, 2)), line((0, 0), (2, 0), (2, 2), (0, 2))
    before = [shut, open_, shut[::-1]] if both_ways else [shut, open_]
    places = walked(*before, cfg=cfg)
    assert way(places, (0, 0), (0, 2))[0] == pytest.approx(2, abs=0.2)
    for _ in range(400):  # a door at y = 1 has been shut: nobody gets beyond it that way
        tried = line((0, 0), (0, 0.9), (0, 0))
        places.learn(tried[None, :-1], tried[None, 1:])
        places.learn(open_[None, :-1], open_[None, 1:])
    places.refresh()
    assert way(places, (0, 0), (0, 2))[0] == pytest.approx(6, rel=0.1)
    for_ever = walked(*before, *[open_] * 400)
    assert way(for_ever, (0, 0), (0, 2))[0] == pytest.approx(2, abs=0.2)


def test_goals_that_nobody_visited_are_reached_by_the_nearest_place():
    left, direction = way(walked(U), (0, 0), (-1, 3))
    assert left == pytest.approx(10 + math.sqrt(2), rel=0.05) and direction @ (1, 0) > 0.98


def test_the_way_to_a_goal_beyond_all_that_is_known_gets_shorter_with_every_step():
    places = walked(line((0, 0), (3, 0)), radius=1.0)
    at = line((0, 0), (4.3, 0))
    goals = np.tile((4.3, 0.0), (len(at), 1))
    left, directions = places.ways(at, goals)
    assert left[0] == pytest.approx(4.3, rel=0.05) and left[-1] == 0
    assert -np.diff(left) == pytest.approx(np.full(len(at) - 1, 0.1), abs=0.03)
    assert (directions[:-1, 0] > 0.98).all()


def test_where_nobody_has_been_the_way_is_the_straight_line_until_somebody_has():
    """There may be a short cut. If there is none, whoever looked has seen that."""
    off = (1.0, 0.5)
    left, direction = way(walked(U), off, (0, 2))
    assert left == pytest.approx(math.hypot(1, 1.5))
    assert direction == pytest.approx(np.array([-1, 1.5]) / left)
    there_and_back = line((1, 0), off, (1, 0))
    left, direction = way(walked(U, there_and_back), off, (0, 2))
    assert left == pytest.approx(way(walked(U), (1.0, 0.0), (0, 2))[0] + 0.5, abs=0.25)
    assert direction @ (0, -1) > 0.6


def test_a_dead_end_beside_the_way_changes_nothing_about_it():
    spur = line((2, 0), (2, -0.5))  # from where nobody came back
    for back in (1.0, 3.0, math.inf):
        cfg = replace(CFG, backward=back)
        plain, other = walked(U, U[::-1], cfg=cfg), walked(U, U[::-1], spur, cfg=cfg)
        at = line((0.5, 0), (3.5, 0))
        goals = np.tile((0.0, 2.0), (len(at), 1))
        assert other.ways(at, goals).left == pytest.approx(plain.ways(at, goals).left, abs=0.05)


def test_a_goal_in_sight_is_where_one_sees_it_and_one_behind_a_wall_is_not():
    places = walked(line((0, 0), (3, 0), (3, 0.75), (0, 0.75)), radius=1.0)
    assert way(places, (0.0, 0.0), (0.9, 0.0))[0] == pytest.approx(0.9)
    behind, direction = way(places, (0.0, 0.0), (0.0, 0.75))  # 0.75 m off, 6.75 m to walk
    assert behind > 6 and direction @ (1, 0) > 0.9


def everywhere(low, high, n, step, rng):
    """n random walks in a box."""
    dim = len(low)
    at, paths = rng.uniform(low, high, (n, dim)), []
    for _ in range(60):
        paths.append(at)
        at = np.clip(at + rng.normal(0, step, (n, dim)), low, high)
    return np.stack(paths, axis=1)


@pytest.mark.parametrize(("dim", "n", "cell"), [(2, 300, 0.25), (3, 1000, 0.4), (6, 800, 0.5)])
def test_in_the_open_ways_are_nearly_straight_in_any_dimension(dim, n, cell):
    rng = np.random.default_rng(0)
    low, high = -np.ones(dim), np.array([2.0, 2.0, 2.0, -0.5, -0.5, -0.5][:dim])
    paths = everywhere(low, high, n, 0.12, rng)
    cfg = replace(CFG, cell=cell, reach=2.4 * cell, backward=1.0)
    places = Places(low, high, 0.3, cfg)
    places.learn(paths[:, :-1], paths[:, 1:])
    places.refresh()
    at, goals = rng.uniform(low, high, (2, 200, dim))
    left, directions = places.ways(at, goals)
    straight = np.linalg.norm(goals - at, axis=1)
    far = straight > 1.0
    assert np.median(left[far] / straight[far]) < (1.25 if dim < 6 else 1.45)  # coarse there
    cosines = (directions * (goals - at)).sum(axis=1) / straight
    assert np.median(cosines[far]) > 0.9


def test_saved_and_loaded_they_answer_the_same():
    rng = np.random.default_rng(1)
    places = walked(U, everywhere(np.array([0, 2]), np.array([2, 4]), 3, 0.1, rng)[0])
    other = Places(LOW, HIGH, 0.3, CFG)
    other.load_state_dict(places.state_dict())
    at, goals = rng.uniform(LOW, HIGH, (2, 100, 2))
    for mine, its in zip(places.ways(at, goals), other.ways(at, goals), strict=True):
        assert np.array_equal(mine, its)
    for each in (places, other):  # and go on learning the same
        each.learn(U[None, 1:], U[None, :-1])
        each.refresh(goals)
    assert np.array_equal(places.heading(at, goals), other.heading(at, goals))


def test_no_places_are_saved_too():
    other = Places(LOW, HIGH, 0.3, CFG)
    other.load_state_dict(Places(LOW, HIGH, 0.3, CFG).state_dict())
    assert len(other) == 0 and way(other, (0, 0), (3, 4))[0] == pytest.approx(5)


def test_what_is_no_state_of_places_is_refused():
    state = walked(U).state_dict()
    with pytest.raises(ValueError, match="lattice"):
        Places(LOW, HIGH, 0.3, CFG).load_state_dict(state | {"keys": state["keys"] - 10**6})
    with pytest.raises(ValueError):
        Places(LOW, HIGH, 0.3, CFG).load_state_dict(state | {"from": state["from"] + 10**6})
    with pytest.raises(ValueError, match=r"another --places\.cell"):
        Places(LOW, HIGH, 0.3, replace(CFG, cell=0.5)).load_state_dict(state)
    with pytest.raises(ValueError, match="finite"):
        count = torch.full_like(state["count"], torch.nan)
        Places(LOW, HIGH, 0.3, CFG).load_state_dict(state | {"count": count})


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    cell=st.floats(0.1, 1.0),
    back=st.sampled_from([1.0, 3.0, math.inf]),
    dim=st.integers(1, 4),
)
def test_whatever_was_walked_ways_are_finite_and_directions_of_length_one(seed, cell, back, dim):
    rng = np.random.default_rng(seed)
    low, high = np.full(dim, -2.0), np.full(dim, 3.0)
    cfg = replace(CFG, cell=cell, reach=2.5 * cell, backward=back, forget=rng.choice([0.0, 50.0]))
    places = Places(low, high, 0.3, cfg)
    paths = everywhere(low * 1.3, high * 1.3, 4, 0.3, rng)  # out of the box, too
    paths[rng.random(paths.shape) < 0.02] = rng.choice([np.nan, np.inf])
    places.learn(paths[:, :-1], paths[:, 1:])
    places.refresh()
    at, goals = rng.uniform(2 * low, 2 * high, (2, 50, dim))
    left, directions = places.ways(at, goals)
    assert np.isfinite(left).all() and (left >= 0).all()
    assert np.linalg.norm(directions, axis=1) == pytest.approx(1, abs=1e-5)
    assert np.isfinite(places.heading(at, goals)).all()
    assert (places.ways(goals, goals).left == 0).all()


@pytest.mark.parametrize(
    ("cfg", "message"),
    [
        (replace(CFG, lags=()), "lags must name at least one"),
        (replace(CFG, reach=0.2), "reach must not be less than cell"),
        (replace(CFG, backward=0.5), "backward must be 1 or more"),
        (replace(CFG, cell=1e-12), "too finely"),
    ],
)
def test_settings_that_make_no_sense_are_refused(cfg, message):
    with pytest.raises(UsageError, match=message):
        Places(LOW, HIGH * 1e10 if "finely" in message else HIGH, 0.3, cfg)


def test_arrays_that_do_not_fit_are_refused():
    with pytest.raises(UsageError, match="corners of a box"):
        Places([0, 0], [1, -1], 0.3)
    with pytest.raises(UsageError, match=r"must be \(n, T, 2\)"):
        Places([0, 0], [1, 1], 0.3).learn(np.zeros((3, 4, 3)), np.zeros((3, 4, 3)))


def test_with_little_memory_the_ways_are_the_same(monkeypatch):
    rng = np.random.default_rng(2)
    path = everywhere(np.array([0, 2]), np.array([2, 4]), 3, 0.1, rng)[0]
    at, goals = rng.uniform(LOW, HIGH, (2, 100, 2))
    expected = walked(U, path).ways(at, goals)
    monkeypatch.setattr("goalgan_bt.recall.places.AT_ONCE", 100)
    monkeypatch.setattr("goalgan_bt.recall.places.MOST", 3000)
    few = walked(U, path)
    for i in range(0, 100, 10):
        some = slice(i, i + 10)
        for mine, its in zip(few.ways(at[some], goals[some]), expected, strict=True):
            assert mine == pytest.approx(its[some], abs=1e-6)
        assert len(few._table) <= 30


def test_what_was_learned_counts_after_a_refresh_and_the_last_answer_does_not():
    places, here, there = walked(U), np.array([[0.0, 0.0]]), np.array([[0.0, 2.0]])
    before = places.heading(here, there)
    door = line((0, 0), (0, 2))
    places.learn(door[None, :-1], door[None, 1:])
    assert np.array_equal(places.heading(here, there), before)
    places.refresh()
    assert np.linalg.norm(places.heading(here, there)) == pytest.approx(2, abs=0.2)


def test_as_many_answers_as_questions():
    places = walked(U)
    assert places.heading(np.empty((0, 2)), np.empty((0, 2))).shape == (0, 2)
    twice = places.heading(U, U[::-1].copy())
    twice[:] = 99.0  # whoever gets an answer may change it
    assert not (places.heading(U, U[::-1].copy()) == 99.0).any()


# What the learner makes of them.


def learner_and_rollouts(*flags, batches=2):
    cfg = table.from_command_line(
        ["--env", "point_umaze", "--threads", "1", "--horizon", "60", *flags]
    )
    env = make_env(cfg, cfg.rollout.num_envs)
    learner = MazeLearner(env, cfg)
    collector = Collector(env, cfg.rollout, learner.rng, learner.noise["rollout"])
    goals = learner.curriculum.uniform(100) / 3
    collector.begin(goals)
    for _ in range(batches):
        rollouts, _ = collector.collect(learner.policy, goals)
        learner.places.learn(rollouts.origins.swapaxes(0, 1), rollouts.achieved.swapaxes(0, 1))
        learner.places.refresh(goals)
    return learner, rollouts


def test_shaping_adds_up_to_the_difference_of_its_ends_along_an_episode():
    learner, rollouts = learner_and_rollouts("--places.shaping", "0.7")
    shaped = shaping(learner, rollouts)
    ended = rollouts.terminated | rollouts.truncated
    pieces = 0
    for i in range(shaped.shape[1]):
        begin = 0
        for end in [*np.flatnonzero(ended[:, i]), len(ended) - 1]:
            if begin > end:
                continue
            goal = rollouts.goals[[begin], i]
            assert (rollouts.goals[begin : end + 1, i] == goal).all()
            first, last = (
                learner.places.ways(place, goal).left[0]
                for place in (rollouts.origins[[begin], i], rollouts.achieved[[end], i])
            )
            assert shaped[begin : end + 1, i].sum() == pytest.approx(0.7 * (first - last), abs=1e-4)
            begin, pieces = end + 1, pieces + 1
    assert pieces > shaped.shape[1] and np.abs(shaped).max() > 0.01


def test_the_action_on_which_a_body_fails_is_not_shaped():
    learner, rollouts = learner_and_rollouts()
    rollouts.terminated[3, 0], rollouts.rewards[3, 0] = True, 0.0
    rollouts.achieved[3, 0] = np.nan  # as a simulation that diverged
    shaped = shaping(learner, rollouts)
    assert shaped[3, 0] == 0 and np.isfinite(shaped).all() and (shaped != 0).mean() > 0.5


def test_without_a_scale_nothing_is_shaped():
    learner, rollouts = learner_and_rollouts("--places.shaping", "0")
    assert not shaping(learner, rollouts).any()


def test_shaping_never_reaches_true_rewards_labels_or_outcomes(tmp_path):
    """Until the policy has learned from it, all else is the same."""
    rows, frames = [], []
    for scale in ("0", "0.5"):
        folder = tmp_path / scale
        folder.mkdir()
        flags = "--env point_umaze --threads 1 --iterations 1 --updates 1 --horizon 40"
        train(table.from_command_line([*flags.split(), "--places.shaping", scale]), folder)
        rows += read_metrics(folder)[1]
        frames.append(read_frame(frame_paths(folder)[-1]))
    without, with_it = rows
    assert float(without["rollout/shaping"]) == 0 != float(with_it["rollout/shaping"])
    for name in ("rollout/reward", "rollout/success", "curriculum/intermediate", "places/moves"):
        assert without[name] == with_it[name] and float(without[name]) >= 0, name
    for name in ("success", "label", "goals", "estimate"):
        assert np.array_equal(frames[0][name], frames[1][name], equal_nan=True), name


def test_a_policy_takes_its_places_along(tmp_path):
    """Whoever loads it sees the ways as it did when it was saved."""
    flags = "--env point_umaze --threads 1 --iterations 3 --updates 2 --horizon 60"
    cfg = table.from_command_line(flags.split())
    assert call("train", *flags.split(), "--viz", "none", "--out", tmp_path).returncode == 0
    (folder,) = tmp_path.iterdir()
    trained = load_policy(folder)
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)["learner"]["places"]
    places = Places(trained.env.goal_low, trained.env.goal_high, 0.3, cfg.places)
    places.load_state_dict(saved)
    at, goals = np.random.default_rng(0).uniform(-1, 5, (2, 50, 2))
    assert len(places) > 10
    assert np.array_equal(trained.env.heading(at, goals), places.heading(at, goals))
    seen = trained.env.observations(np.concatenate([at, 0 * at], axis=1), goals)
    way = trained.env.squashed(places.heading(at, goals))
    assert np.allclose(seen[:, :2], way, atol=1e-6)
    straight = table.from_command_line([*flags.split(), "--places.no-heading"])
    env = make_env(straight, 1)
    MazeLearner(env, straight)
    assert env.heading is None
