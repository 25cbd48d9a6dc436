"""Mazes by chance, and cells of any size."""

import numpy as np
import pytest
from conftest import call
from hypothesis import given
from hypothesis import strategies as st

from goalgan_bt import envs
from goalgan_bt.envs import maze as mazes
from goalgan_bt.envs.random_maze import random_maze
from goalgan_bt.runs.run_folder import maze_of


@given(st.tuples(st.integers(1, 6), st.integers(2, 6)), st.integers(0, 2**32), st.floats(0, 1))
def test_every_place_of_a_random_maze_can_be_reached(rooms, seed, loops):
    maze = random_maze(rooms, np.random.default_rng(seed), loops)  # `Maze` refuses what is cut off
    assert maze.free.shape == (2 * rooms[0] + 1, 2 * rooms[1] + 1)
    assert maze.free[1::2, 1::2].all()
    assert not maze.free[::2, ::2].any()  # posts
    assert maze == random_maze(rooms, np.random.default_rng(seed), loops)


@given(st.integers(0, 1000))
def test_without_loops_there_is_one_way_only(seed):
    """A tree of n places has n - 1 corridors; with all walls open there is a grid."""
    rng = np.random.default_rng(seed)
    assert random_maze((3, 4), rng, loops=0.0).free.sum() == 12 + 11
    assert random_maze((3, 4), rng, loops=1.0).free.sum() == 12 + 3 * 3 + 2 * 4


def test_no_room_is_no_maze():
    with pytest.raises(ValueError, match="two places"):
        random_maze((1, 1), np.random.default_rng(0))


@pytest.mark.parametrize("name", ["point_umaze", "ant_umaze"])
def test_cells_of_another_size_make_ways_and_episodes_longer(name):
    usual, wide = (envs.make(name, 1, threads=1, cell_size=size) for size in (2.0, 4.0))
    assert wide.maze.longest_way == 2 * usual.maze.longest_way == 24
    assert wide.horizon == 2 * usual.horizon
    assert np.allclose(wide.goal_high, 2 * usual.goal_high)
    assert wide.feasible(np.array([[8.0, 8.0]])).all()


def test_a_body_must_fit_into_a_cell(tmp_path):
    with pytest.raises(mazes.MapError, match=r"the ant does not fit into cells of 1 m"):
        envs.make("ant_umaze", 1, threads=1, cell_size=1.0)
    envs.make("ant_umaze", 1, threads=1, cell_size=1.5)
    envs.make("point_umaze", 1, threads=1, cell_size=0.5)
    done = call("train", "--env", "ant_umaze", "--cell-size", 0.5, "--out", tmp_path)
    assert done.returncode == 2 and "does not fit into cells of 0.5 m" in done.stderr
    assert len(done.stderr.splitlines()) == 1 and not list(tmp_path.iterdir())
    done = call("train", "--env", "point_umaze", "--action-repeat", 7, "--out", tmp_path)
    assert done.returncode == 2 and "does not divide the 200 steps" in done.stderr


def test_a_run_records_its_cells_and_goes_on_in_them(tmp_path):
    words = "--env", "point_umaze", "--viz", "none", "--out", tmp_path, "--threads", 1
    small = "--rollout.num-envs", 16, "--rollout.steps", 20, "--coverage.rollouts", 1
    done = call("train", *words, *small, "--cell-size", 1.0, "--iterations", 1)
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.iterdir()
    assert maze_of(folder) == mazes.layout("umaze", 1.0)
    done = call("train", "--resume", folder, "--iterations", 2, "--viz", "none")
    assert done.returncode == 0, done.stderr
    done = call("train", "--resume", folder, "--cell-size", 3.0, "--viz", "none")
    assert done.returncode == 2 and "--cell-size of a run cannot change" in done.stderr
    done = call("train", "--env", "point_nd", "--cell-size", 3.0)
    assert done.returncode == 2 and "point_nd has no cells" in done.stderr
