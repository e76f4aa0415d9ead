"""Structures of results as JSON and back; a description that is none is refused, and runs nothing."""

import enum
import json
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import pytest
from support import layered

from wholearm_jax.core.result_structure import build_structure, describe_structure
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.phases import trace


class Colour(enum.Enum):
    RED = "red"


class Pair(NamedTuple):
    first: Any
    second: Any


class Static(eqx.Module):
    value: Any
    setting: Any = eqx.field(static=True)


TREES = {
    "an array": 1.0,
    "none": None,
    "containers": {"a": [1.0, (2.0, None)], "b": ()},
    "a named tuple": Pair(1.0, Pair(2.0, None)),
    "a module": Static(Static(1.0, "inner"), ("text", 3, 2.5, None, True, (Colour.RED,))),
    "an optimiser's state": optax.adam(0.1).init({"p": jnp.zeros(2)}),
    "not a number": Static(1.0, float("inf")),
}


@pytest.mark.parametrize("tree", TREES.values(), ids=TREES.keys())
def test_structures_come_back(tree):
    structure = jax.tree.structure(tree)
    description = json.loads(json.dumps(describe_structure(structure)))
    assert build_structure(description) == structure


def test_a_traced_phase_comes_back():
    traced = trace(layered("heptagon"))
    structure = jax.tree.structure(traced)
    rebuilt = build_structure(json.loads(json.dumps(describe_structure(structure))))
    again = jax.tree.unflatten(rebuilt, jax.tree.leaves(traced))
    assert isinstance(again[0].dynamics, PathDynamics)
    assert again[0].dynamics.length == traced[0].dynamics.length


class Local:
    """A class that is no container."""


@pytest.mark.parametrize("setting", [object(), jnp.sum, frozenset({1}), {"a": 1}])
def test_what_json_cannot_say_has_no_description(setting):
    assert describe_structure(jax.tree.structure(Static(1.0, setting))) is None


@pytest.mark.parametrize(
    "description",
    [
        "text",
        1.5,
        [],
        ["tuple"],
        ["set", [0]],
        ["namedtuple", [0], "os:system"],
        ["module", {}, "subprocess:Popen", {}],
        ["module", {}, "no_such_module:Popen", {}],
        ["namedtuple", [0], f"{__name__}:Pair"],
        ["namedtuple", [0, 1], f"{__name__}:Local"],
        ["module", {"value": 0}, f"{__name__}:Static", {"setting": {"enum": "builtins:int", "name": "x"}}],
    ],
)
def test_other_descriptions_are_refused(description):
    with pytest.raises(ValueError, match="not a"):
        build_structure(description)
