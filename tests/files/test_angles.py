"""Angles of scenes as texts with a unit, in files, Python tables and `--set`; numbers beyond a turn are noted."""

import copy
import math
import warnings

import pytest
from support import layered_file

import wholearm_jax as wa
from wholearm_jax.core.errors import DoubtfulInput, SceneError
from wholearm_jax.files.angles import read_angle
from wholearm_jax.files.scene_toml import parse, to_dict

DEGREES = {
    "-40 deg": -40,
    "-40deg": -40,
    " +20.9 deg ": 20.9,
    "1e1 degrees": 10,
    "1 degree": 1,
    ".5 deg": 0.5,
    "90.\u00b0": 90,
    "0 deg": 0,
}


@pytest.mark.parametrize(("text", "degrees"), DEGREES.items())
def test_texts_with_a_unit(text, degrees):
    assert read_angle(text) == math.radians(degrees)


def test_radians_with_a_unit_and_numbers():
    assert read_angle("-0.25 rad") == -0.25
    assert read_angle(0.3) == 0.3
    assert read_angle(None) is None


NO_ANGLES = ["", "40", "deg", "40 grad", "4O deg", "1,5 deg", "nan deg", "inf rad", "--4 deg", "1e999 deg", "4 deg 3"]


@pytest.mark.parametrize("text", NO_ANGLES)
def test_other_texts_are_refused(text):
    with pytest.raises(ValueError, match="must be"):
        read_angle(text)


@pytest.fixture
def data():
    return copy.deepcopy(to_dict(wa.load("heptagon")))


def test_wherever_an_angle_may_stand(data):
    data["start"] |= {"phi": "-15 deg", "theta1": "112 deg", "theta2": "0.8 rad"}
    data["hand"]["finger1"]["range"] = ["5 deg", 3.0]
    data["phase"][1]["until"] = {"phi": "-20 deg"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = parse(data)
    assert scene.start[2:].tolist() == [math.radians(-15), math.radians(112), 0.8]
    assert scene.hand.range[0].tolist() == [math.radians(5), 3.0]
    assert float(scene.phases[1].target.until_value) == math.radians(-20)
    again = parse(to_dict(scene))
    assert again.start.tolist() == scene.start.tolist()


WRONG = [
    (("start", "phi"), "fast", "start.phi: must be a number of radians or a text such as '-40 deg', not 'fast'"),
    (("start", "x"), "3 deg", "start.x: must be a number, not '3 deg'"),
    (("start", "theta1"), "9" * 400 + " deg", "start.theta1: must be finite"),
    (("start", "theta2"), True, "start.theta2: must be a number"),
    (("phase", 1, "until"), {"phi": "3 dge"}, "phase[1].until: phi: must be a number of radians"),
    (("phase", 1, "until"), {"x": "3 deg"}, "phase[1].until.x: must be a number, not '3 deg'"),
    (("hand", "finger1", "range"), ["9 deg", "4 deg"], "hand.finger1.range: the least angle"),
    (("hand", "finger2", "range"), ["9", 1.0], "hand.finger2.range[0]: must be a number of radians"),
    (("hand", "finger1", "offset"), "1 deg", "hand.finger1.offset: must be a number"),
]


@pytest.mark.parametrize(("place", "value", "cause"), WRONG)
def test_bad_angles_are_named(place, value, cause, data):
    table = data
    for key in place[:-1]:
        table = table[key]
    table[place[-1]] = value
    with pytest.raises(SceneError) as caught:
        parse(data, "mine")
    assert str(caught.value).startswith(f"mine: {cause}")


DOUBTFUL = [
    (("start", "phi"), 20.9, "start.phi: 20.9 radians"),
    (("start", "theta1"), -112, "start.theta1: -112 radians"),
    (("phase", 1, "until"), {"phi": -40.0}, "phase[1].until.phi: -40 radians"),
    (("hand", "finger1", "range"), [0.0, 170.0], "hand.finger1.range[1]: 170 radians"),
    (("hand", "finger2", "range"), [-90, 3.0], "hand.finger2.range[0]: -90 radians"),
]


@pytest.mark.parametrize(("place", "value", "doubt"), DOUBTFUL)
def test_numbers_beyond_a_turn_are_noted(place, value, doubt, data):
    table = data
    for key in place[:-1]:
        table = table[key]
    table[place[-1]] = value
    with pytest.warns(DoubtfulInput) as caught:
        parse(data, "mine")
    (message,) = (str(one.message) for one in caught)
    assert message.startswith(f"mine: {doubt} are more than a whole turn; degrees are written")


def test_neither_texts_nor_lengths_nor_a_turn_are_doubted(data):
    data["start"] |= {"phi": "400 deg", "theta1": 6.28, "x": 20.0}
    data["phase"][1]["until"] = {"x": 50.0}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parse(data)


DOUBTFUL_UNITS = [
    (("object", "vertices"), [[0, 0], [80, 0], [40, 60]], "object.vertices: the object is 80 m wide, the fingers are"),
    (("gravity",), -9.81, "gravity: -9.81 points up"),
]


@pytest.mark.parametrize(("place", "value", "doubt"), DOUBTFUL_UNITS, ids=["millimetres", "a sign"])
def test_other_units_are_noted(place, value, doubt, data):
    *outer, last = place
    table = data
    for key in outer:
        table = table[key]
    table[last] = value
    for phase in data["phase"]:
        phase["contacts"] = ["palm:v0", "palm:v1", "finger1:v1", "finger2:v2"]
    with pytest.warns(DoubtfulInput) as caught:
        parse(data, "mine")
    (message,) = (str(one.message) for one in caught)
    assert message.startswith(f"mine: {doubt}")


@pytest.mark.filterwarnings("default")
def test_the_case_in_degrees_is_noted(wholearm, request):
    path = request.path.parents[1] / "data" / "cases" / "degrees.toml"
    _, _, errors = wholearm("formations", path)
    note = 'start.phi: 20.9 radians are more than a whole turn; degrees are written "20.9 deg"'
    assert f"wholearm: note: {path}: {note}" in errors


def changed(*changes):
    from wholearm_jax.cli.arguments import load_scene

    return load_scene(layered_file("heptagon"), list(changes))


def test_set_takes_angles_and_lengths(capsys):
    scene = changed("start.phi=-15 deg", "1.until.phi=-20deg", "slide left.until.x=0.001", "start.theta1=1.9")
    assert scene.start[2:4].tolist() == [math.radians(-15), 1.9]
    assert float(scene.phases[1].target.until_value) == math.radians(-20)
    assert int(scene.phases[1].target.until_coordinate) == 2
    assert float(scene.phases[0].target.until_value) == 0.001
    assert capsys.readouterr().err == ""
    scene = changed("start.x=-20 mm", "start.y=4cm", "slide left.until.x=0.1 m")
    assert scene.start[:2].tolist() == [-0.02, 0.04]
    assert float(scene.phases[0].target.until_value) == 0.1
    changed("start.phi=-15")
    assert 'degrees are written "-15 deg"' in capsys.readouterr().err


BAD_CHANGES = {
    "start.phi=fast": "phi is a number of radians or a text such as '-40 deg'",
    "start.x=3 deg": "x is a number of metres or a text such as '-20 mm'",
    "start.x=mm": "x is a number of metres",
    "start.x=inf mm": "x is a number of metres",
    "start.z=3": "write PHASE.duration=SECONDS, PHASE.until.COORDINATE=VALUE or start.COORDINATE=VALUE",
    "1.until.phi=nan": "phi is a number of radians",
    "1.until.speed=1": "write PHASE.duration=SECONDS",
    "5.until.phi=1": "phases: slide left, flip right",
}


@pytest.mark.parametrize(("change", "cause"), BAD_CHANGES.items())
def test_bad_changes_of_angles(change, cause, wholearm):
    status, out, errors = wholearm("simulate", layered_file("heptagon"), "--torque", "none.csv", "--set", change)
    assert (status, out) == (2, "")
    assert errors.startswith(f"wholearm: --set {change}: ")
    assert cause in errors
    assert errors.count("\n") == 1
