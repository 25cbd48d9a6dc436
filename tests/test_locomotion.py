"""TRPO and SAC on locomotion from the command line, with and without recall traces."""

import csv

import pytest
import torch
from conftest import run_module

from goalgan_bt import locomotion
from goalgan_bt.command_line import UsageError

SHORT = "--backtracking.min-steps", 20, "--backtracking.every", 100, "--episodes", 1


def test_presets_are_the_papers():
    assert locomotion.preset("hopper", "trpo").backtracking.trace_length == 10
    assert locomotion.preset("hopper", "sac").backtracking.trace_length == 20
    assert locomotion.preset("humanoid", "sac").backtracking.trace_length == 50
    for cfg in (locomotion.preset("ant", method) for method in ("trpo", "sac")):
        assert cfg.backtracking.fade_steps == cfg.total_steps // 2  # this is ours
    asked = locomotion.from_command_line(["--env", "ant", "--method", "sac"])
    assert (asked.num_envs, asked.total_steps, asked.backtracking.trace_length) == (1, 200_000, 50)
    with pytest.raises(UsageError, match="trpo or sac"):
        locomotion.from_command_line(["--env", "ant", "--method", "a2c"])


@pytest.mark.parametrize(("method", "steps"), [("trpo", 5000), ("sac", 400)])
def test_a_run_of_the_hopper(method, steps, tmp_path):
    pytest.importorskip("sb3_contrib")
    flags = "--env", "hopper", "--method", method, "--total-steps", steps, "--out", tmp_path
    done = run_module("train", *flags, *SHORT)
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.iterdir()
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert int(rows[-1]["steps/train"]) >= steps
    assert [int(row["iteration"]) for row in rows] == list(range(1, len(rows) + 1))
    assert float(rows[-1]["eval/return"]) > 0 and float(rows[-1]["recall/kl"]) >= 0
    saved = torch.load(folder / "policy.pt", weights_only=True)
    weights = saved["policy"]
    assert ("mean" in saved) == (method == "trpo")
    assert any(name.startswith(("actor", "action_net")) for name in weights)
    drawn = run_module("plot", folder)
    assert drawn.returncode == 0 and (folder / "curves.png").stat().st_size > 10_000
    watched = run_module("viz", folder)
    assert watched.returncode == 2 and "hopper has no map" in watched.stderr


def test_without_traces_nothing_is_recalled(tmp_path):
    pytest.importorskip("sb3_contrib")
    flags = "--env", "hopper", "--total-steps", 4000, "--out", tmp_path
    done = run_module("train", *flags, "--backtracking.trace-length", 0, *SHORT)
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.iterdir()
    assert "recall/" not in (folder / "metrics.csv").read_text()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--total-steps", "0"], "--total-steps must be"),
        (["--backtracking.trace-length", "-1"], "trace_length must be greater"),
        (["--method", "ppo"], "choose trpo or sac"),
        (["--speed", "9"], "--speed"),
    ],
)
def test_bad_flags_end_in_one_line(flags, words, tmp_path):
    done = run_module("train", "--env", "hopper", "--out", tmp_path, *flags)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and words in done.stderr
    assert not list(tmp_path.iterdir())
