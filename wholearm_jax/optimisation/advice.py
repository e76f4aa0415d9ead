"""Advice on a plan that fails: the cause of each phase's failure, and what helps against that cause.

Causes are looked for in this order: a hand-over that no torque survives, a negative bound (no torque holds the contacts
somewhere on the path, however slowly), torque limits (no motion keeps them, however long it takes), too little time,
and last torques that do not reach what a motion along the path can.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import jax
import jax.numpy as jnp
import numpy as np

from wholearm_jax.core import Status
from wholearm_jax.dynamics import PathDynamics
from wholearm_jax.margin import MarginBound, affine_coefficients, best_quasistatic_torque
from wholearm_jax.model import Arrival, Scene
from wholearm_jax.optimisation.best_motion import convex_bounds, shortest_motions
from wholearm_jax.optimisation.quasistatic_plan import DEFAULT_KNOTS, bounds
from wholearm_jax.optimisation.singular_advice import explain_singular
from wholearm_jax.phases import (
    OPENING_ADVICE,
    HandOver,
    PhaseResult,
    Result,
    TracedPhase,
    configuration,
    find_hand_overs,
    group_phases,
)

REMEDY_BOUND = "lower the friction or raise the torque limits, turn the object another way, or choose other contacts"
REMEDY_LIMITS = "raise the torque limits, lower the friction, or choose other contacts"
REMEDY_LOST_HAND_OVER = "hand over elsewhere: choose other contacts, or fingers of another length"
REMEDY_OPTIMISE = "`wholearm optimise` looks for torques that work"
SPARE_TIME = 1.5  # a phase should have this much more time than its fastest motion takes
MIN_KNOTS = 11  # fewer are too few for most phases
ENOUGH_MARGIN = 0.9  # share of the largest margin with which phases at speed are fast enough
AMPLE_TIME = 10.0  # time of such a phase, over its fastest motion with that margin, that torques lead it through
LONG_SHARE = 0.5  # ample time as a share of a duration that is long


@dataclass(frozen=True)
class Search:
    """How the torques of a plan were searched: knots a phase, and whether their rates were limited."""

    knots: int
    limits_rates: bool = False


def explain(
    result: Result,
    *,
    margin_bounds: Sequence[MarginBound] = (),
    search: Search | None = None,
    too_short: Mapping[int, float] = MappingProxyType({}),
) -> Result:
    """Say of each phase that fails what the cause is, and advise what helps against it.

    Args:
        result: a simulated plan.
        margin_bounds: the result of `bounds`, to reuse it.
        search: how the optimiser searched its torques; None for torques from elsewhere.
        too_short: the shortest duration [s] of phases for which nothing was searched, as no torques are so fast.

    Returns:
        The same result with `detail` and `remedy` of phases that fail on the way; others are as they were.
    """
    traced = tuple(phase.traced for phase in result.phases)
    result = _explain_singular_phases(result)
    failed = [k for k, phase in enumerate(result.phases) if _fails_on_its_way(phase)]
    if not failed and not too_short:
        return result
    values = margin_bounds or bounds(result.scene, traced=traced)
    phases = list(result.phases)
    impossible = _impossible_hand_overs(result, traced)
    for k in impossible.keys() & set(failed):
        phases[k] = _explain_hand_over(phases[k], impossible[k])
    searched = [k for k in failed if k not in too_short and k not in impossible]
    refused = [k for k in searched if _no_torque_holds(result.phases[k], float(values[k].value))]
    open_ones = [k for k in searched if k not in refused and result.phases[k].arrive is not Arrival.HOLD]
    fastest = shortest_motions(result.scene, 0.0, traced=traced) if open_ones else (None,) * len(traced)
    shorter = {} if search is None else _shorter_durations(result.scene, traced, open_ones, search.knots)
    for k, shortest in too_short.items():
        detail, remedy = _explain_motion(k, phases[k], shortest, search)
        phases[k] = replace(phases[k], status=Status.TOO_SHORT, contact=None, slips=False, detail=detail, remedy=remedy)
    for k in searched:
        motion = fastest[k]
        if k in refused:
            phases[k] = _explain_negative_bound(phases[k], values[k], traced[k])
        elif motion is not None:
            at_speed = [j for j in (k - 1, k) if j >= 0 and phases[j].arrive is Arrival.MOVING]
            stop = phases[at_speed[0]].name if at_speed else None
            detail, remedy = _explain_motion(k, phases[k], motion.duration, search, stop, shorter.get(k, {}))
            phases[k] = replace(phases[k], detail=detail or phases[k].detail, remedy=remedy)
    return replace(result, phases=tuple(phases))


def _explain_singular_phases(result: Result) -> Result:
    """Say of each phase that is `singular` which of the causes it is."""
    phases = list(result.phases)
    for k, phase in enumerate(result.phases):
        if phase.status is Status.SINGULAR:
            detail, remedy = explain_singular(result.scene, result.scene.phases[k], phase.traced)
            phases[k] = replace(phase, detail=detail, remedy=remedy)
    return replace(result, phases=tuple(phases))


def _fails_on_its_way(phase: PhaseResult) -> bool:
    """Whether a phase has a path, and torques fail it there."""
    has_path = int(phase.traced.dynamics.status) == Status.OK
    return has_path and phase.status not in (Status.OK, Status.OBSTACLE)


def _impossible_hand_overs(result: Result, traced: tuple[TracedPhase, ...]) -> dict[int, HandOver]:
    """Return the hand-over that no torque survives of each phase that begins or ends with one."""
    found = {}
    for k, hand_over in enumerate(find_hand_overs(result.scene, traced)):
        if hand_over is not None and not hand_over.margin > 0:
            found |= {k - 1: hand_over, k: hand_over}
    return found


def _explain_hand_over(phase: PhaseResult, hand_over: HandOver) -> PhaseResult:
    """Name the contacts of a hand-over that no torque survives."""
    old, new = (one.name for one in hand_over)
    detail = f"{old} hands over to {new} there, and no torque stops and starts the object under either"
    return replace(phase, detail=detail, remedy=REMEDY_LOST_HAND_OVER)


def _no_torque_holds(phase: PhaseResult, bound: float) -> bool:
    """Whether a bound says that no torque holds a phase; a duration beyond what can be computed leaves none (-inf)."""
    return bound <= 0 and (math.isfinite(bound) or phase.arrive is Arrival.HOLD)


def _explain_motion(
    number: int,
    phase: PhaseResult,
    fastest: float,
    search: Search | None,
    stop: str | None = None,
    shorter: Mapping[int, float] = MappingProxyType({}),
) -> tuple[str | None, str | None]:
    """Return cause and remedy of a phase that torques could hold at rest anywhere; `fastest` [s] is its fastest motion.

    The fastest motion presses every contact and stays within the torque limits; it is infinite where there is none.
    `stop` names the phase whose end the object passes at speed, where it does; `shorter` are durations [s] of such
    phases, by number, where theirs are long.
    """
    longer = (
        f"--set {number}.duration={round_up_digits(SPARE_TIME * fastest) if math.isfinite(fastest) else math.inf:g}"
    )
    if math.isinf(fastest):
        return "within the torque limits no motion presses every contact, however long it takes", REMEDY_LIMITS
    if fastest > phase.duration:
        detail = f"faster than the torques allow: the phase takes {fastest:.4g} s or longer, not {phase.duration:.4g} s"
        return detail, f"give it more time ({longer})"
    if search is None:
        return phase.detail, f"{_first_half(phase)}; {REMEDY_OPTIMISE}"
    stopping = f"stop before the change of formation (`arrive = \"rest\"` in phase '{stop}')"
    if phase.is_opened_at_its_beginning and stop is not None:
        return None, stopping
    changes = " ".join(f"--set {k}.duration={duration:g}" for k, duration in shorter.items())
    if shorter and stop is not None:
        detail = "so slowly no torques led it through the phases without a stop"
        return detail, f"give them less time ({changes}), or {stopping}"
    if phase.status is Status.MAX_STEPS:
        return phase.detail, None
    possible = f"a motion of {fastest:.3g} s or longer exists"
    if SPARE_TIME * fastest > phase.duration:
        return f"{possible}, which leaves little spare time in {phase.duration:.3g} s", f"give it more time ({longer})"
    if search.limits_rates:
        return f"{possible} where torques may jump", f"allow faster torques (--rate-limit) or more time ({longer})"
    if stop is not None:
        return f"{possible}, but at speed no torques led to it", f"{stopping}, or try another --passing"
    if shorter:
        return f"{possible}, but so slowly no torques led to it", f"give it less time ({changes})"
    return f"{possible}, but {search.knots} knots did not lead to it", (
        f"take more knots (--knots {max(MIN_KNOTS, 2 * search.knots)})"
    )


def _shorter_durations(
    scene: Scene, traced: tuple[TracedPhase, ...], failed: Sequence[int], knots: int
) -> dict[int, dict[int, float]]:
    """Return shorter durations [s] of a failed phase and those that it is coupled with, where theirs are long.

    None of a phase between rests that fails with few torque knots: more may lead through it.
    """
    groups = [group for group in group_phases(scene) if not set(group).isdisjoint(failed)]
    groups = [group for group in groups if len(group) > 1 or knots >= DEFAULT_KNOTS]
    best = convex_bounds(scene, any_duration=True, traced=traced) if groups else ()
    found = {}
    for group in groups:
        margins = [motion.margin for k in group if (motion := best[k]) is not None]
        level = ENOUGH_MARGIN * min(margins, default=-math.inf)
        if not level > 0:
            continue
        fastest = shortest_motions(scene, level, traced=traced)
        durations = {k: float(scene.phases[k].duration) for k in group}
        ample = AMPLE_TIME if len(group) > 1 else SPARE_TIME
        share = max(ample * motion.duration / durations[k] for k in group if (motion := fastest[k]) is not None)
        if share < LONG_SHARE:
            shorter = {k: round_up_digits(share * duration) for k, duration in durations.items()}
            found |= {k: shorter for k in group}
    return found


def _first_half(phase: PhaseResult) -> str:
    """Return what a status means: its advice as far as the remedy; of an impact that opens a contact, the remedy."""
    return OPENING_ADVICE if phase.is_opened_at_its_beginning else phase.status.advice.partition(";")[0]


def round_up_digits(value: float, significant: int = 2) -> float:
    """Round a positive number up to so many significant digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - significant + 1)
    return math.ceil(value / unit - 1e-9) * unit


def _explain_negative_bound(phase: PhaseResult, bound: MarginBound, traced: TracedPhase) -> PhaseResult:
    """Say where a phase's bound is negative, and what would pull."""
    if phase.arrive is Arrival.HOLD:
        detail = f"no torque holds the object there: the bound is {float(bound.value):.3g} N"
        return replace(phase, detail=detail, remedy=REMEDY_BOUND)
    return replace(phase, detail=_negative_bound(phase, bound, traced), remedy=REMEDY_BOUND)


def _negative_bound(phase: PhaseResult, bound: MarginBound, traced: TracedPhase) -> str:
    """Name the place at which a phase's bound is negative, and the contacts whose forces are the least there."""
    z, forces = (np.asarray(a) for a in _forces_at_best_torque(traced.dynamics, bound.s))
    rows = np.flatnonzero(~np.asarray(traced.dynamics.tangential))[: len(phase.contacts)]
    pulling = [name for name, row in zip(phase.contacts, rows, strict=True) if forces[row] < 0]
    whose = f": {' and '.join(pulling)} would have to pull" if pulling else ""
    place = "at its start" if float(bound.path_fraction) == 0 else f"{100 * float(bound.path_fraction):.0f} % along it"
    pose = f"x = {1e3 * z[0]:.1f} mm, phi = {np.degrees(z[2]):.1f} deg"
    return (
        f"no torque moves the object along this path: the bound is {float(bound.value):.3g} N {place} ({pose}){whose}"
    )


@jax.jit
def _forces_at_best_torque(dynamics: PathDynamics, s):
    """Return `z` (SI) at `s`, and the constraint forces [N] of the best torque at rest there."""
    torque = best_quasistatic_torque(dynamics, s).torque
    _, force = affine_coefficients(dynamics, s)
    segment = jnp.minimum((s >= dynamics.breakpoints[1:-1]).sum(), dynamics.count - 1)
    return configuration(dynamics, segment, s), force @ jnp.concatenate([jnp.array([1.0, 0.0, 0.0]), torque])
