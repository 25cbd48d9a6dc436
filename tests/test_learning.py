"""Does it learn? Minutes each: `pytest -m slow`."""

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
    coverage = learn(tmp_path / "run", "--env", "point_umaze", "--seed", seed)
    assert max(coverage) >= 0.8


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_ant_learns_to_walk_around_the_first_corner(tmp_path):
    coverage = learn(tmp_path / "run", "--env", "ant_umaze", "--total-steps", "4000000")
    assert coverage[-1] >= 0.38 > 0.25 > coverage[0]
