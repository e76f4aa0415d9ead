"""Which formation next: what the bundled plans do is among the ways found, and no way is made up."""

import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.planning.successors import exit_velocity, successor_formations, touching_contacts


@pytest.mark.parametrize("name", ["heptagon", "hexagon"])
def test_the_planned_phases_are_among_the_ways(name):
    scene = layered(name)
    traced = wa.trace(scene)
    places = [traced[0].begin, traced[0].end]
    tops = wa.bounds(scene, traced=traced)
    for phase, at, z, top in zip(scene.phases, traced, places, tops, strict=True):
        assert set(phase.formation.names) <= set(touching_contacts(scene, z))
        same = [way for way in successor_formations(scene, z) if set(way.contacts) == set(phase.formation.names)]
        length = float(at.dynamics.length)
        way = min(same, key=lambda way: abs(way.length - length))
        assert way.length == pytest.approx(length, rel=1e-3), "charts begin with the same tangent"
        np.testing.assert_allclose(way.end, at.end, atol=1e-9)
        assert way.bound == pytest.approx(float(top.value), rel=1e-6)


def test_a_fifth_contact_stops_the_ways_that_would_push_into_it():
    scene = layered("heptagon")
    z = wa.trace(scene)[0].end
    assert "finger2:v4" in touching_contacts(scene, z)
    old = [way for way in successor_formations(scene, z) if set(way.contacts) == set(scene.phases[0].formation.names)]
    assert [way.toward for way in old] == ["x+"], "the slide cannot go on, only back"


def test_impacts_are_told():
    scene = layered("heptagon")
    end = wa.trace(scene)[0]
    found = successor_formations(scene, end.end, exit_velocity(end.dynamics))
    flip = next(way for way in found if set(way.contacts) == set(scene.phases[1].formation.names))
    assert flip.entering in ("turns back", "pulls")
    onward = [way for way in found if way.entering.endswith("%")]
    assert onward
    assert all(way.speed > 0 and not way.pulls for way in onward)


@pytest.mark.parametrize(
    ("length", "on_finger"), [(0.1, {"v1", "v2"}), (0.05, {"v1", "e1"}), (0.06, {"v1", "v2", "e1", "e2"})]
)
def test_what_touches_lies_on_its_feature(length, on_finger):
    """A square of 60 mm between upright fingers that are longer, shorter, and as long, their tips at corners."""
    finger = {"length": length, "inertia": 2e-3, "torque_limit": 1.0}
    scene = wa.parse(
        {
            "title": "square",
            "gravity": 9.81,
            "hand": {"finger1": finger | {"joint": [0.03, 0.0]}, "finger2": finger | {"joint": [-0.03, 0.0]}},
            "object": {
                "vertices": [[-0.03, -0.03], [0.03, -0.03], [0.03, 0.03], [-0.03, 0.03]],
                "mass": 0.2,
                "friction": 0.3,
            },
            "start": {"x": 0.0, "y": 0.03, "phi": 0.0, "theta1": np.pi / 2, "theta2": np.pi / 2},
            "phase": [
                {
                    "name": "hold",
                    "contacts": ["palm:v0", "palm:v1", "finger1:v1", "finger2:v0"],
                    "hold": True,
                    "duration": 1.0,
                }
            ],
        }
    )
    found = {
        name.removeprefix("finger1:") for name in touching_contacts(scene, scene.start) if name.startswith("finger1")
    }
    assert found == on_finger
    palm = {name for name in touching_contacts(scene, scene.start) if name.startswith("palm")}
    assert palm == {"palm:v0", "palm:v1"}
