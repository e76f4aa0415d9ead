"""Moves of a finger alone, while the object rests on its other contacts: which of them matter, and where they are left.

A finger opens to stand away from the object, at one of a few places, or closes until it touches. Holds of the same
object that differ in which contacts stick lead along the same path: the one with the largest margin stands for all.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from wholearm_jax.model import (
    AWAY_NAMES,
    COORDINATES,
    EDGE,
    FEATURE_GROUPS,
    LINKS,
    VERTEX,
    contact_name,
    regrasp_toward,
)
from wholearm_jax.planning.moves import Move
from wholearm_jax.planning.plans import Step
from wholearm_jax.tracing import PathEnd

STAYS_TOL = 1e-9  # [m] and [rad], within which the object and the other finger stay where they are
OPENINGS = (0.3, 0.6, 0.95)  # fractions of the way to what stops a finger, at which it may stand away


def separate_regrasps(moves: Sequence[Move]) -> tuple[tuple[Move, ...], tuple[Move, ...]]:
    """Separate the moves of a finger alone, the best of each finger and way, from all others."""
    best: dict[str, Move] = {}
    others = []
    for move in moves:
        if moving_finger(move) is None:
            others.append(move)
        elif move.toward not in best or move.margins.min() > best[move.toward].margins.min():
            best[move.toward] = move
    return tuple(best.values()), tuple(others)


def moving_finger(move: Move) -> int | None:
    """Return the finger that moves alone along a path; None where the object moves, or both fingers do."""
    moves = np.abs(move.places - move.places[0]).max(0) > STAYS_TOL
    alone = np.flatnonzero(moves)
    return int(alone[0]) - 2 if len(alone) == 1 and alone[0] >= 3 else None


def regrasp_stops(
    move: Move, capacity: int, last: str | None, goal: Mapping[str, float]
) -> Iterator[tuple[Step, bool]]:
    """Yield the places at which a finger that moves alone may stop: a contact, or a few places away from the object.

    Args:
        move: the move.
        capacity: rows of the object's vertices.
        last: the regrasp of the step before, if it was one: the same finger does not move alone again.
        goal: coordinates that the goal asks for; a finger may also stop where its angle has that value.
    """
    finger = moving_finger(move)
    if finger is None or (last is not None and last.startswith(LINKS[finger])):
        return
    lowest, end = np.minimum.accumulate(move.margins), len(move.places) - 1
    if move.end_reason == PathEnd.CONTACT_MADE:
        group, feature = divmod(move.end_contact, capacity)
        link, kind = FEATURE_GROUPS[group]
        if link == finger and kind in (VERTEX, EDGE):
            regrasp = contact_name(link, kind, feature)
            yield Step(move.contacts, move.toward, None, move.places[end], float(lowest[end]), regrasp), True
    away = AWAY_NAMES[finger - 1]
    if move.toward == regrasp_toward(away):
        joint, row = COORDINATES[2 + finger], 2 + finger
        begin, turn = move.places[0], move.places[end] - move.places[0]
        fractions = [*OPENINGS, *([(goal[joint] - begin[row]) / turn[row]] if joint in goal else [])]
        for fraction in fractions:
            if 0 < fraction < 1:
                z = begin + fraction * turn
                yield Step(move.contacts, move.toward, (joint, float(z[row])), z, float(lowest[end]), away), False
