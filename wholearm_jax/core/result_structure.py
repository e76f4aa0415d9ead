"""Structure of a program's result as JSON: which containers hold which of its arrays.

The description is data. Reading it imports nothing and calls no constructor: a class is looked up among those already
imported, and must be a NamedTuple or an `equinox.Module`.
"""

import dataclasses
import enum
import sys
from typing import Any

import equinox as eqx
import jax

PLAIN_TYPES = (bool, int, float, str, type(None))


def describe_structure(structure) -> Any | None:
    """Describe a tree structure in types that JSON can hold; None where that is not possible."""
    try:
        description = _describe(jax.tree.unflatten(structure, range(structure.num_leaves)))
        same = build_structure(description) == structure
    except (TypeError, ValueError, AttributeError):
        return None
    return description if same else None


def build_structure(description: Any):
    """Build the tree structure that `describe_structure` described. Raises ValueError for any other description."""
    try:
        return jax.tree.structure(_build(description))
    except (TypeError, LookupError, ValueError, AttributeError, RecursionError) as error:
        raise ValueError(f"not a description of a tree: {error}") from None


def _describe(node) -> Any:
    """Describe a tree whose leaves are numbers: `[kind, children, name of the class, static fields]`."""
    if node is None or type(node) is int:
        return node
    if isinstance(node, tuple) and hasattr(node, "_fields"):
        return ["namedtuple", [_describe(child) for child in node], _class_name(type(node))]
    if type(node) in (tuple, list):
        return [type(node).__name__, [_describe(child) for child in node]]
    if type(node) is dict and all(isinstance(key, str) for key in node):
        return ["dict", {key: _describe(child) for key, child in node.items()}]
    if isinstance(node, eqx.Module):
        children, static = {}, {}
        for field in dataclasses.fields(node):
            value = getattr(node, field.name)
            if field.metadata.get("static", False):
                static[field.name] = _describe_static(value)
            else:
                children[field.name] = _describe(value)
        return ["module", children, _class_name(type(node)), static]
    raise TypeError(f"a result of type {type(node)} has no description")


def _build(description) -> Any:
    """Build a tree from its description."""
    if description is None or type(description) is int:
        return description
    kind, children = description[:2]
    if kind == "dict":
        return {key: _build(child) for key, child in children.items()}
    if kind in ("tuple", "list"):
        return {"tuple": tuple, "list": list}[kind](map(_build, children))
    found = _find_class(description[2])
    if kind == "namedtuple" and issubclass(found, tuple) and len(getattr(found, "_fields", ())) == len(children):
        return tuple.__new__(found, map(_build, children))
    if kind != "module" or not issubclass(found, eqx.Module):
        raise ValueError(f"{description[2]} is not a {kind}")
    module = object.__new__(found)
    for name, child in children.items():
        object.__setattr__(module, name, _build(child))
    for name, value in description[3].items():
        object.__setattr__(module, name, _build_static(value))
    return module


def _describe_static(value) -> Any:
    if isinstance(value, enum.Enum):
        return {"enum": _class_name(type(value)), "name": value.name}
    if type(value) is tuple:
        return [_describe_static(part) for part in value]
    if type(value) in PLAIN_TYPES:
        return value
    raise TypeError(f"a static field of type {type(value)} has no description")


def _build_static(value) -> Any:
    if isinstance(value, dict):
        found = _find_class(value["enum"])
        if not issubclass(found, enum.Enum):
            raise ValueError(f"{value['enum']} is not an enum")
        return found[value["name"]]
    return tuple(map(_build_static, value)) if isinstance(value, list) else value


def _class_name(found: type) -> str:
    return f"{found.__module__}:{found.__qualname__}"


def _find_class(name: str) -> Any:
    """Return a class of a module that is already imported."""
    module, _, path = name.partition(":")
    found: Any = sys.modules[module]
    for part in path.split("."):
        found = vars(found)[part]
    if not isinstance(found, type):
        raise ValueError(f"{name} is not a class")
    return found
