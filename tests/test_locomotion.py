"""TRPO and SAC on locomotion from the command line, with and without recall traces."""

import csv
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from conftest import call, started

from goalgan_bt.learners import locomotion, table
from goalgan_bt.runs import checkpoint, run_folder
from goalgan_bt.runs.errors import RunError, UsageError


def done(iteration, tested, trained, seconds, value):
    """Of a checkpoint what is not the agent's."""
    steps = {"train": trained, "label": 0, "eval": tested}
    run = {"iteration": iteration, "steps": steps, "seconds": seconds, "next_measurement": 0.0}
    run |= {"metrics": {}}
    return {"run": run, "return": value}


SHORT = "--backtracking.min-steps", 20, "--backtracking.every", 100, "--episodes", 1


def test_presets_are_the_papers():
    assert locomotion.preset("hopper", "trpo").backtracking.trace_length == 10
    assert locomotion.preset("hopper", "sac").backtracking.trace_length == 20
    assert locomotion.preset("humanoid", "sac").backtracking.trace_length == 50
    for cfg in (locomotion.preset("ant", method) for method in ("trpo", "sac")):
        assert cfg.backtracking.fade_steps == cfg.total_steps // 2  # this is ours
    asked = table.from_command_line(["--env", "ant", "--method", "sac"])
    assert (asked.num_envs, asked.total_steps, asked.backtracking.trace_length) == (1, 200_000, 50)
    with pytest.raises(UsageError, match="trpo or sac"):
        table.from_command_line(["--env", "ant", "--method", "a2c"])


@pytest.mark.parametrize(("method", "steps"), [("trpo", 5000), ("sac", 300)])
def test_a_run_of_the_hopper(method, steps, tmp_path):
    pytest.importorskip("sb3_contrib")
    flags = "--env", "hopper", "--method", method, "--total-steps", steps, "--out", tmp_path
    done = call("train", *flags, *SHORT)
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.iterdir()
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert int(rows[-1]["steps/train"]) >= steps
    assert [int(row["iteration"]) for row in rows] == list(range(1, len(rows) + 1))
    assert float(rows[-1]["eval/return"]) > 20
    assert 0 < float(rows[-1]["recall/kl"]) <= {"trpo": 0.005, "sac": 0.2}[method]
    saved = torch.load(folder / "policy.pt", weights_only=True)
    weights = saved["policy"]
    assert ("mean" in saved) == (method == "trpo")
    assert any(name.startswith(("actor", "action_net")) for name in weights)
    if method == "sac":
        return  # the same from here on
    drawn = call("plot", folder)
    assert drawn.returncode == 0 and (folder / "curves.png").stat().st_size > 10_000
    exported = call("viz", folder, "--export", tmp_path / "run.html")
    assert exported.returncode == 2 and "no map to export" in exported.stderr


@pytest.mark.parametrize("method", ["trpo", "sac"])
def test_a_run_that_is_stopped_goes_on(method, tmp_path):
    """From its last measurement, to the same number of steps, with all that it had learned."""
    pytest.importorskip("sb3_contrib")
    steps = {"trpo": 2 * 4096, "sac": 400}[method]
    flags = "--env", "hopper", "--method", method, "--total-steps", steps, "--out", tmp_path
    with started("train", *flags, *SHORT, stderr=subprocess.PIPE) as running:
        while not list(tmp_path.glob("*/checkpoint.pt")):
            assert running.poll() is None
            time.sleep(0.02)
        running.send_signal(signal.SIGTERM)
        _, said = running.communicate(timeout=20)
    (folder,) = tmp_path.iterdir()
    assert running.returncode == 2 and said.count("\n") == 1
    assert said.endswith(f"go on from the last checkpoint with --resume {folder}\n")
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert 0 < saved["steps"] < steps and saved["parameters"]["policy"]
    if method == "sac":
        assert len(saved["replay"]["rewards"]) == saved["steps"]

    refused = call("train", "--resume", folder, "--hidden", 8)
    assert refused.returncode == 2 and "--hidden of a run cannot change" in refused.stderr
    done = call("train", "--resume", folder)
    assert done.returncode == 0, done.stderr
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["iteration"]) for row in rows] == list(range(1, len(rows) + 1))
    counts = [int(row["steps/train"]) for row in rows]
    assert counts[saved["run"]["iteration"] - 1] == saved["steps"] and counts == sorted(set(counts))
    assert counts[-1] >= steps and (folder / "policy.pt").exists()
    assert not (folder / "checkpoint.pt").exists()
    again = call("train", "--resume", folder)
    assert again.returncode == 2 and "has reached its limits" in again.stderr


@pytest.mark.parametrize("method", ["trpo", "sac"])
def test_what_is_restored_is_what_was_saved(method, tmp_path):
    """Agent, normalisation, replay and callback: they act and learn alike from there on."""
    sb3 = pytest.importorskip("sb3_contrib") and pytest.importorskip("goalgan_bt.sb3")
    cfg = locomotion.preset("hopper", method).backtracking
    cfg = replace(cfg, min_steps=20, every=100)
    agents = []
    for seed in (0, 1):
        agent, _ = locomotion.make(replace(locomotion.preset("hopper", method), seed=seed))
        agents.append((agent, sb3.RecallTraces(cfg, seed)))
    (agent, recall), (other, another) = agents
    agent.learn(400, callback=recall)  # with TRPO a whole batch
    file = tmp_path / "state.pt"
    torch.save(locomotion.state_dict(agent, recall), file)
    locomotion.restore(other, another, torch.load(file, weights_only=True))
    assert other.num_timesteps == agent.num_timesteps
    obs = np.random.default_rng(0).normal(size=(5, 11))
    for env in filter(None, (agent.get_vec_normalize_env(),)):
        seen = other.get_vec_normalize_env()
        np.testing.assert_array_equal(seen.normalize_obs(obs), env.normalize_obs(obs))
        np.testing.assert_array_equal(seen.ret_rms.var, env.ret_rms.var)
    first = agent.predict(obs, deterministic=True)[0]
    np.testing.assert_array_equal(other.predict(obs, deterministic=True)[0], first)
    assert another.best()[1] == recall.best()[1]
    models = recall.dynamics.parameters(), another.dynamics.parameters()
    assert all(torch.equal(a, b) for a, b in zip(*models, strict=True))
    if method == "sac":  # replay, moments and temperature: it learns the same from there
        other.set_logger(agent.logger)
        for learner in (agent, other):
            learner.set_random_seed(0)
            learner.train(gradient_steps=3, batch_size=32)
        weights = agent.policy.parameters(), other.policy.parameters()
        assert all(torch.allclose(a, b) for a, b in zip(*weights, strict=True))
        assert torch.equal(agent.log_ent_coef, other.log_ent_coef)


def test_a_run_cut_off_between_its_last_measurement_and_its_end_only_ends(tmp_path):
    pytest.importorskip("sb3_contrib")
    cfg = replace(locomotion.preset("hopper", "trpo"), total_steps=4096)
    cfg = replace(cfg, backtracking=replace(cfg.backtracking, trace_length=0))
    folder = run_folder.new_run(tmp_path, "hopper", 0, asdict(cfg))
    agent, _ = locomotion.make(cfg)
    agent.learn(4096)
    state = done(25, 100, 4096, 1.0, 7.5) | locomotion.state_dict(agent, None)
    checkpoint.save(state, folder / "checkpoint.pt")
    assert locomotion.train(replace(cfg, resume=folder), folder).value == 7.5
    saved = torch.load(folder / "policy.pt", weights_only=True)
    seen = agent.get_vec_normalize_env().obs_rms
    np.testing.assert_array_equal(saved["mean"], seen.mean)
    np.testing.assert_array_equal(saved["var"], seen.var)
    assert abs(seen.mean[0] - 1.2) < 0.1  # the Hopper's height
    assert not (folder / "checkpoint.pt").exists()


@pytest.mark.parametrize(
    "change",
    [{"env": "moon"}, {"hidden": None}, {"seed": 1.5}, {"total_steps": -1}, {"backtracking": 3}],
)
def test_damaged_settings_are_refused(change, tmp_path):
    cfg = asdict(locomotion.preset("hopper", "sac"))
    run_folder.write_settings(tmp_path, cfg)
    assert table.load(tmp_path) == locomotion.preset("hopper", "sac")
    run_folder.write_settings(tmp_path, cfg | change)
    with pytest.raises(RunError, match=r"cannot read .*config.json"):
        table.load(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"return": "a"},
        done(1, 5, 10, np.nan, 2.0),
        {"log_ent_coef": torch.tensor([np.nan])},
        {"parameters": "nan"},
        {"steps": "many"},
        {"replay": None},
        {"replay": "past"},
    ],
)
def test_a_checkpoint_that_says_nonsense_is_refused(change, tmp_path):
    pytest.importorskip("sb3_contrib")
    cfg = locomotion.preset("hopper", "sac")
    agent, _ = locomotion.make(cfg)
    agent.learn(10)
    state = done(1, 5, 10, 1.0, 2.0) | locomotion.state_dict(agent, None)
    if change == {"replay": "past"}:
        change = {"replay": state["replay"] | {"pos": 10**7}}
    if change == {"parameters": "nan"}:
        policy = {name: weights * np.nan for name, weights in state["parameters"]["policy"].items()}
        change = {"parameters": state["parameters"] | {"policy": policy}}
    for told, good in ((state, True), (state | change, False)):
        checkpoint.save(told, tmp_path / "checkpoint.pt")
        if good:
            assert locomotion.resume(agent, None, tmp_path) == (state["run"], 2.0)
        else:
            with pytest.raises(RunError, match="it is damaged"):
                locomotion.resume(agent, None, tmp_path)


@pytest.mark.parametrize("package", ["stable_baselines3", "sb3_contrib"])
def test_without_the_agents_there_is_no_run_folder(package, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    done = call("train", "--env", "hopper", "--out", tmp_path / "runs")
    assert done.returncode == 2 and not (tmp_path / "runs").exists()
    assert done.stderr == f'error: locomotion needs {package}: pip install "goalgan_bt[sb3]"\n'


def test_without_traces_nothing_is_recalled(tmp_path):
    pytest.importorskip("sb3_contrib")
    flags = "--env", "hopper", "--method", "sac", "--total-steps", 120, "--out", tmp_path
    done = call("train", *flags, "--backtracking.trace-length", 0, *SHORT)
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.iterdir()
    assert "recall/" not in (folder / "metrics.csv").read_text()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--total-steps", "0"], "--total-steps must be"),
        (["--backtracking.trace-length", "-1"], "--backtracking.trace-length must be 0 or more"),
        (["--method", "ppo"], "choose trpo or sac"),
        (["--speed", "9"], "--speed"),
    ],
)
def test_bad_flags_end_in_one_line(flags, words, tmp_path):
    done = call("train", "--env", "hopper", "--out", tmp_path, *flags)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and words in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_signal_after_the_last_line_changes_nothing(tmp_path):
    pytest.importorskip("sb3_contrib")
    flags = "--env", "hopper", "--method", "sac", "--total-steps", 20, "--episodes", 1
    flags = *flags, "--viz", "none"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with started("train", *flags, "--out", tmp_path, **pipes) as running:
        while " training steps: " not in running.stdout.readline():
            assert running.poll() is None
        time.sleep(0.05)
        for number in (signal.SIGINT, signal.SIGTERM):
            running.send_signal(number)
        _, errors = running.communicate(timeout=60)
    assert running.returncode == 0 and not errors
