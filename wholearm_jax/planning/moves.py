"""Moves of the planner: paths of all formations that hold at a configuration, many of them in one program."""

import functools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.core import CachedJit, Status
from wholearm_jax.margin import best_quasistatic_torque
from wholearm_jax.model import (
    AWAY_NAMES,
    PathTarget,
    Scene,
    alike_formations,
    contact_kinematics,
    feature_pair,
    path_target,
    rigid_body,
    scaled_mechanics,
)
from wholearm_jax.phases import configuration, trace_phase
from wholearm_jax.planning.contact_rows import formation_in_numpy
from wholearm_jax.planning.path_choices import LEAST_HOLD, PathChoice, path_choices
from wholearm_jax.planning.successors import touching_contacts
from wholearm_jax.tracing import PathEnd, Resolution, feature_clearance, pivot_clearance

MOVES_PER_CALL = 8  # paths that one call of the program traces; the last call is filled up
SHORTEST_MOVE = 0.02  # path length, in the object's radii, below which a hand cannot tell a move from standing still
PLACES = 33  # configurations of a path that are kept
RESOLUTION = Resolution(panels=16)  # of the planner's tables: forces to three digits


class Move(NamedTuple):
    """A path of a formation from a configuration, in one direction."""

    contacts: tuple[str, ...]
    toward: str
    length: float  # in the object's radii
    places: np.ndarray  # (PLACES, 5): `z` (SI), evenly spaced along the path, start and end included
    margins: np.ndarray  # (PLACES,): largest compressive margin [N] at rest at these places, moving on forward
    end_reason: int  # a `PathEnd`
    end_contact: int
    leaves: str | None  # the contact that is at its feature's end where the path ends, as at a fingertip
    secure: int  # number of the last place at which it is still far enough from there


class _Paths(NamedTuple):
    """What the program returns for each path."""

    status: Int[Array, "moves"]
    length: Float[Array, "moves"]
    pivot: Float[Array, "moves"]  # distance of the nearest rolling contact from the end of its feature
    places: Float[Array, "moves places 5"]
    margins: Float[Array, "moves places"]
    end_reason: Int[Array, "moves"]
    end_contact: Int[Array, "moves"]
    secure: Int[Array, "moves"]


def moves_from(
    scene: Scene,
    z: Float[Array, "5"],
    touching: Sequence[str] | None = None,
    *,
    left: str | None = None,
    rolling: bool = True,
    regrasps: bool = False,
    floor: float = -np.inf,
) -> tuple[Move, ...]:
    """Return all moves from a configuration: formations `2R + S = 4` of what touches, sliding and rolling, both ways.

    A contact that has come to the end of its feature, as a vertex to a fingertip, holds no longer: a micrometre farther
    it is gone. Moves that keep it are left out, as are those on which a contact rolls so near the end of its feature
    that a hand may miss it.

    Args:
        scene: the hand and the object.
        z: the configuration (5,), SI.
        touching: the contacts to combine; those that touch at `z` unless given.
        left: the contact, if any, at whose feature's end the path to `z` has ended.
        rolling: whether contacts may roll.
        regrasps: whether a finger may be away.
        floor: margin at rest [N] that a move has to exceed where it begins; unless given, none has to.
    """
    names = touching_contacts(scene, z) if touching is None else touching
    choices = path_choices(scene, z, names, rolling=rolling, away=AWAY_NAMES if regrasps else (), floor=floor)
    chosen = [choice for choice in choices if left not in {*map(feature_pair, choice[0])}]
    parts = _parts(chosen)
    traced = _threads().map(functools.partial(_trace, scene, z, regrasps), parts)
    pairs = [(choice, paths, k) for part, paths in zip(parts, traced, strict=True) for k, choice in enumerate(part)]
    moves = (_as_move(*choice, jax.tree.map(lambda a, k=k: a[k], paths)) for choice, paths, k in pairs)
    return tuple(move for move in moves if move is not None)


def _parts(chosen: list[PathChoice]) -> list[list[PathChoice]]:
    """Share choices out among the processors, in calls of at most `MOVES_PER_CALL`."""
    calls = max(-(-len(chosen) // MOVES_PER_CALL), min(len(chosen), os.cpu_count() or 1))
    return [chosen[first::calls] for first in range(calls)]


def move_along(
    scene: Scene, z: Float[Array, "5"], contacts: Sequence[str], toward: str, *, regrasps: bool
) -> Move | None:
    """Return the move of one formation in one direction; None where it is none that `moves_from` returns."""
    choice = (tuple(contacts), toward)
    return _as_move(*choice, jax.tree.map(lambda a: a[0], _trace(scene, z, regrasps, [choice])))


def _as_move(contacts: tuple[str, ...], toward: str, path) -> Move | None:
    """Return a move from what the program returns for it; None where it cannot be traced, or a hand may miss it."""
    if path.status != Status.OK or path.length < SHORTEST_MOVE or path.pivot < LEAST_HOLD:
        return None
    reason, contact = int(path.end_reason), int(path.end_contact)
    leaves = _contact_of_row(contacts, contact) if reason == PathEnd.FEATURE_END else None
    curve = float(path.length), path.places, path.margins
    return Move(contacts, toward, *curve, reason, contact, leaves, int(path.secure))


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """The threads in which calls of the program run: one a processor."""
    return ThreadPoolExecutor(os.cpu_count())


def _contact_of_row(contacts: tuple[str, ...], row: int) -> str:
    """Name the contact, as if it slid, of a row of a formation's constraints."""
    formation = formation_in_numpy(contacts)
    return feature_pair(formation.names[formation.contact_of_row[row]])


@functools.cache
def _target(toward: str) -> PathTarget:
    return jax.tree.map(np.asarray, path_target(toward))


def _trace(scene: Scene, z, regrasps: bool, chosen) -> _Paths:
    """Trace the paths of at most `MOVES_PER_CALL` choices."""
    count, rows = np.array(len(chosen)), MOVES_PER_CALL - len(chosen)
    chosen = [*chosen, *chosen[:1] * rows]  # rows of arrays that are not looked at
    every = [formation_in_numpy(contacts) for contacts, _ in chosen]
    if regrasps:  # one program, whether or not a finger is away in one of them
        every = alike_formations([*every, formation_in_numpy(AWAY_NAMES[:1])])[:-1]
    formations = jax.tree.map(lambda *rows: np.stack(rows), *every)
    targets = jax.tree.map(lambda *rows: np.stack(rows), *(_target(toward) for _, toward in chosen))
    body = rigid_body(scene.object)
    return jax.device_get(_trace_moves(body, scene.hand, scene.gravity, formations, targets, np.asarray(z), count))


@CachedJit
def _trace_moves(body, hand, gravity, formations, targets, z, count) -> _Paths:
    """Trace and tabulate the first `count` paths one after the other, and sample places and margins."""

    def one(move):
        formation, target = move
        traced = trace_phase(body, hand, gravity, formation, z, target, RESOLUTION, False, True)
        dynamics = traced.dynamics
        s = dynamics.breakpoints[0] + dynamics.length * jnp.linspace(0.0, 1.0, PLACES)
        segment = (s[:, None] >= dynamics.breakpoints[1:-1]).sum(1).clip(0, dynamics.count - 1)

        places = jax.vmap(configuration, (None, 0, 0))(dynamics, segment, s)
        margins = jax.vmap(lambda s: best_quasistatic_torque(dynamics, s).margin)(s)
        mechanics = scaled_mechanics(body, hand, gravity, formation)
        at = jax.vmap(contact_kinematics, (None, 0))(mechanics.contacts, places / mechanics.configuration_unit)
        pivot = pivot_clearance(mechanics.contacts, jax.tree.map(lambda a: a[0], at)).min()

        # Where does the contact that leaves its feature, if one does, come near the end?
        reason, contact = traced.path.end_reason, traced.path.end_contact
        left = jnp.minimum(contact, at.along.shape[1] - 1)
        inside = feature_clearance(mechanics.contacts, at)[:, left]
        secure = jnp.where(inside >= LEAST_HOLD, jnp.arange(PLACES), 0).max()
        return _Paths(dynamics.status, dynamics.length, pivot, places, margins, reason, contact, secure)

    def next_one(k, paths: _Paths) -> _Paths:
        found = one(jax.tree.map(lambda rows: rows[k], (formations, targets)))
        return jax.tree.map(lambda rows, row: rows.at[k].set(row), paths, found)

    number, integers = jnp.zeros(MOVES_PER_CALL, z.dtype), jnp.zeros(MOVES_PER_CALL, int)
    places, margins = (jnp.zeros((MOVES_PER_CALL, PLACES, *row), z.dtype) for row in ((5,), ()))
    none = _Paths(integers, number, number, places, margins, integers, integers, integers)
    return jax.lax.fori_loop(0, count, next_one, none)
