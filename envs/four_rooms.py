"""Four rooms: a grid world whose walls have one doorway each (Schaul et al. 2015).

    ###########
    #S...#....#     S start, G goal; each wall between two rooms has its doorway in its middle.
    #....#....#     A move into a wall leaves the agent where it is.
    #.........#
    #....#....#
    ###.###.###
    #....#....#
    #.........#
    #....#....#
    #....#...G#
    ###########

Small enough for tables: states and actions are numbers, and what led to a state can be listed.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from goalgan_bt.envs.maze import BoolArray

Ints = NDArray[np.int64]

ACTIONS = ((-1, 0), (0, 1), (1, 0), (0, -1))  # up, right, down, left: (row, column)
SIZES = range(7, 52)


class FourRooms:
    """The world and its exact transitions, forward and backward.

    Args:
        size: cells of a side, outer walls included, 7 to 51.

    Attributes:
        free: (size, size) whether each cell is free.
        cells: (S, 2) row and column of each state; start, goal: states in opposite corners.
        next_state: (S, A) where each action leads; from the goal none is ever taken.
        predecessors: (S, A, 2) the states from which an action leads to a state, the first
            `ways` (S, A) of them (0, 1 or 2); the rest are -1.

    Raises:
        ValueError: for another size.
    """

    def __init__(self, size: int) -> None:
        if size not in SIZES:
            raise ValueError(f"four rooms have {SIZES[0]} to {SIZES[-1]} cells a side, not {size}")
        middle = size // 2
        doors = (1 + middle) // 2, (middle + size - 1) // 2
        self.free: BoolArray = np.zeros((size, size), dtype=bool)
        self.free[1:-1, 1:-1] = True
        self.free[middle, :] = self.free[:, middle] = False
        for door in doors:
            self.free[middle, door] = self.free[door, middle] = True
        self.cells: Ints = np.argwhere(self.free)
        number = np.full((size, size), -1)
        number[self.free] = np.arange(len(self.cells))
        self.start, self.goal = int(number[1, 1]), int(number[size - 2, size - 2])

        there = self.cells[:, None] + np.array(ACTIONS)
        reached = number[there[..., 0], there[..., 1]]
        self.next_state: Ints = np.where(reached >= 0, reached, np.arange(len(self.cells))[:, None])
        self.predecessors: Ints = np.full((len(self.cells), len(ACTIONS), 2), -1)
        self.ways: Ints = np.zeros((len(self.cells), len(ACTIONS)), dtype=np.int64)
        for state in range(len(self.cells)):
            for action, following in enumerate(self.next_state[state]):
                if state != self.goal:
                    self.predecessors[following, action, self.ways[following, action]] = state
                    self.ways[following, action] += 1

    @property
    def rows(self) -> tuple[str, ...]:
        """The map as text: '#' wall, '.' free, 'S' start."""
        text = np.where(self.free, ".", "#")
        text[tuple(self.cells[self.start])] = "S"
        return tuple("".join(row) for row in text)

    def picture(self, of_states: NDArray[Any]) -> NDArray[np.float64]:
        """A value per state, (S,), laid out on the grid, (size, size); NaN in the walls."""
        grid = np.full(self.free.shape, np.nan)
        grid[self.free] = of_states
        return grid
