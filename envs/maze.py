"""Mazes as text: cells, walls, tiles, and what it means to stand in one.

A map is rows of characters, drawn as the maze looks from above (x to the right, y up):
`#` or `1` is wall, `.` or `0` is free, `S` (or `r`) is the free cell where every episode starts.
The centre of the start cell is the origin, as in the original Goal GAN code (maze 0 is `umaze`,
maze 11 is `spiral`); `medium` and `large` are the layouts of gymnasium-robotics.
"""

from collections import deque
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from goalgan_bt.envs.arrays import Array, like, namespace

FloatArray = NDArray[np.floating]
BoolArray = NDArray[np.bool_]

LAYOUTS = {
    "umaze": """
        #####
        #...#
        ###.#
        #S..#
        #####""",
    "spiral": """
        #######
        #.....#
        #.#####
        #.#S..#
        #.###.#
        #.....#
        #######""",
    "medium": """
        ########
        #S.##..#
        #..#...#
        ##...###
        #..#...#
        #.#..#.#
        #...#..#
        ########""",
    "large": """
        ############
        #S...#.....#
        #.##.#.#.#.#
        #......#...#
        #.####.###.#
        #..#.#.....#
        ##.#.#.#.###
        #..#...#...#
        ############""",
}


MOST_CELLS = 10_000  # of a map: walls, coverage and ways of more take minutes and gigabytes
MOST_TILES = 4_000  # each of which is tried some times whenever coverage is measured
_ZERO = np.zeros(())


class MapError(ValueError):
    """A map that cannot be a maze; the message names the row and column (from 1) at fault."""


@dataclass(frozen=True)
class Maze:
    """A grid of square cells with walls around the free ones.

    Args:
        rows: the map, top row first (see the module docstring).
        cell_size: side of a cell in metres (2.0 in the original).
        start: where the middle of the start cell is, metres.

    Raises:
        MapError: if the map is not rectangular, has an unknown character, an open border, no
            start, more than one start, or a free cell that cannot be reached from the start.
    """

    rows: tuple[str, ...]
    cell_size: float = 2.0
    start: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        _check(self.rows)

    @cached_property
    def free(self) -> BoolArray:
        """Which cells are free, (rows, columns), row 0 at the bottom (lowest y)."""
        return np.array([[c in ".0Sr" for c in row] for row in reversed(self.rows)])

    @cached_property
    def _start(self) -> tuple[int, int]:
        for r, row in enumerate(reversed(self.rows)):
            for c, char in enumerate(row):
                if char in "Sr":
                    return r, c
        raise AssertionError("checked in _check")

    @cached_property
    def low(self) -> FloatArray:
        """Lower corner of the whole map, walls included, (2,), metres."""
        r, c = self._start
        return np.array(self.start) - self.cell_size * (np.array([c, r]) + 0.5)

    @cached_property
    def high(self) -> FloatArray:
        """Upper corner of the whole map, walls included, (2,), metres."""
        return self.low + self.cell_size * np.array(self.free.shape[::-1])

    def is_free(self, xy: Array) -> Array:
        """Whether each point lies in a free cell: (..., 2) metres -> (...,) bool."""
        cell = self._cell(xy - like(self.low, xy))
        return like(self.free, xy)[cell[..., 1], cell[..., 0]]

    def _cell(self, offset: Array, axes: int | slice = slice(None)) -> Array:
        """The cells at offsets from `low`, (..., axes) metres, as integers along those axes.

        Whatever lies outside of the map, or nowhere (a diverged state), is put into the border,
        which is wall. That also makes cutting off the same as rounding down.
        """
        xp = namespace(offset)
        first, last = like(_ZERO, offset), like(self._last[axes], offset)
        return xp.asarray(xp.fmin(xp.fmax(offset / self.cell_size, first), last), dtype=xp.int64)

    @cached_property
    def _last(self) -> FloatArray:
        """The last column and row."""
        return np.array(self.free.shape[::-1]) - 1.0

    def cell_centres(self) -> FloatArray:
        """Centres of the free cells, (K, 2), metres."""
        r, c = np.nonzero(self.free)
        return self.low + self.cell_size * (np.stack([c, r], axis=1) + 0.5)

    def tiles(self, spacing: float = 0.5) -> FloatArray:
        """Centres of square tiles that cover the free cells, (K, 2), metres.

        With 2 m cells and 0.5 m tiles: 16 per cell, 112 in the U-maze (Florensa et al. 2018). In
        mazes of which that would make more than `MOST_TILES` the tiles are larger.
        """
        n = max(1, round(self.cell_size / spacing))
        n = max(1, min(n, int((MOST_TILES / self.free.sum()) ** 0.5)))
        offset = ((np.arange(n) + 0.5) / n - 0.5) * self.cell_size
        grid = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
        return (self.cell_centres()[:, None] + grid).reshape(-1, 2)

    def tile_side(self, tiles: int) -> float:
        """The side of so many tiles over the free cells, metres (see `tiles`)."""
        return self.cell_size / max(1, round(float(np.sqrt(tiles / self.free.sum()))))

    def sample_free(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Points drawn uniformly from the free area, (n, 2), metres."""
        centres = self.cell_centres()
        cells = centres[rng.integers(len(centres), size=n)]
        return cells + self.cell_size * rng.uniform(-0.5, 0.5, (n, 2))

    def walls(self) -> FloatArray:
        """Wall cells merged into few rectangles, (W, 4) as x0, y0, x1, y1, metres."""
        wall = ~self.free
        boxes = []
        while wall.any():
            r, c = map(int, np.argwhere(wall)[0])
            width = int(np.argmin(np.append(wall[r, c:], False)))
            height = int(np.argmin(np.append(wall[r:, c : c + width].all(axis=1), False)))
            wall[r : r + height, c : c + width] = False
            boxes.append([c, r, c + width, r + height])
        return np.tile(self.low, 2) + self.cell_size * np.array(boxes, dtype=float)

    @cached_property
    def longest_path(self) -> int:
        """Steps from the start cell to the free cell farthest from it."""
        return int(self._steps.max())

    @property
    def longest_way(self) -> float:
        """From the start cell to the free cell farthest from it, metres along the corridors."""
        return self.cell_size * self.longest_path

    @cached_property
    def _steps(self) -> NDArray[np.int64]:
        """Steps from the start cell to each cell, -1 to walls."""
        return _distances(self.free, self._start)

    def way_from_start(self, xy: FloatArray) -> FloatArray:
        """How far it is from the start to places, (n, 2) -> (n,) metres, along the corridors and
        counted in cells; NaN in walls."""
        column, row = self._cell(xy - self.low).T
        steps = self._steps[row, column].astype(float)
        steps[steps < 0] = np.nan
        return self.cell_size * steps

    def slide(self, before: Array, after: Array, radius: float) -> tuple[Array, Array]:
        """Stop a body at the walls, letting it slide along them.

        The body collides as an axis-aligned square of half-width `radius`, one axis after the
        other, so it cannot enter a wall in a step shorter than a cell, however fast.

        Args:
            before: positions at the start of the step, (n, 2), metres.
            after: positions that the step proposes, (n, 2), metres.
            radius: half-width of the body, metres.

        Returns:
            Positions outside every wall, (n, 2), and which axes a wall stopped, (n, 2) bool.
        """
        xp = namespace(before)
        # A body that touches a wall beside it may move along it, also after its place is rounded.
        skin = 1e-9 if before.dtype.itemsize == 8 else 1e-4
        inner = radius * (1 - skin)
        low, edges = like(self.low, before), like(np.array([[-inner], [inner]]), before)
        move = after - before
        side = xp.asarray(xp.where(move < 0, -1.0, 1.0), dtype=move.dtype)
        ahead = after + side * radius - low  # the leading edges
        cell = self._cell(ahead)
        # How far each leading edge goes into the cell that it must perhaps not enter.
        into = ahead % self.cell_size
        into = xp.where(side > 0, into, self.cell_size - into)
        back = xp.minimum(into + skin, abs(move))
        position, stopped = xp.asarray(before, copy=True), xp.empty_like(move, dtype=xp.bool)
        free = like(self.free, before)
        for axis, other, free_along in ((0, 1, free.T), (1, 0, free)):
            beside = self._cell(position[:, other] + edges - low[other], other)  # (2, n)
            open_ = free_along[cell[:, axis], beside]
            blocked = ~(open_[0] & open_[1])
            stopped[:, axis] = blocked
            shift = side[:, axis] * xp.where(blocked, back[:, axis], 0.0)
            position[:, axis] = after[:, axis] - shift
        return position, stopped


def layout(name: str, cell_size: float = 2.0) -> Maze:
    """The shipped maze of that name (a key of `LAYOUTS`)."""
    return parse(LAYOUTS[name], cell_size)


def parse(text: str, cell_size: float = 2.0) -> Maze:
    """A maze from the text of a map; blank lines around it and indentation do not count.

    Raises:
        MapError: as `Maze`.
    """
    return Maze(tuple(line.strip() for line in text.strip().splitlines()), cell_size)


def load(path: Path, cell_size: float = 2.0) -> Maze:
    """A maze from a text file.

    Raises:
        MapError: as `Maze`, or if the file cannot be read as text.
    """
    try:
        if path.exists() and not path.is_file():
            raise OSError("it is no file")
        with path.open(encoding="utf-8-sig") as file:
            return parse(file.read(4 * MOST_CELLS), cell_size)
    except (OSError, UnicodeDecodeError) as error:
        raise MapError(f"cannot read the map {path}: {error}") from error
    except MapError as error:
        raise MapError(f"{path}: {error}") from None


def _distances(free: BoolArray, start: tuple[int, int]) -> NDArray[np.int64]:
    """Steps from `start` to each cell through free cells, -1 where there is no way."""
    distance = np.full(free.shape, -1)
    distance[start] = 0
    queue = deque([start])
    while queue:
        r, c = queue.popleft()
        for cell in ((r + 1, c), (r - 1, c), (r, c + 1), (r, c - 1)):
            if free[cell] and distance[cell] < 0:
                distance[cell] = distance[r, c] + 1
                queue.append(cell)
    return distance


def _check(rows: tuple[str, ...]) -> None:
    if not rows or not any(rows):
        raise MapError("the map is empty")
    if sum(map(len, rows)) > MOST_CELLS:
        raise MapError(f"the map has more than {MOST_CELLS:,} cells")
    starts = []
    for r, row in enumerate(rows, 1):
        if len(row) != len(rows[0]):
            raise MapError(
                f"row {r} has {len(row)} columns and row 1 has {len(rows[0])}: "
                "a map must be rectangular"
            )
        for c, char in enumerate(row, 1):
            if char not in "#1.0Sr":
                raise MapError(
                    f"row {r}, column {c}: unknown character {char!r} "
                    "('#' or '1' wall, '.' or '0' free, 'S' start)"
                )
            if char in "Sr":
                starts.append((r, c))
            if char not in "#1" and (r in (1, len(rows)) or c in (1, len(row))):
                raise MapError(f"row {r}, column {c}: the border is open, put a wall there")
    free = np.array([[c not in "#1" for c in row] for row in rows])
    if not free.any():
        raise MapError("the map has no free cell: row 1 to the last are all wall")
    if len(starts) != 1:
        where = ", ".join(f"row {r}, column {c}" for r, c in starts) or "none"
        raise MapError(f"a map needs exactly one start cell 'S', found {where}")
    cut_off = free & (_distances(free, (starts[0][0] - 1, starts[0][1] - 1)) < 0)
    if cut_off.any():
        r, c = np.argwhere(cut_off)[0] + 1
        raise MapError(
            f"row {r}, column {c}: no way leads from the start to this free cell "
            f"({cut_off.sum()} cells are cut off)"
        )
