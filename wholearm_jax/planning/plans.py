"""Plans: phases that lead to a goal, each with its certificate, and what a search for them returns."""

from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core import BackgroundTask, CachedJit, Status, as_device_array, compile_in_background
from wholearm_jax.dynamics import placeholder_dynamics
from wholearm_jax.margin import (
    BOUND_PLACES,
    best_quasistatic_torque,
    largest_margin,
    margin_upper_bound,
    rest_to_rest,
)
from wholearm_jax.model import COORDINATES, Phase, Scene, contact_formation, path_target
from wholearm_jax.phases import describe_end, find_hand_overs, trace
from wholearm_jax.planning.goal import Goal
from wholearm_jax.tracing import Resolution


@dataclass(frozen=True)
class Step:
    """One phase of a plan: a move, and the place at which it is left."""

    contacts: tuple[str, ...]
    toward: str
    until: tuple[str, float] | None  # a coordinate and its value; None: the path's end
    end: np.ndarray  # (5,) `z` (SI)
    margin: float  # [N], least on the way, at rest
    regrasp: str | None = None  # what a finger does that moves alone, as scene files write it
    leaves: str | None = None  # the contact that is at its feature's end there: no next phase keeps it
    delay: float = 0.0  # by how many phases later the search goes on from there


def leading_coordinate(displacement: Float[np.ndarray, "5"], unit: Float[np.ndarray, "5"]) -> str:
    """Name the coordinate that a displacement changes most, each over its unit."""
    return COORDINATES[int(np.argmax(np.abs(displacement) / unit))]


def contact_left(steps: tuple[Step, ...]) -> str | None:
    """Name the contact, if any, that is at its feature's end after some steps."""
    return steps[-1].leaves if steps else None


@dataclass(frozen=True)
class Plan:
    """Phases that lead to the goal, as a scene that `optimise` takes as it is."""

    scene: Scene
    steps: tuple[Step, ...]
    begins: tuple[np.ndarray, ...]  # `z` (SI) where each phase begins, and
    ends: tuple[np.ndarray, ...]  # ends
    reasons: tuple[str, ...]  # why each path ends
    bounds: tuple[float, ...]  # largest margin of all motions along each phase's path [N]

    @property
    def bound(self) -> float:
        """The plan's certificate: no torque gives a larger margin."""
        return min(self.bounds)


@dataclass(frozen=True)
class Edge:
    """A move of the search, from one configuration to another."""

    begin: np.ndarray  # (5,) `z` (SI)
    end: np.ndarray
    margin: float  # [N], least on the way, at rest


@dataclass(frozen=True)
class PlanningResult:
    """The best plans, or what stands in the way."""

    start: np.ndarray  # (5,) `z` (SI)
    goal: Goal
    plans: tuple[Plan, ...]  # best first
    nearest: Plan | None  # where there is none: to the configuration nearest to the goal
    reason: str  # why there is no plan, empty if there is one
    nodes: int  # configurations that were expanded
    moves: int  # paths that were traced
    graph: tuple[Edge, ...]  # what the search reached, and from where
    out_of_time: bool = False  # whether it ended before all moves were tried
    distance: float = np.inf  # of the nearest configuration from the goal, in moves as the search estimates them

    @property
    def found(self) -> bool:
        """Whether there is a plan."""
        return bool(self.plans)


def make_plan(
    scene: Scene,
    start: Float[np.ndarray, "5"],
    steps: tuple[Step, ...],
    duration: float,
    goal: Goal | None,
    floor: float = -np.inf,
) -> Plan | None:
    """Trace steps as a plan at full resolution.

    None where a phase cannot be traced, no torque survives a hand-over between two, or the certificate is not above the
    floor; with a goal, also where it is missed, and where nothing holds the object at rest somewhere on the way.
    """
    planned = _as_scene(scene, start, steps, duration)
    traced = trace(planned)
    if any(int(one.dynamics.status) != Status.OK or bool(one.dynamics.ends_at_obstacle) for one in traced):
        return None
    ends = tuple(np.asarray(one.end) for one in traced)
    if goal is not None and not goal.is_reached(ends[-1]):
        return None
    phases = planned.phases
    reasons = tuple(describe_end(planned, phase, one) for phase, one in zip(phases, traced, strict=True))
    if any(over is not None and not over.margin > 0 for over in find_hand_overs(planned, traced)):
        return None
    bounds = np.full(len(steps), np.nan)
    for k in np.argsort([step.margin for step in steps]):  # the phase first that is likely to limit the plan
        dynamics = traced[k].dynamics
        if goal is not None and not float(_least_rest_margin(dynamics)) > 0:
            return None
        bounds[k] = _certificate(dynamics, phases[k].duration)
        if not bounds[k] > floor:
            return None
    return Plan(planned, steps, tuple(np.asarray(one.begin) for one in traced), ends, reasons, tuple(bounds.tolist()))


def precompile_certificates() -> BackgroundTask:
    """Compile what judges a plan's phases, in the background; returns the task to wait for."""
    return compile_in_background(_judge_placeholder)


def _judge_placeholder() -> None:
    dynamics = placeholder_dynamics(Resolution())
    _least_rest_margin(dynamics)
    largest_margin(dynamics, as_device_array(1.0), rest_to_rest())


@CachedJit
def _least_rest_margin(dynamics) -> Float[Array, ""]:
    """Compute the least margin with which the object can be held at rest along a path [N]."""
    places = dynamics.breakpoints[0] + dynamics.length * jnp.linspace(0.0, 1.0, BOUND_PLACES + 1)
    return jax.vmap(partial(best_quasistatic_torque, dynamics))(places).margin.min()


def _certificate(dynamics, duration) -> float:
    """Return the largest margin of all motions along a path; without one, the bound of each place alone [N]."""
    best = largest_margin(dynamics, duration, rest_to_rest())
    return float(best.margin if best.converged else _pointwise_bound(dynamics, duration).value)


_pointwise_bound = CachedJit(margin_upper_bound)


def _as_scene(scene: Scene, start: Float[np.ndarray, "5"], steps: tuple[Step, ...], duration: float) -> Scene:
    """Write steps as the phases of a scene."""
    phases = tuple(
        Phase(
            f"{k + 1}: {step.regrasp or step.toward}",
            contact_formation(step.contacts),
            path_target(step.toward, dict([step.until]) if step.until else None),
            as_device_array(duration),
            regrasp=step.regrasp,
        )
        for k, step in enumerate(steps)
    )
    return eqx.tree_at(lambda s: (s.start, s.phases), scene, (as_device_array(start), phases))


def survives_hand_over(scene: Scene, begin: Float[np.ndarray, "5"], steps: tuple[Step, Step], duration: float) -> bool:
    """Say whether torques stop and start the object under either contact between two steps, the first from `begin`."""
    planned = _as_scene(scene, begin, steps, duration)
    over = find_hand_overs(planned, trace(planned))[1]
    return over is None or over.margin > 0
