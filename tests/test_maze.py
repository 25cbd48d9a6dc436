import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from goalgan_bt.envs import maze as mazes
from goalgan_bt.envs.maze import MapError

UMAZE = mazes.layout("umaze")


def test_umaze_is_the_papers():
    centres = {tuple(c) for c in UMAZE.cell_centres()}
    assert centres == {(0, 0), (2, 0), (4, 0), (4, 2), (4, 4), (2, 4), (0, 4)}
    assert UMAZE.low.tolist() == [-3, -3] and UMAZE.high.tolist() == [7, 7]
    assert UMAZE.longest_path == 6
    tiles = UMAZE.tiles()
    assert len(tiles) == 112
    assert UMAZE.is_free(tiles).all()
    # 12 tiles lie within 1 m of the start: the coverage of an Ant that does not move.
    assert (np.linalg.norm(tiles, axis=1) < 1).sum() == 12


@pytest.mark.parametrize(("name", "cells"), [("spiral", 17), ("medium", 26), ("large", 46)])
def test_other_layouts(name, cells):
    maze = mazes.layout(name)
    assert maze.free.sum() == cells
    assert maze.is_free(np.zeros((1, 2))).all()
    assert len(maze.tiles()) == 16 * cells


def test_walls_cover_exactly_what_is_not_free():
    for name in mazes.LAYOUTS:
        maze = mazes.layout(name)
        rng = np.random.default_rng(0)
        xy = rng.uniform(maze.low, maze.high, (5000, 2))
        x0, y0, x1, y1 = maze.walls().T
        inside = (xy[:, :1] > x0) & (xy[:, :1] < x1) & (xy[:, 1:] > y0) & (xy[:, 1:] < y1)
        assert inside.sum(axis=1).max() == 1  # boxes do not overlap
        assert (inside.any(axis=1) == ~maze.is_free(xy)).all()


def test_free_means_inside_the_map_and_finite():
    xy = np.array([[100.0, 0], [-100, 0], [np.nan, 0], [0, np.inf]])
    assert not UMAZE.is_free(xy).any()


def test_sampled_points_are_free_and_everywhere():
    xy = UMAZE.sample_free(20_000, np.random.default_rng(0))
    assert UMAZE.is_free(xy).all()
    cell = np.linalg.norm(xy[:, None] - UMAZE.cell_centres(), axis=2).argmin(axis=1)
    assert np.bincount(cell).min() > 20_000 / 7 * 0.9


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("###\n#S#\n####", "row 3 has 4 columns"),
        ("####\n#S?#\n####", "row 2, column 3: unknown character '\\?'"),
        ("###\n#S.\n###", "row 2, column 3: the border is open"),
        ("#.#\n#S#\n###", "row 1, column 2: the border is open"),
        ("###\n###\n###", "no free cell"),
        ("####\n#..#\n####", "exactly one start cell 'S', found none"),
        ("####\n#SS#\n####", "found row 2, column 2, row 2, column 3"),
        ("#####\n#S#.#\n#####", "row 2, column 4: no way leads"),
    ],
)
def test_bad_maps_are_named_by_row_and_column(text, message):
    with pytest.raises(MapError, match=message):
        mazes.parse(text)


def test_load_names_the_file(tmp_path):
    path = tmp_path / "mine.txt"
    with pytest.raises(MapError, match=r"mine\.txt"):
        mazes.load(path)
    path.write_text("###\n#S#\n###\n")
    assert mazes.load(path).free.sum() == 1
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(MapError, match="cannot read"):
        mazes.load(path)


free_point = st.tuples(st.integers(0, 6), st.floats(-0.85, 0.85), st.floats(-0.85, 0.85))
move = st.tuples(st.floats(-1.9, 1.9), st.floats(-1.9, 1.9))


@settings(max_examples=300, deadline=None)
@given(free_point, move)
def test_slide_never_enters_a_wall(start, move):
    cell, x, y = start
    before = UMAZE.cell_centres()[cell] + (x, y)
    after, stopped = UMAZE.slide(before[None], before[None] + move, radius=0.1)
    for corner in 0.099 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]):
        assert UMAZE.is_free(after + corner).all()
    # It never goes beyond what was asked, and only a stopped axis falls short.
    travelled = after[0] - before
    assert (np.abs(travelled) <= np.abs(move) + 1e-6).all()
    assert np.allclose(travelled[~stopped[0]], np.array(move)[~stopped[0]])


def test_slide_along_a_wall_keeps_the_free_axis():
    before = np.array([[0.0, 0.9]])  # touching the wall above the start cell
    after, stopped = UMAZE.slide(before, before + np.array([0.5, 0.3]), radius=0.1)
    assert after[0] == pytest.approx([0.5, 0.9])
    assert stopped.tolist() == [[False, True]]


def test_a_map_may_begin_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "map.txt"
    path.write_text("####\n#S.#\n####\n", encoding="utf-8-sig")
    assert mazes.load(path).rows == ("####", "#S.#", "####")


def test_a_large_maze_has_larger_tiles():
    """A thousand cells of four tiles, two thousand of one; each cell keeps the same number."""
    for cells, each in ((250, 16), (444, 9), (1000, 4), (2000, 1), (5000, 1)):
        rows = ("#" * (cells + 2), "#S" + "." * (cells - 1) + "#", "#" * (cells + 2))
        maze = mazes.Maze(rows) if 3 * (cells + 2) <= mazes.MOST_CELLS else None
        if maze is not None:
            assert len(maze.tiles()) == cells * each <= max(mazes.MOST_TILES, cells)
            assert maze.tile_side(cells * each) == pytest.approx(2 / each**0.5)
