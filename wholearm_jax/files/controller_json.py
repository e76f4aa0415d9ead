"""Controllers as JSON (`docs/feedback.md`): everything the law needs, in SI units."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from wholearm_jax.core import write_atomically
from wholearm_jax.core.errors import BadInput
from wholearm_jax.feedback import Controller, PhaseLaw

VERSION = 1


def controller_to_dict(controller: Controller) -> dict[str, Any]:
    """Return the content of `controller.json`."""
    content = {"version": VERSION} | {f.name: _plain(getattr(controller, f.name)) for f in fields(Controller)}
    rows = [{f.name: _plain(getattr(phase, f.name)) for f in fields(PhaseLaw)} for phase in controller.phases]
    return content | {"phases": rows}


def write_controller(controller: Controller, path: str | Path) -> None:
    """Write a controller as JSON."""
    write_atomically(path, json.dumps(controller_to_dict(controller)) + "\n")


def read_controller(path: str | Path) -> Controller:
    """Read a controller from JSON.

    Raises:
        BadInput: In one line, for a file that cannot be read or that is not a controller.

    >>> wa.read_controller("no_such_file.json")
    Traceback (most recent call last):
    wholearm_jax.core.errors.BadInput: no_such_file.json: No such file or directory
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInput(f"{path}: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{path}: cannot be read as JSON: {error}") from None
    if not isinstance(content, dict) or content.get("version") != VERSION:
        raise BadInput(f"{path}: version: not a controller of version {VERSION}")
    rows = content.get("phases")
    if not isinstance(rows, list) or not rows:
        raise BadInput(f"{path}: phases: needs at least one")
    phases = tuple(_phase_law(row, f"{path}: phases[{k}]") for k, row in enumerate(rows))
    return Controller(**_read_fields(Controller, content, str(path), {"phases": phases}))


def _plain(value):
    """Return a field as what JSON knows."""
    return value.tolist() if isinstance(value, np.ndarray) else list(value) if isinstance(value, tuple) else value


def _phase_law(content, where: str) -> PhaseLaw:
    """Build the law of a phase from a JSON object."""
    entries = _read_fields(PhaseLaw, content, where, {})
    _require_shapes(entries, where)
    return PhaseLaw(**entries)


def _read_fields(kind: type, content, where: str, given: dict[str, Any]) -> dict[str, Any]:
    """Read a dataclass's fields from a JSON object, each as the type that it is annotated with."""
    if not isinstance(content, dict):
        raise BadInput(f"{where}: must be an object")
    for field in fields(kind):
        if field.name in given:
            continue
        if field.name not in content:
            raise BadInput(f"{where}: {field.name}: is missing")
        given[field.name] = _converted(field.type, content[field.name], f"{where}: {field.name}")
    return given


def _converted(kind, value, where: str):
    """Return a JSON value as a field's type; arrays must be finite numbers."""
    if kind in (str, bool):
        if not isinstance(value, kind):
            raise BadInput(f"{where}: must be a {'text' if kind is str else 'truth value'}")
        return value
    if isinstance(value, list) and value and all(isinstance(v, str) for v in value):
        return tuple(value)
    try:
        numbers = np.array(value, float)
    except (TypeError, ValueError):
        raise BadInput(f"{where}: must be numbers") from None
    if not np.isfinite(numbers).all():
        raise BadInput(f"{where}: must be finite")
    if kind is float:
        if numbers.ndim:
            raise BadInput(f"{where}: must be one number")
        return float(numbers)
    return tuple(numbers.tolist()) if getattr(kind, "__origin__", None) is tuple else numbers


def _require_shapes(entries: dict[str, Any], where: str) -> None:
    """Raise BadInput where tables do not fit together."""
    for base, others in (("s", ("theta", "tangent", "gain")), ("time", ("torque",))):
        nodes = entries[base]
        if nodes.ndim != 1 or len(nodes) < 2 or np.any(np.diff(nodes) < 0):
            raise BadInput(f"{where}: {base}: must be at least two numbers that do not decrease")
        for name in others:
            if entries[name].shape != (len(nodes), 2):
                raise BadInput(f"{where}: {name}: must have two numbers for each of {base}")
    for name in ("s_ref", "v_ref"):
        if entries[name].shape != entries["time"].shape:
            raise BadInput(f"{where}: {name}: must have one number for each of time")
