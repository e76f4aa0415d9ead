r"""Hand-overs: where a vertex on a finger reaches its tip, the tip goes on along an edge, or the other way round.

The object rests where one phase ends and the next begins, at a place at which the vertex and the tip coincide. Which of
the two contacts holds it there is decided by less than a micrometre. So there must be torques that press either contact
while they brake the object, however it arrives, and while they move it on; and where it waits, the torque must hold it
by either:

    arrives:  c_n >= m,   a <= -d |da/dtau|     at the end of the one path and at the start of the other
    stays:    some forces within both sets of limits (`margin.statics`) with c_n >= m
    starts:   c_n >= m,   a >= d |da/dtau|

with torques over their limits and the surplus `d` that `LEAST_SURPLUS` says: an object that hardly moves stays. All are
linear in the torque and `m`: linear programmes.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from wholearm_jax.core import LinearProgramme, LinearProgrammeSolution, Status
from wholearm_jax.margin import (
    MARGIN_TIE,
    MIN_REST_MARGIN,
    RestAccelerations,
    StaticMargin,
    Statics,
    contact_statics,
)
from wholearm_jax.model import AWAY_NAMES, EDGE, Arrival, Phase, Scene, feature_pair, parse_contact, rigid_body
from wholearm_jax.phases.phase_ends import rest_terms
from wholearm_jax.phases.phase_tracing import TracedPhase

POINT_TOL = 1e-6  # distance of a tip from a vertex, in the object's radius, at which the two are one point
LEAST_SURPLUS = 0.03  # of the torques that brake or move the object, over the limits, beyond those that only balance
UNPLANNED_SHARE = 0.5  # of the best margin by either contact, with which torques press the one that is not planned
STOPPING, STARTING = -1.0, 1.0  # what torques do at a hand-over: signs of their surplus


class OneContact(NamedTuple):
    """The object at rest at a hand-over, held by one of the two contacts."""

    name: str  # of the contact
    statics: Statics
    accelerations: RestAccelerations
    slack: Float[np.ndarray, "facets 3"]  # of the forces of forward travel [N], linear in `(1, tau1, tau2)`

    def surplus_row(self, limit: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3"]:
        """Return how far torques are beyond those that keep the object's speed, linear in `(1, tau / limit)`."""
        row = self.accelerations.ahead * np.append(1.0, limit)
        return row / np.linalg.norm(row[1:])


class HandOver(NamedTuple):
    """A contact that takes over from another at the same point, at rest."""

    before: OneContact
    after: OneContact

    @property
    def margin(self) -> float:
        """The smaller of the largest margins with which the object arrives and starts [N]; negative: it cannot."""
        return min(self.best_motion(sign).margin for sign in (STOPPING, STARTING))

    def best_hold(self) -> StaticMargin:
        """Compute the torque that holds the object by either contact with the largest margin.

        Of torques with nearly this margin it is that which is farthest from those that move the object.
        """
        programme, limit = self._programme()
        programme.add_variables("apart", 0.0, 0.0)
        for prefix, one in zip(("before_", "after_"), self, strict=True):
            press = self.before.statics.unit / one.statics.unit
            one.statics.add_forces(programme, level="level", press=press, torque_unit=limit, prefix=prefix)
            rows = one.accelerations.rest_rows(limit)
            programme.at_most(prefix + "rest", -rows[:, 0] - MIN_REST_MARGIN, torque=rows[:, 1:], apart=1.0)
        best = programme.maximise("level")
        if best is None:
            return StaticMargin(-np.inf, self.after.name, np.zeros(2))
        level = float(best.values["level"][0])
        programme.set_bounds("level", level - (1 - MARGIN_TIE) * abs(level), np.inf)
        programme.set_bounds("apart", 0.0, 1.0)
        return self._margin(level, programme.maximise("apart") or best)

    def best_motion(self, sign: float) -> StaticMargin:
        """Compute the torque that starts or stops the object with the largest margin by either contact."""
        programme, limit = self._programme()
        for prefix, one in zip(("before_", "after_"), self, strict=True):
            slack, surplus = one.slack / self.before.statics.unit, sign * one.surplus_row(limit)
            programme.at_least(prefix + "forces", -slack[:, 0], torque=slack[:, 1:] * limit, level=-1.0)
            programme.at_least(prefix + "surplus", [LEAST_SURPLUS - surplus[0]], torque=surplus[None, 1:])
        best = programme.maximise("level")
        if best is None:
            return StaticMargin(-np.inf, self.after.name, np.zeros(2))
        return self._margin(float(best.values["level"][0]), best)

    def unplanned_rows(self, sign: float) -> Float[np.ndarray, "rows 3"]:
        """Return what must not be negative where torques start or stop the object by the contact of another phase.

        An object that arrives a moment early is held by the contact that takes over, one that is late by the contact
        that ends. Torques that stop it must press and brake it then as well, those that start it must press it.

        Returns:
            Rows linear in 1 and the torques over their limits; empty where no torque does by either contact.
        """
        best, limit = self.best_motion(sign).margin, self.before.statics.torque_limit
        if not best > 0:
            return np.zeros((0, 3))
        other = self.after if sign == STOPPING else self.before
        force = other.slack * np.append(1.0, limit) / self.before.statics.unit
        force[:, 0] -= UNPLANNED_SHARE * best / self.before.statics.unit
        if sign == STARTING:
            return force
        return np.vstack([force, sign * other.surplus_row(limit) - [LEAST_SURPLUS, 0.0, 0.0]])

    def planned_margin(self, sign: float) -> float:
        """Compute the largest margin by the planned contact [N] of torques that respect `unplanned_rows`."""
        programme, limit = self._programme()
        planned, rows = self.before if sign == STOPPING else self.after, self.unplanned_rows(sign)
        slack = planned.slack / self.before.statics.unit
        programme.at_least("forces", -slack[:, 0], torque=slack[:, 1:] * limit, level=-1.0)
        programme.at_least("unplanned", -rows[:, 0], torque=rows[:, 1:])
        best = programme.maximise("level")
        return -np.inf if best is None else float(best.values["level"][0]) * self.before.statics.unit

    def _programme(self) -> tuple[LinearProgramme, Float[np.ndarray, "2"]]:
        """Begin a programme: torques over their limits, and the margin over the unit of force."""
        programme = LinearProgramme()
        programme.add_variables("torque", -np.ones(2), np.ones(2))
        programme.add_variables("level", -np.inf, np.inf)
        return programme, self.before.statics.torque_limit

    def _margin(self, level: float, solution: LinearProgrammeSolution) -> StaticMargin:
        statics = self.before.statics
        return StaticMargin(level * statics.unit, self.after.name, statics.torque_limit * solution.values["torque"])


def find_hand_overs(scene: Scene, traced: tuple[TracedPhase, ...]) -> list[HandOver | None]:
    """Return for each phase the hand-over with which it begins, if any."""
    pairs = zip(scene.phases[:-1], traced[:-1], scene.phases[1:], traced[1:], strict=True)
    return [None, *(find_hand_over(scene, *pair) for pair in pairs)]


def find_hand_over(
    scene: Scene, before: Phase, path_before: TracedPhase, after: Phase, path_after: TracedPhase
) -> HandOver | None:
    """Return the hand-over between two phases; None where they do not change contacts at one point, at rest."""
    names = hand_over_contacts(scene, before, path_before, after)
    if names is None or int(path_after.dynamics.status) != Status.OK:
        return None
    sides = ((before, path_before, -1), (after, path_after, 0))
    return HandOver(*(_one_contact(scene, name, *side) for name, side in zip(names, sides, strict=True)))


def hand_over_contacts(scene: Scene, before: Phase, path: TracedPhase, after: Phase) -> tuple[str, str] | None:
    """Name the contact that ends and the one that takes over from it at the same point, at rest; None without any."""
    if int(path.dynamics.status) != Status.OK:
        return None
    for old, new, vertex in _hand_overs_by_name(scene, before, after):
        if _tip_to_vertex(scene, path.end, parse_contact(old)[0] - 1, vertex) < POINT_TOL:
            return old, new
    return None


def may_hand_over(scene: Scene, before: Phase, after: Phase) -> bool:
    """Whether the contacts of two phases allow a hand-over between them, wherever the path ends."""
    return any(True for _ in _hand_overs_by_name(scene, before, after))


def _hand_overs_by_name(scene: Scene, before: Phase, after: Phase) -> Iterator[tuple[str, str, int]]:
    """Yield `possible_hand_overs` between two phases; none where they do not meet at rest, or regrasp."""
    at_rest = before.arrive in (Arrival.AT_REST, Arrival.ANY_SPEED) and after.arrive is not Arrival.HOLD
    if at_rest and not before.regrasp and not after.regrasp:
        held, then = (tuple(map(feature_pair, phase.formation.names)) for phase in (before, after))
        yield from possible_hand_overs(held, then, int(scene.object.count))


def possible_hand_overs(before: Sequence[str], after: Sequence[str], vertices: int) -> Iterator[tuple[str, str, int]]:
    """Yield contacts of a finger, at least one of them by its tip, of which one may take over from another at a vertex.

    Args:
        before: names of the contacts of one phase.
        after: those of the next.
        vertices: how many vertices the object has.
    """
    gone = [name for name in before if name not in (*after, *AWAY_NAMES)]
    new = [name for name in after if name not in (*before, *AWAY_NAMES)]
    for one, other in itertools.product(gone, new):
        (link, kind, *_), (other_link, other_kind, *_) = parse_contact(one), parse_contact(other)
        if link == other_link and EDGE in (kind, other_kind):
            for vertex in _vertices(one, vertices) & _vertices(other, vertices):
                yield one, other, vertex


def _vertices(contact: str, count: int) -> set[int]:
    """Return the vertices at a contact's feature."""
    _, kind, feature, _ = parse_contact(contact)
    return {feature, (feature + 1) % count} if kind == EDGE else {feature}


def _tip_to_vertex(scene: Scene, z, finger: int, vertex: int) -> float:
    """Return how far a finger's tip is from a vertex, in the object's radius."""
    z, hand = np.asarray(z), jax.device_get(scene.hand)
    corners = np.asarray(rigid_body(scene.object).vertices)
    turned, along = (np.array([np.cos(angle), np.sin(angle)]) for angle in (z[2], z[3 + finger]))
    offset = (1.0, -1.0)[finger] * hand.offset[finger] * np.array([-along[1], along[0]])
    tip = hand.joint[finger] + hand.length[finger] * along + offset
    at = z[:2] + corners[vertex, 0] * turned + corners[vertex, 1] * np.array([-turned[1], turned[0]])
    return float(np.hypot(*(tip - at)) / np.hypot(*corners.T).max())


def _one_contact(scene: Scene, name: str, phase: Phase, path: TracedPhase, end: int) -> OneContact:
    """Return the object at an end (0 or -1) of a phase's path."""
    dynamics = path.dynamics
    accelerations, slack = rest_terms(dynamics, end)
    z = path.begin if end == 0 else path.end
    return OneContact(
        name=name,
        statics=contact_statics(scene, phase.formation, z),
        accelerations=accelerations,
        slack=slack,
    )
