"""Paths that end where links meet: places against bisection of a closed form, gradients against differences, names."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from scipy.optimize import brentq, root
from support import layered, steadiest_difference

import wholearm_jax as wa
from wholearm_jax.files.scene_toml import parse_start, to_dict
from wholearm_jax.model import rigid_body, scaled_mechanics
from wholearm_jax.phases import describe_end
from wholearm_jax.phases.obstacles import describe_overlaps
from wholearm_jax.phases.phase_tracing import trace_phase_path
from wholearm_jax.tracing import PathEnd, Resolution


def coplanar(name="heptagon", length=0.14, offset=0.0, back=0.0, phases=slice(None), **start):
    """A bundled object on a hand whose fingers share a plane."""
    data = to_dict(layered(name))
    data["hand"]["fingers"] = "coplanar"
    for finger in ("finger1", "finger2"):
        data["hand"][finger] |= {"length": length, "offset": offset, "back": back}
    data["phase"] = data["phase"][phases]
    data["start"] |= start
    return wa.parse(data)


@pytest.fixture(scope="module")
def flip():
    """The heptagon's flip, from where its slide ends."""
    scene = coplanar()
    traced = wa.trace(scene)
    return eqx.tree_at(lambda s: (s.start, s.phases), scene, (traced[0].end, scene.phases[1:])), traced[1]


def curve_point(scene, phi, guess):
    """The configuration at an angle of the flip, from the four gaps written out anew."""
    corners = np.asarray(rigid_body(scene.object).vertices)
    hand = jax.tree.map(np.asarray, scene.hand)

    def gaps(z):
        x, y, theta1, theta2 = z
        turn = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
        at = corners @ turn.T + [x, y]
        normal1 = np.array([-np.sin(theta1), np.cos(theta1)])
        normal2 = -np.array([-np.sin(theta2), np.cos(theta2)])
        rows = [at[6, 1], normal1 @ (at[1] - hand.joint[0]) - hand.offset[0]]
        return rows + [normal2 @ (at[k] - hand.joint[1]) - hand.offset[1] for k in (3, 4)]

    found = root(gaps, np.asarray(guess)[[0, 1, 3, 4]], tol=1e-14)
    assert np.abs(found.fun).max() < 1e-15, found.message
    x, y, theta1, theta2 = found.x
    return np.array([x, y, phi, theta1, theta2])


def test_end_is_where_a_tip_meets_the_other_finger(flip):
    scene, traced = flip
    assert int(traced.path.end_reason) == PathEnd.OBSTACLE
    assert describe_end(scene, scene.phases[0], traced) == "finger1 meets finger2 0.132 m from its joint"
    end, joint = np.asarray(traced.end), np.asarray(scene.hand.joint)

    def distance(phi):
        z = curve_point(scene, phi, end)
        tip = joint[0] + 0.14 * np.array([np.cos(z[3]), np.sin(z[3])])
        away = tip - joint[1]
        return np.cos(z[4]) * away[1] - np.sin(z[4]) * away[0]

    met = brentq(distance, end[2] - 0.05, end[2] + 0.05, xtol=1e-14)
    np.testing.assert_allclose(end, curve_point(scene, met, end), atol=1e-10)


@pytest.mark.parametrize("clearance", [0.0, 0.0015])
def test_end_is_where_strips_begin_to_overlap(flip, clearance):
    """Bisection of whether Shapely's rectangles are as near as they may be, for fingers with a thickness."""
    scene, _ = flip
    values = (jnp.array([0.002, 0.001]), jnp.full(2, 0.003), jnp.array(clearance))
    scene = eqx.tree_at(lambda s: (s.hand.offset, s.hand.back, s.hand.clearance), scene, values)
    (traced,) = wa.trace(scene, tolerance=1e-3)  # the table is not looked at
    assert int(traced.path.end_reason) == PathEnd.OBSTACLE
    assert ("(within their clearance of 1.5 mm)" in describe_end(scene, scene.phases[0], traced)) == (clearance > 0)
    begin, end = np.asarray(traced.begin), np.asarray(traced.end)

    def strip(z, k):
        along = np.array([np.cos(z[3 + k]), np.sin(z[3 + k])])
        across = (1, -1)[k] * np.array([-along[1], along[0]])
        root_, tip = np.asarray(scene.hand.joint)[k], np.asarray(scene.hand.joint)[k] + 0.14 * along
        front, back = float(scene.hand.offset[k]) * across, -0.003 * across
        return shapely.Polygon([root_ + front, tip + front, tip + back, root_ + back])

    ahead = end[2] - begin[2]
    apart, met = end[2] - 0.05 * ahead, end[2] + 0.05 * ahead
    for _ in range(42):
        middle = (apart + met) / 2
        z = curve_point(scene, middle, end)
        apart, met = (apart, middle) if strip(z, 0).distance(strip(z, 1)) <= clearance else (middle, met)
    assert abs(met - end[2]) < 0.04 * abs(ahead)
    np.testing.assert_allclose(end, curve_point(scene, met, end), atol=1e-10)


def test_a_phase_that_ends_at_an_obstacle_is_not_ok_and_names_it(flip):
    """The optimised torques bring the object there, at rest: still no plan."""
    scene, _ = flip
    result = wa.optimise(scene, knots=21).result
    assert result.status is wa.Status.OBSTACLE
    assert "finger1 meets finger2 0.132 m from its joint" in result.message
    assert result.phases[0].margin > 0.5


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_gradient_of_the_end(flip, mode):
    """With respect to lengths, joints, offsets, backs, clearance and vertices, of strips, against differences."""
    scene, _ = flip
    scene = eqx.tree_at(lambda s: (s.hand.offset, s.hand.back), scene, (jnp.array([0.002, 0.001]), jnp.full(2, 0.003)))
    phase, weights = scene.phases[0], jnp.array([1.0, -2.0, 0.5, 0.3, -0.7])

    def chosen(s):
        return (s.hand.length, s.hand.joint, s.hand.offset, s.hand.back, s.hand.clearance, s.object.vertices)

    @jax.jit
    def end(values):
        changed = eqx.tree_at(chosen, scene, values)
        mechanics = scaled_mechanics(rigid_body(changed.object), changed.hand, changed.gravity, phase.formation)
        path, _, end = trace_phase_path(mechanics, scene.start, phase.target, Resolution(), True, True)
        return weights @ end, path.end_reason

    values = chosen(scene)
    assert int(end(values)[1]) == PathEnd.OBSTACLE
    directions = np.random.default_rng(2)
    for which in range(len(values)):
        way = [jnp.zeros_like(v) for v in values]
        way[which] = jnp.asarray(directions.normal(size=values[which].shape))
        way = tuple(way)
        expected = steadiest_difference(
            lambda h, way=way: float(end(tuple(v + h * w for v, w in zip(values, way, strict=True)))[0])
        )
        if mode == "forward":
            slope = float(jax.jvp(lambda v: end(v)[0], (values,), (way,))[1])
        else:
            slope = sum(float((g * w).sum()) for g, w in zip(jax.grad(lambda v: end(v)[0])(values), way, strict=True))
        assert slope == pytest.approx(expected, rel=1e-7, abs=1e-7)


def test_mirror_image_and_units(flip):
    """The mirrored hand, and the same one in other units of length, meet at the same place."""
    scene, traced = flip
    end = np.asarray(traced.end)
    data = to_dict(scene)
    data["object"]["vertices"] = [[-x, y] for x, y in data["object"]["vertices"][::-1]]
    count = len(data["object"]["vertices"])
    joints = [data["hand"][f"finger{k}"] for k in (1, 2)]
    data["hand"]["finger1"], data["hand"]["finger2"] = (
        finger | {"joint": [-finger["joint"][0], finger["joint"][1]]} for finger in joints[::-1]
    )
    start = data["start"]
    data["start"] = {"x": -start["x"], "y": start["y"], "phi": -start["phi"]}
    data["start"] |= {"theta1": np.pi - start["theta2"], "theta2": np.pi - start["theta1"]}
    names = {"finger1": "finger2", "finger2": "finger1", "palm": "palm"}

    def mirrored(contact):
        link, _, vertex = contact.partition(":v")
        return f"{names[link]}:v{count - 1 - int(vertex)}"

    data["phase"][0] |= {"contacts": [mirrored(c) for c in data["phase"][0]["contacts"]], "toward": "phi+"}
    image = wa.parse(data)
    (found,) = wa.trace(image)
    flipped = np.array([-end[0], end[1], -end[2], np.pi - end[4], np.pi - end[3]])
    np.testing.assert_allclose(np.asarray(found.end), flipped, atol=1e-10)
    assert describe_end(image, image.phases[0], found).startswith("finger2 meets finger1")

    tenfold = eqx.tree_at(
        lambda s: (s.hand.length, s.hand.joint, s.object.vertices, s.start, s.gravity),
        scene,
        (
            10 * scene.hand.length,
            10 * scene.hand.joint,
            10 * scene.object.vertices,
            scene.start * jnp.array([10.0, 10.0, 1, 1, 1]),
            10 * scene.gravity,
        ),
    )
    (found,) = wa.trace(tenfold)
    np.testing.assert_allclose(np.asarray(found.end), end * [10, 10, 1, 1, 1], atol=1e-10)


def test_a_joint_stops_at_the_end_of_its_range(flip):
    scene, traced = flip
    limit = float(traced.begin[3]) - 0.1
    narrow = eqx.tree_at(lambda s: s.hand.range, scene, scene.hand.range.at[0, 0].set(limit))
    (found,) = wa.trace(narrow)
    assert float(found.end[3]) == pytest.approx(limit, abs=1e-12)
    assert describe_end(narrow, narrow.phases[0], found).startswith("finger1 reaches its range at")


def test_a_start_with_crossing_fingers_is_refused_with_pair_and_depth():
    scene = coplanar(length=0.17, phases=slice(0, 1))
    (traced,) = wa.trace(scene)
    assert int(traced.path.status) == wa.Status.OBSTACLE
    (line,) = describe_overlaps(scene, traced.begin)
    assert line.startswith("finger1 and finger2 cross, ")
    assert line.endswith(" mm deep")


def test_fingers_nearer_than_their_clearance_are_named_with_their_distance(flip):
    """No path begins there; shapely measures how near they are."""
    scene, _ = flip
    (traced,) = wa.trace(scene)
    z = np.asarray(traced.begin)
    ends = [np.asarray(scene.hand.joint[k]) for k in range(2)]
    tips = [end + 0.14 * np.array([np.cos(z[3 + k]), np.sin(z[3 + k])]) for k, end in enumerate(ends)]
    distance = 1e3 * shapely.LineString([ends[0], tips[0]]).distance(shapely.LineString([ends[1], tips[1]]))
    near = eqx.tree_at(lambda s: s.hand.clearance, scene, jnp.array(1.1e-3 * distance))
    (line,) = describe_overlaps(near, z)
    assert line == f"finger1 and finger2 are {distance:.3g} mm apart, of a clearance of {1.1 * distance:.3g} mm"
    assert int(wa.trace(near)[0].path.status) == wa.Status.OBSTACLE
    far = eqx.tree_at(lambda s: s.hand.clearance, scene, jnp.array(0.9e-3 * distance))
    assert describe_overlaps(far, z) == ()


def test_layered_fingers_do_not_stop_the_path(flip):
    scene, _ = flip
    (found,) = wa.trace(eqx.tree_at(lambda s: s.hand.layered, scene, jnp.asarray(True)))
    assert int(found.path.end_reason) != PathEnd.OBSTACLE


@pytest.mark.parametrize("deeper", [0.0, 1e-12, -1e-12, 1e-11, -1e-11, 3e-10])
def test_a_tip_that_lies_flush_on_a_side_is_not_inside(deeper):
    """Where the line of a flush finger crosses the object is decided by rounding: it is no depth of the finger."""
    side, joint, theta, length = 0.07, -0.08, 0.8, 0.11
    fingers = {
        f"finger{k}": {"joint": [x, 0.0], "length": length, "inertia": 2e-3, "torque_limit": 1.0}
        for k, x in ((1, 0.2), (2, joint))
    }
    square = [[0.0, 0.0], [side, 0.0], [side, side], [0.0, side]]
    data = {"title": "", "gravity": 9.81, "hand": fingers, "object": {"vertices": square, "mass": 0.2, "friction": 0.1}}
    data |= {"start": dict.fromkeys(("x", "y", "phi", "theta1", "theta2"), 0.0), "phase": []}
    scene = parse_start(data)
    along, phi = np.array([np.cos(theta), np.sin(theta)]), theta + np.pi
    turn = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
    centre = np.array([joint, 0.0]) + 0.12 * along + turn @ [side / 2, side / 2]

    def lines(by):
        every = describe_overlaps(scene, jnp.asarray([*centre, phi, 1.0, theta - by]))
        return [line for line in every if line.startswith("finger2")]

    assert lines(deeper) == []
    assert "inside the object" in lines(0.01)[0]
