"""Mazes by chance, for tests and studies: corridors with dead ends, and some loops."""

import numpy as np

from goalgan_bt.envs.maze import Maze


def random_maze(
    rooms: tuple[int, int],
    rng: np.random.Generator,
    loops: float = 0.1,
    cell_size: float = 2.0,
) -> Maze:
    """A maze by depth-first search, begun anywhere; some walls between its corridors are then
    opened, so that there is more than one way.

    Args:
        rooms: rows and columns of places that are always free; corridors and walls lie between
            them, so that the map has 2 n + 1 cells along a side with n.
        rng: what is drawn with.
        loops: share of the walls between two such places that is opened besides.
        cell_size: side of a cell, metres.

    Raises:
        ValueError: for no room at all.
    """
    if min(rooms) < 1 or max(rooms) < 2:
        raise ValueError(f"a maze needs two places or more, not {rooms[0]} x {rooms[1]}")
    text = np.full((2 * rooms[0] + 1, 2 * rooms[1] + 1), "#")
    text[1::2, 1::2] = "."
    first = tuple(int(rng.integers(n)) for n in rooms)
    seen, way = {first}, [first]
    while way:
        row, column = way[-1]
        beside = [(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)]
        new = [
            (r, c)
            for r, c in beside
            if 0 <= r < rooms[0] and 0 <= c < rooms[1] and (r, c) not in seen
        ]
        if not new:
            way.pop()
            continue
        r, c = new[rng.integers(len(new))]
        text[row + r + 1, column + c + 1] = "."
        seen.add((r, c))
        way.append((r, c))
    for row, column in np.argwhere(text == "#"):
        inner = 0 < row < len(text) - 1 and 0 < column < len(text[0]) - 1
        if inner and (row + column) % 2 and rng.random() < loops:
            text[row, column] = "."
    start = tuple(2 * int(rng.integers(n)) + 1 for n in rooms)
    text[start] = "S"
    return Maze(tuple("".join(row) for row in text), cell_size)
