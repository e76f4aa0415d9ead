"""What a law has to do near a hand-over, where measured angles do not tell which of two formations holds the object."""

from dataclasses import replace

import numpy as np

from wholearm_jax.feedback.controller import Controller, PhaseLaw
from wholearm_jax.feedback.path_table import PathTable, PathTerms, with_facets
from wholearm_jax.model import Scene
from wholearm_jax.phases import TracedPhase, hand_over_contacts

UNSURE = 0.005  # distance from a corner within which angles do not tell its sides: 3 counts of 4096 a turn [rad]


def find_takeovers(scene: Scene, traced: tuple[TracedPhase, ...]) -> list[bool]:
    """Say of each two phases whether a vertex and a fingertip take over from one another between them, at rest."""
    pairs = zip(scene.phases[:-1], traced[:-1], scene.phases[1:], strict=True)
    return [hand_over_contacts(scene, *pair) is not None for pair in pairs]


def with_either_formation(
    tables: list[PathTable], terms: list[list[PathTerms]], hand_overs: list[bool]
) -> list[list[PathTerms]]:
    """Add, next to each hand-over, the objects as the other formation holds them.

    Measured angles do not tell there which of the two holds the object: the law has to move it under both, and the
    torques that move it under the one must not lose it under the other, which takes over at once.
    """
    found = [[*each] for each in terms]
    for k in np.flatnonzero(hand_overs):
        near_end = tables[k].s > tables[k].s[-1] - UNSURE
        near_start = tables[k + 1].s < UNSURE
        for before, after in zip(*terms[k : k + 2], strict=True):
            found[k] += _either(before, near_end, after, 0)
            found[k + 1] += _either(after, near_start, before, -1)
    return found


def _either(own: PathTerms, rows, other: PathTerms, at: int) -> list[PathTerms]:
    """Put one place of another path in some rows of a path's terms: all of it, how it moves, and what it must keep."""
    facets = max(own.slack.shape[1], other.slack.shape[1])
    slack, there = (with_facets(each.slack, facets) for each in (own, other))
    moves = np.where(rows[:, None], other.acceleration[at], own.acceleration)
    keeps = np.where(rows[:, None, None], there[at], slack)
    return [PathTerms(moves, keeps), PathTerms(moves, slack), PathTerms(own.acceleration, keeps)]


def with_hand_overs_judged(controller: Controller, terms: list[list[PathTerms]], hand_overs: list[bool]) -> Controller:
    """Give minus infinity as margin to phases that begin with a hand-over and may not get away from there.

    Args:
        controller: the law.
        terms: of all objects on all paths, as `with_either_formation` returns them.
        hand_overs: of each two phases, whether there is one between them.
    """
    begins = zip(controller.phases, terms, [False, *hand_overs], strict=True)
    phases = (
        replace(law, margin=-np.inf) if begins_so and not _moves_from_begin(law, every, controller.stiffness) else law
        for law, every, begins_so in begins
    )
    return replace(controller, phases=tuple(phases))


def _moves_from_begin(law: PhaseLaw, terms: list[PathTerms], stiffness: float) -> bool:
    """Say whether a law moves all objects from a path's begin, whichever formation holds them there.

    An object that stands still is pushed the more the farther the reference goes on, and with `press` at most once that
    is near the path's stop.
    """
    if law.reach == 0:
        return True
    at_rest = np.stack([each.acceleration[0] for each in terms])
    needed = -(at_rest[:, 0] + at_rest[:, 3:] @ law.torque[0]) / (at_rest[:, 3:] @ law.gain[0])
    return bool(needed.max() <= max(stiffness**2 * (law.s[-1] - law.reach), law.press))
