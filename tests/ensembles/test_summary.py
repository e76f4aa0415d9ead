"""Summaries of checks: Wilson's interval and rank correlations against their definitions."""

import numpy as np
import pytest

from wholearm_jax.ensembles.summary import rank_correlations, wilson_interval


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (8, 10), (10, 10), (187, 200)])
def test_wilson_interval(successes, trials):
    """The bounds are the rates p with |successes/trials - p| = z sqrt(p (1 - p) / trials)."""
    z, rate = 1.959963984540054, successes / trials
    for bound, extreme in zip(wilson_interval(successes, trials), (0.0, 1.0), strict=True):
        if bound != extreme:
            assert abs(rate - bound) == pytest.approx(z * np.sqrt(bound * (1 - bound) / trials), rel=1e-9)
    assert wilson_interval(8, 10) == pytest.approx((0.4901625, 0.9433178), abs=1e-6)


def test_rank_correlations_of_ties_and_infinite_margins():
    """Equal values share the mean of their ranks; a scene without motion has the lowest rank."""
    margins = np.array([-np.inf, 0.1, 0.1, 0.4, 0.2])
    offsets = np.array([[0.0, 3.0], [1.0, 3.0], [2.0, 3.0], [5.0, 3.0], [4.0, 3.0]])
    ranks = np.array([1.0, 2.5, 2.5, 5.0, 4.0])
    expected = np.corrcoef(ranks, [1, 2, 3, 5, 4])[0, 1]
    np.testing.assert_allclose(rank_correlations(margins, offsets), [expected, 0.0], rtol=1e-12)
    np.testing.assert_array_equal(rank_correlations(np.full(5, -np.inf), offsets), [0.0, 0.0])
