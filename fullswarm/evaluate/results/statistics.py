"""Statistics of trials: description with intervals, and comparison, paired by seed or of two groups.

Intervals that hold for few trials (docs/decisions/0082): Student's t for means, Wilson 1927 for shares, order
statistics for medians (Conover 1999, 3.2), Hodges and Lehmann 1963 for the shift of pairs, Welch 1947 for two groups;
no bootstrap. What does not vary has no interval of its mean: its variance is not known to be zero. SciPy computes the
quantiles, the sign test and the ranks. The p of the signed-rank test (Wilcoxon 1945) is counted here, because SciPy's
exact form does not allow for ties; Kerby 2014 for the rank-biserial correlation, Holm 1979 for several tests.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import MissingExtra

CONFIDENCE = 0.95
EXACT_PAIRS = 200
"""Above this many pairs that differ the signed-rank test uses the normal approximation."""
WALSH_PAIRS = 1000
"""Above this many pairs the Hodges-Lehmann shift is not computed: it needs the means of all pairs of differences."""

Values = Sequence[float] | NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Described:
    """A sample; `low` and `high` bound the mean. One value, or values that do not vary: unknown, NaN."""

    count: int
    mean: float
    low: float
    high: float
    median: float
    median_low: float  # exact; NaN below six values, of which no two bound the median with 95 %
    median_high: float
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
    shift: float  # Hodges-Lehmann: median of the means of all pairs of differences
    shift_low: float  # NaN below six pairs
    shift_high: float
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
        return Described(0, *(math.nan,) * 10)
    lower, median, upper = np.percentile(sample, (25.0, 50.0, 75.0)).tolist()
    mean, low, high = _mean_interval(sample, confidence)
    if not math.isnan(low):
        low, high = max(low, at_least), min(high, at_most)
    bounds = _scipy_stats().quantile_test(sample, q=median, p=0.5).confidence_interval(confidence)
    return Described(
        sample.size, mean, low, high, median, float(bounds.low), float(bounds.high), lower, upper,
        float(sample.min()), float(sample.max()),
    )  # fmt: skip


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
        return Paired(0, *(math.nan,) * 8, None, 0.0, 1.0, 1.0, 0, 0, 0)
    mean, low, high = _mean_interval(difference, confidence)
    less, more = int((difference < 0.0).sum()), int((difference > 0.0).sum())
    spread = float(difference.std(ddof=1)) if difference.size > 1 else 0.0
    rank_biserial, wilcoxon_p = _signed_ranks(difference[difference != 0.0])
    shift, shift_low, shift_high = _shift(difference, confidence)
    return Paired(
        count=difference.size,
        mean_a=float(first.mean()),
        mean_b=float(second.mean()),
        mean_difference=mean,
        low=low,
        high=high,
        shift=shift,
        shift_low=shift_low,
        shift_high=shift_high,
        dz=mean / spread if spread > 1e-12 * max(abs(mean), 1e-300) else None,
        rank_biserial=rank_biserial,
        wilcoxon_p=wilcoxon_p,
        sign_p=_sign_p(less, more),
        less=less,
        equal=difference.size - less - more,
        more=more,
    )


def two_groups(a: Values, b: Values, confidence: float = CONFIDENCE) -> tuple[float, float, float]:
    """Return mean(b) - mean(a) of two groups without partners, and its interval by Welch's t.

    Parameters
    ----------
    a, b : shape (n,) and (m,); values that are not finite are left out

    Returns
    -------
    tuple
        Difference, low, high; the interval is NaN when a group has fewer than two values, or neither varies.

    Raises
    ------
    MissingExtra
        SciPy is not installed.
    """
    first, second = (each[np.isfinite(each)] for each in (np.asarray(a, np.float64), np.asarray(b, np.float64)))
    if not first.size or not second.size:
        return math.nan, math.nan, math.nan
    difference = float(second.mean() - first.mean())
    if min(first.size, second.size) < 2 or (_is_constant(first) and _is_constant(second)):
        return difference, math.nan, math.nan
    # Not scipy.stats.ttest_ind, which warns when one of the groups does not vary.
    parts = [float(each.var(ddof=1)) / each.size for each in (first, second)]
    below = sum(part**2 / (each.size - 1) for part, each in zip(parts, (first, second), strict=True))
    if not below > 0.0:  # variances that are too small for a number
        return difference, math.nan, math.nan
    freedom = sum(parts) ** 2 / below
    half = float(_scipy_stats().t.ppf(0.5 + 0.5 * confidence, freedom)) * math.sqrt(sum(parts))
    return difference, difference - half, difference + half


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p values corrected for their number (Holm 1979): one error of the first kind among all at most."""
    order = sorted(range(len(p_values)), key=lambda place: p_values[place])
    corrected, largest = [0.0] * len(p_values), 0.0
    for rank, place in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[place]))
        corrected[place] = largest
    return corrected


def _mean_interval(sample: NDArray[np.float64], confidence: float) -> tuple[float, float, float]:
    """Return the mean and its interval by Student's t."""
    mean = float(sample.mean())
    if sample.size < 2 or _is_constant(sample):
        return mean, math.nan, math.nan
    quantile = float(_scipy_stats().t.ppf(0.5 + 0.5 * confidence, sample.size - 1))
    half = quantile * float(sample.std(ddof=1)) / math.sqrt(sample.size)
    return mean, mean - half, mean + half


def _is_constant(sample: NDArray[np.float64]) -> bool:
    return bool(np.ptp(sample) <= 1e-12 * np.abs(sample).max())


def _shift(difference: NDArray[np.float64], confidence: float) -> tuple[float, float, float]:
    """Return the Hodges-Lehmann shift and its interval, the inversion of the signed-rank test."""
    n = difference.size
    if n > WALSH_PAIRS:
        return math.nan, math.nan, math.nan
    rows, columns = np.triu_indices(n)
    walsh = np.sort(0.5 * (difference[rows] + difference[columns]))
    middle = float(np.median(walsh))
    place = _shift_place(n, confidence)
    if place < 1:
        return middle, math.nan, math.nan
    return middle, float(walsh[place - 1]), float(walsh[walsh.size - place])


@cache
def _shift_place(n: int, confidence: float) -> int:
    """Return which of the ordered means bounds the shift; 0: none, there are too few pairs.

    It is the largest k for which the sum of signed ranks is below k with probability (1 - confidence) / 2 at most.
    """
    tail = 0.5 * (1.0 - confidence)
    total = n * (n + 1) // 2
    if n > EXACT_PAIRS:
        z = NormalDist().inv_cdf(tail)
        return max(0, math.floor(0.5 * total + z * math.sqrt(total * (2 * n + 1) / 12.0)))
    share = np.zeros(total + 1)
    share[0] = 1.0
    for rank in range(1, n + 1):
        with_rank = np.zeros_like(share)
        with_rank[rank:] = share[:-rank]
        share = 0.5 * (share + with_rank)
    return int(np.searchsorted(np.cumsum(share), tail, side="right"))


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
