"""Scene files: what is read is what is written, and every bad input is named in one line."""

import copy
import tomllib
from importlib import resources

import equinox as eqx
import jax
import numpy as np
import pytest
import tomli_w
from support import layered

from wholearm_jax.core.errors import SceneError
from wholearm_jax.files.scene_toml import bundled, load, parse, save, to_dict
from wholearm_jax.model.scene import path_target, rigid_body

NAN, INF = float("nan"), float("inf")
SQUARE = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]


def heptagon():
    text = (resources.files("wholearm_jax") / "scenes" / "heptagon.toml").read_text("utf-8")
    return tomllib.loads(text)


CORNERS = heptagon()["object"]["vertices"]


def changed(*path_and_value):
    """The heptagon's scene as a dictionary with one value replaced (or added)."""
    *path, value = path_and_value
    data = heptagon()
    dynamics = data
    for part in path[:-1]:
        dynamics = dynamics[part]
    dynamics[path[-1]] = copy.deepcopy(value)
    return data


def without(*path):
    data = heptagon()
    dynamics = data
    for part in path[:-1]:
        dynamics = dynamics[part]
    del dynamics[path[-1]]
    return data


def renamed(old, new, *path):
    """The scene with a key misspelt."""
    data = heptagon()
    dynamics = data
    for part in path:
        dynamics = dynamics[part]
    dynamics[new] = dynamics.pop(old)
    return data


def polygon_scene(vertices):
    """A scene whose object is another polygon; the contacts name vertices that a triangle has."""
    data = changed("object", "vertices", vertices)
    for phase in data["phase"]:
        phase["contacts"] = ["palm:v0", "palm:v1", "finger1:v1", "finger2:v2"]
    return data


def complaint(data, folder):
    """The message about a scene file, checked to be one line that begins with the file's name."""
    path = folder / "scene.toml"
    path.write_text(tomli_w.dumps(data))
    with pytest.raises(SceneError) as caught:
        load(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    return message.removeprefix(f"{path}: ")


def assert_same(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_array_equal(a, b)


# --- what is read is what is written ---------------------------------------------------------------------------------


def test_bundled_scenes():
    assert bundled() == ("box", "flight", "heptagon", "hexagon", "passage", "tipping")


@pytest.mark.parametrize("name", ["heptagon", "hexagon"])
def test_round_trip_keeps_every_float_and_every_name(name, tmp_path):
    scene = load(name)
    path = tmp_path / "scene.toml"
    save(scene, path)
    again = load(path)
    assert_same(scene, again)
    assert [p.name for p in again.phases] == [p.name for p in scene.phases]
    assert [p.formation.names for p in again.phases] == [p.formation.names for p in scene.phases]
    assert to_dict(again) == to_dict(scene)


def test_round_trip_of_everything_optional(tmp_path):
    data = heptagon()
    data["gravity"] = [0.3, -9.7]
    data["hand"]["finger1"]["offset"] = 1 / 300
    data["hand"]["clearance"] = 1 / 3000
    data["object"] |= {"inertia": 1e-4 / 3, "center_of_mass": [1 / 700, -1 / 900]}
    data["object"]["friction"] = {"palm": 0.1, "finger1": 0.2, "finger2": 0.3}
    data["phase"][0] |= {"until": {"x": -0.01}, "arrive": "moving", "name": 'a "name" = with [signs] \u03b8'}
    data["phase"][1]["contacts"] = ["palm:v6", "finger1:v1", "finger2:v3", "finger2:e4"]
    scene = parse(data)
    save(scene, tmp_path / "scene.toml")
    assert_same(scene, load(tmp_path / "scene.toml"))
    np.testing.assert_array_equal(scene.gravity, [0.3, -9.7])
    np.testing.assert_array_equal(scene.object.friction, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(scene.hand.offset, [1 / 300, 0.0])
    assert float(scene.hand.clearance) == 1 / 3000
    assert scene.phases[1].formation.names[3] == "finger2:e4"


def test_scalar_friction_and_gravity_may_be_integers():
    data = changed("object", "friction", 1)
    data["gravity"] = 10
    scene = parse(data)
    np.testing.assert_array_equal(scene.object.friction, [1.0, 1.0, 1.0])
    np.testing.assert_array_equal(scene.gravity, [0.0, -10.0])
    assert scene.gravity.dtype == scene.object.friction.dtype == np.float64


def test_gravity_vector():
    np.testing.assert_array_equal(parse(changed("gravity", [1, -9.5])).gravity, [1.0, -9.5])


# --- polygons --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "vertices",
    [
        [[0, 0], [2, 0], [2, 2], [1, 0.5], [0, 2]],
        [[0, 0], [0.5, 0], [1, 0], [1, 1], [0.5, 1], [0, 1], [0, 0.5]],
        [[0, 0], [1, 0], [0, 1]],
        [[1000.0, 1000.0], [1000.01, 1000.0], [1000.0, 1000.01]],
    ],
    ids=["concave", "collinear neighbours", "triangle", "far from the origin"],
)
def test_polygons_accepted(vertices):
    scene = parse(polygon_scene(vertices))
    assert int(scene.object.count) == len(vertices)
    assert float(rigid_body(scene.object).inertia) > 0


@pytest.mark.parametrize(
    ("vertices", "cause"),
    [
        (SQUARE[::-1], "clockwise"),
        (CORNERS[::-1], "clockwise"),
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "intersects itself"),
        ([[0, 0], [2, 0], [2, 2], [1, -1], [0, 2]], "edges 0 and 2 cross"),
        ([[0, 0], [1, -1], [1, 1], [0, 0], [-1, 1], [-1, -1]], "intersects itself"),
        ([[0, 0], [2, 0], [1, 0], [0, 1]], "intersects itself"),
        ([SQUARE[0], *SQUARE], "vertices 0 and 1 coincide"),
        ([*SQUARE, SQUARE[0]], "vertices 4 and 0 coincide"),
        ([[0, 0], [1, 1], [3, 3]], "no area"),
        ([[0, 0], [0, 0], [0, 0]], "coincide"),
        (SQUARE[:2], "at least 3"),
    ],
    ids=[
        *("clockwise square", "clockwise heptagon", "bow-tie", "crossing", "touching", "spike"),
        *("repeated vertex", "closed by hand", "no area", "point", "two vertices"),
    ],
)
def test_polygons_refused(vertices, cause, tmp_path):
    message = complaint(polygon_scene(vertices), tmp_path)
    assert message.startswith("object.vertices: ")
    assert cause in message


# --- bad input -------------------------------------------------------------------------------------------------------

CONTACTS = {
    "vertex out of range": (["palm:v5", "palm:v7", "finger1:v1", "finger2:v3"], "'palm:v7'", "vertices 0 to 6"),
    "edge out of range": (["palm:v5", "palm:v6", "finger1:e9", "finger2:v3"], "'finger1:e9'", "0 to 6"),
    "same contact twice": (["palm:v5", "palm:v5", "finger1:v1", "finger2:v3"], "same contact", "twice"),
    "three": (["palm:v5", "palm:v6", "finger1:v1"], "3 constraints", "exactly 4"),
    "five": (["palm:v5", "palm:v6", "finger1:v1", "finger2:v3", "finger2:v4"], "5 constraints", "exactly 4"),
    "none": ([], "0 constraints", "exactly 4"),
    "too much rolling": (
        ["palm:v5 rolling", "finger1:v1", "finger2:v3", "finger2:v4"],
        "5 constraints (1 rolling, two each; 3 sliding, one each)",
        "exactly 4",
    ),
    "rolling twice": (["palm:v5 rolling", "palm:v5", "finger2:v3"], "same contact", "twice"),
    "not a contact": (["palm:v5", "thumb:v6", "finger1:v1", "finger2:v3"], "'thumb:v6' is not a contact", "LINK:vN"),
    "negative number": (["palm:v-1", "palm:v6", "finger1:v1", "finger2:v3"], "'palm:v-1' is not a contact", "LINK:vN"),
    "two lines": (["palm:v5", "palm\n:v6", "finger1:v1", "finger2:v3"], "is not a contact", "LINK:vN"),
    "palm on an edge": (["palm:e1", "palm:v6", "finger1:v1", "finger2:v3"], "'palm:e1'", "the palm has no tip"),
    "one text": ("palm:v5", "must be a list", "'palm:v5'"),
}


@pytest.mark.parametrize(("contacts", "cause", "more"), CONTACTS.values(), ids=CONTACTS.keys())
@pytest.mark.parametrize("phase", [0, 1])
def test_contacts_refused(contacts, cause, more, phase, tmp_path):
    message = complaint(changed("phase", phase, "contacts", contacts), tmp_path)
    assert message.startswith(f"phase[{phase}].contacts: ")
    assert cause in message
    assert more in message


FINGER1, FINGER2, OBJECT, START, PHASE = ("hand", "finger1"), ("hand", "finger2"), ("object",), ("start",), ("phase", 1)
NUMBERS = [
    ((*OBJECT, "mass", -0.2), "object.mass: must be greater than 0"),
    ((*OBJECT, "mass", 0), "object.mass: must be greater than 0"),
    ((*OBJECT, "mass", NAN), "object.mass: must be finite"),
    ((*OBJECT, "mass", INF), "object.mass: must be finite"),
    ((*OBJECT, "mass", "0.2"), "object.mass: must be a number"),
    ((*OBJECT, "mass", True), "object.mass: must be a number"),
    ((*OBJECT, "inertia", 0.0), "object.inertia: must be greater than 0"),
    ((*OBJECT, "center_of_mass", [0.0, NAN]), "object.center_of_mass[1]: must be finite"),
    ((*OBJECT, "friction", -0.1), "object.friction: must be greater than or equal to 0"),
    ((*OBJECT, "friction", NAN), "object.friction: must be finite"),
    ((*OBJECT, "friction", "smooth"), "object.friction: must be a number"),
    ((*OBJECT, "friction", {"palm": -1, "finger1": 0, "finger2": 0}), "object.friction.palm: must be greater than or"),
    ((*OBJECT, "friction", {"palm": 0.1, "finger1": 0.1}), "object.friction.finger2: missing"),
    ((*OBJECT, "friction", {"palm": 0, "finger1": 0, "finger2": 0, "thumb": 0}), "object.friction.thumb: unknown key"),
    ((*OBJECT, "vertices", [[NAN, 0.0], *CORNERS[1:]]), "object.vertices[0][0]: must be finite"),
    ((*OBJECT, "vertices", [*CORNERS[:2], [0.0, INF], *CORNERS[3:]]), "object.vertices[2][1]: must be finite"),
    ((*OBJECT, "vertices", [[0.0, 0.0, 0.0], *CORNERS[1:]]), "object.vertices[0]: must have at most 2 items"),
    ((*FINGER1, "length", -0.17), "hand.finger1.length: must be greater than 0"),
    ((*FINGER2, "length", 0.0), "hand.finger2.length: must be greater than 0"),
    ((*FINGER1, "offset", INF), "hand.finger1.offset: must be finite"),
    ((*FINGER2, "inertia", 0.0), "hand.finger2.inertia: must be greater than 0"),
    ((*FINGER1, "viscous", -1.0), "hand.finger1.viscous: must be greater than or equal to 0"),
    ((*FINGER1, "dry", NAN), "hand.finger1.dry: must be finite"),
    ((*FINGER2, "torque_limit", -1), "hand.finger2.torque_limit: must be greater than 0"),
    (("hand", "clearance", -0.001), "hand.clearance: must be greater than or equal to 0"),
    ((*FINGER1, "joint", [NAN, 0.0]), "hand.finger1.joint[0]: must be finite"),
    ((*FINGER1, "joint", [0.08]), "hand.finger1.joint[1]: missing"),
    ((*FINGER1, "joint", [-0.1, 0.0]), "hand: finger 1 is the right one"),
    ((*FINGER1, "joint", [-0.08, 0.0]), "hand: finger 1 is the right one"),
    (("gravity", NAN), "gravity: must be finite"),
    (("gravity", [0.0, -INF]), "gravity[1]: must be finite"),
    (("gravity", [0.0, 0.0, -9.81]), "gravity: must have at most 2 items"),
    *(((*START, name, NAN), f"start.{name}: must be finite") for name in ("x", "y", "phi", "theta1", "theta2")),
    ((*START, "theta2", -INF), "start.theta2: must be finite"),
    ((*PHASE, "duration", 0.0), "phase[1].duration: must be greater than 0"),
    ((*PHASE, "duration", NAN), "phase[1].duration: must be finite"),
    ((*PHASE, "until", {"x": NAN}), "phase[1].until.x: must be finite"),
    ((*PHASE, "until", {"x": 0.0, "y": 0.0}), "phase[1].until: give exactly one coordinate"),
    ((*PHASE, "until", {}), "phase[1].until: give exactly one coordinate"),
    ((*PHASE, "until", {"z": 0.0}), "phase[1].until.z: must be 'x', 'y', 'phi', 'theta1' or 'theta2'"),
    ((*PHASE, "toward", "x"), "phase[1].toward: 'x' is not a coordinate and a sign"),
    ((*PHASE, "toward", "z-"), "phase[1].toward: 'z-' is not a coordinate and a sign"),
    ((*PHASE, "toward", ""), "phase[1].toward: '' is not a coordinate and a sign"),
    ((*PHASE, "arrive", "flying"), "phase[1].arrive: must be 'rest', 'moving' or 'caught'"),
    ((*PHASE, "hold", True), "phase[1].toward: a phase with hold = true does not move; leave it out"),
    ((*PHASE, "hold", 1), "phase[1].hold: must be true or false"),
    ((*PHASE, "name", 3), "phase[1].name: must be text"),
    (("phase", []), "phase: must have at least 1 item"),
    (("object", 3), "object: must be a table"),
]


@pytest.mark.parametrize(("change", "expected"), NUMBERS, ids=[row[1].partition(":")[0] for row in NUMBERS])
def test_values_refused(change, expected, tmp_path):
    assert complaint(changed(*change), tmp_path).startswith(expected)


MISSPELT = [
    (("torque_limit", "torqe_limit", *FINGER1), "hand.finger1.torqe_limit", "torque_limit"),
    (("phase", "phases"), "phases", "phase"),
    (("vertices", "vertexes", "object"), "object.vertexes", "vertices"),
    (("duration", "durtion", "phase", 1), "phase[1].durtion", "duration"),
    (("theta2", "theta_2", "start"), "start.theta_2", "theta2"),
    (("gravity", "gravty"), "gravty", "gravity"),
    (("finger2", "finger_2", "hand"), "hand.finger_2", "finger2"),
]


@pytest.mark.parametrize(("change", "key", "nearest"), MISSPELT, ids=[row[1] for row in MISSPELT])
def test_misspelt_keys_are_named_with_the_nearest_known_one(change, key, nearest, tmp_path):
    assert complaint(renamed(*change), tmp_path) == f"{key}: unknown key; did you mean '{nearest}'?"


def test_unknown_key_like_no_other_lists_the_known_ones(tmp_path):
    message = complaint(changed("start", "qqqqqqqq", 1.0), tmp_path)
    assert message == "start.qqqqqqqq: unknown key; known: x, y, phi, theta1, theta2"


@pytest.mark.parametrize(
    "path",
    [("title",), ("gravity",), ("hand",), ("phase",), (*FINGER2, "inertia"), (*START, "phi"), ("phase", 0, "toward")],
    ids=lambda path: ".".join(map(str, path)),
)
def test_missing_keys(path, tmp_path):
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).lstrip(".")
    advice = "; `wholearm plan` finds them, and in Python `wa.plan(wa.load_start(...), ...)`" if key == "phase" else ""
    assert complaint(without(*path), tmp_path) == f"{key}: missing{advice}"


# --- files that are no scenes ----------------------------------------------------------------------------------------


def refused(path):
    with pytest.raises(SceneError) as caught:
        load(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_byte_order_mark_is_read(tmp_path):
    path = tmp_path / "scene.toml"
    save(load("heptagon"), path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert to_dict(load(path)) == to_dict(load("heptagon"))


def test_not_toml(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text("title = \n")
    message = refused(path)
    assert message.startswith(f"{path}: not valid TOML: ")
    assert "line 1" in message


def test_nested_beyond_what_can_be_read(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(f"gravity = {'[' * 100_000}{']' * 100_000}\n")
    assert refused(path).startswith(f"{path}: not valid TOML: ")


@pytest.mark.parametrize("digits", [400, 5000])
def test_numbers_beyond_any_float(digits, tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(f"gravity = 1{'0' * digits}\n")
    assert refused(path).startswith(f"{path}: ")


def test_missing_file_names_the_nearest_bundled_scene():
    assert refused("heptagn") == "heptagn: no such file; did you mean the bundled scene 'heptagon'?"


def test_missing_file_unlike_any_lists_the_bundled_scenes(tmp_path):
    path = tmp_path / "nothing" / "such.toml"
    assert refused(path) == f"{path}: no such file; bundled scenes: box, flight, heptagon, hexagon, passage, tipping"


def test_folder(tmp_path):
    assert refused(tmp_path) == f"{tmp_path}: cannot be read: Is a directory"


def test_binary_file(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_bytes(bytes(range(256)))
    assert refused(path).startswith(f"{path}: cannot be read: ")


def test_parse_names_its_source():
    with pytest.raises(SceneError, match=r"^my scene: object\.mass: must be greater than 0, not -1$"):
        parse(changed("object", "mass", -1), "my scene")


def test_a_phase_without_a_heading_is_not_written():
    scene = layered("heptagon")
    scene = eqx.tree_at(lambda s: s.phases[0].target, scene, path_target(None))
    with pytest.raises(ValueError, match="'slide left' does not say which way"):
        to_dict(scene)
