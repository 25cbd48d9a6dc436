"""`python -m goalgan_bt.export --minari`: episodes of a policy as a data set, and made again."""

import json

import gymnasium
import numpy as np
import pytest
from conftest import TINY, call

import goalgan_bt.gym
from goalgan_bt.demo import HOME
from goalgan_bt.learners import table
from goalgan_bt.learners.maze import train
from goalgan_bt.learners.maze_config import make_env
from goalgan_bt.learners.trained_policy import load_policy
from goalgan_bt.runs import run_folder

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")

ANT = HOME / "ant_umaze"
POINT = HOME / "point_umaze"


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    """Where the data sets of a test are."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    return tmp_path / "sets"


def made(run, *words, name="some/maze-v0"):
    done = call("export", run, "--minari", name, *words)
    assert done.returncode == 0 and not done.stderr, done.stderr
    assert len(done.stdout.splitlines()) == 1
    return minari.load_dataset(name), done.stdout


def seeds(data):
    return [one["seed"] for one in data.storage.get_episode_metadata(data.episode_indices)]


def check_replay(data):
    """What it holds happens again in the environment that it names."""
    env = data.recover_environment()
    assert data.observation_space == env.observation_space
    assert data.action_space == env.action_space
    for episode, seed in zip(data, seeds(data), strict=True):
        obs, _ = env.reset(seed=seed)
        seen, rewards = [obs], []
        for action in episode.actions:
            obs, reward, terminated, truncated, _ = env.step(action)
            seen.append(obs)
            rewards.append(reward)
        assert (terminated, truncated) == (episode.terminations[-1], episode.truncations[-1])
        assert np.array_equal(rewards, episode.rewards)
        for name, rows in episode.observations.items():
            assert np.array_equal([row[name] for row in seen], rows), name
    return env


def check_rewards(data):
    """1 exactly where the goal was reached, which ends an episode; how many reached it."""
    env = data.recover_environment().unwrapped
    reached = 0
    for episode in data:
        obs, healthy = episode.observations, episode.infos["healthy"]
        there = env.sims.reached(obs["achieved_goal"], obs["desired_goal"])
        assert len(there) == len(episode.rewards) + 1 == len(episode.actions) + 1
        assert np.array_equal(episode.rewards, (there & healthy)[1:].astype(float))
        assert np.array_equal(episode.infos["success"][1:], episode.rewards > 0)
        assert not there[0] and not episode.rewards[:-1].any()
        assert episode.terminations[-1] == (there[-1] or not healthy[-1])
        assert episode.truncations[-1] == (not episode.terminations[-1])
        reached += there[-1]
    return int(reached)


@pytest.mark.parametrize("run", [POINT, ANT], ids=["point", "ant"])
def test_the_data_set_is_what_happened_and_happens_again(run, place):
    data, said = made(run, "--episodes", 8, "--seed", 5)
    assert said.startswith(str(place / "some/maze-v0"))
    assert data.total_episodes == 8 and seeds(data) == [*range(5, 13)]
    assert data.total_steps == sum(len(episode.actions) for episode in data)
    check_replay(data)
    reached = check_rewards(data)
    assert f"8 episodes, {data.total_steps} actions, success {reached / 8:.3f}" in said
    assert reached >= 6
    goals = np.array([episode.observations["desired_goal"][0] for episode in data])
    assert len(np.unique(goals, axis=0)) == 8


def test_without_noise_it_is_what_the_policy_says(trained):
    data, _ = made(trained, "--episodes", 3, "--deterministic")
    policy = load_policy(trained)
    for episode in data:
        obs = episode.observations
        said = policy.act(obs["observation"][:-1], obs["desired_goal"][:-1])
        assert np.allclose(said, episode.actions, atol=1e-5)
    noisy, _ = made(trained, "--episodes", 3, name="noisy-v0")
    assert not np.allclose(next(iter(noisy)).actions[0], next(iter(data)).actions[0])


def test_it_tells_who_made_it_how_and_no_path(trained, place):
    data, _ = made(trained, "--episodes", 2)
    told = data.storage.metadata
    assert told["algorithm_name"] == "TRPO, goalgan_bt --method recall_traces"
    assert "point_umaze" in told["description"] and "with the noise" in told["description"]
    assert told["author"] and "code_permalink" not in told
    text = (place / "some/maze-v0/data/metadata.json").read_text()
    assert str(trained.parent) not in text and str(place) not in text


@pytest.mark.parametrize(
    "words", ["--env point_nd --dim 3", "--map {map} --horizon 40 --cell-size 1"]
)
def test_boxes_and_mazes_of_ones_own(tmp_path, words):
    rows, folder = ["#####", "#S..#", "#.#.#", "#####"], tmp_path / "run"
    (tmp_path / "my.txt").write_text("\n".join(rows) + "\n")
    words = f"{TINY} {words.format(map=tmp_path / 'my.txt')} --iterations 1"
    cfg = table.from_command_line(words.split())
    folder.mkdir()
    run_folder.write_meta(folder, make_env(cfg, 1).maze)
    train(cfg, folder)
    (tmp_path / "my.txt").unlink()  # the run has recorded it
    data, _ = made(folder, "--episodes", 4)
    env = check_replay(data)
    check_rewards(data)
    sims = env.unwrapped.sims
    assert (sims.horizon, sims.action_repeat) == (cfg.horizon or 200, cfg.action_repeat)
    if cfg.map is None:
        assert data.observation_space["achieved_goal"].shape == (3,)
    else:
        assert [*sims.maze.rows] == rows and sims.maze.cell_size == 1
        assert "my.txt" not in str(data.storage.metadata)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ("--minari maze", "Minari takes no such id"),
        ("--minari ../maze-v0", "Minari takes no such id"),
        ("--minari taken/maze-v0", "remove it with `minari delete taken/maze-v0`, or choose"),
        ("--minari a-v0 --episodes 0", "--episodes must be between 1 and"),
        ("--minari a-v0 --seed -1", "--seed"),
        ("--minari a-v0 --onnx a.onnx", "give one of --onnx FILE and --minari ID"),
        ("", "give one of --onnx FILE and --minari ID"),
        ("--onnx a.onnx --episodes 3", "go with --minari"),
        ("--onnx a.onnx --deterministic", "go with --minari"),
    ],
)
def test_bad_words_end_in_one_line(trained, place, tmp_path, monkeypatch, words, problem):
    monkeypatch.chdir(tmp_path)
    (place / "taken/maze-v0/data").mkdir(parents=True)
    done = call("export", trained, *words.split())
    assert done.returncode == 2 and problem in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert [*place.iterdir()] == [place / "taken"] and not (tmp_path / "a.onnx").exists()


def test_other_runs_and_what_is_missing_are_refused_in_one_line(folder, monkeypatch, tmp_path):
    def refused(run, problem):
        done = call("export", run, "--minari", "a-v0")
        assert done.returncode == 2 and problem in done.stderr, done.stderr
        assert len(done.stderr.splitlines()) == 1

    refused(tmp_path / "nowhere", "is no run")
    settings = json.loads((folder / "config.json").read_text())
    for env in ("my_tasks:make_reacher", "four_rooms_15"):
        (folder / "config.json").write_text(json.dumps(settings | {"env": env}))
        refused(folder, f"is a run of {env}: --minari goes with")
    (folder / "config.json").write_text(json.dumps(settings))
    for name in ("checkpoint.pt", "checkpoint_previous.pt"):
        (folder / name).unlink()
    refused(folder, "has no checkpoint.pt")
    for library, other in (("h5py", "minari"), ("minari", "h5py")):
        monkeypatch.setattr("importlib.util.find_spec", {other: "is there"}.get)
        refused(folder, f'{library} is missing: pip install "goalgan_bt[minari]"')


def test_half_a_data_set_is_removed(trained, place, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(minari.MinariDataset, "__init__", full)
    done = call("export", trained, "--minari", "some/maze-v0", "--episodes", 1)
    assert done.returncode == 2 and "the disk is full" in done.stderr
    assert not (place / "some/maze-v0").exists()


def test_ids_of_gymnasium_take_rows_in_the_place_of_a_file(tmp_path):
    rows = ["####", "#S.#", "####"]
    env = gymnasium.make(goalgan_bt.gym.env_id("point_umaze"), map_rows=rows)
    assert [*env.unwrapped.sims.maze.rows] == rows
    with pytest.raises(ValueError, match="not by both"):
        gymnasium.make("goalgan_bt/PointUMaze-v0", map_rows=rows, map_file=tmp_path / "x.txt")
