"""Parts of other shape meet their stops elsewhere: the law comes to them slowly, and goes on to those that are late."""

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.execution import Amounts, execute, run_trials
from wholearm_jax.feedback import feedback, stop_torque
from wholearm_jax.feedback.design import _default_rates, corner_scenes
from wholearm_jax.feedback.path_table import tabulate_path
from wholearm_jax.feedback.reference_motion import passing_motion, smooth_motions
from wholearm_jax.feedback.stop_places import draw_shapes, stop_places
from wholearm_jax.feedback.stop_torque import choose_push, object_at_stop
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.model import object_radius, rigid_body
from wholearm_jax.phases import describe_end

SHAPE = 5e-4


@pytest.fixture(scope="module")
def heptagon():
    scene = wa.load("heptagon")
    return wa.simulate(scene, wa.quasistatic(scene))


@pytest.mark.parametrize(("slow", "approach"), [(0.0, 0.0), (0.07, 0.28)])
def test_a_reference_comes_to_the_end_in_time(slow, approach):
    for motion in smooth_motions(1.6, 1.0, slow, approach):
        assert motion.s[0] == motion.v[0] == 0
        assert motion.s[-1] == pytest.approx(1.6, abs=1e-12)
        assert motion.v[-1] == pytest.approx(approach, abs=1e-12)
        assert (motion.v >= 0).all()
        late = motion.s > 1.6 - slow
        np.testing.assert_allclose(motion.v[late][:-1], approach, atol=0.05)
        slow_at = 1.0 - (slow / approach if slow else 0.0)  # a node: the law does not brake there any more
        assert (motion.a[motion.time >= slow_at - 1e-12] == 0).all()
        steps = np.diff(motion.time)
        np.testing.assert_allclose(np.diff(motion.s), steps * (motion.v[1:] + motion.v[:-1]) / 2, atol=2e-4)
        np.testing.assert_allclose(np.diff(motion.v)[:60], (steps * (motion.a[1:] + motion.a[:-1]) / 2)[:60], atol=1e-2)


@pytest.mark.parametrize(("slow", "approach", "leaves"), [(0.0, 0.0, 0.0), (0.0, 0.0, 0.9), (0.07, 0.28, 0.0)])
def test_a_reference_that_flows_in_comes_to_the_end_in_time(slow, approach, leaves):
    motion = passing_motion(1.6, 1.0, 1.2, leaves, slow, approach)
    assert motion.s[0] == 0
    assert motion.v[0] == pytest.approx(1.2, abs=1e-12)
    assert motion.s[-1] == pytest.approx(1.6, abs=1e-12)
    assert motion.v[-1] == pytest.approx(leaves or approach, abs=1e-12)
    np.testing.assert_allclose(motion.v[motion.s > 1.6 - slow][:-1], approach, atol=1e-12)
    steps, fast = np.diff(motion.time), motion.s[1:] < 1.6 - slow
    np.testing.assert_allclose(np.diff(motion.s), steps * (motion.v[1:] + motion.v[:-1]) / 2, atol=2e-4)
    np.testing.assert_allclose(np.diff(motion.v)[fast], (steps * (motion.a[1:] + motion.a[:-1]) / 2)[fast], atol=1e-2)


def test_stops_of_drawn_parts_lie_within_what_is_said(heptagon):
    scene = heptagon.scene
    tables = [tabulate_path(phase.traced.dynamics) for phase in heptagon.phases]
    places, smaller = (
        stop_places(tables, [wa.trace(part) for part in draw_shapes([scene], shape)]) for shape in (SHAPE, SHAPE / 10)
    )
    for table, place, near in zip(tables, places, smaller, strict=True):
        assert 0 < near.before < place.before < 0.1 * table.s[-1]
        assert 0 < near.beyond < place.beyond < 0.1 * table.s[-1]
    # Of parts that were not drawn, few stop beyond what was said of those that were.
    others = [wa.trace(part) for part in draw_shapes([scene], SHAPE, seed=1)]
    for k, (table, place) in enumerate(zip(tables, places, strict=True)):
        alone = [stop_places(tables[: k + 1], [other[: k + 1]])[k] for other in others]
        outside = sum(other.before > place.before or other.beyond > place.beyond for other in alone)
        assert outside <= 2, (alone, place, table.s[-1])


@pytest.mark.parametrize(
    ("torque", "bound", "chosen"),
    [([0.3, -0.2], np.inf, 0.0), ([0.317, -0.139], np.inf, 15.0), ([0.317, -0.139], 0.06, 12.0)],
)
def test_the_push_at_a_stop_has_the_largest_margin_of_all_that_move_every_object(heptagon, torque, bound, chosen):
    scene, phase, path = heptagon.scene, heptagon.scene.phases[0], heptagon.phases[0].traced
    stops = [object_at_stop(scene, phase, path)]
    for other in corner_scenes(scene, 0.2, 0.1)[1:4]:
        stops.append(object_at_stop(other, phase, wa.trace(other)[0]))
    torque, limit = np.array(torque), np.asarray(scene.hand.torque_limit)
    push, direction = choose_push(stops, torque, limit, either_finger=True, bound=bound)
    assert push == chosen
    assert (np.abs(push * direction) <= bound).all()

    def margin(under):
        return min(stop.statics.margin_under(under).margin for stop in stops)

    found, tried = margin(torque + push * direction), 0
    pull = stops[0].acceleration[3:]
    ahead, across = pull / np.hypot(*pull), np.array([-pull[1], pull[0]]) / np.hypot(*pull)
    for size in np.linspace(0.0, 60.0, 61):
        for turn in np.linspace(-1.2, 1.2, 7):
            under = torque + size * (ahead + np.tan(turn) * across) / np.hypot(*pull)
            moves = min(stop.acceleration[0] + under @ stop.acceleration[3:] for stop in stops)
            if moves >= 5.0 and (np.abs(under) <= limit).all() and (np.abs(under - torque) <= bound).all():
                tried += 1
                assert margin(under) <= found + 1e-9
    assert tried > 10


def test_a_push_squeezes_an_object_that_milder_ones_tip(heptagon, monkeypatch):
    """Where it is to be moved by 16 rad/s^2, with torques that hold it loosely until then."""
    monkeypatch.setattr(stop_torque, "DECISIVE", 16.0)
    scene, phase, path = heptagon.scene, heptagon.scene.phases[1], heptagon.phases[1].traced
    stop, torque = object_at_stop(scene, phase, path), np.array([0.031, -0.045])
    assert stop.statics.margin_under(torque).margin > 0
    pull = stop.acceleration[3:]
    ahead, across = pull / np.hypot(*pull), np.array([-pull[1], pull[0]]) / np.hypot(*pull)
    for turn in np.linspace(-1.2, 1.2, 7):
        direction = ahead + np.tan(turn) * across
        least = (16.0 - stop.acceleration[0] - torque @ pull) / (direction @ pull)
        for size in least * np.array([1.0, 1.5, 3.0]):
            assert stop.statics.margin_under(torque + size * direction).margin < 0
    push, direction = choose_push([stop], torque, np.ones(2), either_finger=True)
    pressed = torque + push * direction
    assert stop.acceleration[0] + pressed @ pull >= 16.0
    assert (np.abs(pressed) <= 1.0).all()
    assert stop.statics.margin_under(pressed).margin > 0
    alone = choose_push([stop], torque, np.ones(2), either_finger=False)
    np.testing.assert_allclose(alone[1] / np.hypot(*alone[1]), ahead, err_msg="one finger alone has no choice")


def test_parts_that_need_not_be_held_spoil_no_push_at_a_stop(tmp_path):
    """No push holds a rounded plate and all parts that are a little off its shape where the next vertex comes."""
    turns = np.pi / 8 * np.arange(5)
    middles = {-np.pi / 2: (70, 10), 0.0: (70, 40), np.pi / 2: (10, 40), np.pi: (10, 10)}
    arcs = [np.add(at, 10 * np.column_stack([np.cos(a + turns), np.sin(a + turns)])) for a, at in middles.items()]
    rows = np.roll(np.vstack(arcs), 1, axis=0)
    (tmp_path / "plate.csv").write_text("x [mm],y [mm]\n" + "\n".join(f"{x:.6f},{y:.6f}" for x, y in rows))
    friction = {"palm": 0.5, "finger1": 0.1, "finger2": 0.1}
    scene = wa.scene_from_outline(wa.read_outline(tmp_path / "plate.csv"), friction=friction)
    slide = {"name": "slide", "contacts": ["palm:v0", "palm:v1", "finger1:v7", "finger2:v14"], "toward": "x-"}
    scene = wa.parse(to_dict(scene) | {"phase": [slide | {"duration": 1.0}]})
    result = wa.simulate(scene, wa.quasistatic(scene))
    controller = feedback(scene, result.torque, friction=0.05)
    assert controller.margin > 0
    (law,) = controller.phases
    assert (np.abs(law.press * law.gain[-1]) <= controller.push).all()
    under = law.torque[-1] + law.press * law.gain[-1]
    for one in corner_scenes(scene, 0.05, 0.0):
        stop = object_at_stop(one, scene.phases[0], wa.trace(one)[0])
        assert stop.acceleration[0] + under @ stop.acceleration[3:] >= 5.0
        assert stop.statics.margin_under(under).margin > 0


def test_a_push_that_tips_objects_over_their_stop_makes_the_margin_negative(heptagon, monkeypatch):
    """Where every object is to be moved by no less than 16 rad/s^2, one of the set does not stay at its stop."""
    scene, torque = heptagon.scene, heptagon.torque
    assert feedback(scene, torque, friction=0.2).margin > 0
    monkeypatch.setattr(stop_torque, "DECISIVE", 16.0)
    law = feedback(scene, torque, friction=0.2).phases[1]
    under = law.torque[-1] + law.press * law.gain[-1]
    stops = [object_at_stop(one, scene.phases[1], wa.trace(one)[1]) for one in corner_scenes(scene, 0.2, 0.0)]
    assert law.margin == pytest.approx(min(stop.statics.margin_under(under).margin for stop in stops), abs=1e-9)
    assert law.margin < 0


def test_without_a_shape_the_reference_stops_at_the_end(heptagon):
    law = feedback(heptagon.scene, heptagon.torque, friction=0.0, shape=0.0)
    for phase in law.phases:
        assert phase.v_ref[-1] == 0
        assert phase.reach == 0.06
    other = feedback(heptagon.scene, heptagon.torque, friction=0.0, shape=SHAPE)
    for phase in other.phases:
        assert phase.reach > 0.06
        assert phase.v_ref[-1] == pytest.approx(phase.approach)
    with pytest.raises(ValueError, match="edges of the polygon could cross"):
        feedback(heptagon.scene, heptagon.torque, shape=0.02)


def test_the_margin_covers_parts_of_other_shape(heptagon):
    """Parts that the design has not drawn keep what it says, to 3 %."""
    scene, torque = heptagon.scene, heptagon.torque
    law = feedback(scene, torque, friction=0.2, shape=SHAPE)
    parts = draw_shapes(corner_scenes(scene, 0.2, 0.0), SHAPE, seed=1)
    checked = wa.check(parts, controller=law)
    assert (np.asarray(checked.status) == 0).all()
    assert law.margin == pytest.approx(float(checked.margin.min()), rel=0.03)
    assert law.margin < 0.95 * feedback(scene, torque, friction=0.2).margin


def test_parts_of_other_shape_arrive_at_their_own_stops(heptagon):
    law = feedback(heptagon.scene, heptagon.torque, friction=0.2, mass=0.1, shape=SHAPE)
    amounts = Amounts(friction=0.2, mass=0.1, geometry=SHAPE, start=1e-3)
    trials = run_trials(heptagon, 8, amounts, seed=0, timestep=5e-4, controller=law)
    assert trials.own_successes == 8


def larger(scene, size, mass):
    """The same plan for a part `size` times as large and `mass` times as heavy, in a hand that grows with it."""
    time, force = np.sqrt(size), mass
    units = {
        "joint": size,
        "length": size,
        "inertia": mass * size**2,
        "viscous": force * size * time,
        "dry": force * size,
        "torque_limit": force * size,
    }
    hand, shape = scene.hand, scene.object
    return eqx.tree_at(
        lambda s: (
            *(getattr(s.hand, name) for name in units),
            s.object.vertices,
            s.object.mass,
            s.start,
            *(phase.duration for phase in s.phases),
        ),
        scene,
        (
            *(np.asarray(getattr(hand, name)) * unit for name, unit in units.items()),
            np.asarray(shape.vertices) * size,
            np.asarray(shape.mass) * mass,
            np.asarray(scene.start) * np.array([size, size, 1, 1, 1]),
            *(np.asarray(phase.duration) * time for phase in scene.phases),
        ),
    )


def test_a_large_part_moves_as_a_small_one_does():
    """Lengths times 6, forces times 50, times by the square root of lengths: Froude's similarity of falling bodies."""
    small = wa.load("heptagon")
    fall = np.hypot(*np.asarray(small.gravity)) / object_radius(small.object)
    small = larger(small, fall / stop_torque.FALL, 1.0)  # as large as pushes and speeds are meant for
    size, mass = 6.0, 50.0
    laws = []
    for scene, slow in ((small, 1.0), (larger(small, size, mass), np.sqrt(size))):
        assert stop_torque.slowness(scene) == pytest.approx(slow, rel=1e-6)
        laws.append(wa.feedback(scene, wa.quasistatic(scene), friction=0.2))
    own, its = laws
    assert own.margin > 0
    assert (own.stiffness, own.integral, own.observer) == pytest.approx((60.0, 10.0, 200.0), rel=1e-6)
    assert (its.stiffness, its.integral, its.observer) == pytest.approx((60.0 / slow, 10.0 / slow, 200.0 / slow))
    assert its.felt == pytest.approx((own.felt[0] / slow, own.felt[1] * slow), rel=1e-6)
    assert its.patience == pytest.approx(own.patience * slow, rel=1e-6)
    for one, other in zip(own.phases, its.phases, strict=True):
        assert other.margin == pytest.approx(mass * one.margin, rel=0.01)
        assert other.approach == pytest.approx(one.approach / slow, rel=1e-6)
        assert other.press == pytest.approx(one.press / slow**2, rel=1e-6)


def lasting(scene, *durations):
    """The same plan with other durations [s]."""
    phases = zip(scene.phases, durations, strict=True)
    return replace(scene, phases=tuple(replace(phase, duration=np.asarray(time)) for phase, time in phases))


def test_a_slow_motion_has_a_law_that_an_encoder_does_not_reverse(heptagon):
    """With the rates of a fast one the loop could not be followed, nor did executions keep their contacts."""
    scene = lasting(heptagon.scene, 12.0, 12.0)
    law = wa.feedback(scene, wa.quasistatic(scene), friction=0.2)
    assert law.margin > 0.3
    slowest = min(float(phase.s[-1]) for phase in law.phases) / 12.0
    by_a_step = law.stiffness * 2 * np.pi / 4096
    assert by_a_step == pytest.approx(1.2 * slowest, rel=1e-6)
    assert (law.integral, law.observer) == pytest.approx((law.stiffness / 6, law.stiffness / 0.3), rel=1e-6)


def test_a_loop_settles_within_the_shortest_phase(heptagon):
    """A slow phase lowers the rates only so far."""
    tables = [tabulate_path(phase.traced.dynamics) for phase in heptagon.phases]
    usual = {"stiffness": 60.0, "integral": 10.0, "observer": 200.0}
    brief, otherwise = _default_rates(lasting(heptagon.scene, 20.0, 0.8), tables)
    assert brief["stiffness"] == pytest.approx(20.0 / 0.8, rel=1e-12)
    assert otherwise == usual
    assert _default_rates(lasting(heptagon.scene, 20.0, 0.1), tables) == [usual]


def test_a_finger_that_its_torque_does_not_bring_back_is_not_at_its_stop(heptagon):
    """A finger that went on alone comes back only if its torque is more than its dry friction."""
    dry, path = 0.2, heptagon.phases[0].traced
    scene = eqx.tree_at(lambda s: s.hand.dry, heptagon.scene, np.full(2, dry))
    stop = object_at_stop(scene, scene.phases[0], path)
    weak, strong = np.array([[0.9 * dry, -0.3], [1.1 * dry, -0.3]])
    assert stop.surplus(weak)[0] < 0 < stop.surplus(strong)[0]
    assert stop.surplus(strong)[1] == pytest.approx((0.3 - dry) / lever(scene, path, 2), rel=1e-6)
    assert stop.statics.margin_under(weak).margin > 0, "dry friction would help to hold the contact"
    # It leaves the object at the speed of its joint, and friction and torque brake it evenly.
    leaves = 8.0 * tabulate_path(path.dynamics).tangent[-1, 0]
    assert leaves < 0
    away = float(scene.hand.inertia[0]) * leaves**2 / (2 * 1.9 * dry) * lever(scene, path, 1)
    assert stop.distances_away(weak, 8.0) == pytest.approx([away, 0.0], rel=1e-6)
    assert (stop.distances_away(strong, 8.0) == 0).all()
    assert away > 5e-4
    assert stop.pressed_over(weak, 8.0) == pytest.approx(stop.surplus(weak)[0])
    assert stop.pressed_over(weak, 0.15) == np.inf, "it comes to rest next to the object"
    assert stop.pressed_over(strong, 8.0) == np.inf
    assert stop.pressed_over(weak, 8.0, either_finger=False) == np.inf
    size, direction = choose_push([stop], weak, np.ones(2), either_finger=True)
    assert (stop.surplus(weak + size * direction) > 0).all(), "pushes that bring it back are preferred"


def lever(scene, path, finger):
    """How far a finger's contacts at a path's end are from its joint, together [m]."""
    x, y, phi, *theta = np.asarray(path.end)
    turn = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])
    corners = (np.asarray(rigid_body(scene.object).vertices) @ turn.T) + [x, y]
    along = np.array([np.cos(theta[finger - 1]), np.sin(theta[finger - 1])])
    touching = {1: (6,), 2: (1, 2)}[finger]
    return sum((corners[k] - np.asarray(scene.hand.joint)[finger - 1]) @ along for k in touching)


def test_an_edge_is_not_pressed_against_a_fingers_root():
    """A corner above the palm, at which no formation holds an object: the law comes there by itself, and stays."""
    scene = wa.load(Path(__file__).parents[1] / "data" / "edge_at_root.toml")
    optimum = wa.optimise(scene)
    assert describe_end(scene, scene.phases[0], optimum.result.phases[0].traced) == "e1 meets finger1's root"
    law = wa.feedback(scene, optimum.torque, friction=0.1)
    assert law.phases[0].reach == 0
    assert law.margin > 0
    done = execute(optimum.result, timestep=5e-4, controller=law)
    assert done.ending.value == "ok", done.message
    assert done.position_error < 5e-4
