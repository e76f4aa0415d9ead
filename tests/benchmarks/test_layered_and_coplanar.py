"""Sharing a plane costs a hand only what its fingers would cross: random scenes of the stability sweep, both ways.

Whether fingers cross is judged by the sweep's own segments.
"""

import jax
import numpy as np
import pytest

from benchmarks.stability.levels import to_device
from benchmarks.stability.links import Links, between
from benchmarks.stability.programs import mechanics
from benchmarks.stability.scenes import Scenes, draw
from tests.reference.mechanics import Model
from wholearm_jax.core import Status
from wholearm_jax.phases.phase_tracing import trace_phase_path
from wholearm_jax.tracing import PathEnd, Resolution

COUNT = 400
DEEP = 1e-4  # of the object's radius, what places along a path cannot miss


@jax.jit
def paths_of(scenes):
    def one(scene):
        system, target = mechanics(scene)
        path, _, _ = trace_phase_path(system, scene.rough, target, Resolution(), True, True)
        return path.status, path.length, path.end_reason, path.start, path.end, path.nodes

    return jax.lax.map(one, scenes)


@pytest.fixture(scope="module")
def both():
    """Random scenes on layered and on coplanar hands, and how deep fingers are in each other along layered paths."""
    scenes = draw(COUNT, 22)
    layered, coplanar = (
        jax.tree.map(np.asarray, paths_of(to_device(Scenes(*scenes._replace(layered=np.full(COUNT, value))))))
        for value in (True, False)
    )
    places = np.concatenate([layered[3][:, None], layered[5].reshape(COUNT, -1, 5), layered[4][:, None]], axis=1)
    return layered, coplanar, between(Links.of(scenes, Model.of(scenes).size), places)


def test_fingers_that_stay_apart_change_nothing(both):
    layered, coplanar, depth = both
    apart = (depth.max(1) == 0) & (layered[0] == Status.OK)
    assert apart.sum() > COUNT / 8
    np.testing.assert_array_equal(coplanar[0][apart], layered[0][apart])
    np.testing.assert_allclose(coplanar[1][apart], layered[1][apart], rtol=1e-12)


def test_fingers_that_would_cross_end_the_path_or_refuse_its_start(both):
    layered, coplanar, depth = both
    cross = (depth.max(1) > DEEP) & (layered[0] == Status.OK)
    begins = depth[:, 0] > DEEP
    assert (cross & begins).sum() > COUNT / 40
    assert (cross & ~begins).sum() > COUNT / 40
    assert set(coplanar[0][cross & begins]) == {Status.OBSTACLE}
    stopped = cross & ~begins & (coplanar[0] == Status.OK)
    assert stopped.sum() > 0.9 * (cross & ~begins).sum()
    assert np.all(coplanar[2][stopped] == PathEnd.OBSTACLE)
    assert np.all(coplanar[1][stopped] < layered[1][stopped])
