"""Scenes at the edge: paths that turn far or meet another, wedging on the way back, tiny pieces, many stops."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.path import Path
from shapely import LineString, Polygon
from support import layered, steadiest_difference

import wholearm_jax as wa
from wholearm_jax.dynamics import equations_of_motion, evaluate, locate_panel, placeholder_dynamics
from wholearm_jax.margin import (
    MAX_REFINED,
    SAMPLES_PER_STEP,
    best_quasistatic_torque,
    best_quasistatic_torque_batch,
    minimum_margin,
)
from wholearm_jax.model import link_overlaps
from wholearm_jax.model.kinematics import FEATURE_GROUPS, contact_kinematics, gaps
from wholearm_jax.model.mechanics import scaled_mechanics
from wholearm_jax.model.scene import rigid_body
from wholearm_jax.model.schedule import restrict_to_phase
from wholearm_jax.phases.obstacles import describe_refused_start
from wholearm_jax.phases.phase_ends import configuration, describe_end
from wholearm_jax.phases.phase_tracing import trace_phase
from wholearm_jax.phases.plan_simulation import simulate_phases
from wholearm_jax.phases.sampling import sample_phase
from wholearm_jax.simulation import IntegratorOptions, quintic_hermite, simulate_motion
from wholearm_jax.tracing.events import EventFunctions, EventValues, detect_events
from wholearm_jax.tracing.path import Resolution
from wholearm_jax.tracing.start_checks import lie_before_link, link_penetrates_object, violates_contact_limits


def scene(vertices, contacts, toward, start, *, joint, length, offset=(0.0, 0.0)):
    """A scene of one phase on a hand with two like fingers."""
    alike = {"length": length, "inertia": 0.3, "viscous": 0.05, "dry": 0.02, "torque_limit": 100.0}
    places = zip(("finger1", "finger2"), joint, offset, strict=True)
    return wa.parse(
        {
            "title": "edge",
            "gravity": 9.81,
            "hand": {"fingers": "layered"}
            | {name: alike | {"joint": [x, 0.0], "offset": away, "range": [-6.2, 6.2]} for name, x, away in places},
            "object": {"vertices": vertices, "mass": 1.0, "friction": 0.2},
            "start": dict(zip(("x", "y", "phi", "theta1", "theta2"), start, strict=True)),
            "phase": [
                {"name": "p", "contacts": contacts, "toward": toward, "duration": 2.0, "arrive": "moving"},
            ],
        }
    )


def mechanics(scene):
    return scaled_mechanics(rigid_body(scene.object), scene.hand, scene.gravity, scene.phases[0].formation)


def turning():
    """A path that turns so far that one chart does not reach its end; between the charts' meeting and the next reversal
    lies a short piece."""
    return scene(
        [[-0.32, 0.61], [-0.97, -0.25], [0.55, -0.53], [0.9, 0.15]],
        ["finger1:v3", "finger2:v0", "palm:v1", "finger1:v2"],
        "phi-",
        [-0.332, 0.997, 1.245, 2.339, 1.472],
        joint=(1.97, -1.32),
        length=6.7,
        offset=(-0.02, 0.0),  # at a root on the palm a vertex would leave the finger and meet the palm at once
    )


def test_a_path_may_turn_far():
    """Charts follow each other: closure holds on both sides, `z` and `z_dot` are continuous where they meet."""
    at = wa.trace(turning())[0]
    dynamics, path, formation = at.dynamics, at.path, mechanics(turning())
    assert int(dynamics.status) == wa.Status.OK
    charts = np.asarray(path.chart)[: int(dynamics.count)]
    met = [k for k in range(1, len(charts)) if np.any(charts[k] != charts[k - 1])]
    assert met, "the path stays in one chart: it is no test"

    def read(segment, s):
        panel, xi = locate_panel(dynamics, jnp.asarray(segment), s)
        unit = formation.configuration_unit
        return evaluate(dynamics.configuration, panel, xi) / unit, evaluate(dynamics.velocity, panel, xi) / unit

    for k in met:
        before, after = read(k - 1, dynamics.breakpoints[k]), read(k, dynamics.breakpoints[k])
        assert np.abs(before[0] - after[0]).max() < 1e-12
        assert np.abs(before[1] - dynamics.speed_ratio[k] * after[1]).max() < 1e-10
        assert float(dynamics.speed_ratio[k]) > 1.1
    for segment in range(len(charts)):
        for s in np.linspace(float(dynamics.breakpoints[segment]), float(dynamics.breakpoints[segment + 1]), 9):
            assert float(jnp.abs(gaps(formation.contacts, read(segment, jnp.asarray(s))[0])).max()) < 1e-10


def test_derivatives_pass_from_chart_to_chart():
    """Place, time and force at the end of a motion through both charts, against differences.

    Only what does not depend on the charts can be compared: they change with the scene themselves.
    """
    edge = turning()
    dynamics = wa.trace(edge)[0].dynamics
    knots = np.linspace(0.0, 2.0, 7)
    u = jnp.asarray(knots / 1.6)
    places = dynamics.length * jnp.minimum(u, 1.0) ** 2
    rate = 1 / 1.6
    held = best_quasistatic_torque_batch(
        dynamics, places, 2 * dynamics.length * u * rate, jnp.full(7, 2 * dynamics.length * rate**2)
    )
    schedule = wa.torque_schedule(knots, held.torque)
    inputs, rest = eqx.partition((edge, schedule), eqx.is_inexact_array)
    still = jax.tree.map(jnp.zeros_like, inputs)
    moving = (
        jnp.array([1.0, 0.5]),
        jnp.full_like(edge.object.vertices, 1.0) * jnp.array([0.3, -0.2]),
        jnp.array([0.2, 1.0]),
    )
    way = eqx.tree_at(lambda i: (i[0].hand.length, i[0].object.vertices, i[0].hand.offset), still, moving)

    def outcome(inputs, adjoint):
        # All inputs have tangents and the tolerance is data: other tests of derivatives share the programs.
        moved, torque = eqx.combine(inputs, rest)
        at = wa.trace(moved)
        found = simulate_phases(moved, torque, at, IntegratorOptions(adjoint=adjoint, tolerance=jnp.asarray(1e-12)))[0]
        share = found.motion.phase_time[found.motion.count]
        return jnp.concatenate([at[0].end, jnp.stack([share, found.margin_result.margin])])

    def moved(h):
        return outcome(jax.tree.map(lambda at, along: at + h * along, inputs, way), "none")

    value, slope = jax.jvp(lambda i: outcome(i, "forward"), (inputs,), (way,))
    assert 0.5 < float(value[5]) < 1.0, "it does not arrive"
    assert (np.abs(slope) > 1e-3).sum() >= 4  # it ends flush with the palm, which fixes y, phi and one finger
    for k in range(len(slope)):
        numeric = steadiest_difference(lambda h, k=k: float(moved(h)[k]))
        assert float(slope[k]) == pytest.approx(numeric, rel=1e-6, abs=1e-9)


def test_a_tip_that_a_vertex_and_an_edge_hold_where_they_meet_is_refused():
    """A finger's edge flush with the object, held by a vertex and the tip: where the two meet, they are one contact."""
    flush = scene(
        [[0.5708, 0.3954], [-0.9376, 0.2421], [-0.6901, -0.3374], [0.9554, -0.2954]],
        ["finger1:v1", "palm:v0", "finger2:v3", "finger1:e0"],
        "x+",
        [0.3358, 0.5621, -2.804, 0.7572, 1.4],
        joint=(0.6971, -0.7538),
        length=0.881,
        offset=(0.05339, 0.0),
    )
    assert int(wa.trace(flush)[0].dynamics.status) == wa.Status.LEFT_FORMATION


def test_wedging_on_the_way_back_does_not_spoil_the_table():
    """Backward accelerations keep their sign through a place where friction would wedge an object going back."""
    name = layered("heptagon")
    end = wa.trace(name)[1].end
    rough = eqx.tree_at(lambda s: s.object.friction, name, jnp.full(3, 0.7))
    phase = rough.phases[1]
    target = eqx.tree_at(lambda h: h.sign, phase.target, -phase.target.sign)
    solid = rigid_body(rough.object)
    at = trace_phase(solid, rough.hand, rough.gravity, phase.formation, end, target)
    dynamics, path = at.dynamics, at.path
    assert int(dynamics.status) == wa.Status.OK
    assert float(dynamics.error) < 1e-9
    formation = scaled_mechanics(solid, rough.hand, rough.gravity, phase.formation)
    turned = []
    for s in np.linspace(0.02, 0.98, 60) * float(dynamics.length):
        segment = jnp.minimum((s >= dynamics.breakpoints[1:-1]).sum(), dynamics.count - 1)
        panel, xi = locate_panel(dynamics, segment, jnp.asarray(s))
        z = evaluate(dynamics.configuration, panel, xi) / formation.configuration_unit
        x = evaluate(dynamics.velocity, panel, xi) / formation.configuration_unit
        signs = path.slip_sign[segment], path.joint_sign[segment]
        back, right = equations_of_motion(formation, z, x, 0 * x, -signs[0], -signs[1])
        smooth, _ = equations_of_motion(formation, z, x, 0 * x, 0 * signs[0], signs[1])
        turned.append(float(jnp.linalg.det(back) * jnp.linalg.det(smooth)))
        exact = jnp.linalg.solve(back, right)[0, jnp.array([0, 3, 4])]
        np.testing.assert_array_equal(np.sign(evaluate(dynamics.reverse_acceleration, panel, xi)), np.sign(exact))
    assert min(turned) < 0 < max(turned), "nothing wedges: it is no test"


class _Track(NamedTuple):
    """A table of straight pieces without any acceleration, and a schedule without torque."""

    dynamics: object
    phase_schedule: object


def track(breaks, factor, knots=2):
    """Pieces that end at `breakpoints`, at whose beginnings `ds/dt` is multiplied by `speed_ratio`."""
    dynamics = placeholder_dynamics(Resolution(len(factor), len(factor), 4))
    rows = jnp.arange(len(factor))
    dynamics = eqx.tree_at(
        lambda t: (t.breakpoints, t.count, t.speed_ratio, t.first),
        dynamics,
        (jnp.asarray(breaks), jnp.asarray(len(factor)), jnp.asarray(factor), rows),
    )
    schedule = wa.torque_schedule(np.linspace(0.0, 1.0, knots), np.zeros((knots, 2)))
    phase_schedule = restrict_to_phase(schedule, jnp.asarray(0.0), jnp.asarray(1.0))
    return _Track(dynamics, phase_schedule)


def test_a_piece_crossed_in_one_step_keeps_its_speed():
    """Behind a change of chart the step that already passes the next one starts at the new chart's speed."""
    dynamics, phase_schedule = track([0.0, 1.0, 1.001, 99.0], [1.0, 2.0, 3.0])
    motion = simulate_motion(dynamics, phase_schedule, jnp.asarray(1.0), options=IntegratorOptions(), speed=4.0)
    last = int(motion.count)
    assert float(motion.w[last]) == pytest.approx(24.0, rel=1e-12)
    assert float(motion.phase_time[last]) == 1.0
    time = 1.0 / 4 + 0.001 / 8
    assert float(motion.s[last]) == pytest.approx(1.001 + 24.0 * (1 - time), rel=1e-12)


def test_a_step_as_short_as_rounding_keeps_its_speed():
    dynamics, phase_schedule = track([0.0, 1.0], [1.0])
    here, now = 0.6460973036766916, 0.8463721297745421
    share = jnp.array([now, np.nextafter(now, 1.0)])
    s = jnp.array([here, np.nextafter(np.nextafter(here, 1.0), 1.0)])
    quintic = quintic_hermite(dynamics, phase_schedule, jnp.asarray(1.0), share, s, jnp.array([1.5, 1.5]), 0, 0, True)
    slope = np.polynomial.polynomial.polyder(np.asarray(quintic))
    speed = np.polynomial.polynomial.polyval(np.linspace(0, 1, 7), slope) / float(share[1] - share[0])
    np.testing.assert_allclose(speed, 1.5, rtol=1e-12)


def test_a_step_that_takes_no_time_says_nothing():
    """Where a motion ends twice, as by a landing within rounding of a step's end, forces are those of its speed."""
    dynamics, phase_schedule = track([0.0, 99.0], [1.0])
    pulls_at_rest = jnp.zeros((1, 4, 4, 5)).at[0, 0, :, :2].set(jnp.array([-1.0, 1.0]))
    dynamics = eqx.tree_at(lambda t: t.force, dynamics, pulls_at_rest)
    motion = simulate_motion(dynamics, phase_schedule, jnp.asarray(1.0), options=IntegratorOptions(), speed=4.0)
    motion = motion._replace(w_begin=motion.w_begin.at[motion.count].set(4.0), count=motion.count + 1)
    assert float(motion.phase_time[motion.count - 1]) == float(motion.phase_time[motion.count]) == 1.0
    found = minimum_margin(dynamics, phase_schedule, jnp.asarray(1.0), motion, IntegratorOptions())
    assert float(found.margin) == pytest.approx(15.0, rel=1e-12)
    assert float(found.loss_time) == np.inf
    schedule = wa.torque_schedule([0.0, 1.0], np.zeros((2, 2)))
    course = sample_phase(dynamics, schedule, jnp.asarray(0.0), jnp.asarray(1.0), motion, jnp.array([0.5, 1.0]))
    np.testing.assert_allclose(course.cn, 15.0, rtol=1e-12)


@pytest.mark.parametrize("floor", [0.3, -1e-3])
def test_a_dip_between_samples_is_found_among_many_low_steps(floor):
    """One piece of many has a force that falls from above all others' to far below them within a third of a step, or
    below zero for less than any sample shows."""
    count, deep = 2 * MAX_REFINED, MAX_REFINED + 1
    dynamics, phase_schedule = track(np.append(np.arange(count), 99.0), np.ones(count))
    motion = simulate_motion(
        dynamics, phase_schedule, jnp.asarray(1.0), options=IntegratorOptions(), speed=float(count - 1)
    )
    places = np.asarray(motion.s)[: int(motion.count) + 1]
    last = np.searchsorted(places, deep + 1.0)
    half = (places[last] - places[last - 1]) / (SAMPLES_PER_STEP - 1)  # in xi, which goes from -1 to 1 in every piece
    lowest = 2 * ((places[last] + places[last - 1]) / 2 - deep) - 1 + half
    steepness = 8.0 / half**2
    forces = np.zeros((count, 4, 4, 5))
    forces[:, 0, :, 0] = 1.0
    forces[deep, :3, 2, 0] = [floor + steepness * lowest**2, -2 * steepness * lowest, steepness]
    dynamics = eqx.tree_at(lambda t: t.force, dynamics, jnp.asarray(forces))
    found = minimum_margin(dynamics, phase_schedule, jnp.asarray(1.0), motion, IntegratorOptions())
    assert float(found.margin) == pytest.approx(floor, abs=1e-9)
    assert int(found.contact) == 2
    assert float(found.s) == pytest.approx(deep + (lowest + 1) / 2, abs=1e-6)
    assert float(found.loss_time) == (float(found.phase_time) if floor < 0 else np.inf)
    assert floor > 0 or int(found.loss_contact) == 2


def _watched(**crossings):
    """Event functions of which only the crossings matter: the other fields stay empty."""
    return EventFunctions(**dict.fromkeys(EventFunctions._fields) | crossings)


@pytest.mark.parametrize("side", [1, -1])
def test_what_passes_and_comes_back_within_a_step_is_met_on_its_way_down(side):
    """A vertex that grazes a finger, or its back: it dips through soon, and is back to rounding where the step ends."""
    lower, upper = jnp.array([0.0, -jnp.inf]), jnp.array([1.0, jnp.inf])
    watch = _watched(
        lower=lower,
        upper=upper,
        is_terminal=jnp.array([True, True]),
        two_sided=jnp.array([True, False]),
        half_width=jnp.zeros(2),
        may_part=jnp.array([False, False]),
    )
    step, inside = 2e-3, jnp.array([0.5, 0.0])
    gap = np.polynomial.Polynomial.fromroots([0.3 * step, 0.999999 * step])
    steady = jnp.array([1.0])  # some room that nothing changes

    def at(s):
        values, rates = jnp.array([side * gap(s)]), jnp.array([side * gap.deriv()(s)])
        return EventValues(jnp.append(values, steady), jnp.append(rates, 0.0), inside)

    assert gap(step) > 0 > gap(0.5 * step)
    for end in (step, 0.999 * step):  # back outside, and not yet
        crossed, where = detect_events(watch, at(0.0), at(end), end, 1e-16)
        assert list(np.asarray(crossed)) == [True, False]
        assert float(where[0] * end) == pytest.approx(0.3 * step, rel=1e-9)


@pytest.mark.parametrize(("angle", "status"), [(np.pi / 2, "ok"), (np.pi - 0.2, "left_formation")])
def test_a_finger_may_not_pierce_the_object(angle, status):
    """A square that the palm and one finger hold, and the other finger beside it, or through two of its edges."""
    square = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
    contacts = ["palm:v0", "palm:v1", "finger2:v0", "finger2:v3"]
    start = [0.0, 0.5, 0.0, angle, np.pi / 2]
    beside = scene(square, contacts, "theta1+", start, joint=(2.0, -0.5), length=3.0)
    assert wa.Status(int(wa.trace(beside)[0].dynamics.status)).label == status


def test_a_convex_object_is_not_held_by_a_finger_s_back():
    """A flat polygon whose vertex touches a finger without being pierced, and which lies behind it."""
    upper = [[1.0, -0.0094], [0.8911, 0.0653], [0.5899, 0.1157], [-0.0242, 0.143]]
    lower = [[-0.864, 0.0709], [-0.9937, -0.0105], [-0.3774, -0.1331], [0.6787, -0.1061]]
    contacts = ["finger1:v0", "finger2:v2", "palm:v1", "palm:v2"]
    start = [0.8951, 0.7397, -2.3001, 1.4571, 0.5759]
    joints, offset = (1.58917, -0.60079), (0.25245, 0.0)
    near = scene(upper + lower, contacts, "theta1+", start, joint=joints, length=1.86075, offset=offset)
    near = eqx.tree_at(lambda s: s.hand.joint, near, near.hand.joint.at[0, 1].set(-0.38341))
    assert int(wa.trace(near)[0].dynamics.status) == wa.Status.LEFT_FORMATION


def test_a_vertex_stops_at_the_back_of_a_finger():
    """A fingertip lies in a polygon's notch, which turns until one of its sides comes down on the finger's back."""
    lower = [[-0.1329, 0.0351], [-0.242, 0.0235], [-0.2817, 0.0035], [-0.1905, -0.0126], [-0.1286, -0.0474]]
    upper = [[0.0768, -0.0378], [0.2606, -0.0203], [0.2611, 0.0124], [0.1257, 0.0325], [0.0003, 0.0468]]
    contacts = ["palm:v2", "finger1:e3", "finger1:e2", "finger2:v7"]
    start = [-0.05781, 0.24483, -4.17855, 2.78475, 0.97554]
    notched = scene(lower + upper, contacts, "phi-", start, joint=(0.28353, -0.51556), length=1.51684)
    notched = eqx.tree_at(lambda s: s.hand.length, notched, notched.hand.length.at[0].set(0.24942))
    traced = wa.trace(notched)[0]
    assert int(traced.dynamics.status) == wa.Status.OK
    assert describe_end(notched, notched.phases[0], traced) == "finger1:v4 is made"
    side = np.subtract(lower[3], lower[4])  # from the rim to the bottom, where the tip is: along the finger at the end

    def across(z):
        """How far the rim is behind the finger: the sine of the angle between finger and side, times its length."""
        way = z[..., 3] - z[..., 2]
        return np.cos(way) * side[1] - np.sin(way) * side[0]

    assert across(np.asarray(traced.end)) == pytest.approx(0, abs=1e-12)
    used = np.asarray(traced.path.segment_of_panel) < int(traced.dynamics.count)
    assert np.all(across(np.asarray(traced.path.nodes)[used]) > 0)


@pytest.mark.parametrize(
    ("offset", "corner"), [(0.0, "finger1's root"), (-0.01, "the palm's end at finger1"), (0.01, "finger1's root")]
)
def test_the_hand_s_corners_stop_the_object(offset, corner):
    """A block tips over its lower right corner: its side comes down on the palm's end, or on a root in front of it."""
    block = [[-0.3, -0.5], [0.3, -0.5], [0.3, 0.5], [-0.3, 0.5]]
    start = [0.857, 0.46, -1.2, 0.52, 0.476]
    contacts = ["palm:v1 rolling", "finger1:v2", "finger2:v0"]
    tipping = scene(block, contacts, "phi-", start, joint=(0.8, -0.8), length=2.5, offset=(offset, 0.0))
    traced = wa.trace(tipping)[0]
    assert int(traced.dynamics.status) == wa.Status.OK
    assert describe_end(tipping, tipping.phases[0], traced) == f"e1 meets {corner}"
    x, y, phi, theta, _ = np.asarray(traced.end)
    met = np.array([0.8, 0.0]) + max(offset, 0.0) * np.array([-np.sin(theta), np.cos(theta)])
    across = np.array([np.cos(phi), np.sin(phi)]) @ (met - [x, y])
    assert across == pytest.approx(0.3, abs=1e-12)
    assert (phi == pytest.approx(-np.pi / 2, abs=1e-12)) == (offset <= 0)


def test_links_within_an_object_of_any_shape():
    """Parts of fingers and of the palm within polygons that are not convex, as another library sees them."""
    rng, found = np.random.default_rng(4), []
    for _ in range(60):
        angle, radius = np.sort(rng.uniform(0, 2 * np.pi, 11)), rng.uniform(0.2, 1.2, 11)
        star = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        contacts = ["palm:v0", "palm:v1", "finger1:v2", "finger2:v3"]
        holding = scene(star.tolist(), contacts, "x+", [0.0] * 5, joint=(1, -1), length=2, offset=(0.2, -0.2))
        near, z = mechanics(holding), np.append(rng.normal(size=2) * 2 + [0, 1], rng.uniform(0, np.pi, 3))
        turn = np.array([[np.cos(z[2]), np.sin(z[2])], [-np.sin(z[2]), np.cos(z[2])]])
        outline = Path(np.asarray(rigid_body(holding.object).vertices)[:11] @ turn + z[:2])
        share, links = np.linspace(0, 1, 2001)[:, None], [np.linspace([-1, 0], [1, 0], 2001)]
        for x, theta in ((1, z[3]), (-1, z[4])):
            root = [x - 0.2 * np.sin(theta), 0.2 * np.cos(theta)]
            links.append(root + 2 * share * [np.cos(theta), np.sin(theta)])
        expected = bool(outline.contains_points(np.concatenate(links)).any())
        pairs = contact_kinematics(near.candidates, jnp.asarray(z) / near.configuration_unit)
        assert bool(link_penetrates_object(near, pairs, 1e-10)) == expected
        found.append(expected)
    assert 10 < sum(found) < 50


def test_too_few_steps_are_always_said():
    """A phase of several pieces that needs more steps than the record holds says `max_steps`, or is right."""
    dynamics, phase_schedule = track([0.0, 1.0, 2.0, 99.0], [1.0, 1.0, 1.0], knots=9)
    whole = simulate_motion(dynamics, phase_schedule, jnp.asarray(1.0), options=IntegratorOptions(), speed=4.0)
    needed = int(whole.count)
    assert needed > 9
    short = jax.jit(simulate_motion, static_argnames=("options", "speed"))
    said = []
    for most in (*range(3, needed - 3, 3), *range(needed - 3, needed + 2)):  # each size is a program
        motion = short(dynamics, phase_schedule, jnp.asarray(1.0), options=IntegratorOptions(max_steps=most), speed=4.0)
        said.append(int(motion.status) == wa.Status.MAX_STEPS)
        if not said[-1]:
            assert float(motion.s[motion.count]) == pytest.approx(4.0, rel=1e-12)
            assert float(motion.phase_time[motion.count]) == 1.0
    assert said[0]
    assert not said[-1]


def test_a_motion_may_stop_and_go_on_often():
    """Pushes and pauses, twelve of each: more stages than a phase usually has."""
    slide = layered("heptagon")
    dynamics = wa.trace(slide)[0].dynamics
    push = np.asarray(best_quasistatic_torque(dynamics, dynamics.breakpoints[0], 0.0, 3.0).torque)
    brake = np.asarray(best_quasistatic_torque(dynamics, dynamics.breakpoints[0], 0.0, -6.0).torque)
    cycle = np.stack([push, push, brake, brake, brake, brake])
    ticks = np.array([0.0, 1.0, 1.0, 2.0, 2.0, 4.0]) / 4
    times = np.concatenate([(k + ticks) / 12 for k in range(12)])
    values = np.tile(cycle, (12, 1))
    keep = np.concatenate([[True], np.diff(times) >= 0])
    times, first = times[keep], values[keep]
    # No time more than twice: the step at 2.0 repeats the row before it.
    unique = np.concatenate([[True], ~((np.diff(times) == 0) & np.all(np.diff(first, axis=0) == 0, axis=1))])
    schedule = wa.torque_schedule(times[unique], first[unique])
    (phase,) = wa.simulate(eqx.tree_at(lambda s: s.phases, slide, slide.phases[:1]), schedule).phases
    assert phase.status is wa.Status.STUCK, "it rests when time is over"
    assert len(phase.holds) == 12
    stops = [float(phase.outcome.motion.s[k]) for k in np.flatnonzero(phase.outcome.motion.at_rest)]
    assert np.diff(stops).min() > 1e-4, "each push moves it"


def notched(flat, **phase):
    """A part with a notch in its top, beside a finger; vertex 1 is `flat` [m] beyond the line through vertex 2."""
    finger = {"length": 0.1, "inertia": 2e-3, "viscous": 0.02, "dry": 0.01, "torque_limit": 1.0, "range": [-3.2, 6.2]}
    hand = {"finger1": finger | {"joint": [0.06, -0.02]}, "finger2": finger | {"joint": [-0.05, 0.0]}}
    corners = [[0, 0], [0.06 + flat, 0], [0.06, 0.04], [0.03, 0.03], [0, 0.04]]
    body = {"center_of_mass": [0.03, 0.02], "inertia": 1e-4, "mass": 0.2, "friction": 0.2}
    return wa.parse(
        {
            "title": "notched",
            "gravity": 9.81,
            "hand": hand | {"fingers": "layered"},
            "object": body | {"vertices": corners},
            "start": {"x": 0.03, "y": 0.02, "phi": 0.0, "theta1": np.pi / 2, "theta2": np.arctan2(0.04, 0.05)},
            "phase": [{"name": "p", "duration": 1.0} | phase],
        }
    )


@pytest.mark.parametrize(("toward", "length"), [("theta1-", 0.0), ("theta1+", 1.6058)])
def test_a_vertex_that_begins_flush_stops_a_part_with_a_notch(toward, length):
    """10 nm behind the finger's line it does not count as behind the finger; the way on is measured by shapely."""
    plan = notched(1e-8, contacts=["finger1:v2 rolling", "palm:v0", "finger2:v4"], toward=toward)
    traced = wa.trace(plan)[0]
    assert float(traced.dynamics.length) == pytest.approx(length, abs=1e-4)
    corners = np.asarray(rigid_body(plan.object).vertices)[:5]
    joint = np.asarray(plan.hand.joint)[0]
    for s in np.linspace(0.0, length, 20):
        z = np.asarray(configuration(traced.dynamics, jnp.asarray(0), traced.dynamics.breakpoints[0] + s))
        (c, q), (c1, q1) = ((np.cos(a), np.sin(a)) for a in z[2:4])
        outline = Polygon(corners @ np.array([[c, q], [-q, c]]) + z[:2])
        finger = LineString([joint, joint + 0.1 * np.array([c1, q1])])
        assert finger.intersection(outline.buffer(-1e-5)).length == 0


def test_what_touches_and_sinks_is_met_at_once():
    """A gap of 0 that dips to -0.01 and comes back within a step; one that dips below rounding alone does not count."""
    step, tolerance = 0.2, 1e-10
    old, leaving = jnp.zeros(2), jnp.array([-0.2, -1e-12])
    before = EventValues(values=old, rates=leaving, along=old)
    after = EventValues(values=old + 1e-3, rates=-leaving + 0.01, along=old)
    unlimited = jnp.full(2, jnp.inf)
    flags = {"two_sided": old > 1, "may_part": old > 1, "is_terminal": old == 0}
    events = _watched(lower=-unlimited, upper=unlimited, half_width=old, **flags)
    crossed, where = detect_events(events, before, after, step, tolerance)
    np.testing.assert_array_equal(crossed, [True, False])
    assert 0 <= float(where[0]) < 1e-6


@pytest.mark.parametrize(("phi", "behind"), [(0.0, True), (np.pi, False)])
def test_a_link_is_not_touched_from_behind(phi, behind):
    """A triangle that stands with a vertex on the back of finger 2, level in the air, and one that hangs below it."""
    contacts = ["finger2:v0", "finger1:v1", "palm:v1", "palm:v2"]
    plan = scene([[0.0, 0.0], [0.03, 0.05], [-0.03, 0.05]], contacts, "x-", (0,) * 5, joint=(0.2, -0.1), length=0.2)
    apex = np.asarray(rigid_body(plan.object).vertices)[0]
    turn = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
    z = jnp.asarray([*(-turn @ apex), phi, np.pi / 2, 0.0])  # finger 2 lies along y = 0, its front below
    fixed = mechanics(plan)
    rows = contact_kinematics(fixed.candidates, z / fixed.configuration_unit).gap
    in_front = lie_before_link(fixed, rows, jnp.asarray(1e-9)).reshape(len(FEATURE_GROUPS), -1)[2, 0]
    assert bool(in_front) is not behind
    if behind:
        assert bool(violates_contact_limits(fixed, z / fixed.configuration_unit))
    said = describe_refused_start(plan, plan.phases[0], z) or ""
    assert ("finger2:v0: the object lies behind finger2" in said) is behind


def test_rounding_does_not_put_a_finger_into_the_palm():
    """A finger from below the palm's surface whose tip is level with it, to within rounding."""
    joint, length = 0.02, 0.1
    hand = scene(
        [[0.0, 0.0], [0.03, 0.0], [0.0, 0.03]],
        ["palm:v0", "palm:v1", "finger1:v1", "finger2:v2"],
        "x-",
        (0, 0, 0, 1, 1),
        joint=(0.08, -0.08),
        length=length,
    ).hand
    low = eqx.tree_at(lambda h: h.joint, hand, jnp.array([[0.08, -joint], [-0.08, 0.0]]))
    level = np.pi - np.arcsin(joint / length)
    for off, depth in ((1e-12, 0.0), (-1e-12, 0.0), (0.1, joint)):
        found = float(link_overlaps(low, jnp.array([level + off, np.pi / 2]))[1])
        assert found == pytest.approx(depth, abs=1e-9 if depth == 0 else length * np.sin(0.1))
