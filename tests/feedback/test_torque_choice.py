"""The choice of a law's feed-forward torques: as large a least force as there is, and no jumps where none is needed."""

import numpy as np
import pytest
from scipy.optimize import linprog

from wholearm_jax.feedback.path_table import PathTerms
from wholearm_jax.feedback.torque_choice import choose_torques

PLACES, LIMIT = 101, np.array([1.5, 1.5])


@pytest.fixture(scope="module")
def terms():
    """Terms of a path on which the second torque may be from 0 to 1 N m: more costs force first, and gives some later.

    Accelerations are of the first torque alone.
    """
    u = np.linspace(0.0, 1.0, PLACES)
    acceleration = np.tile([0.0, 0.0, 0.0, 1.0, 0.0], (PLACES, 1))
    zero, one = np.zeros(PLACES), np.ones(PLACES)
    facets = [(0.0 * one, 10.0 * one), (10.0 * one, -10.0 * one), (0.5 * one, u - 0.5)]  # constant, of the torque
    slack = np.stack([np.stack([constant, zero, zero, zero, slope], axis=1) for constant, slope in facets], axis=1)
    return PathTerms(acceleration, slack)


def best_torque(slack):
    """The largest least slack at one place, and its second torque, by a linear programme."""
    above, most = np.column_stack([-slack[:, 4], np.ones(len(slack))]), slack[:, 0]
    answer = linprog([0.0, -1.0], A_ub=above, b_ub=most, bounds=[(-LIMIT[1], LIMIT[1]), (None, None)])
    return answer.x


def test_torques_go_over_from_one_squeeze_to_another_by_and_by(terms):
    torque, _, margin = choose_torques([terms], LIMIT, np.ones(PLACES), np.zeros(PLACES))
    best, largest = np.array([best_torque(slack) for slack in terms.slack]).T
    assert np.abs(np.diff(best)).max() > 0.8, "place by place it jumps"
    assert np.abs(np.diff(torque[:, 1])).max() < 0.1
    assert margin.min() == pytest.approx(largest.min(), abs=0.02), "nothing is given where forces are least"
    assert np.all(margin >= largest.min() - 0.02)
    assert np.mean(largest - margin) < 0.1


def test_the_nominal_object_gets_its_acceleration(terms):
    wanted = np.linspace(-0.5, 0.5, PLACES)
    torque, gain, _ = choose_torques([terms], LIMIT, np.ones(PLACES), wanted)
    np.testing.assert_allclose(torque[:, 0], wanted, atol=1e-12)
    np.testing.assert_allclose((gain * terms.acceleration[:, 3:]).sum(1), 1.0, rtol=1e-12)


def test_no_torque_within_the_limit(terms):
    margin = choose_torques([terms], LIMIT, np.ones(PLACES), np.full(PLACES, 2.0)).margin
    assert np.all(margin == -np.inf)
