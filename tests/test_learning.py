"""Does it learn? Minutes each: `pytest -m slow`."""

import numpy as np
import pytest

from goalgan_bt.learners import table
from goalgan_bt.learners.maze import train
from goalgan_bt.runs.metrics_csv import read_metrics


def learn(folder, *flags):
    folder.mkdir()
    train(table.from_command_line([*flags]), folder)
    _, rows = read_metrics(folder)
    return [float(row["eval/coverage"]) for row in rows if row["eval/coverage"]]


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("seed", ["0", "1"])
def test_the_point_learns_most_of_the_umaze(tmp_path, seed):
    """Seeds 0 to 9 reach 0.96 within 0.7 million steps and end at 0.99 or above."""
    coverage = learn(tmp_path / "run", "--env", "point_umaze", "--seed", seed)
    assert max(coverage[:4]) >= 0.9 and coverage[-1] >= 0.95


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_default_beats_uniform_goals_on_the_same_budget(tmp_path):
    """In the mean of three seeds: over the run as at its end."""
    budget = "--env", "point_umaze", "--total-steps", "600000", "--coverage.every", "100000"
    found = {}
    for method in ("recall_traces", "uniform"):
        runs = [
            learn(tmp_path / f"{method}{seed}", *budget, "--method", method, "--seed", seed)
            for seed in "012"
        ]
        found[method] = np.mean([(np.mean(run), run[-1]) for run in runs], axis=0)
    assert (found["recall_traces"] > found["uniform"] + 0.15).all(), found


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_point_learns_a_box_of_six_dimensions(tmp_path):
    """Seeds 0 to 6 end at 0.64 or above, 0.83 in the mean."""
    coverage = learn(tmp_path / "run", "--env", "point_nd", "--dim", "6")
    assert coverage[-1] >= 0.6


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_ant_learns_most_of_the_umaze(tmp_path):
    """In runs of 12 million steps five seeds are at 0.76 or above after 3.3 million."""
    coverage = learn(tmp_path / "run", "--env", "ant_umaze", "--total-steps", "4000000")
    assert coverage[-1] >= 0.7 > 0.25 > coverage[0]
