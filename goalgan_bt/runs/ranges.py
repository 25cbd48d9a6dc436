"""What values a setting may have, said at the setting itself.

    max_kl: Annotated[float, ABOVE_ZERO] = 0.03

A range counts for a number, for each number of a tuple, and not for None. The kinds themselves
(whole numbers, a choice of words) are checked too: settings come from JSON and from Python as well
as from a command line.
"""

import math
import types
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from numbers import Integral, Real
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from goalgan_bt.runs.errors import UsageError

Corner = NDArray[np.floating]
SANE = 1e12  # no count, length or rate of ours is larger


@dataclass(frozen=True)
class Range:
    """words: what a number in it is; low <= x <= high, or, with `above`, low < x; `endless`:
    whether infinity is in it."""

    words: str
    low: float
    high: float = SANE
    above: bool = False
    endless: bool = False

    def problem(self, x: Any) -> str | None:
        """What is wrong with a number; None if it is in the range."""
        if self.endless and x == math.inf:
            return None
        if not self.low <= x or (self.above and x == self.low):  # not a number is in none
            return f"must be {self.words}, not {x}"
        if x <= self.high:
            return None
        if self.high < SANE:
            return f"must be {self.words}, not {x}"
        return f"must be {'finite' if x == math.inf else 'a sane number'}, not {x}"


ABOVE_ZERO = Range("greater than 0", 0, above=True)
ABOVE_ZERO_OR_INFINITE = Range("greater than 0", 0, above=True, endless=True)
NOT_NEGATIVE = Range("0 or more", 0)
SHARE = Range("between 0 and 1", 0, 1)
SHARE_ABOVE_ZERO = Range("greater than 0 and at most 1", 0, 1, above=True)


def between(low: float, high: float) -> Range:
    """The numbers from low to high."""
    return Range(f"between {low:,} and {high:,}".replace(",", ""), low, high)


def faults(settings: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Name (with dots) and problem of each setting of a dataclass that is out of its range."""
    hints = get_type_hints(type(settings), include_extras=True)
    for field in fields(settings):
        name, value = prefix + field.name, getattr(settings, field.name)
        if is_dataclass(value):
            yield from faults(value, f"{name}.")
        elif problem := _problem(hints[field.name], value):
            yield name, problem


def require(settings: Any) -> None:
    """Refuse settings that are out of their ranges.

    Raises:
        UsageError: naming the first such setting.
    """
    for name, problem in faults(settings):
        raise UsageError(f"{name} {problem}")


def require_whole(name: str, number: Any, least: int) -> None:
    """Refuse what is no whole number, or too small a one.

    Raises:
        UsageError: naming it.
    """
    if isinstance(number, bool) or not isinstance(number, Integral) or number < least:
        raise UsageError(f"{name} must be a whole number from {least} on, not {number!r}")


def require_box(low: ArrayLike, high: ArrayLike) -> tuple[Corner, Corner]:
    """The corners of a box as arrays.

    Raises:
        UsageError: if they are none.
    """
    corners = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    shapes = corners[0].shape, corners[1].shape
    if shapes[0] != shapes[1] or len(shapes[0]) != 1 or not shapes[0][0]:
        raise UsageError(f"low and high must be the corners of a box, not of shapes {shapes}")
    with np.errstate(over="ignore"):
        finite = np.isfinite([*corners, corners[1] - corners[0]]).all()
    if not (finite and (corners[0] < corners[1]).all()):
        raise UsageError(
            "low must be less than high in every dimension, and both finite, to be corners of a box"
        )
    return corners


def _problem(hint: Any, value: Any) -> str | None:
    """What is wrong with a value of that annotation."""
    if get_origin(hint) is Annotated:
        kind, *marks = get_args(hint)
    else:
        kind, marks = hint, []
    kinds = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
    if value is None and types.NoneType in kinds:
        return None
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        return None if value in choices else f"must be one of {', '.join(choices)}, not {value!r}"
    number = next((k for k in kinds if k in (int, float)), None)
    if get_origin(kind) is tuple and isinstance(value, tuple | list):
        number, values = get_args(kind)[0], tuple(value)
    else:
        values = (value,)
    for x in values if number in (int, float) else ():
        words, accepted = ("a whole number", Integral) if number is int else ("a number", Real)
        if not isinstance(x, accepted) or isinstance(x, bool):
            return f"must be {words}, not {x!r}"
        for mark in marks:
            if isinstance(mark, Range) and (problem := mark.problem(x)):
                return problem
    return None
