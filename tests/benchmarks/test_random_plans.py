"""What benchmarks share follows the package: random plans can be made, and are what they say."""

import sys
from pathlib import Path

import numpy as np
import pytest
from support import layered

import wholearm_jax as wa


@pytest.fixture
def benchmarks(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    yield
    for name in ("random_plans", "flying_plans"):
        sys.modules.pop(name, None)


@pytest.mark.usefixtures("benchmarks")
def test_random_plans_can_be_followed_and_held():
    from random_plans import LEAST_BOUND, random_plans

    (scene,) = random_plans(1, seed=3)
    traced = wa.trace(scene)
    assert [wa.Status(int(one.dynamics.status)).label for one in traced] == ["ok", "ok"]
    assert min(float(top.value) for top in wa.bounds(scene, traced=traced)) > LEAST_BOUND


@pytest.mark.usefixtures("benchmarks")
def test_random_plans_at_speed_lead_on():
    from flying_plans import chains

    from wholearm_jax.planning.successors import exit_velocity

    scene = layered("flight")
    traced = wa.trace(scene)
    onward = list(chains(scene, traced[0].end, 1, exit_velocity(traced[0].dynamics)))
    assert all(way.status is wa.Status.OK and way.bound > 0 for (way,) in onward)
    for (way,) in onward:
        np.testing.assert_allclose(way.traced.begin, traced[0].end, atol=1e-9)
    assert scene.phases[1].formation.names in [tuple(way.contacts) for (way,) in onward]
