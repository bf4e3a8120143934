"""Statistics against SciPy and against known values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from fullswarm.evaluate.results.statistics import describe, holm, paired, two_groups, wilson

COUNTS = st.lists(st.integers(0, 6), min_size=1, max_size=12)
REALS = st.lists(st.floats(-1e3, 1e3, allow_nan=False), min_size=2, max_size=30)


def test_description_of_a_known_sample() -> None:
    found = describe([1.0, 2.0, 3.0, 4.0, math.nan])
    assert (found.count, found.mean, found.median, found.minimum, found.maximum) == (4, 2.5, 2.5, 1.0, 4.0)
    assert (found.lower_quartile, found.upper_quartile) == (1.75, 3.25)
    # t(3, 0.975) = 3.18245, s = 1.29099
    assert found.high - found.mean == pytest.approx(3.18245 * 1.29099 / 2.0, rel=1e-5)


@given(REALS)
def test_the_interval_is_student_s(values: list[float]) -> None:
    found = describe(values)
    if np.std(values) > 1e-6:
        low, high = stats.t.interval(0.95, len(values) - 1, np.mean(values), stats.sem(values))
        assert found.low == pytest.approx(low, rel=1e-6, abs=1e-6)
        assert found.high == pytest.approx(high, rel=1e-6, abs=1e-6)
        assert found.low <= found.mean <= found.high


def test_what_does_not_vary_has_no_interval_of_its_mean() -> None:
    for values in ([0.0] * 5, [2.5] * 3, [7.0]):
        found = describe(values)
        assert found.mean == values[0]
        assert math.isnan(found.low)
        assert math.isnan(found.high)
    assert math.isnan(paired([1.0, 2.0], [0.0, 1.0]).low)
    assert math.isnan(two_groups([1.0, 1.0], [2.0, 2.0])[1])


def test_of_one_value_the_interval_is_unknown_and_of_none_everything() -> None:
    assert describe([3.0]).mean == 3.0
    assert math.isnan(describe([3.0]).low)
    assert describe([]).count == 0
    assert math.isnan(describe([]).mean)
    assert describe([0.0, 0.0, 9.0]).low < 0.0
    assert describe([0.0, 0.0, 9.0], at_least=0.0).low == 0.0


def test_wilson_intervals() -> None:
    assert wilson(10, 20) == pytest.approx((0.29930, 0.70070), abs=1e-4)
    assert wilson(0, 20) == pytest.approx((0.0, 0.16113), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)


@given(st.integers(1, 200), st.data())
def test_wilson_is_scipy_s(total: int, data: st.DataObject) -> None:
    count = data.draw(st.integers(0, total))
    known = stats.binomtest(count, total).proportion_ci(method="wilson")
    assert wilson(count, total) == pytest.approx((known.low, known.high), abs=1e-9)


def test_a_known_pair() -> None:
    found = paired([5.0, 3.0, 8.0, 4.0], [1.0, 3.0, 2.0, 3.0])
    assert (found.count, found.less, found.equal, found.more) == (4, 3, 1, 0)
    assert (found.mean_a, found.mean_b, found.mean_difference) == (5.0, 2.25, -2.75)
    assert found.dz == pytest.approx(-2.75 / np.std([-4, 0, -6, -1], ddof=1))
    assert found.rank_biserial == -1.0
    assert found.sign_p == 0.25
    assert found.wilcoxon_p == 0.25


@pytest.mark.parametrize("values", [[0.0], [0.0] * 20, [0.1, 0.2, 0.3], [1e300, -1e300]])
def test_equal_pairs_differ_in_nothing(values: list[float]) -> None:
    found = paired(values, values)
    assert (found.mean_difference, found.rank_biserial, found.dz) == (0.0, 0.0, None)
    assert (found.wilcoxon_p, found.sign_p, found.equal) == (1.0, 1.0, len(values))


def test_a_constant_difference_has_no_cohen() -> None:
    found = paired([1.1, 2.2, 3.3], [2.1, 3.2, 4.3])
    assert found.dz is None
    assert found.rank_biserial == 1.0


def test_no_pairs_and_unequal_sides() -> None:
    assert paired([], []).count == 0
    assert paired([math.nan, 1.0], [1.0, math.nan]).count == 0
    assert paired([], []).wilcoxon_p == 1.0
    with pytest.raises(ValueError, match="as many values"):
        paired([1.0], [])


@given(st.permutations(range(1, 13)), st.lists(st.sampled_from([-1.0, 1.0]), min_size=12, max_size=12))
def test_without_ties_the_signed_rank_test_is_scipy_s(sizes: list[int], signs: list[float]) -> None:
    difference = np.array(sizes) * np.array(signs)
    known = stats.wilcoxon(difference, method="exact")
    assert paired(np.zeros(12), difference).wilcoxon_p == pytest.approx(known.pvalue)


@given(COUNTS, st.data())
def test_with_ties_it_is_the_count_of_all_signs(a: list[int], data: st.DataObject) -> None:
    b = data.draw(st.lists(st.integers(0, 6), min_size=len(a), max_size=len(a)))
    difference = np.array([two - one for one, two in zip(a, b, strict=True) if one != two], float)
    found = paired([float(each) for each in a], [float(each) for each in b])
    if not difference.size:
        assert found.wilcoxon_p == 1.0
        return
    ranks = stats.rankdata(np.abs(difference))
    signs = (np.arange(2**difference.size)[:, None] >> np.arange(difference.size)) & 1
    sums = signs @ ranks
    seen = min(ranks[difference > 0].sum(), ranks[difference < 0].sum())
    assert found.wilcoxon_p == pytest.approx(min(1.0, 2.0 * float(np.mean(sums <= seen + 1e-9))))


@given(st.integers(0, 40), st.integers(0, 40))
def test_the_sign_test_is_scipy_s(less: int, more: int) -> None:
    if less + more:
        found = paired(np.zeros(less + more), np.array([-1.0] * less + [1.0] * more))
        assert found.sign_p == pytest.approx(stats.binomtest(less, less + more).pvalue)


def test_many_pairs_use_the_normal_approximation() -> None:
    difference = np.random.default_rng(3).normal(0.1, 1.0, 400)
    known = stats.wilcoxon(difference, method="approx", correction=False)
    assert paired(np.zeros(400), difference).wilcoxon_p == pytest.approx(known.pvalue, rel=1e-6)


# Coverage: which share of samples has an interval that holds the true value. The seeds are fixed; the samples are drawn
# and the true values known here, without the code under test. With 95 % and 300 samples the share is within
# 95 % +- 3.8 %: three standard deviations.
SAMPLES, SLACK = 300, 0.038


@pytest.mark.parametrize("n", [3, 5, 9])
def test_the_mean_s_interval_holds_it_in_95_percent_of_small_samples(n: int) -> None:
    rng = np.random.default_rng(n)
    found = [describe(rng.normal(1.0, 2.0, n)) for _ in range(SAMPLES)]
    assert np.mean([each.low <= 1.0 <= each.high for each in found]) == pytest.approx(0.95, abs=SLACK)


def test_the_mean_s_interval_of_few_counts_is_not_too_short() -> None:
    rng = np.random.default_rng(5)
    found = [describe(rng.poisson(3.0, 5).astype(float)) for _ in range(SAMPLES)]
    known = [each for each in found if not math.isnan(each.low)]
    assert np.mean([each.low <= 3.0 <= each.high for each in known]) >= 0.95 - SLACK


@pytest.mark.parametrize("n", [6, 9, 20])
def test_the_median_s_and_the_shift_s_intervals_hold_at_least_95_percent(n: int) -> None:
    rng = np.random.default_rng(n)
    medians = [describe(rng.exponential(1.0, n)) for _ in range(SAMPLES)]
    assert np.mean([each.median_low <= math.log(2.0) <= each.median_high for each in medians]) >= 0.95 - SLACK
    shifts = [paired(np.zeros(n), rng.normal(1.0, 2.0, n)) for _ in range(SAMPLES)]
    assert np.mean([each.shift_low <= 1.0 <= each.shift_high for each in shifts]) >= 0.95 - SLACK


def test_welch_s_interval_holds_when_the_groups_vary_unlike() -> None:
    rng = np.random.default_rng(2)
    found = [two_groups(rng.normal(0.0, 1.0, 5), rng.normal(1.0, 4.0, 8)) for _ in range(SAMPLES)]
    assert np.mean([low <= 1.0 <= high for _, low, high in found]) == pytest.approx(0.95, abs=SLACK)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_wilson_s_interval_of_ten_trials_by_all_outcomes(share: float) -> None:
    # Its coverage is computed, not drawn: the sum of the binomial probabilities of outcomes whose interval holds.
    held = [low <= share <= high for low, high in (wilson(k, 10) for k in range(11))]
    covered = float(np.dot(stats.binom.pmf(np.arange(11), 10, share), held))
    assert covered >= 0.92


def test_the_shift_of_a_known_sample() -> None:
    # Hollander and Wolfe 1999, table 3.1, depression scale: R's wilcox.test(conf.int = TRUE) gives -0.46 and
    # an interval from -0.786 to -0.010 at 95 %.
    before = [1.83, 0.50, 1.62, 2.48, 1.68, 1.88, 1.55, 3.06, 1.30]
    after = [0.878, 0.647, 0.598, 2.05, 1.06, 1.29, 1.06, 3.14, 1.29]
    found = paired(before, after)
    assert found.shift == pytest.approx(-0.46)
    assert (found.shift_low, found.shift_high) == pytest.approx((-0.786, -0.010))


def test_few_values_bound_no_median() -> None:
    found = describe([1.0, 2.0, 3.0, 4.0, 5.0])
    assert math.isnan(found.median_low)
    assert math.isnan(paired([0.0] * 5, [1.0, 2.0, 3.0, 4.0, 5.0]).shift_low)
    six = describe([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert (six.median_low, six.median_high) == (1.0, 6.0)


def test_many_pairs_have_a_shift_of_the_normal_approximation() -> None:
    difference = np.random.default_rng(4).normal(0.3, 1.0, 300)
    found = paired(np.zeros(300), difference)
    assert found.shift_low < 0.3 < found.shift_high
    assert found.shift_high - found.shift_low == pytest.approx(found.high - found.low, rel=0.15)
    assert math.isnan(paired(np.zeros(1001), np.arange(1001.0)).shift)


def test_holm_against_known_values() -> None:
    # R: p.adjust(c(0.01, 0.04, 0.03, 0.005), "holm")
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


@given(REALS, REALS)
def test_two_groups_are_scipy_s_welch(a: list[float], b: list[float]) -> None:
    difference, low, high = two_groups(a, b)
    assert difference == pytest.approx(np.mean(b) - np.mean(a), abs=1e-9)
    if np.std(a) > 1e-3 and np.std(b) > 1e-3:
        known = stats.ttest_ind(b, a, equal_var=False).confidence_interval()
        assert (low, high) == pytest.approx((known.low, known.high), rel=1e-6)
