r"""Transition at rest: the torque at which one phase ends and the next begins, where torque rates are limited.

Where torques may jump, phases that begin and end at rest are independent. Where they may not, the torque `tau` at the
transition serves both phases: it brakes the object that arrives, or holds the one that rests, and holds it in the
contact formation that follows. From there torques change linearly to `sigma`, at which the object is about to start:

    arrives:   c_n >= m,   b <= -a <= B         with the friction of travel along the path that ends
    stays:     a forward <= 0 <= a backward     and some forces of statics (`margin.statics`) with c_n >= m
    starts:    c_n >= m,   a = 0                at `sigma`; or b <= a <= B at `tau` itself, without a dwell

All are linear in `(tau, sigma, m)` and the forces of statics: a linear programme. Of the torques with nearly the
largest `m`, in units of the phases' bounds, those with the smallest change are taken. Between them the object stays, as
it does at both ends: accelerations are linear in the torque, and the margin of statics is concave.

Derivation: section 8 of `docs/derivation.md`.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core import CachedJit, LinearProgramme
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin import (
    MARGIN_TIE,
    MIN_REST_MARGIN,
    RestAccelerations,
    Statics,
    affine_coefficients,
    cone_facets,
)

MIN_ACCELERATION = 1.0  # least with which an object arrives, or starts without a dwell [path lengths a duration^2]
MIN_SPEED_CHANGE = 2.0  # within which the largest acceleration is reached [path lengths a duration]


class Moving(NamedTuple):
    """A phase that moves the object."""

    dynamics: PathDynamics
    duration: float  # [s]
    bound: float  # of its margin [N]


class Resting(NamedTuple):
    """The object at rest in a contact formation."""

    statics: Statics
    accelerations: RestAccelerations
    bound: float  # of its margin [N]


class ReachableTorque(NamedTuple):
    """Torques that can be reached by the transition: no joint further than `max_change` from `torque` [N m]."""

    torque: Float[np.ndarray, "2"]
    max_change: float


class RestTransition(NamedTuple):
    """Torques of a transition at rest."""

    torque: Float[np.ndarray, "2"]  # at the transition [N m]
    departure_torque: Float[np.ndarray, "2"]  # with which the object starts [N m]
    dwell_time: float  # from the transition to the start [s]
    margin_fraction: float  # least margin at both, over its bound; -inf: no torques are feasible

    @property
    def is_feasible(self) -> bool:
        """Whether there are such torques."""
        return self.margin_fraction > 0


def rest_transition(
    before: Moving | Resting,
    after: Resting,
    onward: Moving | None,
    rate_limit: float,
    max_dwell: float,
    reachable: ReachableTorque | None = None,
) -> RestTransition:
    """Find the best torques where one phase gives way to another at rest.

    Args:
        before: the phase that ends.
        after: the rest with which the next phase begins.
        onward: the motion of the next phase; None if it only holds the object.
        rate_limit: largest torque rate [N m/s].
        max_dwell: longest time for which the object may wait, as a fraction of the next phase.
        reachable: torques that can be reached by the transition; None: all.
    """
    limit = after.statics.torque_limit

    def programme(max_dwell_time: float) -> LinearProgramme:
        new = _torque_programme(limit, rate_limit * max_dwell_time)
        if isinstance(before, Moving):
            _add_start(new, "before_", before, -1, limit, "tau", rate_limit)
        else:
            _add_rest(new, "before_", before)
        if reachable is not None:
            row, change = np.eye(2), reachable.max_change / limit
            new.at_least("reachable_above", reachable.torque / limit - change, tau=row)
            new.at_most("reachable_below", reachable.torque / limit + change, tau=row)
        return new

    at_once = programme(0.0)
    if onward is None:
        _add_rest(at_once, "after_", after)
        return _best_torques(at_once, limit, rate_limit, 0.0)
    _add_start(at_once, "after_", onward, 0, limit, "tau", rate_limit)
    without_dwell = _best_torques(at_once, limit, rate_limit, 0.0)
    later = programme(max_dwell * onward.duration)
    _add_rest(later, "after_", after)
    _add_start(later, "start_", onward, 0, limit, "sigma", None)
    with_dwell = _best_torques(later, limit, rate_limit, max_dwell * onward.duration)
    return without_dwell if without_dwell.margin_fraction >= MARGIN_TIE * with_dwell.margin_fraction else with_dwell


def _torque_programme(limit, max_change: float) -> LinearProgramme:
    """Begin a programme: torques over their limits, the larger of their changes [N m], and the level of the margin."""
    programme, one, scale = LinearProgramme(), np.ones(2), np.diag(limit)
    programme.add_variables("tau", -one, one)
    programme.add_variables("sigma", -one, one)
    programme.add_variables("change", 0.0, max_change)
    programme.add_variables("level", 0.0, 1.0)
    programme.at_least("decrease", np.zeros(2), tau=scale, sigma=-scale, change=1.0)
    programme.at_least("increase", np.zeros(2), tau=-scale, sigma=scale, change=1.0)
    return programme


def _add_start(
    programme: LinearProgramme, prefix: str, phase: Moving, end: int, limit, torque: str, rate_limit: float | None
) -> None:
    """Add a phase's forces and accelerations at an end of its path (0: where it starts, -1: where it arrives).

    Without `rate_limit` the acceleration is zero; with it, in the range of `_acceleration_range`.
    """
    motion, forces = jax.device_get(_terms(phase.dynamics, phase.dynamics.breakpoints[end]))
    motion, forces = motion if end == 0 else -motion, forces / phase.bound
    programme.at_least(prefix + "forces", -forces[:, 0], **{torque: forces[:, 3:] * limit}, level=-1.0)
    by_torque = motion[3:] * limit
    size = np.linalg.norm(by_torque)
    row = {torque: by_torque[None] / size}
    if rate_limit is None:
        programme.equal(prefix + "acceleration", [-motion[0] / size], **row)
        return
    least, largest = _acceleration_range(phase, motion, rate_limit)
    programme.at_least(prefix + "least", [(least - motion[0]) / size], **row)
    programme.at_most(prefix + "largest", [(largest - motion[0]) / size], **row)


def _acceleration_range(phase: Moving, motion, rate_limit: float) -> tuple[float, float]:
    """Return the accelerations with which an object may arrive or start.

    The largest is reached at the limited rate while the speed changes by `MIN_SPEED_CHANGE`.
    """
    length, by_torque = float(phase.dynamics.length), float(np.abs(motion[3:]).sum())
    least = MIN_ACCELERATION * length / phase.duration**2
    return least, max(
        2 * least, float(np.sqrt(2 * MIN_SPEED_CHANGE * length / phase.duration * by_torque * rate_limit))
    )


def _add_rest(programme: LinearProgramme, prefix: str, rest: Resting) -> None:
    """Add that the object stays at `tau`: by its accelerations, and by forces within friction cones."""
    statics = rest.statics
    press, unit = rest.bound / statics.unit, statics.torque_limit
    statics.add_forces(programme, level="level", press=press, torque="tau", torque_unit=unit, prefix=prefix)
    rows = rest.accelerations.rest_rows(unit)
    programme.at_most(prefix + "rest", -rows[:, 0] - MIN_REST_MARGIN, tau=rows[:, 1:])


def _best_torques(programme: LinearProgramme, limit, rate_limit: float, max_dwell_time: float) -> RestTransition:
    """Maximise the level, then minimise the change of torques at nearly this level."""
    best = programme.maximise("level")
    if best is None:
        return RestTransition(np.zeros(2), np.zeros(2), 0.0, -np.inf)
    programme.set_bounds("level", MARGIN_TIE * best.values["level"], 1.0)
    x = (programme.minimise("change") or best).values
    tau, sigma = limit * x["tau"], limit * x["sigma"]
    has_dwell = max_dwell_time > 0
    dwell = float(np.abs(sigma - tau).max()) / rate_limit if has_dwell else 0.0
    return RestTransition(tau, sigma if has_dwell else tau, dwell, float(x["level"][0]))


@CachedJit
def _terms(dynamics: PathDynamics, s) -> tuple[Float[Array, "5"], Float[Array, "slacks 5"]]:
    """Return the coefficients of the acceleration and of the force slacks at a place of a path."""
    motion, forces = affine_coefficients(dynamics, s)
    return motion, cone_facets(dynamics, forces)
