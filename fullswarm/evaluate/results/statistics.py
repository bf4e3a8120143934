"""Statistics of trials: description with intervals, and paired comparison by seed.

SciPy computes the intervals, the sign test and the ranks. The p of the signed-rank test (Wilcoxon 1945) is counted
here, because SciPy's exact form does not allow for ties; Kerby 2014 for the rank-biserial correlation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import MissingExtra

CONFIDENCE = 0.95
EXACT_PAIRS = 200
"""Above this many pairs that differ the signed-rank test uses the normal approximation."""

Values = Sequence[float] | NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Described:
    """A sample; `low` and `high` bound the mean. One value: the interval is unknown, NaN."""

    count: int
    mean: float
    low: float
    high: float
    median: float
    lower_quartile: float
    upper_quartile: float
    minimum: float
    maximum: float


@dataclass(frozen=True, slots=True)
class Paired:
    """Differences b - a of n pairs."""

    count: int
    mean_a: float
    mean_b: float
    mean_difference: float
    low: float  # of the mean difference
    high: float
    dz: float | None  # Cohen's: mean over standard deviation of the differences; None: they do not vary
    rank_biserial: float  # -1: b is smaller in every pair that differs; 1: larger
    wilcoxon_p: float  # signed-rank, two-sided
    sign_p: float  # two-sided
    less: int  # pairs with b < a
    equal: int
    more: int


def describe(
    values: Values, confidence: float = CONFIDENCE, at_least: float = -math.inf, at_most: float = math.inf
) -> Described:
    """Return the description of a sample; values that are not finite are left out.

    Parameters
    ----------
    values : shape (n,)
    at_least, at_most : values that the quantity can have; the interval of its mean ends there

    Raises
    ------
    MissingExtra
        SciPy is not installed.
    """
    sample = np.asarray(values, np.float64)
    sample = sample[np.isfinite(sample)]
    if not sample.size:
        return Described(0, *(math.nan,) * 8)
    lower, median, upper = np.percentile(sample, (25.0, 50.0, 75.0)).tolist()
    mean, low, high = _mean_interval(sample, confidence)
    if not math.isnan(low):
        low, high = max(low, at_least), min(high, at_most)
    return Described(sample.size, mean, low, high, median, lower, upper, float(sample.min()), float(sample.max()))


def wilson(successes: int, total: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the interval of a share of which `successes` of `total` were found; (0, 1) when `total` is 0.

    Raises
    ------
    MissingExtra
        SciPy is not installed.
    """
    if total <= 0:
        return 0.0, 1.0
    found = _scipy_stats().binomtest(successes, total).proportion_ci(confidence, method="wilson")
    return float(found.low), float(found.high)


def paired(a: Values, b: Values, confidence: float = CONFIDENCE) -> Paired:
    """Compare pairs (a[i], b[i]); pairs with a value that is not finite are left out.

    Parameters
    ----------
    a, b : shape (n,) each

    Raises
    ------
    ValueError
        They are not of the same length.
    MissingExtra
        SciPy is not installed.
    """
    first, second = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if first.shape != second.shape:
        raise ValueError(f"pairs need as many values on both sides, not {first.size} and {second.size}")
    known = np.isfinite(first) & np.isfinite(second)
    first, second = first[known], second[known]
    difference = second - first
    # What the subtraction of equal decimals leaves is no difference.
    scale = np.maximum(np.abs(first), np.abs(second))
    difference[np.abs(difference) <= 1e-12 * scale] = 0.0
    if not difference.size:
        return Paired(0, *(math.nan,) * 5, None, 0.0, 1.0, 1.0, 0, 0, 0)
    mean, low, high = _mean_interval(difference, confidence)
    less, more = int((difference < 0.0).sum()), int((difference > 0.0).sum())
    spread = float(difference.std(ddof=1)) if difference.size > 1 else 0.0
    rank_biserial, wilcoxon_p = _signed_ranks(difference[difference != 0.0])
    return Paired(
        count=difference.size,
        mean_a=float(first.mean()),
        mean_b=float(second.mean()),
        mean_difference=mean,
        low=low,
        high=high,
        dz=mean / spread if spread > 1e-12 * max(abs(mean), 1e-300) else None,
        rank_biserial=rank_biserial,
        wilcoxon_p=wilcoxon_p,
        sign_p=_sign_p(less, more),
        less=less,
        equal=difference.size - less - more,
        more=more,
    )


def _mean_interval(sample: NDArray[np.float64], confidence: float) -> tuple[float, float, float]:
    """Return the mean and its interval by Student's t."""
    mean = float(sample.mean())
    if sample.size < 2:
        return mean, math.nan, math.nan
    quantile = float(_scipy_stats().t.ppf(0.5 + 0.5 * confidence, sample.size - 1))
    half = quantile * float(sample.std(ddof=1)) / math.sqrt(sample.size)
    return mean, mean - half, mean + half


def _sign_p(less: int, more: int) -> float:
    return float(_scipy_stats().binomtest(less, less + more).pvalue) if less + more else 1.0


def _signed_ranks(difference: NDArray[np.float64]) -> tuple[float, float]:
    """Return the rank-biserial correlation and the p of the signed-rank test, for differences without zeros."""
    if not difference.size:
        return 0.0, 1.0
    doubled = (2.0 * _scipy_stats().rankdata(np.round(np.abs(difference), 12))).astype(np.int64)
    total, positive = int(doubled.sum()), int(doubled[difference > 0.0].sum())
    least = min(positive, total - positive)
    if difference.size <= EXACT_PAIRS:
        ways = [0] * (total + 1)
        ways[0] = 1
        reach = 0
        for rank in doubled.tolist():
            reach += rank
            for at in range(reach, rank - 1, -1):
                ways[at] += ways[at - rank]
        p = float(2 * sum(ways[: least + 1]) / 2**difference.size)
    else:
        z = (least - 0.5 * total) / math.sqrt(0.25 * float((doubled.astype(np.float64) ** 2).sum()))
        p = 2.0 * NormalDist().cdf(z)
    return (2 * positive - total) / total, min(1.0, p)


def _scipy_stats() -> Any:
    try:
        from scipy import stats
    except ImportError as error:
        raise MissingExtra("statistics need SciPy", hint="pip install 'fullswarm[experiments]'") from error
    return stats
