"""Group: phases that follow one another at speed are one problem, which is descended on from several starts.

A group begins and ends at rest, or with the plan. Where torque rates are limited its first and last torques are those
that it shares with its neighbours (`rest_transition`). What counts is not what the descent says of its intervals but an
honest simulation of the schedules.

Derivation: section 9 of `docs/derivation.md`.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np
import optax

from wholearm_jax.core import Status, as_device_array, stack_trees
from wholearm_jax.margin import MarginBound
from wholearm_jax.model import (
    Arrival,
    Phase,
    Scene,
    TorqueSchedule,
    concatenate_schedules,
    pad_schedule,
    uniform_schedule,
)
from wholearm_jax.optimisation.constraints import Limits
from wholearm_jax.optimisation.initial_guess import initial_guesses
from wholearm_jax.optimisation.interior_point import interior_point
from wholearm_jax.optimisation.multiple_shooting import extra_parts
from wholearm_jax.optimisation.projected_gradient import projected_gradient
from wholearm_jax.optimisation.rest_transition import RestTransition
from wholearm_jax.optimisation.solver import CONVERGED, REPEATED, IterationRecord, Problem, solve
from wholearm_jax.optimisation.variables import Variables
from wholearm_jax.phases import TracedPhase, rest_intervals, simulate_phase
from wholearm_jax.simulation import IntegratorOptions, with_step_capacity

TORQUE_SHARE = 0.9  # share of the torque limits that a start may use
SHORTEST = 0.01  # share of its longest time that a phase moves at the least
GOOD = 0.99  # share of the bound with which no further start is tried


@dataclass(frozen=True)
class OptimiseOptions:
    """What `optimise` was asked for; `rows` is the size of the whole plan's schedule: those of one share programs."""

    knots: int
    rows: int
    steps: int
    rate_limit: float | None
    durations: tuple[float, float] | None
    passing: float
    optimiser: optax.GradientTransformation | None
    tolerance: float
    callback: Callable[[IterationRecord], None] | None


@dataclass(frozen=True)
class CoupledPhases:
    """Phases with all that is known of them; `index` is the first one's number."""

    index: int
    phases: tuple[Phase, ...]
    traced: list[TracedPhase]
    certificates: list[MarginBound]
    begin: RestTransition | None  # where torque rates are limited, and a phase stands before
    end: RestTransition | None  # or behind
    wanted: OptimiseOptions

    @property
    def pins(self) -> dict[tuple[int, int], np.ndarray]:
        """Torques that stay as they are, in units of their limits, by phase and knot."""
        begin = [] if self.begin is None else [((0, 0), self.begin, self.begin.departure_torque / self.limits[0])]
        end = [] if self.end is None else [((-1, -1), self.end, self.end.torque / self.limits[-1])]
        return {at: torque for at, change, torque in [*begin, *end] if change.is_feasible}

    @property
    def most(self) -> float:
        """The share of the bounds that the torques at both ends allow."""
        changes = [
            change.margin_fraction for change in (self.begin, self.end) if change is not None and change.is_feasible
        ]
        return min([1.0, *changes])

    @property
    def lead(self) -> np.ndarray:
        """How long the object waits in each phase before it sets out."""
        first = self.begin.dwell_time if self.begin is not None else 0.0
        return np.append(first, np.zeros(len(self.phases) - 1))

    @property
    def durations(self) -> np.ndarray:
        """How long it moves in each."""
        return np.array([float(p.duration) for p in self.phases]) - self.lead

    @property
    def limits(self) -> np.ndarray:
        """The largest torques of each [N m]."""
        return np.stack([np.asarray(at.dynamics.torque_limit) for at in self.traced])

    @property
    def bounds(self) -> np.ndarray:
        return np.array([float(top.value) for top in self.certificates])

    def problem(self, limits: Limits) -> Problem:
        """What is descended on."""
        phase_dynamics = stacked_tables([at.dynamics for at in self.traced])
        return Problem(self.index, phase_dynamics, self.bounds, limits, self.wanted.steps, self.wanted.tolerance)


def solve_coupled_phases(scene: Scene, group: CoupledPhases) -> tuple[list[TorqueSchedule], str, list[IterationRecord]]:
    """Descend from one start after the other, until one comes near the bound or two agree.

    Returns the best schedules (each from time 0), why their descent stopped, and the steps taken.
    """
    wanted, tolerance = group.wanted, group.wanted.tolerance
    for at in group.traced:
        if int(at.dynamics.status) != Status.OK:
            why = f"the wire cannot be followed: {Status(int(at.dynamics.status)).label}"
            return [uniform_schedule(t, np.zeros((wanted.knots, 2))) for t in group.durations], why, []
    begins = initial_guesses([at.dynamics for at in group.traced], group.durations, wanted.knots, TORQUE_SHARE)
    weakest = int(np.argmin(group.bounds))
    if group.bounds[weakest] <= 0:
        where = 100 * float(group.certificates[weakest].path_fraction)
        why = f"no torque within limits holds this formation at {where:.0f} % of its wire"
        return _schedules(group, begins[0]), why, []
    if group.begin is not None and not group.begin.is_feasible:
        return _schedules(group, begins[0]), "no torque lets this formation take over at the limited rate", []
    problem = group.problem(_limits(group))
    method = descent_method(wanted.optimiser, len(group.phases), extra_parts(problem.phase_dynamics))
    found, history = [], []
    for number, start in enumerate(begins):
        for at, torque in group.pins.items():
            start = eqx.tree_at(lambda p: p.torque, start, start.torque.at[at].set(torque))
        ended = [other for fine, _, why, other in found if fine and why == CONVERGED]
        p, why, taken = solve(problem, start, number, method, wanted.callback, ended)
        history += taken
        if why == REPEATED:
            break
        fine, share = _verify_by_simulation(scene, group, p)
        best = max((other for ok, other, *_ in found if ok), default=np.nan)
        agree = fine and abs(share - best) <= tolerance
        found.append((fine, share, why, p))
        if agree or (fine and share >= GOOD * group.most):
            break
    fine, share, why, p = max(found, key=lambda one: one[:2])
    if fine and share >= 1 - tolerance:
        why = f"within {tolerance:g} of the bound"
    return _schedules(group, p), why, history


def _schedules(group: CoupledPhases, p: Variables) -> list[TorqueSchedule]:
    """Each phase's schedule, from time 0."""
    values, lengths = np.asarray(p.torque) * group.limits[:, None], np.exp(np.asarray(p.log_duration))
    first, *others = [uniform_schedule(length, rows) for length, rows in zip(lengths, values, strict=True)]
    if group.begin is not None and group.begin.dwell_time > 0:
        times = np.append(0.0, group.begin.dwell_time + np.asarray(first.times))
        first = TorqueSchedule(as_device_array(times), as_device_array(np.vstack([group.begin.torque, first.values])))
    return [first, *others]


def _verify_by_simulation(scene: Scene, group: CoupledPhases, p: Variables) -> tuple[bool, float]:
    """Whether a simulation of the schedules says `ok`, holds included, and the least margin over its bound."""
    start, shares, fine, incoming_velocity = 0.0, [], [], None
    torque = concatenate_schedules(_schedules(group, p))
    schedule, options = (
        pad_schedule(torque, group.wanted.rows),
        with_step_capacity(IntegratorOptions(), group.wanted.knots),
    )
    ends = np.cumsum(np.exp(np.asarray(p.log_duration)) + group.lead)
    for phase, at, end, top in zip(group.phases, group.traced, ends, group.bounds, strict=True):
        one = simulate_phase(at.dynamics, schedule, start, end - start, options, phase.arrive, incoming_velocity)
        start += float(one.duration) * float(np.asarray(one.motion.phase_time)[int(one.motion.count)])
        incoming_velocity = one.exit_velocity if phase.arrive is Arrival.MOVING else None
        held = rest_intervals(scene, torque, phase, at, one)
        fine.append(int(one.assessment.status) == Status.OK and all(h.loss_time is None for h in held))
        shares.append(float(one.margin_result.margin) / top)
    least = min(shares)
    return all(fine), least if np.isfinite(least) else -np.inf


def _limits(group: CoupledPhases) -> Limits:
    lengths, asked = group.durations, group.wanted
    shortest, longest = (lengths, lengths) if asked.durations is None else (t - group.lead for t in asked.durations)
    rate = np.full(2, np.inf if asked.rate_limit is None else float(asked.rate_limit))
    pinned = np.zeros((len(lengths), asked.knots), bool)
    for at in group.pins:
        pinned[at] = True
    shortest, unit = np.maximum(shortest, SHORTEST * longest), np.maximum(group.bounds, 1e-300)
    return Limits(*(as_device_array(a) for a in (rate, shortest, longest, np.asarray(asked.passing), pinned, unit)))


@functools.cache
def descent_method(optimiser, phases: int, further: int):
    """One transformation for every use, so that programs are not compiled again."""
    return interior_point(phases, further) if optimiser is None else projected_gradient(optimiser)


stacked_tables = jax.jit(stack_trees)
