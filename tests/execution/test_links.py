"""Links are bodies in MuJoCo, too: what meets stops, is reported, and fails an execution; layered fingers pass."""

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.execution.executions import ExecutionOutcome, execute, run_schedule
from wholearm_jax.execution.link_meetings import unexpected_meetings
from wholearm_jax.execution.mujoco_model import CONVEX, build_mujoco_model

DATA = Path(__file__).parents[1] / "data"
LENGTH = 0.17  # [m] of the fingers


def on_one_plane(scene):
    return eqx.tree_at(lambda s: s.hand.layered, scene, jnp.asarray(False))


@pytest.fixture(scope="module")
def crossing():
    """The heptagon's flip alone, predicted for layered fingers: it begins with fingers apart, and they cross."""
    scene, torque = layered("heptagon"), wa.read_torque(DATA / "heptagon_torque.csv")
    first = int(np.flatnonzero(np.asarray(torque.times) <= 1.0)[-1])
    flip = eqx.tree_at(lambda s: (s.start, s.phases), scene, (wa.trace(scene)[0].end, scene.phases[1:]))
    return wa.simulate(flip, wa.torque_schedule(torque.times[first:] - 1.0, torque.values[first:]))


def test_a_layered_hand_has_no_pair_of_fingers(crossing):
    meetings = build_mujoco_model(crossing.scene, 2e-4).link_meetings
    assert meetings == ("finger1 meets the palm", "finger2 meets the palm")
    coplanar = build_mujoco_model(on_one_plane(crossing.scene), 2e-4).link_meetings
    assert set(coplanar) - set(meetings) == {"finger1 meets finger2"}


def test_a_plan_made_to_cross_is_stopped_and_reported(crossing):
    assert crossing.status is wa.Status.OK
    done = execute(crossing, timestep=2e-4)
    assert (done.ending, done.link_contacts) == (ExecutionOutcome.OK, {})
    stopped = execute(replace(crossing, scene=on_one_plane(crossing.scene)), timestep=2e-4)
    assert stopped.ending is ExecutionOutcome.LINKS_MET
    time = min(stopped.link_contacts.values())
    assert stopped.message.startswith(f"links_met: finger1 meets finger2 at {time:.4g} s")
    assert 0.01 < time < 0.5
    assert stopped.position_error > 1e-3
    after = (stopped.course.time >= time) & (stopped.course.time < time + 0.5)  # jammed for longer, steps are unstable
    assert deepest(stopped.course.z[after], crossing.scene.hand) < 1e-4


def deepest(z, hand):
    """How far a fingertip is on the wrong side of the other finger's line, at most, where it is beside it [m]."""
    depths = [0.0]
    for k, other, side in ((0, 1, -1.0), (1, 0, 1.0)):
        joint, length = np.asarray(hand.joint), np.asarray(hand.length)
        tip = joint[k] + length[k] * np.stack([np.cos(z[:, 3 + k]), np.sin(z[:, 3 + k])], 1) - joint[other]
        along = np.stack([np.cos(z[:, 3 + other]), np.sin(z[:, 3 + other])], 1)
        height = side * (along[:, 0] * tip[:, 1] - along[:, 1] * tip[:, 0])
        place = (tip * along).sum(1)
        depths.append(np.max(np.where((place > 0) & (place < length[other]), -height, 0.0)))
    return max(depths)


@pytest.mark.parametrize("softness", ["coulomb", "convex"])
def test_a_joint_stops_at_the_end_of_its_range_and_a_tip_on_the_palm(crossing, softness):
    """Idle fingers far from the object, driven outward, and one of a lifted joint driven onto the palm."""
    chosen = CONVEX if softness == "convex" else type(CONVEX)()
    scene = eqx.tree_at(lambda s: s.hand.range, on_one_plane(crossing.scene), jnp.asarray([[0.5, np.pi], [0.0, 2.5]]))
    start, torques = np.array([0.0, 1.0, 0.0, 0.7, 2.3]), np.tile([-0.05, 0.05], (2000, 1))
    course, _, met = run_schedule(build_mujoco_model(scene, 2e-4, chosen), scene, start, torques, 2e-4)
    assert set(met) == {"finger1 reaches its range", "finger2 reaches its range"}
    np.testing.assert_allclose(course.z[-1, 3:], [0.5, 2.5], atol=1e-4)
    lifted = eqx.tree_at(lambda s: s.hand.joint, crossing.scene, jnp.asarray([[0.08, 0.08], [-0.08, 0.08]]))
    lifted = eqx.tree_at(lambda s: s.hand.range, lifted, jnp.asarray([[0.0, 4.0], [-1.0, np.pi]]))
    course, _, met = run_schedule(
        build_mujoco_model(lifted, 2e-4, chosen), lifted, np.array([0.0, 1.0, 0.0, 3.3, -0.1]), -torques, 2e-4
    )
    assert "finger1 meets the palm" in met
    tip = 0.08 + LENGTH * np.sin(course.z[-1, 3])
    assert abs(tip) < 1e-4


def test_a_range_may_end_where_a_phase_does(crossing):
    """A joint that a plan leads to the end of its range meets it, which is no fault; elsewhere it is."""
    end, range_end = crossing.phases[-1].traced.end[4], "finger2 reaches its range"
    assert unexpected_meetings(crossing, {range_end}) == {range_end}
    bounded = eqx.tree_at(lambda s: s.hand.range, crossing.scene, crossing.scene.hand.range.at[1, 1].set(end))
    assert unexpected_meetings(replace(crossing, scene=bounded), {range_end, "finger1 meets finger2"}) == {
        "finger1 meets finger2"
    }


def test_a_tip_may_come_to_the_palm_where_a_phase_ends():
    """A fingertip that slides along an edge down to the vertex on the palm touches both at once: no fault."""
    finger = {"length": 0.064, "inertia": 6e-4, "viscous": 0.02, "dry": 0.01, "torque_limit": 2.0}
    data = {
        "title": "trapezoid",
        "hand": {
            "finger1": {"joint": [0.0814, 0.0], "offset": 0.00282, **finger},
            "finger2": {"joint": [-0.0814, -0.005], **finger},
        },
        "object": {
            "vertices": [[0.0, 0.0], [0.06729, 0.0], [0.04143, 0.0539], [0.0128, 0.0539]],
            "mass": 0.05,
            "friction": 0.2,
        },
        "gravity": 9.81,
        "start": {"on": "e3", "x": -0.0034},
        "phase": [
            {"name": name, "contacts": ["palm:v0", "palm:v3", "finger1:e0", finger2], "toward": "x-", "duration": 0.3}
            for name, finger2 in (("on", "finger2:e1"), ("down", "finger2:v2"))
        ],
    }
    done = execute(wa.optimise(wa.parse(data)).result, timestep=1e-4)
    assert "finger1 meets the palm" in done.link_contacts
    assert done.ending is ExecutionOutcome.OK
    assert unexpected_meetings(done.prediction, {"finger2 meets the palm"}) == {"finger2 meets the palm"}


def test_a_tip_passes_round_the_other_fingers_end():
    """A box that is slid left: finger 1's tip, beyond the other finger's end at first, is above the object at last."""
    finger = {"length": 0.09, "inertia": 2e-3, "viscous": 0.02, "dry": 0.01, "torque_limit": 1.0}
    phase = {"name": "left", "contacts": ["palm:v0", "palm:v1", "finger1:v2", "finger2:v3"], "toward": "x-"}
    data = {
        "title": "box",
        "gravity": 9.81,
        "hand": {f"finger{k}": finger | {"joint": [x, 0.0]} for k, x in ((1, 0.055), (2, -0.055))},
        "object": {"vertices": [[0, 0], [0.044, 0], [0.044, 0.043], [0, 0.043]], "mass": 0.2, "friction": 0.1},
        "start": {"x": 0.01, "y": 0.0215, "phi": 0.0, "theta1": 2.04, "theta2": 0.79},
        "phase": [phase | {"until": {"x": -0.01}, "duration": 1.0}],
    }
    optimum = wa.optimise(wa.parse(data), knots=21)
    first, last = (np.asarray(z) for z in (optimum.result.phases[0].traced.begin, optimum.result.phases[0].traced.end))
    sides = [above_other_finger(z, optimum.scene.hand) for z in (first, last)]
    assert sides[0] > 0 > sides[1]  # else nothing passes
    done = execute(optimum.result)
    assert (done.ending, done.link_contacts) == (ExecutionOutcome.OK, {}), done.message


def above_other_finger(z, hand):
    """How far finger 1's tip is on the outer side of finger 2's line [m]."""
    joint, length = np.asarray(hand.joint), np.asarray(hand.length)
    tip = joint[0] + length[0] * np.array([np.cos(z[3]), np.sin(z[3])]) - joint[1]
    return float(np.cos(z[4]) * tip[1] - np.sin(z[4]) * tip[0])
