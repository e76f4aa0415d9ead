"""Margins at rest of formations that are not traced: those of the traced paths, by which moves are chosen."""

import functools

import equinox as eqx
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.core import as_device_array
from wholearm_jax.model import feature_pair
from wholearm_jax.planning.contact_rows import contact_rows
from wholearm_jax.planning.moves import Move, moves_from
from wholearm_jax.planning.path_choices import contact_numbers, path_choices
from wholearm_jax.planning.rest_margins import both_senses, path_tangents, rest_margins
from wholearm_jax.planning.successors import touching_contacts

SCENES = ("heptagon", "hexagon", "flight")


@functools.cache
def _moves(name: str) -> tuple[wa.Scene, np.ndarray, tuple[Move, ...]]:
    scene = wa.load(name)
    z = as_device_array(wa.trace(scene)[0].begin)
    return scene, z, moves_from(scene, z)


def _key(move: Move):
    return move.contacts, move.toward


def _weight(scene: wa.Scene) -> float:
    return float(scene.object.mass * np.linalg.norm(np.asarray(scene.gravity)))


def _margin_at(scene: wa.Scene, move: Move, place: int) -> float:
    """Compute the margin of a move's formation at one of its places, with the sign of its motion there."""
    rows = contact_rows(scene, move.places[place], [feature_pair(name) for name in move.contacts])
    tangents = path_tangents(
        rows, contact_numbers(rows, [move.contacts]), sum(name != feature_pair(name) for name in move.contacts)
    )
    radii = np.array([*2 * [np.linalg.norm(np.asarray(scene.object.vertices), axis=1).max()], 1, 1, 1])
    begin = min(place, len(move.places) - 2)
    forward = (move.places[begin + 1] - move.places[begin]) / radii @ tangents.direction[0] > 0
    return float(rest_margins(rows, both_senses(tangents))[0 if forward else 1])


@pytest.mark.parametrize("name", SCENES)
def test_margins_at_rest_are_those_of_the_traced_path(name):
    """At every place of every path; but for a few, where a slip reverses between that place and the table's panel."""
    scene, _, moves = _moves(name)
    for move in moves:
        margins = np.array([_margin_at(scene, move, place) for place in range(len(move.places))])
        known = np.isfinite(margins)
        assert known.sum() >= len(margins) // 2
        agree = np.isclose(margins[known], move.margins[known], rtol=1e-3, atol=1e-3 * _weight(scene))
        assert agree.mean() > 0.9, move


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("share", [None, 0.75])
def test_moves_above_a_floor_are_those_whose_margin_exceeds_it(name, share):
    """The floor is just above zero, or exceeded by a quarter of the moves that hold the object at all.

    Besides, there are those for which friction's sign is not known before they are traced.
    """
    scene, z, moves = _moves(name)
    least = 1e-6 * _weight(scene)
    held = [move.margins[0] for move in moves if move.margins[0] > least]
    floor = least if share is None else float(np.quantile(held, share))
    above = {_key(move) for move in moves if move.margins[0] > floor}
    unknown = {_key(move) for move in moves if _margin_at(scene, move, 0) == np.inf}
    assert 0 < len(above) < len(moves)
    assert above <= {_key(move) for move in moves_from(scene, z, floor=floor)} <= above | unknown
    assert len(unknown) < len(moves) / 4


def test_what_has_no_friction_does_not_roll():
    """Of a palm without friction; with it some contact of the palm rolls."""
    scene, z, moves = _moves("heptagon")
    palm = [name for name in dict.fromkeys(name for move in moves for name in move.contacts) if name.startswith("palm")]
    assert any("rolling" in name for name in palm)
    smooth = eqx.tree_at(lambda s: s.object.friction, scene, as_device_array([0.0, 0.1, 0.1]))
    left = {_key(move) for move in moves_from(smooth, z)}
    assert left == {_key(move) for move in moves if not any("palm" in n and "rolling" in n for n in move.contacts)}


@pytest.mark.parametrize("name", SCENES)
def test_what_touches_already_and_is_pressed_on_is_not_traced(name):
    """At the ends of paths, where five and more contacts touch: no move is lost, and few paths are traced in vain."""
    scene, _, moves = _moves(name)
    least = 1e-6 * _weight(scene)
    traced, kept = 0, 0
    for move in [one for one in moves if one.margins.min() > least]:
        z = as_device_array(move.places[-1])
        above = [one for one in moves_from(scene, z) if one.margins[0] > least]
        with_floor = {_key(one) for one in moves_from(scene, z, floor=least)}
        assert {_key(one) for one in above} <= with_floor
        traced += len([*path_choices(scene, z, touching_contacts(scene, z), rolling=True, floor=least)])
        kept += len(with_floor)
    assert 0 < kept <= traced < 2 * kept
