"""The best of all motions along each phase's path: the largest margin in the time allowed, the shortest time with one.

Torques are any functions of time within limits, without knots, and may step: no schedule reaches a larger margin.
Derivation: section 8 of `docs/derivation.md`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from wholearm_jax.core import Status, as_device_array, require_x64
from wholearm_jax.margin import PathOptimum, SpeedRange, largest_margin, shortest_duration
from wholearm_jax.model import Arrival, Phase, Scene
from wholearm_jax.optimisation.quasistatic_plan import rolling_count
from wholearm_jax.phases import TracedPhase, starts_at_rest, trace


@dataclass(frozen=True)
class BestMotion:
    """The best motion along one phase's path, in SI units. Points are the midpoints of the intervals between nodes."""

    margin: float
    """Least force [N]; minus infinity where no motion is feasible."""
    duration: float
    """Time that it takes [s]; infinite where no motion is feasible."""
    time_gain: float
    """Growth of the margin with the time allowed [N/s]."""
    contact_weights: dict[str, float]
    """Part of each contact in what limits the margin; all in all one."""
    limit_gains: tuple[float, float]
    """Growth of the margin with each finger's torque limit, times the limit [N]."""
    hardest_place: float
    """Where contacts limit the margin most, as a fraction of the path."""
    place: Float[np.ndarray, "nodes"]
    """Fraction of the path."""
    time: Float[np.ndarray, "nodes"]
    """Time [s]."""
    speed: Float[np.ndarray, "nodes"]
    """`ds/dt` [1/s]."""
    point_place: Float[np.ndarray, "points"]
    """Fraction of the path at the points."""
    torque: Float[np.ndarray, "points 2"]
    """Torques [N m]."""
    force: Float[np.ndarray, "points rows"]
    """Constraint forces [N]."""

    @property
    def feasible(self) -> bool:
        """Whether there is such a motion."""
        return self.margin > -np.inf and self.duration < np.inf


def convex_bounds(
    scene: Scene, *, any_duration: bool = False, traced: tuple[TracedPhase, ...] = ()
) -> tuple[BestMotion | None, ...]:
    """Return for each phase the motion with the largest margin that any torque within limits reaches in its duration.

    A phase begins at rest, or at any speed where another hands over to it at speed; likewise at its end. The margin
    bounds that of every schedule, but for the error of `PROGRAMME_INTERVALS` intervals, which falls with the square of
    their number.

    Args:
        scene: the plan.
        any_duration: let each phase take as long as it likes.
        traced: the result of `trace`, to reuse it.

    Returns:
        One `BestMotion` a phase; None for a phase that holds the object, and where no path can be traced.

    Raises:
        RuntimeError: without float64.

    >>> [f"{best.margin:.3f} N" for best in wa.convex_bounds(wa.load("heptagon"))]
    ['0.417 N', '2.460 N']
    """

    def solve(path, phase, speeds):
        seconds = as_device_array(np.inf) if any_duration else phase.duration
        return largest_margin(path.dynamics, seconds, speeds, rolling_count(phase))

    return _each_phase(scene, traced, solve)


def shortest_motions(
    scene: Scene, margin: float, *, traced: tuple[TracedPhase, ...] = ()
) -> tuple[BestMotion | None, ...]:
    """Return for each phase the fastest motion with at least a margin everywhere, whatever the phase's own duration.

    Args:
        scene: the plan.
        margin: least force of every contact [N].
        traced: the result of `trace`, to reuse it.

    Returns:
        One `BestMotion` a phase; None for a phase that holds the object, and where no path can be traced.

    Raises:
        RuntimeError: without float64.

    >>> [f"{best.duration:.3f} s" for best in wa.shortest_motions(wa.load("heptagon"), 0.4)]
    ['0.132 s', '0.123 s']
    """

    def solve(path, phase, speeds):
        return shortest_duration(path.dynamics, as_device_array(float(margin)), speeds, rolling_count(phase))

    return _each_phase(scene, traced, solve)


def _each_phase(scene: Scene, traced, solve) -> tuple[BestMotion | None, ...]:
    """Solve the programme of each phase that moves the object."""
    require_x64(scene)

    def best(path, phase, from_rest):
        if phase.arrive is Arrival.HOLD or int(path.dynamics.status) != Status.OK:
            return None
        ends = [0.0 if rests else np.nan for rests in (from_rest, phase.arrive is Arrival.AT_REST)]
        speeds = SpeedRange(*(as_device_array(a) for a in (*ends, np.full(2, np.inf))))
        return _best_motion(path, phase, solve(path, phase, speeds))

    return tuple(best(*row) for row in zip(traced or trace(scene), scene.phases, starts_at_rest(scene), strict=True))


def _best_motion(path: TracedPhase, phase: Phase, optimum: PathOptimum) -> BestMotion:
    """Bring an optimum to the host, with the contacts' names."""
    begin, length = path.dynamics.range()
    place, point_place, critical = ((np.asarray(s) - begin) / length for s in _places(optimum))
    feasible = bool(optimum.converged)
    formation = phase.formation
    owners = [*formation.contact_of_row, *np.array(formation.contact_of_row)[np.asarray(formation.tangential)]]
    weights = np.bincount(owners, np.asarray(optimum.facet_weight), len(formation.names))
    return BestMotion(
        margin=float(optimum.margin) if feasible else -np.inf,
        duration=float(optimum.duration) if feasible else np.inf,
        time_gain=float(optimum.time_gain),
        contact_weights=dict(zip(formation.names, (weights / weights.sum()).tolist(), strict=True)),
        limit_gains=tuple(np.asarray(optimum.limit_gain).tolist()),
        hardest_place=float(critical),
        place=place,
        time=np.asarray(optimum.time),
        speed=np.asarray(optimum.speed),
        point_place=point_place,
        torque=np.asarray(optimum.torque),
        force=np.asarray(optimum.force),
    )


def _places(optimum: PathOptimum):
    return optimum.node_s, optimum.point_s, optimum.hardest_s
