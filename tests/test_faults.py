"""What goes wrong in a run: either it goes on soundly and counts it, or it ends with one line and a
checkpoint that can be used."""

import math
import time

import numpy as np
import pytest
import torch
from conftest import call, run_module
from test_resume import SMALL, new_folder, rows_of, settings

from goalgan_bt.agent.coverage import coverage
from goalgan_bt.agent.policy import ValueFunction
from goalgan_bt.agent.rollout import Collector
from goalgan_bt.curriculum.gan import GoalGAN
from goalgan_bt.envs.mujoco_env import MujocoEnv
from goalgan_bt.envs.point_maze import PointMaze
from goalgan_bt.learners import maze, maze_learner
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.maze_learner import MazeLearner
from goalgan_bt.recall.backtracking import BacktrackingModel
from goalgan_bt.runs import checkpoint
from goalgan_bt.runs.errors import InterruptedRun, RunError
from goalgan_bt.runs.sound import finite, soundly


def once(monkeypatch, owner, name, at, spoil):
    """Let the call `at` of a method be spoiled: spoil(result, self)."""
    real, calls = getattr(owner, name), [0]

    def planted(self, *arguments, **more):
        result = real(self, *arguments, **more)
        calls[0] += 1
        spoilt = spoil(result, self) if calls[0] == at else None
        return result if spoilt is None else spoilt

    monkeypatch.setattr(owner, name, planted)


def nan(weights):
    """What makes the weights that it is told of something no number."""

    def spoil(_, it):
        weights(it).data[:3] = math.nan

    return spoil


def trained(tmp_path, *more, env="point_umaze", method="recall_traces"):
    """A small run with a fault in it: its folder and its rows."""
    cfg = settings(env, method, *more)
    folder = new_folder(tmp_path / "run", cfg)
    maze.train(cfg, folder)
    return folder, rows_of(folder)


def total(rows, name):
    return sum(float(row[name] or 0) for row in rows)


def is_sound(folder):
    """Whether all that a run has learned is finite, and it goes on."""
    state = checkpoint.read(folder / checkpoint.NAME)
    weights = [
        value
        for part in ("policy", "value", "backtracking")
        for name, value in state["learner"][part].items()
        if isinstance(value, torch.Tensor) and "max_std" not in name
    ]
    gan = state["learner"]["curriculum"]["gan"]
    weights += [*gan["generator"].values(), *gan["discriminator"].values()]
    iterations = state["run"]["iteration"] + 1
    done = call("train", "--resume", folder, "--iterations", iterations, "--viz", "none")
    return finite(*weights) and done.returncode == 0


@pytest.mark.parametrize(
    ("name", "number"),
    [("rewards", math.nan), ("rewards", math.inf), ("obs", math.nan), ("last_obs", math.inf)],
)
def test_a_batch_that_is_not_finite_is_left_out(name, number, tmp_path, monkeypatch, capsys):
    """A single number, which was enough to end the value function for ever."""

    def spoil(result, _):
        rows = getattr(result[0], name)
        rows[(0,) * rows.ndim] = number

    once(monkeypatch, Collector, "collect", 9, spoil)
    folder, rows = trained(tmp_path)
    assert total(rows, "rollout/dropped") == 1 and total(rows, "trpo/nonfinite") == 0
    assert "iteration 4: a batch is left out" in capsys.readouterr().err
    assert is_sound(folder)


def test_physics_that_diverge_are_counted_and_end_the_episode(tmp_path, monkeypatch):
    def spoil(_, env):
        env.batch.bind("qpos")[:3, 0] = math.nan

    once(monkeypatch, PointMaze, "advance", 70, spoil)
    folder, rows = trained(tmp_path)
    assert total(rows, "rollout/diverged") == 3 and total(rows, "rollout/dropped") == 0
    assert is_sound(folder)


@pytest.mark.parametrize(
    ("owner", "part", "weights"),
    [
        (ValueFunction, "value", lambda it: it.net.flat),
        (GoalGAN, "gan", lambda it: it.generator.flat),
        (GoalGAN, "gan", lambda it: it.discriminator.flat),
        (BacktrackingModel, "backtracking", lambda it: it.action_net.flat),
    ],
)
def test_a_part_whose_lesson_ends_in_nan_goes_back(owner, part, weights, tmp_path, monkeypatch):
    once(monkeypatch, owner, "fit", 6, nan(weights))
    folder, rows = trained(tmp_path, method="with_traces")
    assert float(rows[-1][f"{part}/undone"]) == 1  # in all
    assert is_sound(folder)


def test_going_back_restores_weights_and_moments():
    value = ValueFunction(3, settings("point_umaze", "goal_gan").value)
    noise, obs = torch.Generator().manual_seed(0), torch.randn(64, 3)
    value.fit(obs, obs.sum(dim=1), noise)
    before = {name: x.clone() for name, x in value.state_dict().items() if hasattr(x, "clone")}
    moments = value.optimiser.state_dict()["state"][0]["exp_avg"].clone()
    told = soundly(value, value.fit, obs * math.nan, obs.sum(dim=1), noise)
    assert told["undone"] == 1 and np.isnan(told["loss"])
    assert all(torch.equal(x, value.state_dict()[name]) for name, x in before.items())
    assert torch.equal(moments, value.optimiser.state_dict()["state"][0]["exp_avg"])
    assert soundly(value, value.fit, obs, obs.sum(dim=1), noise)["undone"] == 0


def test_a_moment_that_overflows_is_undone_too():
    """The weights are finite then, and never move again."""
    value = ValueFunction(3, settings("point_umaze", "goal_gan").value)
    noise, obs = torch.Generator().manual_seed(0), torch.randn(64, 3)
    told = soundly(value, value.fit, obs, torch.full((64,), 1e25), noise)
    assert told["undone"] == 1 and np.isnan(told["loss"])


def test_a_broken_policy_ends_the_run_and_keeps_the_last_checkpoint(tmp_path, monkeypatch):
    broken = nan(lambda it: it.policy.net.flat)
    once(monkeypatch, maze_learner.MazeLearner, "propose", 7, broken)
    cfg = settings("point_umaze", "recall_traces")
    folder = new_folder(tmp_path / "run", cfg)
    with pytest.raises(InterruptedRun, match="iteration 7: a weight of the policy is not finite"):
        maze.train(cfg, folder)
    monkeypatch.undo()
    assert checkpoint.read(folder / checkpoint.NAME)["run"]["iteration"] < 7
    assert is_sound(folder)


def test_a_run_that_learns_nothing_any_more_says_so(tmp_path, monkeypatch):
    def spoil(self, *arguments):
        rollouts, episodes = real(self, *arguments)
        rollouts.rewards[:] = math.nan
        return rollouts, episodes

    real = Collector.collect
    monkeypatch.setattr(Collector, "collect", spoil)
    cfg = settings("point_umaze", "recall_traces", "--iterations", "20")
    with pytest.raises(InterruptedRun, match="none of the last 20 batches was finite"):
        maze.train(cfg, new_folder(tmp_path / "run", cfg))


def test_a_gan_that_has_collapsed_does_not_end_learning(tmp_path, monkeypatch):
    """It says the same goal for ever; noise, memory and what its lessons hold go on."""
    begin = maze.begin

    def planted(learner, *more):
        begin(learner, *more)
        learner.curriculum.gan.generator.flat.data.zero_()

    monkeypatch.setattr(maze, "begin", planted)
    folder, rows = trained(tmp_path)
    assert float(rows[-1]["gan/spread"]) < 0.05
    assert is_sound(folder)


@pytest.mark.parametrize(
    "more",
    [
        ("--rollout.num-envs", "1", "--rollout.steps", "100"),
        ("--horizon", "4"),  # no success, in no episode
        ("--goals.r-max", "0.001", "--goals.r-min", "0"),  # whatever is reached is mastered
        ("--updates", "1", "--rollout.steps", "1"),
    ],
)
@pytest.mark.parametrize("env", ["point_umaze", "ant_umaze"])
def test_odd_worlds_are_learned_soundly(env, more, tmp_path):
    folder, rows = trained(tmp_path, *more, env=env)
    assert len(rows) == 8 and is_sound(folder)


def test_a_maze_of_one_free_cell(tmp_path):
    path = tmp_path / "cell.txt"
    path.write_text("###\n#S#\n###\n")
    folder, rows = trained(tmp_path, "--map", str(path))
    assert float(rows[-1]["eval/coverage"]) > 0 and is_sound(folder)


def test_a_clock_that_is_set_back_changes_nothing(tmp_path, monkeypatch):
    _, rows = trained(tmp_path)
    now = time.time
    monkeypatch.setattr(time, "time", lambda: now() - 10_000 * (now() % 2 > 1))
    (tmp_path / "again").mkdir()
    assert trained(tmp_path / "again")[1] == rows


def test_a_folder_that_is_deleted_while_it_runs_is_one_line(tmp_path, monkeypatch):
    cfg = settings("point_umaze", "recall_traces")
    folder = new_folder(tmp_path / "run", cfg)
    real = maze.imitate

    def planted(learner, env, traces, batch, obs, run):
        if run.iteration == 4:
            folder.rename(tmp_path / "gone")
        return real(learner, env, traces, batch, obs, run)

    monkeypatch.setattr(maze, "imitate", planted)
    with pytest.raises(RunError, match="has vanished"):
        maze.train(cfg, folder)


@pytest.mark.parametrize(("env", "kind"), [("point_umaze", PointMaze), ("ant_umaze", MujocoEnv)])
def test_the_counter_in_the_stepping_layer_agrees(env, kind, tmp_path, monkeypatch):
    """Every step of every simulation, counted where it is made."""
    made = [0]
    step = kind.advance

    def counted(self, ids, actions):
        made[0] += len(ids) * self.action_repeat
        step(self, ids, actions)

    monkeypatch.setattr(kind, "advance", counted)
    more = "--goals.label-rollouts", "1"
    _, rows = trained(tmp_path, *more, env=env, method="with_traces")
    told = sum(int(rows[-1][f"steps/{purpose}"]) for purpose in ("train", "label", "eval"))
    assert told == made[0]


def test_the_same_seed_gives_the_same_bits_with_other_threads(tmp_path):
    cfgs = [settings("ant_umaze", "recall_traces", "--threads", n) for n in ("1", "2")]
    folders = [new_folder(tmp_path / name, cfgs[0]) for name in ("one", "two")]
    for cfg, folder in zip(cfgs, folders, strict=True):
        maze.train(cfg, folder)
    assert rows_of(folders[0]) == rows_of(folders[1])


def test_the_same_seed_gives_the_same_bits_with_a_page(tmp_path):
    words = f"--env point_umaze {SMALL}".split()
    for viz in ("none", "browser"):
        more = "--viz", viz, "--viz-port", "0", "--out", tmp_path / viz
        done = run_module("train", *words, *more)
        assert done.returncode == 0, done.stderr
    one, two = (next((tmp_path / viz).iterdir()) for viz in ("none", "browser"))
    assert rows_of(one) == rows_of(two)


@pytest.mark.parametrize(("env", "tiles"), [("ant_umaze", 12), ("point_umaze", 0)])
def test_a_body_that_does_not_move_has_the_known_coverage(env, tiles):
    """A policy that says nothing to motors: what coverage finds is the floor that is told."""
    sims = make_env(settings(env, "recall_traces"), 128)

    policy = MazeLearner(sims, settings(env, "recall_traces")).policy
    policy.net.flat.data.zero_()
    found = coverage(sims, policy, sims.test_goals(), 1, torch.Generator().manual_seed(0))
    assert found.deterministic.sum() == tiles
    assert maze.still(sims) == pytest.approx(tiles / 112)


def test_a_goal_in_a_wall_is_never_reached():
    sims = make_env(settings("ant_umaze", "recall_traces"), 4)
    wall = np.array([[0.0, 1.6]] * 4)  # within a metre of the start, and in the wall above it
    assert not sims.feasible(wall).any()
    assert sims.reached(np.array([[0.0, 0.7]] * 4), wall).all()
    sims.reset(np.arange(4), wall)
    step = sims.step(np.arange(4), np.zeros((4, 8)))
    assert not step.rewards.any() and not step.terminated.any()


def test_a_scripted_policy_covers_what_it_reaches():
    """A point that is pushed to the right and nowhere else reaches the tiles on its way."""
    sims = make_env(settings("point_umaze", "recall_traces", "--horizon", "400"), 128)
    policy = MazeLearner(sims, settings("point_umaze", "recall_traces")).policy
    policy.net.flat.data.zero_()
    policy.net.views()[-2].copy_(torch.tensor([1.0, 0.0]))  # the last bias: always to the right
    goals = sims.test_goals()
    found = coverage(sims, policy, goals, 1, torch.Generator().manual_seed(0)).deterministic
    sims.reset(np.arange(1), goals[:1] + 100)
    way = []
    for _ in range(100):
        way.append(sims.step(np.arange(1), np.array([[1.0, 0.0]])).achieved[0])
    near = np.linalg.norm(goals[:, None] - np.array(way), axis=2).min(axis=1) < sims.success_radius
    assert 0 < near.sum() < 20 and np.array_equal(found > 0, near)


def test_shaping_is_no_success(tmp_path, monkeypatch):
    """However much of it: what counts as reached stays what the environment says."""
    won = []

    def spoil(result, _):
        won.append(result[0].rewards.mean())
        assert set(np.unique(result[0].rewards)) <= {0.0, 1.0}

    for at in range(1, 20):
        once(monkeypatch, Collector, "collect", at, spoil)
    _, rows = trained(tmp_path, "--places.shaping", "1000", "--horizon", "4")
    assert max(abs(float(row["rollout/shaping"])) for row in rows) > 1
    told = [float(row["rollout/reward"]) for row in rows]
    assert told == pytest.approx(won[2::2], rel=1e-4)  # of each iteration's last batch
    assert {row["eval/coverage"] for row in rows if row["eval/coverage"]} == {"0"}


def test_measuring_takes_at_most_twice_the_steps_of_training(tmp_path, capsys):
    """Also where somebody asks for more; and that is told."""
    flags = "--coverage.every", "1", "--coverage.rollouts", "3", "--iterations", "40"
    _, rows = trained(tmp_path, *flags)
    at = [int(row["iteration"]) for row in rows if row["eval/coverage"]]
    every = 112 * 4 * 60 // 2
    steps = [int(rows[i - 1]["steps/train"]) for i in at]
    assert at[0] == 2 and at[-1] == 40 and 3 < len(at) < 12
    assert min(np.diff(steps[:-1])) >= every
    assert int(rows[-2]["steps/eval"]) <= 2 * int(rows[-2]["steps/train"])
    assert f"every {every:,} training steps, not every 1" in capsys.readouterr().out
