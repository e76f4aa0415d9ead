r"""Hand over: the torque at which one phase ends and the next begins, where torque rates are limited.

Where torques may step, phases that begin and end at rest know nothing of each other. Where they may not, the torque
`tau` at the change serves both: it brakes the object that arrives, or holds the one that rests, and holds it in the
formation that follows. From there torques go straight to `sigma`, at which the object is about to set out:

    arrives:   c_n >= m,   b <= -a <= B         with the friction of travel along the wire that ends
    stays:     a forward <= 0 <= a backward     and some forces of statics (`holding`) with c_n >= m
    sets out:  c_n >= m,   a = 0                at `sigma`; or b <= a <= B at `tau` itself: nothing to wait for

All are linear in `(tau, sigma, m)` and the forces of statics: a linear programme. Of the torques with nearly the
largest `m`, in units of the phases' bounds, those with the shortest way are taken. On that way the object stays, as it
does at both its ends: accelerations are linear in the torque, and the margin of statics is concave.

Derivation: section 8 of `docs/derivation.md`.
"""

import itertools
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core import CachedJit, Status, as_device_array
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin import (
    MARGIN_TIE,
    SOLVER_TOL,
    MarginBound,
    RestAccelerations,
    Statics,
    affine_coefficients,
    cone_facets,
)
from wholearm_jax.model import Arrival, Phase, Scene, TorqueSchedule, uniform_schedule
from wholearm_jax.phases import TracedPhase, statics_at_start

MIN_ACCELERATION = (
    1.0  # least acceleration with which an object arrives, or sets out at once [wire lengths a duration squared]
)
MIN_SPEED_CHANGE = (
    2.0  # change of speed within which the largest such acceleration is reached [wire lengths a duration]
)
MIN_REST_MARGIN = 0.01  # how far from the torques that would move it an object rests, as a share of their limits
TAU, SIGMA, WAY, LEVEL, KNOWN = slice(0, 2), slice(2, 4), 4, 5, 6  # a programme's variables: the torques in units of
# their limits, the larger of the ways from one to the other, m, and then the forces of statics


class Moving(NamedTuple):
    """A phase that moves its object: its table, duration [s], and the bound of its margin [N]."""

    dynamics: PathDynamics
    duration: float
    bound: float


class Resting(NamedTuple):
    """An object at rest in a formation: statics, accelerations, and the bound of its margin [N]."""

    balance: Statics
    departure: RestAccelerations
    bound: float


class ReachableTorque(NamedTuple):
    """The `torque` [N m] with which what stands before a change began, and how far it may have gone since (`way`)."""

    torque: Float[np.ndarray, "2"]
    way: float


class RestTransition(NamedTuple):
    """The `torque` [N m] at a change and the one with which the object sets out (`begin`), `lead` [s] later;
    `margin_fraction`
    is the least margin at both over its bound, `-inf` where no torques can serve."""

    torque: Float[np.ndarray, "2"]
    begin: Float[np.ndarray, "2"]
    lead: float
    margin_fraction: float

    @property
    def serves(self) -> bool:
        """Whether there are such torques."""
        return self.margin_fraction > 0


def rest_transitions(
    scene: Scene,
    groups: list[list[int]],
    traced: tuple[TracedPhase, ...],
    tops: tuple[MarginBound, ...],
    rate_limit: float,
    lead: float,
    durations: tuple[float, float] | None,
) -> list[RestTransition | None]:
    """The torques between each group of a plan's phases and the next; None where there is nothing to hand over.

    Phases of a group follow one another at speed. `tops` are the phases' bounds; an object waits for at most a share
    `lead` of the phase in which it then sets out, whose duration is at most that of `durations`.
    """

    def lasts(k):
        length = float(scene.phases[k].duration)
        moves = scene.phases[k].arrive is not Arrival.HOLD
        return float(np.clip(length, *durations)) if durations is not None and moves else length

    def moving(k):
        return Moving(traced[k].dynamics, lasts(k), float(tops[k].value))

    def resting(k):
        return Resting(*statics_at_start(scene, scene.phases[k], traced[k]), float(tops[k].value))

    def near(group, begin):
        if begin is None or not begin.serves:
            return None
        time = sum(lasts(k) for k in group) - begin.lead
        return ReachableTorque(begin.begin, rate_limit * time)

    def between(group, following, begin):
        k, onward = group[-1], following[0]
        if any(int(traced[n].dynamics.status) != Status.OK or not float(tops[n].value) > 0 for n in (k, onward)):
            return None
        before = resting(k) if scene.phases[k].arrive is Arrival.HOLD else moving(k)
        after = None if scene.phases[onward].arrive is Arrival.HOLD else moving(onward)
        return rest_transition(before, resting(onward), after, rate_limit, lead, near(group, begin))

    found: list[RestTransition | None] = []
    for group, following in itertools.pairwise(groups):
        found.append(between(group, following, found[-1] if found else None))
    return found


def holding_schedule(
    scene: Scene,
    phase: Phase,
    at: TracedPhase,
    knots: int,
    rate_limit: float | None = None,
    begin: RestTransition | None = None,
    end: RestTransition | None = None,
) -> TorqueSchedule:
    """The best torque to hold an object, from time 0; at a limited rate as near to it as there is time for, straight
    from the torque where the hold begins and straight to that where it ends.

    The margin is concave in the torque, so that it is nowhere on either way less than at both its ends.
    """
    duration, known = float(phase.duration), int(at.dynamics.status) == Status.OK
    if not known:
        return uniform_schedule(duration, np.zeros((knots, 2)))
    balance, departure = statics_at_start(scene, phase, at)
    best = balance.steadiest(departure).torque
    if rate_limit is None:
        return uniform_schedule(duration, np.tile(best, (knots, 1)))
    first, last = (one.torque if one is not None and one.serves else best for one in (begin, end))

    def by(share):
        """A torque on the way from the last to the best one, and the times that it takes to come there and to go."""
        via = last + share * (best - last)
        return via, *(float(np.abs(via - one).max()) / rate_limit for one in (first, last))

    def late(share):
        return sum(by(share)[1:]) - duration

    share = 1.0
    if late(1.0) > 0:
        from scipy.optimize import brentq

        share = brentq(late, 0.0, 1.0) if late(0.0) < 0 else 0.0
    via, there, back = by(share)
    times = np.array([0.0, min(there, duration), max(duration - back, there), duration])
    last_of_each = np.append(np.diff(times) > 0, True)
    return TorqueSchedule(
        as_device_array(times[last_of_each]), as_device_array(np.stack([first, via, via, last])[last_of_each])
    )


def rest_transition(
    before: Moving | Resting,
    after: Resting,
    onward: Moving | None,
    rate_limit: float,
    lead: float,
    near: ReachableTorque | None = None,
) -> RestTransition:
    """The best torques where one phase gives way to another at rest.

    `after` is the rest with which the next phase begins, and `onward` its motion, or None if it only holds the object.
    Rates are within `rate_limit` [N m/s], the object waits for at most a share `lead` of the phase, and `near` is where
    torques come from.
    """
    limit = after.balance.torque_limit
    common = _arriving(before, limit, rate_limit) if isinstance(before, Moving) else [_staying(before)]
    if near is not None:
        common.append(_within_reach(near, limit))
    if onward is None:
        return _solved([*common, _staying(after)], limit, rate_limit, 0.0)
    now, soon = _setting_out(onward, limit, rate_limit)
    at_once = _solved([*common, *now], limit, rate_limit, 0.0)
    later = _solved([*common, _staying(after), *soon], limit, rate_limit, lead * onward.duration)
    return at_once if at_once.margin_fraction >= MARGIN_TIE * later.margin_fraction else later


class _Conditions(NamedTuple):
    """`above @ x + above_0 >= 0` and `equal @ x + equal_0 = 0` in a programme's variables and forces of its own."""

    above: Float[np.ndarray, "rows variables"]
    above_0: Float[np.ndarray, "rows"]
    equal: Float[np.ndarray, "equalities variables"]
    equal_0: Float[np.ndarray, "equalities"]


def _within_reach(near: ReachableTorque, limit) -> _Conditions:
    above = np.zeros((4, KNOWN))
    above[:2, TAU], above[2:, TAU] = np.eye(2), -np.eye(2)
    there = near.torque / limit
    return _Conditions(above, near.way / np.tile(limit, 2) - np.append(there, -there), *_nothing())


def _nothing():
    """No equalities."""
    return np.zeros((0, KNOWN)), np.zeros(0)


def _arriving(phase: Moving, limit, rate_limit: float) -> list[_Conditions]:
    motion, forces = _terms_at(phase.dynamics, -1)
    return [
        _bearing(forces / phase.bound, limit),
        _accelerating(-motion, limit, TAU, *_range(phase, motion, rate_limit)),
    ]


def _setting_out(phase: Moving, limit, rate_limit: float) -> tuple[list[_Conditions], list[_Conditions]]:
    """At `tau` itself, and at `sigma`."""
    motion, forces = _terms_at(phase.dynamics, 0)
    forces = forces / phase.bound
    at_once = [_bearing(forces, limit), _accelerating(motion, limit, TAU, *_range(phase, motion, rate_limit))]
    return at_once, [_bearing(forces, limit, SIGMA), _accelerating(motion, limit, SIGMA, 0.0, 0.0)]


def _range(phase: Moving, motion, rate_limit: float) -> tuple[float, float]:
    """Accelerations with which an object may arrive or set out: the largest is reached at the limited rate while the
    object's speed changes by `MIN_SPEED_CHANGE`."""
    length, pull = float(phase.dynamics.length), float(np.abs(motion[3:]).sum())
    least = MIN_ACCELERATION * length / phase.duration**2
    return least, max(2 * least, float(np.sqrt(2 * MIN_SPEED_CHANGE * length / phase.duration * pull * rate_limit)))


def _bearing(forces, limit, where: slice = TAU) -> _Conditions:
    """Forces at rest, over their bound, of at least the level."""
    above = np.zeros((len(forces), KNOWN))
    above[:, where], above[:, LEVEL] = forces[:, 3:] * limit, -1.0
    return _Conditions(above, forces[:, 0], *_nothing())


def _accelerating(motion, limit, where: slice, least: float, most: float) -> _Conditions:
    """An acceleration at rest between two."""
    pull = motion[3:] * limit
    size = np.linalg.norm(pull)
    row = np.zeros((1, KNOWN))
    row[0, where] = pull / size
    from_least, to_most = (motion[0] - least) / size, (most - motion[0]) / size
    if most == least:
        return _Conditions(np.zeros((0, KNOWN)), np.zeros(0), row, np.array([from_least]))
    return _Conditions(np.vstack([row, -row]), np.array([from_least, to_most]), *_nothing())


def _staying(rest: Resting) -> _Conditions:
    """The object stays at `tau`: by its accelerations, and by forces within friction cones."""
    balance, departure = rest.balance, rest.departure
    count, limit = len(balance.names), balance.torque_limit
    one, none, grip = np.eye(count), np.zeros((count, count)), np.diag(balance.friction)
    dry, no_contact = np.eye(2), np.zeros((2, 2 * count))
    cones = np.block([[one, none], [grip, one], [grip, -one]])
    joints = np.block([[no_contact, dry], [no_contact, -dry]])
    forces = np.vstack([np.column_stack([cones, np.zeros((3 * count, 2))]), joints])
    still = np.stack([-departure.ahead, departure.behind]) * np.append(1.0, limit)
    still /= np.linalg.norm(still[:, 1:], axis=1, keepdims=True)
    above = np.zeros((len(forces) + 2, KNOWN + forces.shape[1]))
    above[:-2, KNOWN:] = forces
    above[:count, LEVEL] = -rest.bound / balance.unit
    above[-2:, TAU] = still[:, 1:]
    above_0 = np.concatenate([np.zeros(3 * count), balance.dry, balance.dry, still[:, 0] - MIN_REST_MARGIN])
    equal = np.zeros((5, above.shape[1]))
    equal[:, TAU] = balance.load[:, 1:] * limit
    equal[:, KNOWN:] = balance.wrench
    return _Conditions(above, above_0, equal, balance.load[:, 0])


def _solved(conditions: list[_Conditions], limit, rate_limit: float, longest: float) -> RestTransition:
    """The programme with all conditions together."""
    from scipy.optimize import linprog  # takes half a second to import

    sizes = [c.above.shape[1] - KNOWN for c in conditions]
    begins = np.cumsum([KNOWN, *sizes])

    def wide(rows, number):
        """Rows with their own forces among those of all."""
        full = np.zeros((len(rows), begins[-1]))
        full[:, :KNOWN] = rows[:, :KNOWN]
        full[:, begins[number] : begins[number + 1]] = rows[:, KNOWN:]
        return full

    apart = np.zeros((4, begins[-1]))  # a way no shorter than what either torque goes
    apart[:2, TAU], apart[:2, SIGMA] = np.diag(limit), -np.diag(limit)
    apart[2:] = -apart[:2]
    apart[:, WAY] = 1.0
    above = np.vstack([apart, *(wide(c.above, k) for k, c in enumerate(conditions))])
    above_0 = np.concatenate([np.zeros(4), *(c.above_0 for c in conditions)])
    equal = np.vstack([wide(c.equal, k) for k, c in enumerate(conditions)])
    equal_0 = np.concatenate([c.equal_0 for c in conditions])
    within = [(-1.0, 1.0)] * 4 + [(0.0, rate_limit * longest)]

    def best(price, level):
        bounds = [*within, level, *[(None, None)] * sum(sizes)]
        kind = {"A_ub": -above, "b_ub": above_0, "A_eq": equal, "b_eq": -equal_0, "options": SOLVER_TOL}
        return linprog(price, bounds=bounds, **kind)

    largest = best(-np.eye(begins[-1])[LEVEL], (0.0, 1.0))
    if largest.status != 0:
        return RestTransition(np.zeros(2), np.zeros(2), 0.0, -np.inf)
    found = best(np.eye(begins[-1])[WAY], (MARGIN_TIE * largest.x[LEVEL], 1.0))
    x = found.x if found.status == 0 else largest.x
    tau, sigma = limit * x[TAU], limit * x[SIGMA]
    lead = float(np.abs(sigma - tau).max()) / rate_limit if longest > 0 else 0.0
    return RestTransition(tau, sigma if longest > 0 else tau, lead, float(x[LEVEL]))


def _terms_at(dynamics: PathDynamics, end: int):
    return jax.device_get(_terms(dynamics, dynamics.breakpoints[end]))


@CachedJit
def _terms(dynamics: PathDynamics, s) -> tuple[Float[Array, "5"], Float[Array, "slacks 5"]]:
    """Coefficients of the acceleration and of the slacks at a place of a wire."""
    motion, forces = affine_coefficients(dynamics, s)
    return motion, cone_facets(dynamics, forces)
