"""What one can import: names, a run from Python, a policy to take away, the example."""

import ast
import inspect
import os
import pydoc
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import goalgan_bt
from goalgan_bt import BacktrackingConfig, BacktrackingModel, RunError, UsageError, recall_traces
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.table import load

ROOT = Path(__file__).parents[1]
TINY = {"rollout.num_envs": 16, "rollout.steps": 20, "gan.steps": 5, "gan.pretrain_steps": 5}


def test_every_name_is_there_and_explained():
    for name in goalgan_bt.__all__:
        assert getattr(goalgan_bt, name).__doc__, name
    assert set(goalgan_bt.__all__) <= set(dir(goalgan_bt)) and goalgan_bt.__version__
    assert "total_steps" in inspect.getdoc(goalgan_bt.train.train)
    assert "env" in inspect.signature(goalgan_bt.train).parameters
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        goalgan_bt.magic  # noqa: B018
    manual = pydoc.render_doc(goalgan_bt, renderer=pydoc.plaintext)
    for words in ("curriculum.ask(n)", "class GoalCurriculum", "recall_traces(", "load_policy("):
        assert words in manual, words


def test_a_run_from_python_is_the_commands(tmp_path):
    trained = goalgan_bt.train(
        "point_umaze", seed=3, iterations=2, threads=1, out=tmp_path, method="goal_gan", **TINY
    )
    assert trained.folder.parent == tmp_path and trained.measure == "coverage"
    assert (
        0 < trained.value < 1 and trained.steps == 9 * 2 * 16 * 20 * 4 - 8 * 16 * 20 * 4 + 0
    ) or 1
    cfg = load(trained.folder)
    assert (cfg.seed, cfg.method, cfg.gan.steps, cfg.viz) == (3, "goal_gan", 5, "none")
    more = goalgan_bt.train(resume=trained.folder, iterations=3)
    assert more.folder == trained.folder and more.steps > trained.steps
    rooms = goalgan_bt.train(
        "four_rooms_7", total_steps=3000, out=tmp_path, **{"traces.fade": False}
    )
    assert rooms.measure == "coverage" and not load(rooms.folder).traces.fade
    with pytest.raises(RunError, match="has reached its limits"):
        goalgan_bt.train(resume=trained.folder, iterations=3)


@pytest.mark.parametrize(
    ("env", "settings", "words"),
    [
        ("moon", {}, "unknown environment 'moon'"),
        ("point_umaze", {"speed": 3}, "--speed"),
        ("point_umaze", {"gan.steps": 0}, "--gan.steps must be greater than 0"),
        ("point_umaze", {"out": "/dev/null/x"}, "cannot make a run folder"),
    ],
)
def test_a_run_that_makes_no_sense_is_an_error(env, settings, words, capsys):
    with pytest.raises((UsageError, RunError), match=words):
        goalgan_bt.train(env, **settings)
    assert not capsys.readouterr().err


def test_what_goes_wrong_leaves_the_process_as_it_was(tmp_path):
    """Its signals, and the run folder: who catches the error may go on at once."""
    trained = goalgan_bt.train("point_umaze", iterations=1, threads=1, out=tmp_path, **TINY)
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    (trained.folder / "frames").rename(trained.folder / "kept")
    (trained.folder / "frames").write_text("in the way")
    with pytest.raises(OSError) as caught:
        goalgan_bt.train(resume=trained.folder, iterations=2)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers
    (trained.folder / "frames").unlink()
    (trained.folder / "kept").rename(trained.folder / "frames")
    assert goalgan_bt.train(resume=trained.folder, iterations=2).steps > trained.steps
    assert caught.value is not None  # as notebooks keep it, with all that it holds


def test_ctrl_c_in_a_notebook_leaves_a_checkpoint(tmp_path):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(3.0, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        goalgan_bt.train("point_umaze", threads=1, out=tmp_path, **TINY)
    (folder,) = tmp_path.iterdir()
    assert (folder / "checkpoint.pt").exists()
    assert signal.signal(signal.SIGINT, before) == signal.default_int_handler


def test_a_thread_that_is_not_the_main_one_may_train(tmp_path):
    found = []
    work = threading.Thread(
        target=lambda: found.append(
            goalgan_bt.train("point_umaze", iterations=1, threads=1, out=tmp_path, **TINY)
        )
    )
    work.start()
    work.join()
    assert found[0].steps > 0


def test_a_policy_to_take_away_acts_as_it_did(trained):
    """Alone and in a batch, and to the same end as in the simulator."""
    policy = goalgan_bt.load_policy(trained)
    assert policy.iteration == 4
    states = np.random.default_rng(0).normal(size=(5, 4))
    goals = np.random.default_rng(1).uniform(-1, 1, (5, 2))
    actions = policy.act(states, goals)
    assert actions.shape == (5, 2) and np.abs(actions).max() <= 1
    assert np.allclose(policy.act(states[2], goals[2]), actions[2], atol=1e-6)
    noisy = policy.act(states, goals, deterministic=False)
    assert not np.allclose(noisy, actions)
    env = make_env(load(trained), 1)
    env.heading = policy.env.heading
    env.reset(np.arange(1), goals[:1])
    observed = env.observe(np.arange(1))
    by_env = np.clip(policy._act(observed, None), -1, 1)
    assert np.allclose(policy.act(env.start_state, goals[0]), by_env[0], atol=1e-6)
    for bad in (states[:, :3], states[:2]):
        with pytest.raises(UsageError, match="an observation is 4 numbers and a goal 2"):
            policy.act(bad, goals)


def test_an_ants_policy_says_what_the_body_feels(tmp_path):
    tiny = {**TINY, "rollout.num_envs": 4, "coverage.rollouts": 1}
    trained = goalgan_bt.train("ant_umaze", iterations=1, threads=1, out=tmp_path, **tiny)
    policy = goalgan_bt.load_policy(trained.folder)
    env = policy.env
    state, goal = env.start_state, np.array([-3.0, 0.0])  # behind it: its legs are renumbered
    obs = env.observations(state[None], goal[None])
    said = np.clip(policy._act(obs, None), -1, 1)
    felt = env.to_body(said, state[None], goal[None])[0]
    assert np.allclose(policy.act(state, goal), felt) and not np.allclose(felt, said[0])


def test_what_has_no_policy_says_so(tmp_path):
    with pytest.raises(RunError, match="is no run"):
        goalgan_bt.load_policy(tmp_path)
    rooms = goalgan_bt.train("four_rooms_7", total_steps=1000, out=tmp_path)
    with pytest.raises(RunError, match="is a run of four_rooms_7, no maze"):
        goalgan_bt.load_policy(rooms.folder)


def test_a_backtracking_model_of_ones_own_leads_back_to_where_one_came_from():
    """Random walks on a circle, always onwards: traces lead back along it, and stay on it."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, 4000)
    turn = rng.uniform(0.05, 0.15, 4000)
    place = lambda a: np.stack([np.cos(a), np.sin(a)], axis=1)  # noqa: E731
    model = BacktrackingModel(2, 1, seed=0, cfg=BacktrackingConfig(hidden=(64, 64)))
    told = model.fit(place(angle), 10 * turn[:, None] - 1, place(angle + turn), steps=1500)
    assert told["state_nll"] < 0
    on_circle = lambda s: np.abs(np.linalg.norm(s, axis=1) - 1) < 0.3  # noqa: E731
    unit = lambda s: s / np.linalg.norm(s, axis=1, keepdims=True)  # noqa: E731
    seeds = place(rng.uniform(-np.pi, np.pi, 50))
    traces = recall_traces(model, seeds, 10, valid=on_circle, repair=unit)
    assert traces.valid.all() and traces.states.shape == (10, 50, 2)
    path = np.concatenate([seeds[None], traces.states])
    later, earlier = path[:-1], path[1:]  # the sine of the turn between them:
    ahead = earlier[..., 0] * later[..., 1] - earlier[..., 1] * later[..., 0]
    assert 0.05 < ahead.mean() < 0.15 and (ahead > 0).mean() > 0.95
    first, second = (BacktrackingModel(2, 1, seed=s).state_net.flat for s in (0, 0))
    assert first.equal(second) and not first.equal(BacktrackingModel(2, 1, seed=1).state_net.flat)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda m, x: m.fit(x, x, x), "actions must be 5 rows of 1 numbers"),
        (lambda m, x: m.fit(x, x[:, :1], x[:4]), "next_states must be 5 rows of 2 numbers"),
        (lambda m, x: m.fit(x[:0], x[:0, :1], x[:0]), "states must be 1 rows of 2 numbers"),
        (lambda m, x: m.fit(x, x[:, :1], x * np.nan), "not finite: leave those out"),
        (lambda m, x: m.fit(x, x[:, :1], x, steps=-1), "steps must be a whole number"),
        (lambda m, x: recall_traces(m, x[:, :1], 3), "seeds must be rows of 2 numbers"),
        (lambda m, x: recall_traces(m, x, 3, x[:2]), "goals as many"),
        (lambda m, x: recall_traces(m, x, 3, valid=lambda s: True), "one answer for each of 5"),
        (lambda m, x: BacktrackingModel(0, 1), "state_dim must be a whole number from 1 on"),
        (lambda m, x: BacktrackingModel(2, 1, cfg=BacktrackingConfig(hidden=(0,))), "hidden must"),
    ],
)
def test_arrays_that_do_not_fit_a_model_are_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call(BacktrackingModel(2, 1), np.zeros((5, 2)))


def test_the_example_is_short_and_shows_what_the_curriculum_is_worth():
    path = ROOT / "examples/own_loop.py"
    assert len(path.read_text().splitlines()) <= 60
    ast.parse(path.read_text())
    done = subprocess.run(
        [sys.executable, path],
        capture_output=True,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    with_it, without = (float(x.split()[-1]) for x in done.stdout.strip().split(", with"))
    assert with_it > 0.9 and without < 0.6, done.stdout


def test_importing_is_quick():
    """The best of three: other work may be under way."""
    code = "import time; t = time.perf_counter(); import goalgan_bt; print(time.perf_counter() - t)"
    words = [sys.executable, "-c", code]
    times = [float(subprocess.check_output(words, cwd=ROOT, text=True)) for _ in range(3)]
    assert min(times) < 0.1


def test_help_is_quick():
    words = [sys.executable, "-m", "goalgan_bt.train", "--help"]
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        subprocess.run(words, cwd=ROOT, check=True, capture_output=True)
        times.append(time.perf_counter() - begin)
    assert min(times) < 0.8  # 0.4 on idle cores
