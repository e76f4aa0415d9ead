"""Scene files: TOML in and out, validated; every complaint names the file, the key and the cause."""

import difflib
import tomllib
import warnings
from importlib import resources
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import tomli_w
from pydantic import ValidationError

from wholearm_jax.core import DoubtfulInput, SceneError, as_device_array, write_atomically
from wholearm_jax.files.angles import doubtful_angles
from wholearm_jax.files.doubtful_units import doubtful_units
from wholearm_jax.files.scene_schema import FingerTable, GoalTable, RestTable, SceneTables, explain_validation_error
from wholearm_jax.model import (
    COORDINATES,
    LINKS,
    Arrival,
    Hand,
    Phase,
    Scene,
    contact_formation,
    path_target,
    polygon,
    regrasp_toward,
    resting_angle,
    resting_configuration,
)

ARRIVALS = {"rest": Arrival.AT_REST, "moving": Arrival.MOVING, "caught": Arrival.ANY_SPEED}
"""Words for `arrive`."""

FIND_PHASES = "; `wholearm plan` finds them, and in Python `wa.plan(wa.load_start(...), ...)`"
"""What a scene without phases is good for."""


def bundled() -> tuple[str, ...]:
    """The names of the scenes that come with the package."""
    folder = resources.files("wholearm_jax") / "scenes"
    return tuple(sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml")))


def load(name: str | Path) -> Scene:
    """Read a scene: a bundled one by name (`"heptagon"`), any other by path. Lengths in m, masses in kg, SI throughout.

    Raises `SceneError` with one line that names the file, the key and what is wrong.

    >>> scene = wa.load("heptagon")
    >>> [phase.name for phase in scene.phases]
    ['slide right', 'flip right']
    >>> wa.load("heptagn")
    Traceback (most recent call last):
    wholearm_jax.core.errors.SceneError: heptagn: no such file; did you mean the bundled scene 'heptagon'?
    """
    return parse(_read_toml(name), str(name))


def load_start(name: str | Path) -> Scene:
    """Read a scene as `load` does; its phases may be missing, as `plan` finds them.

    >>> (len(wa.load_start("heptagon").phases), wa.load_goal("heptagon"))
    (2, None)
    """
    return parse_start(_read_toml(name), str(name))


def parse_start(data: dict[str, Any], source: str = "scene") -> Scene:
    """Build a scene as `parse` does; its phases may be missing, as `plan` finds them.

    >>> from wholearm_jax.files.scene_toml import to_dict
    >>> data = to_dict(wa.load("heptagon"))
    >>> del data["phase"]
    >>> wa.parse_start(data).phases
    ()
    """
    if data.get("phase"):
        return parse(data, source)
    contacts = ["palm:v0", "palm:v1", "palm:v2", "finger1:v0"]  # which every polygon has
    placeholder = {"name": "none", "contacts": contacts, "toward": "x-", "duration": 1.0}
    return eqx.tree_at(lambda s: s.phases, parse(data | {"phase": [placeholder]}, source), ())


def load_goal(name: str | Path) -> dict[str, Any] | None:
    """Read the goal of a scene file: keyword arguments `goal`, `by` and `tolerance` of `plan`; None without one.

    Raises:
        SceneError: if it is not a valid goal.

    >>> _ = (folder / "part.toml").write_text('[goal]\\nby = { phi = "-40 deg" }')  # some folder
    >>> wa.load_goal(folder / "part.toml")
    {'goal': {}, 'by': {'phi': -0.6981317007977318}, 'tolerance': {}}
    """
    data = _read_toml(name)
    if "goal" not in data:
        return None
    try:
        goal = GoalTable.model_validate(data["goal"])
    except ValidationError as error:
        raise SceneError(f"{name}: goal.{explain_validation_error(error)}") from None
    values = {c: getattr(goal, c) for c in COORDINATES if getattr(goal, c) is not None}
    if goal.on is not None:
        if "phi" in values or "phi" in goal.by:
            raise SceneError(f"{name}: goal.on: the edge fixes phi; leave phi out")
        shape = load_start(name).object
        try:
            values["phi"] = resting_angle(np.asarray(shape.vertices)[: int(shape.count)], int(goal.on[1:]))
        except ValueError as error:
            raise SceneError(f"{name}: goal.on: {error}") from None
    return {"goal": values, "by": dict(goal.by), "tolerance": dict(goal.tolerance)}


def _read_toml(name: str | Path) -> dict[str, Any]:
    """Read the tables of a scene file. Raises `SceneError`."""
    if str(name) in bundled():
        text = (resources.files("wholearm_jax") / "scenes" / f"{name}.toml").read_text("utf-8")
        return tomllib.loads(text)
    path = Path(name)
    try:
        data = tomllib.loads(path.read_text("utf-8-sig"))
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
        SceneError: With one line that names the key and what is wrong. Numbers that may be meant in other units
            (degrees, millimetres) give a `DoubtfulInput` warning.

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
    rests = isinstance(data.get("start"), dict) and "on" in data["start"]
    try:
        rest = RestTable.model_validate(data["start"]) if rests else None
    except ValidationError as error:
        raise SceneError(f"{source}: start.{explain_validation_error(error)}") from None
    if rest is not None:
        data = data | {"start": dict.fromkeys(COORDINATES, 0.0)}
    try:
        checked = SceneTables.model_validate(data)
    except ValidationError as error:
        complaint = explain_validation_error(error)
        advice = FIND_PHASES if complaint.startswith("phase: ") and not data.get("phase") else ""
        raise SceneError(f"{source}: {complaint}{advice}") from None
    for doubt in (*doubtful_angles(data), *doubtful_units(checked)):
        warnings.warn(f"{source}: {doubt}", DoubtfulInput, stacklevel=2)
    scene = _build(checked)
    if rest is None:
        return scene
    try:
        z = resting_configuration(scene.object, scene.hand, int(rest.on[1:]), rest.x)
    except ValueError as error:
        raise SceneError(f"{source}: start.on: {error}") from None
    return eqx.tree_at(lambda s: s.start, scene, as_device_array(z))


def _build(checked: SceneTables) -> Scene:
    """Build the scene of tables that have been checked."""
    fingers = (checked.hand.finger1, checked.hand.finger2)
    shape, friction = checked.object, checked.object.friction
    each = friction if isinstance(friction, float) else [getattr(friction, link) for link in LINKS]
    gravity = checked.gravity if isinstance(checked.gravity, tuple) else (0.0, -checked.gravity)
    return Scene(
        title=checked.title,
        gravity=as_device_array(gravity),
        hand=Hand(
            **{key: as_device_array([getattr(f, key) for f in fingers]) for key in FingerTable.model_fields},
            layered=as_device_array(checked.hand.fingers == "layered"),
            clearance=as_device_array(checked.hand.clearance),
        ),
        object=polygon(shape.vertices, shape.mass, each, shape.inertia, shape.center_of_mass, shape.flush_tolerance),
        start=as_device_array([getattr(checked.start, c) for c in COORDINATES]),
        phases=tuple(
            Phase(
                p.name,
                contact_formation(p.contacts),
                path_target(regrasp_toward(p.regrasp) if p.regrasp and not p.toward else p.toward, p.until),
                as_device_array(p.duration, float),
                Arrival.HOLD if p.hold else ARRIVALS[p.arrive or "rest"],
                p.regrasp,
            )
            for p in checked.phase
        ),
    )


def to_dict(scene: Scene) -> dict[str, Any]:
    """A scene as nested dictionaries; the inverse of `parse`."""
    fingers = [
        {key: np.asarray(getattr(scene.hand, key))[k].tolist() for key in FingerTable.model_fields} for k in range(2)
    ]
    between: dict[str, str | float] = {"fingers": "layered"} if bool(scene.hand.layered) else {}
    if float(scene.hand.clearance):
        between["clearance"] = float(scene.hand.clearance)
    shape = scene.object
    table = {
        "vertices": np.asarray(shape.vertices)[: int(shape.count)].tolist(),
        "mass": float(shape.mass),
        "friction": dict(zip(LINKS, np.asarray(shape.friction).tolist(), strict=True)),
    }
    if shape.inertia is not None:
        table["inertia"] = float(shape.inertia)
    if shape.center_of_mass is not None:
        table["center_of_mass"] = np.asarray(shape.center_of_mass).tolist()
    if shape.flush_tolerance is not None:
        table["flush_tolerance"] = float(shape.flush_tolerance)
    return {
        "title": scene.title,
        "gravity": np.asarray(scene.gravity).tolist(),
        "hand": {"finger1": fingers[0], "finger2": fingers[1]} | between,
        "object": table,
        "start": dict(zip(COORDINATES, np.asarray(scene.start).tolist(), strict=True)),
        "phase": [_phase_dict(phase) for phase in scene.phases],
    }


def _phase_dict(phase: Phase) -> dict[str, Any]:
    target = phase.target
    row: dict[str, Any] = {"name": phase.name, "contacts": [*phase.formation.names, *phase.formation.away]}
    row |= {"regrasp": phase.regrasp} if phase.regrasp else {}
    if phase.arrive is Arrival.HOLD:
        return row | {"hold": True, "duration": float(phase.duration)}
    if int(target.coordinate) < 0:
        raise ValueError(f"phase '{phase.name}' does not say which way it heads: give it a heading such as 'x-'")
    row |= {
        "toward": COORDINATES[int(target.coordinate)] + ("+" if float(target.sign) > 0 else "-"),
        "duration": float(phase.duration),
    }
    if int(target.until_coordinate) >= 0:
        row["until"] = {COORDINATES[int(target.until_coordinate)]: float(target.until_value)}
    word = next(word for word, arrival in ARRIVALS.items() if arrival is phase.arrive)
    return row | ({} if phase.arrive is Arrival.AT_REST else {"arrive": word})


def save(scene: Scene, path: str | Path) -> None:
    """Write a scene as TOML, whole or not at all; `load` reads it back with every digit. Raises `OSError`.

    >>> wa.save(wa.load("hexagon"), folder / "mine.toml")
    >>> wa.load(folder / "mine.toml").title
    'hexagon'
    """
    write_atomically(path, tomli_w.dumps(to_dict(scene)))
