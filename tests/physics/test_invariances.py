"""What must not matter: left and right, the units of length, mass and time, and which vertex is counted first."""

import copy

import jax.numpy as jnp
import numpy as np
import pytest
from support import layered, passing

import wholearm_jax
from wholearm_jax.files import scene_toml as scene_file
from wholearm_jax.phases.sampling import sample_phase

NAMES = ("heptagon", "hexagon")
EXACT = 1e-10
# An interior minimum fixes its place only to the square root of rounding.
PLACE = 1e-6


def outcome(data, torque):
    """Each phase's status, margin, its contact and time, end time and end pose, all in the scene's units."""
    result = wholearm_jax.simulate(wholearm_jax.parse(data), torque)
    rows = []
    for phase in result.phases:
        motion = phase.outcome.motion
        last = motion.phase_time[motion.count][None]
        start, length = jnp.asarray(phase.start), jnp.asarray(phase.duration)
        path = sample_phase(phase.traced.dynamics, torque, start, length, motion, last * (1 - 1e-13))
        row = {
            "status": phase.status,
            "contact": phase.contacts.index(phase.margin_contact),
            "margin": phase.margin,
            "margin time": phase.margin_time,
            "time": phase.time,
            "pose": np.asarray(path.z)[0],
        }
        assert np.all(np.isfinite(row["pose"]))
        assert 0.1 < abs(row["margin"] / (float(result.scene.object.mass) * np.linalg.norm(result.scene.gravity))) < 10
        rows.append(row)
    return rows


def assert_same(found, expected):
    """Every phase alike: margins, times and poses to `SOLVER_TOL`, the margin's time to `PLACE`."""
    assert len(found) == len(expected) == 2
    for one, other in zip(found, expected, strict=True):
        assert one["status"] == other["status"]
        assert one["contact"] == other["contact"]
        size = np.maximum(np.abs(other["pose"]), np.abs(other["pose"][:2]).max())
        errors = {
            "margin": abs(one["margin"] / other["margin"] - 1),
            "margin time": abs(one["margin time"] - other["margin time"]) / other["time"],
            "time": abs(one["time"] / other["time"] - 1),
            "pose": (np.abs(one["pose"] - other["pose"]) / size).max(),
        }
        print(" ".join(f"{key} {value:.1e}" for key, value in errors.items()))
        assert errors.pop("margin time") < PLACE
        assert max(errors.values()) < EXACT


@pytest.fixture(scope="module", params=NAMES)
def original(request):
    """A bundled scene as a dict, torques that carry it along both its paths, and what comes of it."""
    data = scene_file.to_dict(layered(request.param))
    # Unlike fingers and frictions, so that a mixed-up side shows, and no number that scales as zero.
    data["hand"]["finger1"] |= {"dry": 0.009, "viscous": 0.021, "inertia": 2.1e-3, "offset": 0.002}
    data["hand"]["finger2"] |= {"offset": 0.001}
    data["object"]["friction"] = {"palm": 0.1, "finger1": 0.11, "finger2": 0.09}
    data["gravity"] = [0.1, -9.81]
    schedules = [passing(traced.dynamics) for traced in wholearm_jax.trace(wholearm_jax.parse(data))]
    times = np.concatenate([np.asarray(schedule.times) + k for k, schedule in enumerate(schedules)])
    torque = wholearm_jax.torque_schedule(
        times, np.concatenate([np.asarray(schedule.values) for schedule in schedules])
    )
    expected = outcome(data, torque)
    # Both phases move through their paths and beyond; without that, poses would compare nothing.
    assert all(row["status"] == wholearm_jax.Status.LEFT_FORMATION for row in expected)
    return data, torque, expected


def renamed(data, link, number):
    """Rename contacts: `link` maps names, `number(kind, k)` features."""
    for phase in data["phase"]:
        parts = [text.split(":") for text in phase["contacts"]]
        phase["contacts"] = [f"{link.get(a, a)}:{b[0]}{number(b[0], int(b[1:]))}" for a, b in parts]


def test_mirror_image(original):
    """`x -> -x` with the fingers swapped: finger 1 becomes finger 2, anticlockwise becomes clockwise."""
    data, torque, expected = copy.deepcopy(original)
    count = len(data["object"]["vertices"])
    swap = {"finger1": "finger2", "finger2": "finger1"}
    hand, solid, start = data["hand"], data["object"], data["start"]
    data["hand"] = hand | {swap[k]: hand[k] | {"joint": [-hand[k]["joint"][0], hand[k]["joint"][1]]} for k in swap}
    solid["vertices"] = [[-x, y] for x, y in reversed(solid["vertices"])]
    solid["friction"] = {swap.get(key, key): value for key, value in solid["friction"].items()}
    data["gravity"][0] *= -1
    data["start"] = {
        "x": -start["x"],
        "y": start["y"],
        "phi": -start["phi"],
        "theta1": np.pi - start["theta2"],
        "theta2": np.pi - start["theta1"],
    }
    # Vertex k becomes the one counted from the other end; an edge then starts at its old end.
    renamed(data, swap, lambda kind, k: (count - 1 - k - (kind == "e")) % count)
    turned = {"x": "x", "phi": "phi", "theta1": "theta2", "theta2": "theta1"}
    for phase in data["phase"]:
        phase["toward"] = turned[phase["toward"][:-1]] + {"+": "-", "-": "+"}[phase["toward"][-1]]
    mirrored = wholearm_jax.torque_schedule(torque.times, -np.asarray(torque.values)[:, ::-1])
    for row in expected:
        x, y, phi, theta1, theta2 = row["pose"]
        row["pose"] = np.array([-x, y, -phi, np.pi - theta2, np.pi - theta1])
    assert_same(outcome(data, mirrored), expected)


@pytest.mark.filterwarnings("ignore:.*lengths in a scene are metres")
@pytest.mark.parametrize("units", [(1e3, 1.0, 1.0), (1.0, 1e3, 1.0), (1.0, 1.0, 10.0), (0.37, 11.0, 2.3)])
def test_units(original, units):
    """All numbers of the scene in other units of length, mass and time."""
    length, mass, time = units
    data, torque, expected = copy.deepcopy(original)
    moment = mass * length**2
    scales = {"length": length, "inertia": moment, "viscous": moment / time}
    scales |= {"dry": moment / time**2, "torque_limit": moment / time**2}
    for finger in (data["hand"][name] for name in ("finger1", "finger2")):
        finger["joint"] = [length * c for c in finger["joint"]]
        finger["offset"] *= length
        for key, scale in scales.items():
            finger[key] *= scale
    data["gravity"] = [g * length / time**2 for g in data["gravity"]]
    data["object"]["vertices"] = [[length * x, length * y] for x, y in data["object"]["vertices"]]
    data["object"]["mass"] *= mass
    data["start"] |= {key: data["start"][key] * length for key in "xy"}
    for phase in data["phase"]:
        phase["duration"] *= time
    scaled = wholearm_jax.torque_schedule(np.asarray(torque.times) * time, np.asarray(torque.values) * moment / time**2)
    for row in expected:
        row["margin"] *= mass * length / time**2
        row["margin time"] *= time
        row["time"] *= time
        row["pose"] = row["pose"] * np.array([length, length, 1.0, 1.0, 1.0])
    assert_same(outcome(data, scaled), expected)


@pytest.mark.parametrize("shift", [1, 4])
def test_renumbering(original, shift):
    """Counting the vertices from another one, the contacts renamed."""
    data, torque, expected = copy.deepcopy(original)
    vertices = data["object"]["vertices"]
    data["object"]["vertices"] = vertices[shift:] + vertices[:shift]
    renamed(data, {}, lambda _, k: (k - shift) % len(vertices))
    assert_same(outcome(data, torque), expected)
