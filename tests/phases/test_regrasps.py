"""Fingers that are away and regrasps: statics against a programme of the test's own, paths, refusals, executions."""

import copy

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.optimize import brentq, linprog

import wholearm_jax as wa
from wholearm_jax.core import SceneError
from wholearm_jax.ensembles import make_ensemble, optimise_robustly
from wholearm_jax.execution.executions import ExecutionOutcome, execute, rollout
from wholearm_jax.execution.mujoco_model import build_mujoco_model
from wholearm_jax.feedback import law_tables
from wholearm_jax.files import load_start
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.margin import contact_statics, rest_margin, without_joint
from wholearm_jax.model import contact_formation
from wholearm_jax.phases import closed_loop_result, describe_end


def scene_data():
    """The bundled heptagon at rest on an edge, without phases."""
    data = to_dict(wa.load("heptagon"))
    begin = np.asarray(wa.trace(wa.load("heptagon"))[0].begin).tolist()
    return data | {"start": dict(zip(("x", "y", "phi", "theta1", "theta2"), begin, strict=True))}


def hand_over_hand():
    """Finger 1 opens, finger 2 pushes the object, finger 1 closes on it again."""
    hold = ["palm:v3", "palm:v4", "finger2:v2"]
    return [
        {"name": "open", "contacts": hold, "regrasp": "finger1:away", "until": {"theta1": 0.9}, "duration": 0.5},
        {"name": "push", "contacts": [*hold, "finger1:away"], "toward": "x+", "duration": 1.0},
        {"name": "close", "contacts": hold, "regrasp": "finger1:v6", "duration": 0.5},
    ]


@pytest.fixture(scope="module")
def data():
    return scene_data() | {"phase": hand_over_hand()}


@pytest.fixture(scope="module")
def optimum(data):
    return wa.optimise(wa.parse(data), knots=21)


def changed(data, number, **keys):
    """The plan with other keys of one phase; None removes a key."""
    other = copy.deepcopy(data)
    row = other["phase"][number] | keys
    other["phase"][number] = {key: value for key, value in row.items() if value is not None}
    return other


def independent_margin(scene, z, names, held_fingers):
    """The largest least force of a hold: forces and torques by hand from points and normals of the polygon."""
    vertices = np.asarray(scene.object.vertices)[: int(scene.object.count)]
    after = np.roll(vertices, -1, axis=0)
    cross = vertices[:, 0] * after[:, 1] - vertices[:, 1] * after[:, 0]
    centroid = (cross[:, None] * (vertices + after)).sum(0) / (3 * cross.sum())
    c, s = np.cos(z[2]), np.sin(z[2])
    corners = (vertices - centroid) @ np.array([[c, s], [-s, c]]) + z[:2]
    joints = np.asarray(scene.hand.joint)
    # Unknowns: c_n, c_t of each contact, torque and dry friction of each finger that takes part, the margin.
    n, f = len(names), len(held_fingers)
    size = 2 * n + 2 * f + 1
    balance, cone = np.zeros((3 + f, size)), []
    for k, name in enumerate(names):
        link, feature = name.split(":")
        point, finger = corners[int(feature[1:])], None if link == "palm" else int(link[-1])
        along = np.array([1.0, 0.0]) if finger is None else np.array([np.cos(z[2 + finger]), np.sin(z[2 + finger])])
        normal = np.array([-along[1], along[0]]) * (-1.0 if finger == 2 else 1.0)
        mu = float(scene.object.friction[0 if finger is None else finger])
        for column, force in ((k, normal), (n + k, np.array([normal[1], -normal[0]]))):
            arm = point - z[:2]
            balance[:3, column] = *force, arm[0] * force[1] - arm[1] * force[0]
            if finger in held_fingers:
                arm = point - joints[finger - 1]
                balance[3 + held_fingers.index(finger), column] = -(arm[0] * force[1] - arm[1] * force[0])
        for sign in (1.0, -1.0):
            row = np.zeros(size)
            row[k], row[n + k] = -mu, sign
            cone.append(row)
        row = np.zeros(size)
        row[k], row[-1] = -1.0, 1.0
        cone.append(row)
    for k in range(f):
        balance[3 + k, [2 * n + k, 2 * n + f + k]] = 1.0
    load = np.array([0.0, float(scene.object.mass) * 9.81, 0.0, *np.zeros(f)])
    limits = [float(scene.hand.torque_limit[i - 1]) for i in held_fingers]
    dry = [float(scene.hand.dry[i - 1]) for i in held_fingers]
    bounds = [(None, None)] * (2 * n) + [(-x, x) for x in (*limits, *dry)] + [(None, None)]
    found = linprog(
        [*np.zeros(size - 1), -1.0], np.array(cone), np.zeros(len(cone)), balance, load, bounds, method="highs"
    )
    assert found.success
    return found.x[-1]


@pytest.mark.parametrize(
    ("names", "moving"),
    [
        (["palm:v3", "palm:v4", "finger2:v2"], 1),
        (["palm:v3", "palm:v4", "finger1:v6"], 2),
        (["palm:v3", "palm:v4"], 1),
        (["palm:v3", "palm:v4", "finger2:v2", "finger2:v1"], 1),
    ],
)
def test_the_margin_of_a_hold_without_a_finger_is_that_of_a_programme_of_its_own(data, optimum, names, moving):
    scene = wa.parse(data)
    # Both fingers' vertices touch: of the last formation where the push ends, of the others at the start.
    z = np.asarray(optimum.result.phases[1 if "finger2:v1" in names else 0].traced.end)
    z = np.asarray(optimum.result.phases[0].traced.begin) if "finger1:v6" in names else z
    ours = without_joint(contact_statics(scene, contact_formation(names), z), moving).best().margin
    fingers = sorted({int(name[6]) for name in names if name.startswith("finger")})
    assert ours == pytest.approx(independent_margin(scene, z, names, fingers), abs=1e-9)


def test_a_push_topples_the_object_where_the_margin_is_negative_and_not_where_it_is_positive(data, optimum):
    """Finger 2 alone pushes it on a palm that it does not slide on: free bodies in MuJoCo stay, or fall over."""
    scene = wa.parse(data)
    scene = eqx.tree_at(lambda s: s.object.friction, scene, np.array([1.0, 0.1, 0.1]))
    z = np.asarray(optimum.result.phases[0].traced.end)  # finger 1 is away
    statics = without_joint(contact_statics(scene, contact_formation(["palm:v3", "palm:v4", "finger2:v2"]), z), 1)

    def margin(push):
        return rest_margin(statics, wa.torque_schedule([0.0, 1.0], [[0.0, push]] * 2), 0.0, 1.0).margin

    limit, bodies = brentq(margin, -0.1, -0.01, xtol=1e-9), build_mujoco_model(scene, 2e-4)
    for share, topples in ((0.97, False), (1.03, True)):
        assert (margin(share * limit) < 0) == topples
        course, *_ = rollout(bodies, z, np.tile([0.0, share * limit], (2500, 1)))
        turned = np.abs(course[-1, 2] - course[0, 2])
        assert turned > 5e-3 if topples else turned < 5e-5


def test_one_finger_at_a_time_moves(optimum):
    opens, pushes, closes = optimum.result.phases
    assert optimum.result.status is wa.Status.OK
    for phase, moving in ((opens, [3]), (closes, [3]), (pushes, [0, 4])):
        change = np.abs(np.asarray(phase.traced.end - phase.traced.begin))
        assert np.flatnonzero(change > 1e-9).tolist() == moving
    assert describe_end(optimum.scene, optimum.scene.phases[2], closes.traced) == "finger1:v6 is made"
    assert closes.traced.end[0] > opens.traced.begin[0] + 0.01


def test_the_finger_that_is_away_needs_no_torque(optimum):
    times, values = np.asarray(optimum.torque.times), np.asarray(optimum.torque.values)
    inside = (times > 0.5) & (times < 1.5)
    assert np.all(values[inside, 0] == 0)
    assert np.abs(values[inside, 1]).max() > 0


def test_the_push_obeys_newton(optimum):
    """Without finger 1 the object's acceleration is that of finger 2's force less the palm's friction."""
    motion = wa.trajectory(optimum.result, 401)[1]
    mass, mu = float(optimum.scene.object.mass), float(optimum.scene.object.friction[0])
    normal = np.sin(motion.z[:, 4])  # the x part of finger 2's normal, its slip's friction by the tangent
    push = motion.cn[:, 2] * normal + motion.ct[:, 2] * -np.cos(motion.z[:, 4])
    acceleration = np.gradient(motion.z_dot[:, 0], motion.time)
    moving = motion.z_dot[:, 0] > 0.2 * motion.z_dot[:, 0].max()
    expected = (push - mu * (motion.cn[:, 0] + motion.cn[:, 1])) / mass
    scale = np.abs(acceleration).max()
    np.testing.assert_allclose(acceleration[moving][1:-1], expected[moving][1:-1], atol=2e-2 * scale)
    assert np.isnan(motion.cn[:, 3]).all()


def test_a_hold_reports_its_statics(optimum):
    opens = optimum.result.phases[0]
    (held,) = opens.holds
    assert (held.start, held.end) == (0.0, 0.5)
    assert held.margin >= opens.margin > 0  # forces along the path are some of those that friction can give


def test_the_plan_is_executed_by_free_bodies(optimum):
    done = execute(optimum.result)
    assert done.ending is ExecutionOutcome.OK, done.message
    assert done.position_error < 5e-5
    assert not done.link_contacts


def test_files_keep_regrasps(data, tmp_path):
    scene = wa.parse(data)
    wa.save(scene, tmp_path / "regrasp.toml")
    again = wa.load(tmp_path / "regrasp.toml")
    assert [phase.regrasp for phase in again.phases] == ["finger1:away", None, "finger1:v6"]
    assert to_dict(again) == to_dict(scene)
    assert again.phases[1].formation.away == ("finger1:away",)
    assert load_start(tmp_path / "regrasp.toml").phases[0].formation.names == (
        "palm:v3 rolling",
        "palm:v4",
        "finger2:v2",
    )


def test_a_finger_that_misses_its_contact_is_named(data, optimum):
    wrong = wa.simulate(wa.parse(changed(data, 2, regrasp="finger1:v5")), optimum.torque)
    assert wrong.status is wa.Status.OBSTACLE
    assert "finger1:v6 is made before finger1:v5" in wrong.message


def test_a_start_that_puts_the_finger_within_the_object_is_told_unless_by_rounding(data, optimum):
    """Digits of single precision put a vertex some nanometres behind the finger that leaves it: it is flush."""
    rounded, deep = copy.deepcopy(data), copy.deepcopy(data)
    rounded["start"]["theta1"] += 4e-8
    deep["start"]["theta1"] += 4e-5
    assert wa.simulate(wa.parse(rounded), optimum.torque).status is wa.Status.OK
    wrong = wa.simulate(wa.parse(deep), optimum.torque)
    assert wrong.phases[0].status is wa.Status.LEFT_FORMATION
    assert "finger1 lies 0.0036 mm inside the object at vertex 6" in wrong.message


def test_a_finger_in_the_way_is_named(data, optimum):
    low = copy.deepcopy(data)
    low["hand"]["finger1"]["range"] = [1.2, np.pi]
    blocked = wa.simulate(wa.parse(low), optimum.torque)
    assert blocked.status is wa.Status.OBSTACLE
    assert "finger1 reaches its range at 68.75 deg" in blocked.message


@pytest.fixture(scope="module")
def pushing(optimum):
    """The optimum, but for a torque on finger 1 while it is away that exceeds dry friction."""
    values = np.asarray(optimum.torque.values).copy()
    values[(np.asarray(optimum.torque.times) > 0.6) & (np.asarray(optimum.torque.times) < 0.8), 0] = 0.02
    return wa.torque_schedule(optimum.torque.times, values)


def test_torque_that_turns_the_finger_that_is_away_is_refused(data, pushing):
    pushed = wa.simulate(wa.parse(data), pushing)
    assert pushed.phases[1].status is wa.Status.LEFT_FORMATION
    assert "finger1 does not stay away: its torque of 0.02 N m exceeds 0.01 N m" in pushed.phases[1].message
    assert wa.check([pushed.scene], pushed.torque).status.tolist() == [wa.Status.LEFT_FORMATION]


@pytest.mark.slow  # batches, which are judged by the same simulations, are checked below
def test_robust_schedules_are_scored_by_what_simulations_say(data, optimum, pushing):
    few = {"samples": 2, "steps": 1, "arrival": 0.02, "rate": 1e-9}
    drawn = make_ensemble(wa.parse(data), {"mass": "1%"}, seed=1)
    for torque, rate in ((optimum.torque, 1.0), (pushing, 0.0)):
        assert optimise_robustly(drawn, nominal=torque, **few).in_sample[0].success_rate == rate


def test_batches_judge_what_a_finger_makes_as_simulations_do(data, optimum):
    """Stacked scenes keep their regrasps, and an ensemble's draws are judged alone."""
    scene = wa.parse(changed(data, 2, regrasp="finger1:v5"))
    heavier = eqx.tree_at(lambda s: s.object.mass, scene, 1.01 * scene.object.mass)
    drawn = make_ensemble(wa.parse(data), {"mass": "1%"}, seed=1)
    for scenes, count, expected in (([scene, heavier], None, wa.Status.OBSTACLE), (drawn, 2, wa.Status.OK)):
        assert wa.check(scenes, optimum.torque, count=count, arrival=0.02).status.tolist() == [expected] * 2


@pytest.mark.parametrize(
    ("number", "keys", "message"),
    [
        (0, {"regrasp": "palm:v3"}, "phase[0].regrasp: 'palm:v3': a regrasp moves a finger"),
        (2, {"regrasp": "finger1:v9"}, "phase[2].regrasp: 'finger1:v9': the object has vertices 0 to 6"),
        (0, {"regrasp": "finger2:away"}, "phase[0].contacts: finger2 moves; name the contacts"),
        (0, {"until": None}, "phase[0].until: missing; say how far the finger opens: until = { theta1 = ... }"),
        (0, {"toward": "x+"}, "phase[0].toward: finger1:away moves theta1 alone; leave it out"),
        (0, {"hold": True}, "phase[0].hold: a finger moves in a regrasp; leave it out"),
        (2, {"until": {"theta1": 1.0}}, "phase[2].until: the finger moves until it makes finger1:v6; leave it out"),
        (0, {"arrive": "moving"}, "phase[1].contacts: finger1:away must be at rest; phase 'open' arrives moving"),
        (1, {"contacts": ["palm:v3", "palm:v4", "finger1:v6", "finger1:away"]}, "phase[1].contacts: a finger that is"),
        (0, {"contacts": ["palm:v3"]}, "phase[0].contacts: 3 constraints; a hold needs exactly 4"),
    ],
)
def test_wrong_phases_are_refused_in_one_line(data, number, keys, message):
    with pytest.raises(SceneError, match=r"^scene: ") as refusal:
        wa.parse(changed(data, number, **keys))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_limited_rates_are_refused(data):
    with pytest.raises(ValueError, match="in phase 'push' a finger is away"):
        wa.optimise(wa.parse(data), rate_limit=10.0)


def test_the_path_can_be_differentiated(data):
    """Where the push ends depends on an offset of finger 2: forward and reverse mode against a difference."""
    push = wa.parse(data | {"phase": data["phase"][1:2], "start": data["start"] | {"theta1": 0.9}})

    @jax.jit
    def end(length):
        scene = eqx.tree_at(lambda s: s.hand.joint, push, push.hand.joint.at[1, 0].set(length))
        return wa.trace(scene)[0].end[0]

    joint, step = float(push.hand.joint[1, 0]), 1e-6
    difference = (float(end(joint + step)) - float(end(joint - step))) / (2 * step)
    assert float(jax.jit(jax.grad(end))(joint)) == pytest.approx(difference, rel=1e-6)
    assert float(jax.jit(jax.jacfwd(end))(joint)) == pytest.approx(difference, rel=1e-6)
    assert abs(difference) > 0.1


def test_a_law_leaves_a_finger_that_is_away_alone(data, optimum):
    """Such a finger's torque moves nothing else: none at all, so that dry friction keeps the finger where it is."""
    law = wa.feedback(wa.parse(data), optimum.torque, friction=0.05)
    opens, pushes, closes = law.phases
    np.testing.assert_array_equal(pushes.torque[:, 0], 0.0)
    np.testing.assert_array_equal(pushes.gain[:, 0], 0.0)
    for phase in (opens, closes):  # and the finger that holds the object does not answer to the other one's place
        np.testing.assert_array_equal(phase.gain[:, 1], 0.0)
    execution = execute(optimum.result, controller=law, timestep=1e-3)
    assert execution.ending is ExecutionOutcome.OK
    stands = (execution.course.time > 0.6) & (execution.course.time < 1.4)
    assert np.ptp(execution.course.z[stands, 3]) < 1e-3


def test_a_law_does_not_press_the_object_against_a_finger_that_is_away(data):
    """Nothing but its joint's dry friction would hold that finger."""
    scene = wa.parse(changed(data | {"phase": data["phase"][:2]}, 0, until={"theta1": 2.25}))
    pushes = wa.trace(scene)[1]
    assert describe_end(scene, scene.phases[1], pushes) == "finger1:v6 is made"
    assert wa.feedback(scene, wa.optimise(scene, knots=21).torque, friction=0.05).phases[1].press == 0.0


def test_a_law_holds_the_object_until_the_next_phase_begins(data, optimum):
    """A finger that moves alone arrives a little before its phase's end; what the law exerts holds the object on."""
    scene = wa.parse(data)
    law = wa.feedback(scene, optimum.torque)
    assert all(phase.margin > 0 for phase in law.phases)
    result = closed_loop_result(scene, law_tables(law))
    assert [phase.status for phase in result.phases] == [wa.Status.OK] * 3, result.message
    assert all(law.margin <= float(phase.margin) + 1e-6 for law, phase in zip(law.phases, result.phases, strict=True))
    assert int(wa.check([scene], controller=law).status[0]) == wa.Status.OK
    # Up to every phase's end the torque is the last that the law exerts in it.
    times, torques = np.asarray(result.torque.times), np.asarray(result.torque.values)
    for phase in result.phases[:-1]:
        at_end = np.flatnonzero(np.abs(times - phase.start - phase.duration) < 1e-9)
        np.testing.assert_array_equal(torques[at_end[0]], torques[at_end[0] - 1])
