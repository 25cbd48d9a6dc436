"""Methods are settings of one loop: each trains, and differs from the default as it says."""

import pytest
import torch

from goalgan_bt.learners import maze_config, table
from goalgan_bt.learners.maze import train
from goalgan_bt.learners.methods import METHODS
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.metrics_csv import read_metrics

SHORT = (  # long enough for goals of intermediate difficulty, so that there are traces
    "--env point_umaze --iterations 4 --threads 1 --coverage.rollouts 1 --gan.pretrain-steps 20 "
    "--gan.steps 20 --backtracking.min-transitions 100 --imitation.fade None --updates 4"
)


def trained_with(folder, *flags):
    folder.mkdir()
    train(table.from_command_line([*SHORT.split(), *flags]), folder)
    rows = read_metrics(folder)[1]
    return torch.load(folder / "checkpoint.pt", weights_only=True)["learner"]["policy"], rows


@pytest.mark.parametrize("method", METHODS)
def test_each_method_trains_and_reports(method, tmp_path):
    _, rows = trained_with(tmp_path / method, "--method", method)
    assert float(rows[-1]["eval/coverage"]) >= 0
    assert (int(rows[-1]["steps/label"]) > 0) == (method == "oracle")
    imitated = any(float(row.get("imitation/steps") or 0) > 0 for row in rows)
    without = "backtracking.trace_length", "imitation.steps"
    assert imitated == (0 not in [METHODS[method].get(name) for name in without])


def test_without_imitation_traces_leave_the_policy_alone(tmp_path):
    """Until the first traces all is as in plain Goal GAN; those draw random numbers."""
    early = "--backtracking.min-transitions", "90000"  # never enough for a trace
    plain, _ = trained_with(tmp_path / "plain", "--method", "goal_gan", *early)
    idle, _ = trained_with(tmp_path / "idle", "--method", "no_imitation", *early)
    assert torch.equal(plain["net.flat"], idle["net.flat"])
    default, rows = trained_with(tmp_path / "default")
    assert not torch.equal(plain["net.flat"], default["net.flat"])
    assert float(rows[-1]["imitation/kl"]) > 0
    _, rows = trained_with(tmp_path / "traced", "--method", "no_imitation")
    assert float(rows[-1]["backtracking/traces"]) > 0 and float(rows[-1]["imitation/steps"]) == 0


def test_flags_come_on_top_of_the_method():
    flags = "--env point_umaze --method uniform --goals.new 50"
    cfg = table.from_command_line(flags.split())
    assert (cfg.goals.source, cfg.goals.new, cfg.goals.old) == ("uniform", 50, 0)
    assert cfg.backtracking.trace_length == 0 and cfg.method == "uniform"
    with pytest.raises(UsageError, match="unknown method 'magic': choose one of recall"):
        table.from_command_line(["--method", "magic"])


def test_every_setting_of_every_method_exists():
    for method in METHODS:
        table.check(maze_config.with_method(maze_config.preset("ant_umaze"), method))
