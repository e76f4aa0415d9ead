"""Schema of scene files: tables, keys and types, and one complaint in one line where a scene does not fit it."""

import difflib
import math
import re
from typing import Annotated, Any, Literal

import numpy as np
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
    ValidationInfo,
    model_validator,
)

from wholearm_jax.files.angles import Angle, read_angles_by_coordinate
from wholearm_jax.model import (
    AWAY,
    CONSTRAINTS,
    COORDINATES,
    find_defect,
    hold_contacts,
    parse_contact,
    regrasp_finger,
)

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


class FingerTable(_Strict):
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
    finger1: FingerTable
    finger2: FingerTable
    fingers: Literal["coplanar", "layered"] = "coplanar"
    clearance: NonNegative = 0.0

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
    defect = find_defect(np.asarray(vertices)[None])
    if defect is not None:
        raise ValueError(defect[1])
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


class RestTable(_Strict):
    """A start at rest on an edge, with the fingers closed on the object."""

    on: Annotated[str, Field(pattern=r"^e[0-9]+$")]
    x: Finite = 0.0


class GoalTable(_Strict):
    """What `plan` is to reach: absolute coordinates, displacements `by`, tolerances; or an edge to rest `on`."""

    x: Finite | None = None
    y: Finite | None = None
    phi: Angle | None = None
    theta1: Angle | None = None
    theta2: Angle | None = None
    by: Annotated[dict[Coordinate, Finite], BeforeValidator(read_angles_by_coordinate)] = Field(default_factory=dict)
    tolerance: Annotated[dict[Coordinate, Positive], BeforeValidator(read_angles_by_coordinate)] = Field(
        default_factory=dict
    )
    on: Annotated[str, Field(pattern=r"^e[0-9]+$")] | None = None


def _constraints(contacts: list[str], checked: ValidationInfo) -> list[str]:
    """Refuse contacts that make no path; those of a regrasp are completed first."""
    rows = [parse_contact(text) for text in contacts]
    if len(set(row[:3] for row in rows)) < len(rows):
        raise ValueError("the same contact stands twice")
    away = [row[0] for row in rows if row[1] == AWAY]
    if len(away) > 1 or any(row[0] in away for row in rows if row[1] != AWAY):
        raise ValueError("a finger that is away has no contact, and the other one is not away")
    if checked.data.get("regrasp") is not None:
        return [*hold_contacts(contacts, checked.data["regrasp"])]
    rolling = sum(row[3] for row in rows)
    count = len(rows) + rolling
    if count != CONSTRAINTS:
        split = f" ({rolling} rolling, two each; {len(rows) - rolling} sliding, one each)" if rolling else ""
        raise ValueError(f"{count} constraints{split}; a path needs exactly {CONSTRAINTS}")
    return contacts


def _away(contacts: list[str]) -> list[str]:
    return [text for text in contacts if parse_contact(text)[1] == AWAY]


def _regrasp(text: str) -> str:
    regrasp_finger(text)
    return text


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


class PhaseTable(_Strict):
    name: str
    regrasp: Annotated[str, AfterValidator(_regrasp)] | None = None
    contacts: Annotated[list[str], AfterValidator(_constraints)]
    toward: Annotated[str, AfterValidator(_signed_coordinate)] | None = None
    duration: Positive
    until: _Until | None = None
    arrive: Literal["rest", "moving", "caught"] | None = None
    hold: StrictBool = False

    def complaint(self, before: "PhaseTable | None") -> str | None:
        """The key that does not fit the others, and why; `before` is the phase before this one."""
        if before is not None and before.arrive in ("moving", "caught"):
            started = sorted({*_away(self.contacts)} - {*_away(before.contacts)})
            if started:
                return f"contacts: {started[0]} must be at rest; phase '{before.name}' arrives {before.arrive}"
        if self.regrasp is not None:
            return self._regrasp_complaint(self.regrasp)
        if not self.hold:
            return "toward: missing" if self.toward is None else None
        given = next((key for key in ("toward", "until", "arrive") if getattr(self, key) is not None), None)
        if given is not None:
            return f"{given}: a phase with hold = true does not move; leave it out"
        if before is not None and before.arrive == "moving":
            return f"hold: phase '{before.name}' arrives moving; only an object at rest can be held"
        return None

    def _regrasp_complaint(self, regrasp: str) -> str | None:
        """The same, of a phase in which a finger moves alone."""
        joint = f"theta{regrasp_finger(regrasp)}"
        if self.hold:
            return "hold: a finger moves in a regrasp; leave it out"
        if self.toward is not None and self.toward[:-1] != joint:
            return f"toward: {regrasp} moves {joint} alone; leave it out"
        leaves = parse_contact(regrasp)[1] == AWAY
        if leaves and (self.until is None or joint not in self.until):
            return f"until: missing; say how far the finger opens: until = {{ {joint} = ... }}"
        if not leaves and self.until is not None:
            return f"until: the finger moves until it makes {regrasp}; leave it out"
        return None


class SceneTables(_Strict):
    title: str
    gravity: Annotated[Annotated[Finite, Tag(_NUMBER)] | Annotated[Pair, Tag(_SEVERAL)], Discriminator(_tag)]
    hand: _Hand
    object: _Object
    start: _Start
    goal: GoalTable | None = None
    phase: Annotated[list[PhaseTable], Field(min_length=1)]

    @model_validator(mode="after")
    def _known_features(self) -> "SceneTables":
        count = len(self.object.vertices)
        names = [phase.name for phase in self.phase]
        for k, phase in enumerate(self.phase):
            if phase.name in names[:k]:
                raise ValueError(f"phase[{k}].name: '{phase.name}' stands twice; give each phase its own name")
            wrong = phase.complaint(self.phase[k - 1] if k else None)
            if wrong is not None:
                raise ValueError(f"phase[{k}].{wrong}")
            keys = [("contacts", text) for text in phase.contacts]
            for key, text in [*keys, *([("regrasp", phase.regrasp)] if phase.regrasp else [])]:
                if parse_contact(text)[2] >= count:
                    raise ValueError(f"phase[{k}].{key}: '{text}': the object has vertices 0 to {count - 1}")
        return self


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
    tables = {"hand": _Hand, "finger1": FingerTable, "finger2": FingerTable, "object": _Object, "start": _Start}
    tables |= {"phase": PhaseTable, "friction": _Frictions}
    names = [part for part in location if isinstance(part, str) and part != _SEVERAL]
    return list(tables.get(names[-1], SceneTables).model_fields) if names else list(SceneTables.model_fields)
