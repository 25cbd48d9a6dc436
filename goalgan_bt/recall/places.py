"""A backtracking model over places: from which places has the agent come to this one?

The paper's q(s_t | s_t+1) (Recall Traces, section 2.1) over places instead of full states, by
counting, as one can in four rooms: a place is a point of a lattice in the goal space, and counted
are the moves from place to place that the agent has made. Where q is not zero, a move may have led
here. Unrolled backward from a goal along those moves, the shortest way first, it tells for every
place that the agent has been to the way that is left to that goal, and the direction in which it
gets shorter. A body that loses energy in contacts cannot be unrolled backward over its full states
for long; over places it can, all the way to the start.

The way that is left is a potential of the agent's own making (after Ng, Harada and Russell 1999),
and the direction a part of what the policy sees: the two uses of it in `PlacesConfig`.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from goalgan_bt.envs.maze import FloatArray
from goalgan_bt.recall.settings import PlacesConfig
from goalgan_bt.runs.errors import UsageError
from goalgan_bt.runs.ranges import require, require_box

Float32 = NDArray[np.float32]
Nodes = NDArray[np.int64]  # places by number, in the order in which they were found
NEAR = 1.2  # success radii: a goal in sight and as near as that is where one sees it
MOST = 20_000_000  # ways in memory: 16 bytes each in two dimensions
AT_ONCE = 1_000_000  # of which so many are searched at a time
AROUND = 1.5  # times the straight line: a way that is longer leads around something
ONCE = 0.5  # moves that count for less are forgotten
LISTED = 1_000_000  # points of a lattice whose numbers are looked up in a list, not searched


class Ways(NamedTuple):
    """left: (n,) the way that is left, metres; directions: (n, goal_dim) in which it gets shorter,
    of length 1, or 0 on the goal."""

    left: FloatArray
    directions: FloatArray


class Tabulated(NamedTuple):
    """All ways between places, for who computes with tensors (`Places.tabulated`).

    low, high, strides: (goal_dim,) the lattice: a point's key is its coordinates times the strides.
    numbers, ends: (P,) by key, the number of the place there, K where nobody has been, and of the
    nearest place visited. places: (K, goal_dim). table: (K, K + 1, 2 + goal_dim) to each place from
    each: whether a way is known, what is left of it, its direction; zeros from place K.
    """

    low: FloatArray
    high: FloatArray
    strides: Nodes
    numbers: Nodes
    ends: Nodes
    places: FloatArray
    table: Float32


class Places:
    """Where the agent has been, the moves that it made, and the ways that they add up to.

    Args:
        low, high: (goal_dim,) the box of the goals, metres.
        success_radius: metres.
        cfg: settings; those of the mazes if None.

    Attributes:
        near: metres, within which a goal is where one sees it.
        places: (K, goal_dim) the places visited; moves: (K, K) how often each move was made.

    Raises:
        UsageError: for a box that is none, or settings that make no sense.
    """

    def __init__(
        self,
        low: ArrayLike,
        high: ArrayLike,
        success_radius: float,
        cfg: PlacesConfig | None = None,
    ) -> None:
        self.cfg = cfg = cfg or PlacesConfig()
        self._low, self._high = require_box(low, high)
        self.near = NEAR * success_radius
        # A point of the lattice has a number, its key; a step along axis i adds strides[i] to it.
        self._sides = lattice(self._low, self._high, cfg)
        self._strides = np.concatenate([[1], np.cumprod(self._sides[:-1])])
        self.moves = csr_array((0, 0))
        self._number(np.empty(0, np.int64))
        self.refresh()

    def __len__(self) -> int:
        return len(self.places)

    def learn(self, origins: FloatArray, ends: FloatArray) -> None:
        """Count the moves of n simulations in T actions each. Ways know of them after `refresh`.

        Args:
            origins, ends: (n, T, goal_dim) where each action began and ended. Where one begins
                elsewhere than the last one ended, another episode has begun.

        Raises:
            UsageError: for arrays that do not fit.
        """
        if origins.ndim != 3 or origins.shape != ends.shape or origins.shape[2] != len(self._low):
            raise UsageError(
                f"origins and ends must be (n, T, {len(self._low)}), as many of both, "
                f"not {origins.shape} and {ends.shape}"
            )
        points = np.stack([origins, ends])
        keys = self._keys_of(points)
        self._visit(keys[np.isfinite(squared(points))])  # a diverged body is nowhere
        begun, ended = self._find(keys)
        episode = np.zeros(begun.shape, np.int64)
        episode[:, 1:] = (squared(origins[:, 1:] - ends[:, :-1]) != 0).cumsum(axis=1)
        made = [np.empty((2, 0), np.int64)]
        for lag in self.cfg.lags:
            first, last = slice(max(0, begun.shape[1] - lag + 1)), slice(lag - 1, None)
            near = squared(ends[:, last] - origins[:, first]) <= self.cfg.reach**2
            move = near & (episode[:, first] == episode[:, last])
            move &= begun[:, first] != ended[:, last]
            made.append(np.stack([begun[:, first][move], ended[:, last][move]]))
        a, b = np.concatenate(made, axis=1)
        k = len(self)
        self.moves.resize((k, k))
        if self.cfg.forget:
            actions = np.bincount(begun[begun >= 0], minlength=k)
            fading = diags_array(np.exp2(-actions / self.cfg.forget))
            self.moves = csr_array(fading @ self.moves @ fading)
            self.moves.data[self.moves.data < ONCE] = 0.0
            self.moves.eliminate_zeros()
        self.moves = csr_array(self.moves + csr_array((np.ones(len(a)), (a, b)), shape=(k, k)))

    def refresh(self, goals: FloatArray | None = None) -> None:
        """Let ways go along all moves that were counted.

        Args:
            goals: (n, goal_dim) to which ways will be asked for: searching them at once is faster.
        """
        k, dim = self.places.shape
        a, b = self.moves.nonzero()
        length = np.sqrt(squared(self.places[b] - self.places[a]))
        made = csr_array((length, (a, b)), shape=(k, k))
        either = csr_array(made.maximum(made.T))
        back = self.cfg.backward
        self._costs = made if math.isinf(back) else csr_array(back * either - (back - 1) * made)
        self._slopes = slopes(self.places, either)
        self._tree = cKDTree(self.places)
        # For some goals (rows), at every place (columns): 1, the way that is left, its direction;
        # zeros where no way is known, as at the last place, which is none.
        self._table = np.zeros((0, k + 1, 2 + dim), np.float32)
        self._row = np.full(k, -1)  # by the place nearest to the goal
        self._asked, self._ends = np.empty(0, np.int64), np.empty(0, np.int64)  # by a goal's key
        if goals is not None and len(a):
            self._rows_of(goals)

    def ways(self, places: FloatArray, goals: FloatArray) -> Ways:
        """The ways from places to goals, both (n, goal_dim): to the place visited that is nearest
        to the goal, and straight on from there. Straight lines where nothing is known."""
        offsets = goals - places
        straight = np.sqrt(squared(offsets))
        if self.cfg.way == "straight" or not self._costs.nnz or not len(places):
            return Ways(straight, unit(offsets))
        rows, ends = self._rows_of(goals)
        corners, weights = self._around(places)
        width = self._table.shape[1]
        np.minimum(corners, width - 1, out=corners)  # new since the last refresh
        corners += (rows * width)[:, None]  # -1 is the end of the row before: as empty as any
        known = self._table.reshape(-1, self._table.shape[2]).take(corners, axis=0)
        mean = np.einsum("nc,ncf->nf", weights, known)
        recalled, last_leg = mean[:, 1] / np.maximum(mean[:, 0], 1e-30), goals - self.places[ends]
        left = recalled + np.sqrt(squared(last_leg))
        along = recalled[:, None] * unit(mean[:, 2:]) + last_leg
        # The goal is where one sees it: near and in sight, from the end of what is known on, and
        # where no way leads or nobody has been, so that 0 m are (optimism, which finds short cuts).
        cell = self.cfg.cell
        as_seen = (straight < self.near) & (left < AROUND * straight + 2 * cell)
        as_seen |= (recalled < 2 * cell) | (straight < cell)
        turned = as_seen | (squared(along) < 1e-12)
        along[turned] = offsets[turned]
        return Ways(np.where(as_seen, straight, left), unit(along))

    def heading(self, places: FloatArray, goals: FloatArray) -> FloatArray:
        """Offsets from places to goals, (n, goal_dim) each, along the way: as far as the way is
        long, in the direction in which it begins."""
        ways = self.ways(places, goals)
        return np.asarray(ways.directions * ways.left[:, None])

    def tabulated(self) -> Tabulated:
        """All ways, as they are since the last refresh.

        Raises:
            UsageError: if those are too many to be written down.
        """
        k, points = len(self), int(np.prod(self._sides))
        if k * k > MOST or points > MOST:
            raise UsageError(f"the ways between {k} places of {points} are too many for a table")
        keys = np.arange(points)
        numbers = self._find(keys)
        rows, ends = self._rows_of(self._points(keys))
        order = np.zeros(k, np.int64)
        order[ends] = rows
        return Tabulated(
            self._low,
            self._high,
            self._strides,
            np.where(numbers < 0, k, numbers),
            ends,
            self.places,
            self._table[order],
        )

    def state_dict(self) -> dict[str, Tensor]:
        """The places and the moves; ways follow from them."""
        moves = self.moves.tocoo()
        columns = {"keys": self._keys, "from": moves.row, "to": moves.col, "count": moves.data}
        columns["lattice"] = np.array([*self._low, *self._high, self.cfg.cell])
        return {name: torch.from_numpy(np.asarray(column)) for name, column in columns.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take over what `state_dict` gave, and refresh.

        Raises:
            ValueError: if those are no places and moves.
        """
        keys, a, b, count = (state[name].numpy() for name in ("keys", "from", "to", "count"))
        if not torch.equal(state["lattice"], self.state_dict()["lattice"]):
            raise ValueError("its places are those of another box or of another --places.cell")
        if len(np.unique(keys)) < len(keys) or (keys // self._sides.prod()).any():
            raise ValueError("places visited are none of its lattice")
        if not np.isfinite(count).all():
            raise ValueError("a count of moves is not finite")
        self.moves = csr_array((count, (a, b)), shape=(len(keys), len(keys)))
        self._number(keys.astype(np.int64))
        self.refresh()

    # The lattice.

    def _number(self, keys: Nodes) -> None:
        """Number the places by their order in `keys`, (K,)."""
        self._keys = keys
        self._order = np.argsort(keys)
        self._sorted = keys[self._order]
        self._list = np.full(points if (points := self._sides.prod()) <= LISTED else 0, -1)
        if len(self._list):
            self._list[keys] = np.arange(len(keys))
        self.places = self._points(keys)

    def _visit(self, keys: Nodes) -> None:
        """Give the places with those keys, (n,), numbers, if they have none."""
        new = np.setdiff1d(keys, self._keys)
        if len(new):
            self._number(np.concatenate([self._keys, new]))

    def _on_lattice(self, points: FloatArray) -> FloatArray:
        """Points (..., goal_dim) in units of the lattice, those outside of the box on its rim."""
        return (np.fmin(np.fmax(points, self._low), self._high) - self._low) / self.cfg.cell

    def _keys_of(self, points: FloatArray) -> Nodes:
        """Keys of the places nearest to points, (..., goal_dim) -> (...)."""
        return np.asarray(np.rint(self._on_lattice(points)).astype(np.int64) @ self._strides)

    def _points(self, keys: Nodes) -> FloatArray:
        """Where they are, (n,) -> (n, goal_dim)."""
        return self._low + self.cfg.cell * (keys[:, None] // self._strides % self._sides)

    def _find(self, keys: Nodes) -> Nodes:
        """Numbers of the places with those keys, -1 for those never visited."""
        if len(self._list):
            return self._list[keys]
        if not len(self._keys):
            return np.full(keys.shape, -1)
        at = np.minimum(np.searchsorted(self._sorted, keys), len(self._keys) - 1)
        return np.where(self._sorted[at] == keys, self._order[at], -1)

    def _around(self, points: FloatArray) -> tuple[Nodes, Float32]:
        """Points (n, goal_dim) as weighted means of the corners of Kuhn's simplex around each (as
        Davies 1997 interpolates), goal_dim + 1 of them, not all of which were visited.

        Returns:
            Their numbers and their weights, each (n, goal_dim + 1).
        """
        x = self._on_lattice(points)
        first = x.astype(np.int64)
        behind = first - x
        order = np.argsort(behind, axis=1)  # the axis along which it is farthest comes first
        weights = np.ones((len(x), x.shape[1] + 1), np.float32)
        np.negative(np.sort(behind, axis=1), out=weights[:, 1:])
        weights[:, :-1] -= weights[:, 1:]
        keys = np.zeros(weights.shape, np.int64)
        self._strides[order].cumsum(axis=1, out=keys[:, 1:])
        keys += (first @ self._strides)[:, None]
        return self._find(keys), weights

    # The ways.

    def _rows_of(self, goals: FloatArray) -> tuple[Nodes, Nodes]:
        """Rows of the table for goals (n, goal_dim), and the nearest places visited, (n,) each.
        Rows that are missing are made."""
        keys = self._keys_of(goals)
        at = np.minimum(np.searchsorted(self._asked, keys), len(self._asked) - 1)
        if not len(self._asked) or (self._asked[at] != keys).any():
            if (len(self._table) + len(keys)) * len(self) > MOST:  # anew, of what is asked now
                self._asked, self._table = self._asked[:0], self._table[:0]
                self._row[:] = -1
            self._asked = np.union1d(self._asked, keys)
            self._ends = self._tree.query(self._points(self._asked))[1]
            self._search(np.unique(self._ends[self._row[self._ends] < 0]))
            at = np.searchsorted(self._asked, keys)
        ends = self._ends[at]
        return self._row[ends], ends

    def _search(self, ends: Nodes) -> None:
        """Unroll the moves backward from those places, and put what comes of it into the table."""
        new = np.zeros((len(ends), *self._table.shape[1:]), np.float32)
        some = max(1, AT_ONCE // max(1, len(self)))
        for begin in range(0, len(ends), some):
            rows = slice(begin, begin + some)
            left = dijkstra(self._costs.T, indices=ends[rows])
            with np.errstate(invalid="ignore"):  # beside places from where no way leads there
                down = np.stack([-(slope @ left.T).T for slope in self._slopes], axis=2)
            down[~np.isfinite(down).all(axis=2)] = 0.0
            new[rows, :-1, 0] = np.isfinite(left)
            new[rows, :-1, 1] = np.where(np.isfinite(left), left, 0.0)
            new[rows, :-1, 2:] = unit(down)
        self._row[ends] = len(self._table) + np.arange(len(ends))
        self._table = np.concatenate([self._table, new])


def lattice(low: FloatArray, high: FloatArray, cfg: PlacesConfig) -> NDArray[np.int64]:
    """How many points the lattice has along each side of a box, (goal_dim,).

    Raises:
        UsageError: for settings that make no sense, or make it too fine.
    """
    require(cfg)
    if problem := cfg.problem():
        raise UsageError(problem)
    sides = np.ceil((high - low) / cfg.cell) + 2
    if np.prod(sides) > 2**62:
        raise UsageError(f"a cell of {cfg.cell} divides that box too finely")
    return sides.astype(np.int64)


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors (..., goal_dim) of length 1; zero stays zero."""
    length = np.sqrt(squared(vectors))
    return np.asarray(vectors / np.maximum(length, 1e-9)[..., None])


def squared(vectors: FloatArray) -> FloatArray:
    """Their squared lengths, (..., goal_dim) -> (...), not a number where they are not finite."""
    return np.asarray(np.einsum("...d,...d->...", vectors, vectors))


def slopes(places: FloatArray, neighbours: csr_array) -> list[csr_array]:
    """What takes numbers at places to the slope of the plane through them and their neighbours'
    (least squares), a sparse matrix (K, K) for each axis.

    Args:
        places: (K, goal_dim).
        neighbours: (K, K), symmetric, not zero where two are neighbours.
    """
    k, dim = places.shape
    a, b = neighbours.nonzero()
    steps = places[b] - places[a]
    spread = np.zeros((k, dim, dim))
    np.add.at(spread, a, steps[:, :, None] * steps[:, None, :])
    # Neighbours in a row have a slope along it only.
    spread += 1e-6 * spread.max(initial=1e-12) * np.eye(dim)
    weights = np.einsum("nij,nj->ni", np.linalg.inv(spread)[a], steps)
    matrices = []
    for column in weights.T:
        rise = csr_array((column, (a, b)), shape=(k, k))
        matrices.append(csr_array(rise - diags_array(rise.sum(axis=1))))
    return matrices
