"""When an object at rest starts to move: by the sign of its acceleration, but for rounding."""

from pathlib import Path

import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.core import Status
from wholearm_jax.phases.phase_ends import rest_terms

DATA = Path(__file__).parents[1] / "data"


@pytest.fixture(scope="module")
def balanced():
    """An object that nothing but the torques holds, and torques that balance it."""
    scene = wa.load(DATA / "frictionless_slide.toml")
    traced = wa.trace(scene)
    constant, first, second = rest_terms(traced[0].dynamics, 0)[0].ahead
    return scene, traced, np.array([0.45, -(constant + 0.45 * first) / second])


def status_under(balanced, change):
    scene, traced, torque = balanced
    schedule = wa.torque_schedule([0.0, 2.0], [torque + np.array([0.0, change])] * 2)
    return wa.simulate(scene, schedule, traced=traced).phases[0].status


@pytest.mark.parametrize("ulps", [-4, -1, 0, 1, 4])
def test_rounding_moves_no_object(balanced, ulps):
    assert status_under(balanced, ulps * np.spacing(0.45)) is Status.STUCK


@pytest.mark.parametrize("change", [1e-9, -1e-9])
def test_the_smallest_torque_beyond_rounding_does(balanced, change):
    """Finger 2 pushes the object forward with a positive torque."""
    status = status_under(balanced, change)
    assert (status is Status.REVERSED) == (change < 0)
    assert status is not Status.STUCK
