"""Where a phase begins and ends: configurations on its path, statics at its start, and why it ends, in words."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import CachedJit
from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.margin import RestAccelerations, Statics, cone_facets, contact_statics
from wholearm_jax.model import (
    FEATURE_GROUPS,
    FINGER_ROOT,
    PALM_END,
    Arrival,
    ContactFormation,
    Hand,
    Phase,
    Polygon,
    Scene,
    contact_kinematics,
    contact_name,
    rigid_body,
    scaled_mechanics,
)
from wholearm_jax.phases.obstacles import describe_obstacle
from wholearm_jax.phases.phase_tracing import TracedPhase
from wholearm_jax.simulation import Motion
from wholearm_jax.tracing import PathEnd, hold_same_tip


@jax.jit
def configuration(dynamics: PathDynamics, segment: Int[Array, ""], s: Float[Array, ""]) -> Float[Array, "5"]:
    """Return `z` (SI) at the path parameter `s` of a segment."""
    panel, xi = locate_panel(dynamics, segment, s)
    return evaluate(dynamics.configuration, panel, xi)


@jax.jit
def start_configuration(dynamics: PathDynamics) -> Float[Array, "5"]:
    """Return `z` (SI) at the path's start."""
    return configuration(dynamics, jnp.asarray(0, int), dynamics.breakpoints[0])


def final_configuration(dynamics: PathDynamics, motion: Motion) -> Float[Array, "5"]:
    """Return `z` (SI) at the end of a motion."""
    return configuration(dynamics, motion.segment[jnp.maximum(motion.count - 1, 0)], motion.s[motion.count])


def target_configuration(phase: Phase, traced: TracedPhase) -> Float[Array, "5"]:
    """Return `z` (SI) where a phase should end: at its path's end, or where it began if it holds the object."""
    return traced.begin if phase.arrive is Arrival.HOLD else traced.end


def statics_at_start(scene: Scene, phase: Phase, traced: TracedPhase) -> tuple[Statics, RestAccelerations]:
    """Return the statics at a phase's start, and the accelerations with which the object would depart from there."""
    return contact_statics(scene, phase.formation, traced.begin), rest_terms(traced.dynamics, 0)[0]


def rest_terms(dynamics: PathDynamics, end: int) -> tuple[RestAccelerations, Float[np.ndarray, "facets 3"]]:
    """Return accelerations and slacks of contact forces [N] of an object at rest at an end of a path.

    Args:
        dynamics: of the path.
        end: 0 for its start, -1 for its end.

    Returns:
        The accelerations, and the slacks while it moves forward, linear in `(1, tau1, tau2)`.
    """
    forward, backward, slack = jax.device_get(_rest_terms(dynamics, jnp.asarray(end)))
    return RestAccelerations(forward, backward), slack


@CachedJit
def _rest_terms(dynamics: PathDynamics, end) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "facets 3"]]:
    segment = jnp.where(end == 0, 0, dynamics.count - 1)
    s = jnp.where(end == 0, dynamics.breakpoints[0], dynamics.breakpoints[-1])
    panel, xi = locate_panel(dynamics, segment, s)
    at_rest = jnp.array([0, 3, 4])
    slack = cone_facets(dynamics, evaluate(dynamics.force, panel, xi))
    forward = evaluate(dynamics.acceleration, panel, xi)
    return forward[at_rest], evaluate(dynamics.reverse_acceleration, panel, xi), slack[:, at_rest]


def formation_at_end(scene: Scene, phase: Phase, traced: TracedPhase) -> ContactFormation:
    """Return a phase's formation with the contact that ends its path."""
    link, kind, feature = _end_contact(scene, traced)
    held = phase.formation
    rows = zip((held.link, held.kind, held.feature, held.tangential), (link, kind, feature, False), strict=True)
    return ContactFormation(*(jnp.append(column, value) for column, value in rows))


def _end_contact(scene: Scene, traced: TracedPhase) -> tuple[int, int, int]:
    """Return link, kind and feature of the contact that ends a path."""
    group, feature = divmod(int(traced.path.end_contact), scene.object.vertices.shape[0])
    return *FEATURE_GROUPS[group], feature


def ends_at_stop(scene: Scene, phase: Phase, traced: TracedPhase) -> bool:
    """Return whether a new contact stops the object at the end of a phase's path.

    None does where the path ends because a vertex and a fingertip take over from one another: there the object can go
    on under the new contact. Nor is an edge pressed against the root of a finger whose contact edge stands apart from
    its joint: a corner above the palm, at which no formation holds an object.
    """
    if int(traced.path.end_reason) != PathEnd.CONTACT_MADE:
        return False
    link, kind, _ = _end_contact(scene, traced)
    if kind == FINGER_ROOT and float(scene.hand.offset[link - 1]) > 0:
        return False
    closed = formation_at_end(scene, phase, traced)
    return not bool(_takes_over(scene.object, scene.hand, scene.gravity, closed, traced.end))


@CachedJit
def _takes_over(polygon: Polygon, hand: Hand, gravity, formation: ContactFormation, z) -> Bool[Array, ""]:
    """Say whether the last contact of a formation takes over at `z` (SI) from another, at a vertex and a fingertip."""
    mechanics = scaled_mechanics(rigid_body(polygon), hand, gravity, formation)
    at = contact_kinematics(mechanics.contacts, z / mechanics.configuration_unit)
    return hold_same_tip(mechanics.contacts, at, mechanics.contacts, at)[-1].any()


def describe_end(scene: Scene, phase: Phase, traced: TracedPhase) -> str:
    """Say why a phase's path ends."""
    if phase.arrive is Arrival.HOLD:
        return "the object is held"
    reason, index = int(traced.path.end_reason), int(traced.path.end_contact)
    if reason == PathEnd.CONTACT_MADE:
        link, kind, feature = _end_contact(scene, traced)
        if kind == FINGER_ROOT:
            return f"e{feature} meets finger{link}'s root"
        if kind == PALM_END:
            return f"e{feature} meets the palm's end at finger{link}"
        return f"{contact_name(link, kind, feature)} is made"
    if reason == PathEnd.FEATURE_END:
        return f"{phase.formation.names[phase.formation.contact_of_row[index]]} leaves its feature"
    if reason == PathEnd.OBSTACLE:
        return describe_obstacle(scene, traced.end, index)
    return "the phase's own limit is reached" if reason == PathEnd.TARGET else "no end was found"
