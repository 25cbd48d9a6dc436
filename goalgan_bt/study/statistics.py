"""What a study shows: interquartile means over seeds, bootstrap intervals, times to thresholds.

Statistics as in Agarwal et al. 2021 ("Deep RL at the edge of the statistical precipice"): the
interquartile mean, and percentile intervals of 95% from resampling the seeds of each environment
and method (environments are never mixed, so that is their stratified bootstrap).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from goalgan_bt.envs.maze import FloatArray

RESAMPLES = 5000


class Curve(NamedTuple):
    """One run: steps (n,) of training, values (n,) measured there: coverage, beginning with 0 at 0,
    or return."""

    steps: FloatArray
    values: FloatArray


class Interval(NamedTuple):
    """An estimate and its 95% interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        digits = 2 if abs(self.value) < 10 else 0  # of a coverage, of a return
        if np.isnan(self.low):
            return f"{self.value:.{digits}f}"
        return f"{self.value:.{digits}f} [{self.low:.{digits}f}, {self.high:.{digits}f}]"


def iqm(x: FloatArray, axis: int = 0) -> NDArray[np.float64]:
    """Interquartile mean: the mean without the lowest and the highest quarter."""
    return np.asarray(stats.trim_mean(x, 0.25, axis=axis))


def interval(x: FloatArray) -> Interval:
    """Interquartile mean of a sample (n,) and its bootstrap interval; NaN bounds for a single
    value."""
    if len(x) < 2:
        return Interval(float(iqm(x)), np.nan, np.nan)
    rows = np.random.default_rng(0).integers(len(x), size=(RESAMPLES, len(x)))
    low, high = np.percentile(iqm(x[rows], axis=1), [2.5, 97.5])
    return Interval(float(iqm(x)), float(low), float(high))


def band(curves: list[Curve], grid: FloatArray) -> FloatArray:
    """Interquartile mean over runs and its interval at each step of a grid, (n, 3), from the lines
    between reports. A run counts from its first report to its last; NaN where none is there."""
    gaps = {"left": np.nan, "right": np.nan}
    y = np.array([np.interp(grid, *curve, **gaps) for curve in curves])
    there = [column[np.isfinite(column)] for column in y.T]
    return np.array([interval(x) if len(x) else (np.nan,) * 3 for x in there])


def time_to(curve: Curve, threshold: float) -> float:
    """Steps at which the line through the reports first reaches a coverage; infinite if never."""
    above = np.flatnonzero(curve.values >= threshold)
    if len(above) == 0:
        return np.inf
    i = max(1, above[0])
    (x0, x1), (y0, y1) = curve.steps[i - 1 : i + 1], curve.values[i - 1 : i + 1]
    return float(x0 + (x1 - x0) * (threshold - y0) / (y1 - y0))


def area(curve: Curve) -> float:
    """Mean coverage or return over the run."""
    if len(curve.steps) == 1:
        return float(curve.values[0])
    return float(np.trapezoid(curve.values, curve.steps) / (curve.steps[-1] - curve.steps[0]))


def areas(seeds: dict[int, Curve]) -> FloatArray:
    """The area of each run of a method, (n,)."""
    return np.array([area(curve) for curve in seeds.values()])


def ends(seeds: dict[int, Curve]) -> FloatArray:
    """What each run of a method measured last, (n,)."""
    return np.array([curve.values[-1] for curve in seeds.values()])


class Ratio(NamedTuple):
    """estimate: geometric mean of times over another method's; reached: how many runs of ours and
    of theirs got there at all; n: pairs."""

    estimate: Interval
    reached: tuple[int, int]
    n: int

    def __str__(self) -> str:
        known = f"{self.estimate} " if min(self.reached) >= self.n / 2 else ""
        return f"{known}({self.reached[0]}, {self.reached[1]})"


def ratio(ours: list[Curve], theirs: list[Curve], threshold: float) -> Ratio:
    """Time to a threshold over another method's, paired. A run that never got there counts with
    all its steps, which is too little.

    The interval is Student's for the mean of the logarithms: with five pairs a bootstrap's of 95%
    would hold the truth in 85 of 100 cases.
    """
    pairs = [[time_to(curve, threshold) for curve in curves] for curves in (ours, theirs)]
    most = [[curve.steps[-1] for curve in curves] for curves in (ours, theirs)]
    of_ours, of_theirs = np.log(np.minimum(pairs, most))
    logs = paired(of_ours - of_theirs)
    a, b = (int(np.isfinite(times).sum()) for times in pairs)
    return Ratio(Interval(*np.exp(logs)), (a, b), len(ours))


def paired(differences: FloatArray) -> Interval:
    """Mean of paired differences (n,) and Student's interval; NaN bounds for a single one."""
    n, mean = len(differences), differences.mean()
    half = stats.t.ppf(0.975, n - 1) * differences.std(ddof=1) / np.sqrt(n) if n > 1 else np.nan
    return Interval(float(mean), float(mean - half), float(mean + half))
