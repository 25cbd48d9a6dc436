"""Methods are settings of one loop: each trains, and differs from the default as it says."""

import functools
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from goalgan_bt.envs import maze as mazes
from goalgan_bt.learners import maze_config, table
from goalgan_bt.learners.maze import train
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.maze_learner import MazeLearner
from goalgan_bt.learners.methods import METHODS
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.frames import frame_paths, read_frame
from goalgan_bt.runs.metrics_csv import read_metrics

SHORT = (  # long enough for goals of intermediate difficulty, so that there are traces
    "--env point_umaze --iterations 3 --updates 2 --horizon 40 --threads 1 --coverage.rollouts 1 "
    "--gan.pretrain-steps 20 --gan.steps 20 --backtracking.min-transitions 100 "
    "--imitation.fade None"
)
MORE = {"alp_gmm": ("--iterations", "7")}  # its mixture needs a few hundred episodes
UMAZE = mazes.layout("umaze")
METHOD = pytest.mark.parametrize("method", METHODS)


class Outcome(NamedTuple):
    """A short run: its rows of metrics, its frames, and the learner of its checkpoint."""

    rows: list[dict[str, str]]
    frames: list[dict[str, np.ndarray]]
    learner: dict[str, Any]

    @property
    def policy(self):
        return self.learner["policy"]["net.flat"]

    def total(self, name):
        return sum(float(row.get(name) or 0) for row in self.rows)

    def new_goals(self, i):
        """Those that the method proposed in an iteration."""
        return self.frames[i]["goals"][~self.frames[i]["replayed"]]


def trained_with(folder, *flags):
    folder.mkdir()
    train(table.from_command_line([*SHORT.split(), *flags]), folder)
    learner = torch.load(folder / "checkpoint.pt", weights_only=True)["learner"]
    return Outcome(read_metrics(folder)[1], [*map(read_frame, frame_paths(folder))], learner)


@pytest.fixture(scope="module")
def trained_by(tmp_path_factory):
    """A short run of a method, the same for whoever asks; all have the same seed."""
    place = tmp_path_factory.mktemp("methods")
    return functools.cache(
        lambda method: trained_with(place / method, "--method", method, *MORE.get(method, ()))
    )


def of(method, setting, default):
    return METHODS[method].get(setting, default)


@METHOD
def test_each_method_trains_and_reports(method, trained_by):
    run = trained_by(method)
    assert [int(row["iteration"]) for row in run.rows] == [*range(1, len(run.frames) + 1)]
    assert len(run.rows) == (7 if method in MORE else 3)
    measured = run.frames[-1]["coverage"]
    assert float(run.rows[-1]["eval/coverage"]) == pytest.approx(measured.mean(), abs=1e-5)
    assert (run.total("steps/label") > 0) == (method == "oracle")
    imitates = of(method, "imitation.source", "none") != "none" and method != "no_imitation"
    assert (run.total("imitation/steps") > 0) == imitates
    assert (run.total("rollout/shaping") != 0) == (of(method, "places.shaping", 1) > 0)
    replayed = any(frame["replayed"].any() for frame in run.frames)
    assert replayed == (of(method, "goals.old", 1) > 0)


@METHOD
def test_goals_are_proposed_by_what_the_method_names(method, trained_by):
    run = trained_by(method)
    source, first, last = of(method, "goals.source", "gan"), run.new_goals(0), run.new_goals(-1)
    distances = [np.median(np.linalg.norm(goals, axis=1)) for goals in (first, last)]
    free = UMAZE.is_free(last).mean()
    if source in ("uniform", "feasible"):
        quarters = np.histogram2d(*last.T, bins=2, range=[(-3, 7)] * 2)[0] / len(last)
        assert quarters.min() > 0.15 and min(distances) > 3.5
        assert free == 1 if source == "feasible" else 0.2 < free < 0.4  # 28% of the box
    elif source == "alp_gmm":  # at first uniform, then where outcomes change: near the start
        assert distances[0] > 3.5 and distances[1] < 1 and free > 0.5
    elif source == "oracle":  # tried: a novice reaches some of those near the start, and no others
        assert free == 1 and len(last) < 20 and max(distances) < 1.5
    else:  # wherever the agent has been, and then what it can nearly do, or what is beyond
        beyond = of(method, "goals.frontier", 1) > 0
        assert distances[0] < 2 and distances[1] < (4 if beyond else 2)
        assert 0.2 < free < 1 and len(last) == 200


def test_a_gan_of_all_places_visited_differs_once_there_are_labels(trained_by):
    alike, other = trained_by("goal_gan"), trained_by("gan_fit_all")
    assert np.array_equal(alike.new_goals(0), other.new_goals(0))
    assert not np.array_equal(alike.new_goals(1), other.new_goals(1))
    assert np.array_equal(alike.new_goals(1), trained_by("traces_only").new_goals(1))


@METHOD
def test_traces_are_recalled_where_the_method_has_them_and_from_where_it_says(method, trained_by):
    run = trained_by(method)
    traced = of(method, "imitation.source", "none") == "traces"
    assert (run.total("backtracking/traces") > 0) == traced
    found = [frame["trace_goals"] for frame in run.frames if len(frame["trace_goals"])]
    assert bool(found) == traced
    for frame in run.frames:
        ours, all_goals = set(map(tuple, frame["trace_goals"])), set(map(tuple, frame["goals"]))
        if method == "value_seeds":  # goals that experience led to
            assert ours and not ours & all_goals
        else:  # goals of intermediate difficulty
            assert ours <= set(map(tuple, frame["goals"][frame["label"] == 0]))


@METHOD
def test_the_model_that_the_method_has_learns(method, trained_by):
    run = trained_by(method)
    fresh = fresh_learner(method)
    backward = run.learner["backtracking"]["state_net.flat"]
    moved = not torch.equal(backward, fresh.backtracking.state_net.flat)
    forward = method == "forward_model"
    traced = of(method, "imitation.source", "none") == "traces"
    assert moved == (traced and method != "random_model")
    assert (run.total("backtracking/state_nll") != 0) == moved
    assert (run.total("backtracking/forward_nll") != 0) == forward == ("forward" in run.learner)
    if forward:
        assert not torch.equal(run.learner["forward"]["net.flat"], fresh.forward.net.flat)


def fresh_learner(method):
    cfg = table.from_command_line([*SHORT.split(), "--method", method])
    return MazeLearner(make_env(cfg, 1), cfg)


@METHOD
def test_experience_is_that_of_successes_where_the_method_says_so(method, trained_by):
    """Where time ran out, an episode's goal counts as where it ended, and no gap is left."""
    known = trained_by(method).learner["transitions"]
    if of(method, "imitation.source", "none") == "none":  # nobody would look at them
        assert len(known["left"]) == 0
        return
    ends = known["left"] == 0
    gaps = (known["next_states"][ends, :2] - known["goals"][ends]).norm(dim=1)
    assert len(gaps) > 20 and gaps.max() < 0.3 + 1e-5
    successes = of(method, "backtracking.experience", "all") == "successes"
    assert bool((gaps < 1e-6).any()) != successes


def test_no_two_methods_learn_the_same(trained_by):
    """From the same seed: whatever tells them apart has come to the policy."""
    for one, other in combinations(METHODS, 2):
        assert not torch.equal(trained_by(one).policy, trained_by(other).policy), (one, other)


def test_without_imitation_traces_leave_the_policy_alone(trained_by, tmp_path):
    """Until the first traces all is as in plain Goal GAN; those draw random numbers."""
    early = "--backtracking.min-transitions", "90000"  # never enough for a trace
    plain, idle = (
        trained_with(tmp_path / method, "--method", method, *early)
        for method in ("goal_gan", "no_imitation")
    )
    assert torch.equal(plain.policy, idle.policy)
    assert float(trained_by("traces_only").rows[-1]["imitation/kl"]) > 0
    traced = trained_by("no_imitation").rows[-1]
    assert float(traced["backtracking/traces"]) > 0 and float(traced["imitation/steps"]) == 0


def test_flags_come_on_top_of_the_method():
    flags = "--env point_umaze --method uniform --goals.new 50"
    cfg = table.from_command_line(flags.split())
    assert (cfg.goals.source, cfg.goals.new, cfg.goals.old) == ("uniform", 50, 0)
    assert not cfg.places.heading and cfg.method == "uniform" and cfg.gae_lambda == 0.95
    with pytest.raises(UsageError, match="unknown method 'magic': choose one of recall"):
        table.from_command_line(["--method", "magic"])


def test_every_setting_of_every_method_exists():
    for method in METHODS:
        table.check(maze_config.with_method(maze_config.preset("ant_umaze"), method))
