"""Scene files: TOML in and out, validated; every complaint names the file, the key and the cause."""

import difflib
import math
import re
import tomllib
import warnings
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import numpy as np
import tomli_w
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    StrictBool,
    Tag,
    ValidationError,
    model_validator,
)

from wholearm_jax.core import DoubtfulInput, SceneError, as_device_array, write_atomically
from wholearm_jax.files.angles import Angle, doubtful_angles, read_angles_by_coordinate
from wholearm_jax.model import (
    COORDINATES,
    LINKS,
    Arrival,
    Hand,
    Phase,
    Scene,
    contact_formation,
    find_defect,
    parse_contact,
    path_target,
    polygon,
)

CONSTRAINTS = 4
ARRIVALS = {"rest": Arrival.AT_REST, "moving": Arrival.MOVING, "caught": Arrival.ANY_SPEED}
"""Words for `arrive`."""


Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
Pair = tuple[Finite, Finite]
Coordinate = Literal["x", "y", "phi", "theta1", "theta2"]
_NUMBER, _SEVERAL = "<number>", "<several>"  # tags that tell a number from a vector or a table


def _tag(value: Any) -> str:
    return _SEVERAL if isinstance(value, dict | list) else _NUMBER


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


def _increasing(angles: tuple[float, float]) -> tuple[float, float]:
    if angles[0] >= angles[1]:
        raise ValueError("the least angle must be smaller than the largest")
    return angles


class _Finger(_Strict):
    joint: Pair
    length: Positive
    offset: Finite = 0.0
    back: NonNegative = 0.0
    range: Annotated[tuple[Angle, Angle], AfterValidator(_increasing)] = (0.0, math.pi)
    inertia: Positive
    viscous: NonNegative = 0.0
    dry: NonNegative = 0.0
    torque_limit: Positive


class _Hand(_Strict):
    finger1: _Finger
    finger2: _Finger
    fingers: Literal["coplanar", "layered"] = "coplanar"

    @model_validator(mode="after")
    def _sides(self) -> "_Hand":
        if self.finger1.joint[0] <= self.finger2.joint[0]:
            raise ValueError("finger 1 is the right one: its joint's x must exceed that of finger 2")
        return self


class _Frictions(_Strict):
    palm: NonNegative
    finger1: NonNegative
    finger2: NonNegative


def _polygon(vertices: list[Pair]) -> list[Pair]:
    """Refuse vertices that make no polygon."""
    flaw = find_defect(np.asarray(vertices)[None])
    if flaw is not None:
        raise ValueError(flaw[1])
    return vertices


class _Object(_Strict):
    vertices: Annotated[list[Pair], Field(min_length=3), AfterValidator(_polygon)]
    mass: Positive
    friction: Annotated[
        Annotated[NonNegative, Tag(_NUMBER)] | Annotated[_Frictions, Tag(_SEVERAL)], Discriminator(_tag)
    ]
    inertia: Positive | None = None
    center_of_mass: Pair | None = None
    flush_tolerance: NonNegative | None = None


class _Start(_Strict):
    x: Finite
    y: Finite
    phi: Angle
    theta1: Angle
    theta2: Angle


def _four_constraints(contacts: list[str]) -> list[str]:
    rows = [parse_contact(text) for text in contacts]
    if len(set(row[:3] for row in rows)) < len(rows):
        raise ValueError("the same contact stands twice")
    rolling = sum(row[3] for row in rows)
    count = len(rows) + rolling
    if count != CONSTRAINTS:
        split = f" ({rolling} rolling, two each; {len(rows) - rolling} sliding, one each)" if rolling else ""
        raise ValueError(f"{count} constraints{split}; a wire needs exactly {CONSTRAINTS}")
    return contacts


def _signed_coordinate(toward: str) -> str:
    if toward not in [c + sign for c in COORDINATES for sign in "+-"]:
        raise ValueError(f"'{toward}' is not a coordinate and a sign, such as x- or phi+")
    return toward


def _one_coordinate(until: dict[str, float]) -> dict[str, float]:
    if len(until) != 1:
        raise ValueError(f"give exactly one coordinate, not {len(until)}")
    return until


_Until = Annotated[
    dict[Coordinate, Finite], BeforeValidator(read_angles_by_coordinate), AfterValidator(_one_coordinate)
]


class _Phase(_Strict):
    name: str
    contacts: Annotated[list[str], AfterValidator(_four_constraints)]
    toward: Annotated[str, AfterValidator(_signed_coordinate)] | None = None
    duration: Positive
    until: _Until | None = None
    arrive: Literal["rest", "moving", "caught"] | None = None
    hold: StrictBool = False

    def complaint(self, before: "_Phase | None") -> str | None:
        """The key that does not fit the others, and why; `before` is the phase before this one."""
        if not self.hold:
            return "toward: missing"
        given = next((key for key in ("toward", "until", "arrive") if getattr(self, key) is not None), None)
        if given is not None:
            return f"{given}: a phase with hold = true does not move; leave it out"
        if before is not None and before.arrive == "moving":
            return f"hold: phase '{before.name}' arrives moving; only an object at rest can be held"
        return None


class _Scene(_Strict):
    title: str
    gravity: Annotated[Annotated[Finite, Tag(_NUMBER)] | Annotated[Pair, Tag(_SEVERAL)], Discriminator(_tag)]
    hand: _Hand
    object: _Object
    start: _Start
    phase: Annotated[list[_Phase], Field(min_length=1)]

    @model_validator(mode="after")
    def _known_features(self) -> "_Scene":
        count = len(self.object.vertices)
        names = [phase.name for phase in self.phase]
        for k, phase in enumerate(self.phase):
            if phase.name in names[:k]:
                raise ValueError(f"phase[{k}].name: '{phase.name}' stands twice; give each phase its own name")
            if phase.hold or phase.toward is None:
                wrong = phase.complaint(self.phase[k - 1] if k else None)
                if wrong is not None:
                    raise ValueError(f"phase[{k}].{wrong}")
            for text in phase.contacts:
                if parse_contact(text)[2] >= count:
                    raise ValueError(f"phase[{k}].contacts: '{text}': the object has vertices 0 to {count - 1}")
        return self


def bundled() -> tuple[str, ...]:
    """The names of the scenes that come with the package."""
    folder = resources.files("wholearm_jax") / "scenes"
    return tuple(sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml")))


def load(name: str | Path) -> Scene:
    """Read a scene: a bundled one by name (`"heptagon"`), any other by path. Lengths in m, masses in kg, SI throughout.

    Raises `SceneError` with one line that names the file, the key and what is wrong.

    >>> scene = wa.load("heptagon")
    >>> [phase.name for phase in scene.phases]
    ['slide left', 'flip right']
    >>> wa.load("heptagn")
    Traceback (most recent call last):
    wholearm_jax.core.errors.SceneError: heptagn: no such file; did you mean the bundled scene 'heptagon'?
    """
    return parse(_read_toml(name), str(name))


def load_start(name: str | Path) -> Scene:
    """Read a scene as `load` does; its phases may be missing."""
    data = _read_toml(name)
    if data.get("phase"):
        return parse(data, str(name))
    contacts = ["palm:v0", "palm:v1", "palm:v2", "finger1:v0"]  # which every polygon has
    placeholder = {"name": "none", "contacts": contacts, "toward": "x-", "duration": 1.0}
    return eqx.tree_at(lambda s: s.phases, parse(data | {"phase": [placeholder]}, str(name)), ())


def _read_toml(name: str | Path) -> dict[str, Any]:
    """Read the tables of a scene file. Raises `SceneError`."""
    if str(name) in bundled():
        text = (resources.files("wholearm_jax") / "scenes" / f"{name}.toml").read_text("utf-8")
        return tomllib.loads(text)
    path = Path(name)
    try:
        data = tomllib.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        near = difflib.get_close_matches(str(name), bundled(), 1)
        hint = f"; did you mean the bundled scene '{near[0]}'?" if near else f"; bundled scenes: {', '.join(bundled())}"
        raise SceneError(f"{path}: no such file{hint}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path}: not valid TOML: {error}") from None
    return data


def parse(data: dict[str, Any], source: str = "scene") -> Scene:
    """Build a scene from nested dictionaries, as TOML gives them; angles are radians or texts such as `"-40 deg"`.

    Args:
        data: The tables of a scene file.
        source: Name of the scene, with which messages begin.

    Raises:
        SceneError: With one line that names the key and what is wrong. A number that may be meant as degrees gives a
            `DoubtfulInput` warning.

    >>> from wholearm_jax.files.scene_toml import to_dict
    >>> data = to_dict(wa.load("heptagon"))
    >>> data["object"]["mass"] = 0.3
    >>> float(wa.parse(data).object.mass)
    0.3
    >>> data["object"]["mass"] = -1.0
    >>> wa.parse(data, source="mine")
    Traceback (most recent call last):
    wholearm_jax.core.errors.SceneError: mine: object.mass: must be greater than 0, not -1.0
    """
    try:
        checked = _Scene.model_validate(data)
    except ValidationError as error:
        raise SceneError(f"{source}: {explain_validation_error(error)}") from None
    for doubt in doubtful_angles(data):
        warnings.warn(f"{source}: {doubt}", DoubtfulInput, stacklevel=2)
    fingers = (checked.hand.finger1, checked.hand.finger2)
    shape, friction = checked.object, checked.object.friction
    each = friction if isinstance(friction, float) else [getattr(friction, link) for link in LINKS]
    gravity = checked.gravity if isinstance(checked.gravity, tuple) else (0.0, -checked.gravity)
    return Scene(
        title=checked.title,
        gravity=as_device_array(gravity),
        hand=Hand(
            **{key: as_device_array([getattr(f, key) for f in fingers]) for key in _Finger.model_fields},
            layered=as_device_array(checked.hand.fingers == "layered"),
        ),
        object=polygon(shape.vertices, shape.mass, each, shape.inertia, shape.center_of_mass, shape.flush_tolerance),
        start=as_device_array([getattr(checked.start, c) for c in COORDINATES]),
        phases=tuple(
            Phase(
                p.name,
                contact_formation(p.contacts),
                path_target(p.toward, p.until),
                as_device_array(p.duration, float),
                Arrival.HOLD if p.hold else ARRIVALS[p.arrive or "rest"],
            )
            for p in checked.phase
        ),
    )


_WORDS = {
    "missing": "missing",
    "float_type": "must be a number",
    "finite_number": "must be finite",
    "bool_type": "must be true or false",
    "string_type": "must be text",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "dict_type": "must be a table",
    "model_type": "must be a table",
}


def explain_validation_error(error: ValidationError) -> str:
    """One complaint in one line: the key, what is wrong, and for an unknown key the nearest known one.

    The first complaint, but an unknown key before any other: what is missing is then often only misspelt.
    """
    first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
    place = ""
    for part in first["loc"]:
        if isinstance(part, int):
            place += f"[{part}]"
        elif part not in (_NUMBER, _SEVERAL, "[key]"):
            place += f".{part}" if place else str(part)
    what = re.sub("^(Input|List|Tuple) should", "must", first["msg"].removeprefix("Value error, "))
    what = _WORDS.get(first["type"], what.replace(" after validation", ""))
    if isinstance(first["input"], float | int | str) and first["type"] != "value_error":
        what += f", not {first['input']!r:.40}"
    if first["type"] == "extra_forbidden":
        known = _known_keys(first["loc"][:-1])
        near = difflib.get_close_matches(str(first["loc"][-1]), known, 1, cutoff=0.4)
        what = "unknown key" + (f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(known)}")
    return " ".join((f"{place}: {what}" if place else what).split())


def _known_keys(location) -> list[str]:
    tables = {"hand": _Hand, "finger1": _Finger, "finger2": _Finger, "object": _Object, "start": _Start}
    tables |= {"phase": _Phase, "friction": _Frictions}
    names = [part for part in location if isinstance(part, str) and part != _SEVERAL]
    return list(tables.get(names[-1], _Scene).model_fields) if names else list(_Scene.model_fields)


def to_dict(scene: Scene) -> dict[str, Any]:
    """A scene as nested dictionaries; the inverse of `parse`."""
    fingers = [
        {key: np.asarray(getattr(scene.hand, key))[k].tolist() for key in _Finger.model_fields} for k in range(2)
    ]
    layers = "layered" if bool(scene.hand.layered) else "coplanar"
    shape = scene.object
    solid = {
        "vertices": np.asarray(shape.vertices)[: int(shape.count)].tolist(),
        "mass": float(shape.mass),
        "friction": dict(zip(LINKS, np.asarray(shape.friction).tolist(), strict=True)),
    }
    if shape.inertia is not None:
        solid["inertia"] = float(shape.inertia)
    if shape.center_of_mass is not None:
        solid["center_of_mass"] = np.asarray(shape.center_of_mass).tolist()
    if shape.flush_tolerance is not None:
        solid["flush_tolerance"] = float(shape.flush_tolerance)
    return {
        "title": scene.title,
        "gravity": np.asarray(scene.gravity).tolist(),
        "hand": {"fingers": layers, "finger1": fingers[0], "finger2": fingers[1]},
        "object": solid,
        "start": dict(zip(COORDINATES, np.asarray(scene.start).tolist(), strict=True)),
        "phase": [_phase_dict(phase) for phase in scene.phases],
    }


def _phase_dict(phase: Phase) -> dict[str, Any]:
    way = phase.target
    row: dict[str, Any] = {"name": phase.name, "contacts": list(phase.formation.names)}
    if phase.arrive is Arrival.HOLD:
        return row | {"hold": True, "duration": float(phase.duration)}
    if int(way.coordinate) < 0:
        raise ValueError(f"phase '{phase.name}' does not say which way it heads: give it a heading such as 'x-'")
    row |= {
        "toward": COORDINATES[int(way.coordinate)] + ("+" if float(way.sign) > 0 else "-"),
        "duration": float(phase.duration),
    }
    if int(way.until_coordinate) >= 0:
        row["until"] = {COORDINATES[int(way.until_coordinate)]: float(way.until_value)}
    word = next(word for word, arrival in ARRIVALS.items() if arrival is phase.arrive)
    return row | ({} if phase.arrive is Arrival.AT_REST else {"arrive": word})


def save(scene: Scene, path: str | Path) -> None:
    """Write a scene as TOML, whole or not at all; `load` reads it back with every digit. Raises `OSError`.

    >>> wa.save(wa.load("hexagon"), folder / "mine.toml")
    >>> wa.load(folder / "mine.toml").title
    'hexagon'
    """
    write_atomically(path, tomli_w.dumps(to_dict(scene)))
