"""Small inputs on which users were misled, each for a kind: what the library says of them now."""

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.model import rigid_body
from wholearm_jax.phases import describe_end
from wholearm_jax.planning.successors import successor_formations

CASES = Path(__file__).parents[1] / "data" / "cases"


def load(name: str, *, layered: bool = False) -> wa.Scene:
    """A case; those with long fingers as a layered hand, where something else than their crossing is the matter."""
    scene = wa.load(CASES / f"{name}.toml")
    return eqx.tree_at(lambda s: s.hand.layered, scene, jnp.asarray(True)) if layered else scene


def still_torque():
    return wa.torque_schedule([0.0, 10.0], [[0.1, -0.1], [0.1, -0.1]])


def test_a_finger_that_would_pass_below_the_palm_stops_level_with_it():
    scene = load("finger_below_palm")
    traced = wa.trace(scene)
    assert describe_end(scene, scene.phases[1], traced[1]) == "finger1 reaches its range at 0 deg, level with the palm"
    assert bool(traced[1].dynamics.ends_at_obstacle)


def test_a_finger_inside_the_object_is_named_with_vertex_and_depth():
    result = wa.simulate(load("finger_inside_object"), still_torque())
    assert result.status is wa.Status.LEFT_FORMATION
    assert "finger2 lies 2.89 mm inside the object at vertex 1" in result.message
    assert "brake" not in result.message


@pytest.mark.parametrize("name", ["box_flush", "box_rolling_start", "triangle_flush", "box_tip_negative_bound"])
def test_long_fingers_that_cross_are_refused_by_name(name):
    result = wa.simulate(load(name), still_torque())
    assert result.status in (wa.Status.OBSTACLE, wa.Status.LEFT_FORMATION)
    assert "finger1 and finger2 cross, " in result.message


@pytest.mark.parametrize("name", ["box_flush", "triangle_flush"])
def test_where_a_side_lies_flush_the_formations_with_one_of_its_vertices_go_on(name):
    scene = load(name, layered=True)
    (traced,) = wa.trace(scene)
    assert describe_end(scene, scene.phases[0], traced) == "finger2:v0 is made"
    found = [way for way in successor_formations(scene, traced.end) if way.status is wa.Status.OK]
    assert len(found) >= 4
    with_one = [
        way for way in found if len({"finger2:v0", f"finger2:v{2 if 'tri' in name else 3}"} & {*way.contacts}) == 1
    ]
    assert with_one


def test_a_start_that_is_meant_flat_is_found_flat():
    scene = load("box_rolling_start", layered=True)
    (traced,) = wa.trace(scene)
    assert int(traced.path.status) == wa.Status.OK
    np.testing.assert_allclose(np.asarray(traced.begin)[[1, 2]], [0.02, 0.0], atol=1e-12)
    deep = eqx.tree_at(lambda s: s.start, scene, scene.start.at[2].add(0.2))  # 12 mm below the palm: not meant flat
    assert int(wa.trace(deep)[0].path.status) == wa.Status.LEFT_FORMATION


def test_a_path_that_no_torque_follows_names_the_contacts_that_would_pull():
    scene = load("box_rolling_start", layered=True)
    result = wa.optimise(scene, knots=5).result
    assert result.status is not wa.Status.OK
    assert "the bound is -1.04 N at its start" in result.message
    assert "finger1:v2 and finger2:v3 would have to pull" in result.message


@pytest.fixture(scope="module")
def proud():
    return load("vertex_1nm_proud", layered=True)


def test_a_vertex_within_the_stated_tolerance_is_flush(proud):
    """Its paths and bounds are those of the object without that vertex."""
    found = [float(bound.value) for bound in wa.bounds(proud)]
    data = to_dict(proud)
    del data["object"]["vertices"][6]
    data["phase"][0]["contacts"][1] = data["phase"][1]["contacts"][0] = "palm:v6"
    np.testing.assert_allclose(found, [float(bound.value) for bound in wa.bounds(wa.parse(data))], rtol=1e-6)


@pytest.mark.parametrize(("tolerance", "status"), [(0.5e-9, "left_formation"), (2e-9, "ok")])
def test_the_tolerance_for_flush_is_the_scenes(proud, tolerance, status):
    data = to_dict(proud)
    data["object"]["flush_tolerance"] = tolerance
    traced = wa.trace(wa.parse(data))
    assert wa.Status(int(traced[0].path.status)).label == status
    assert float(rigid_body(wa.parse(data).object).flush_tolerance) == tolerance
