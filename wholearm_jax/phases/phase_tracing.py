"""Tracing of one phase: the path of its contact formation and the path dynamics tabulated on it.

One compiled program (`trace_phase`) serves every phase of every scene.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from wholearm_jax.core import CachedJit, Status, eps_power
from wholearm_jax.dynamics import PathDynamics, tabulate_path_dynamics
from wholearm_jax.model import PathTarget, ScaledMechanics, scaled_mechanics
from wholearm_jax.tracing import ContactPath, Resolution, trace_path

CONTINUITY = 1e-6  # [m] and [rad], gap allowed between the end of a phase and the start of the next
MIN_LENGTH = 1e-9  # [object radii], a shorter path ends where it begins


class TracedPhase(NamedTuple):
    """Path of a phase, and its tabulated dynamics."""

    path: ContactPath
    dynamics: PathDynamics
    begin: Float[Array, "5"]  # `z` (SI) at the path's start
    end: Float[Array, "5"]  # `z` (SI) at the path's end


@CachedJit
def trace_phase(
    body,
    hand,
    gravity,
    formation,
    initial_guess,
    target,
    resolution: Resolution = Resolution(),
    first=True,
    holds=True,
) -> TracedPhase:
    """Trace a formation's path and tabulate its dynamics.

    Args:
        body: Rigid body (`model.rigid_body`).
        hand: Hand of the scene.
        gravity: Gravity [m/s^2].
        formation: Contact formation of the phase.
        initial_guess: Configuration (SI) near the path's start; the end of the phase before.
        target: Direction and limit of the path.
        resolution: Sizes of the path and its tables.
        first: Whether the phase is the plan's first. The path of any other must start at `initial_guess`.
        holds: Whether the phase only holds the object. The path of any other must have a length.

    Returns:
        The traced phase. `dynamics.status` says what is wrong with it.
    """
    mechanics = scaled_mechanics(body, hand, gravity, formation)
    path, begin, end = trace_phase_path(mechanics, initial_guess, target, resolution, first, holds)
    return strengthen_types(TracedPhase(path, tabulate_path_dynamics(mechanics, path), begin, end))


def trace_phase_path(
    mechanics: ScaledMechanics, initial_guess, target: PathTarget, resolution: Resolution, first, holds
) -> tuple[ContactPath, Float[Array, "5"], Float[Array, "5"]]:
    """Trace the path of a phase, and return it with `z` (SI) at its start and end; see `trace_phase`."""
    path = trace_path(mechanics, initial_guess, target, resolution, may_settle=first)
    begin, end = (z * mechanics.configuration_unit for z in (path.start, path.end))
    offset, is_traced = jnp.abs(begin - initial_guess).max(), path.status == int(Status.OK)
    detached = is_traced & ~jnp.asarray(first) & ~(offset < max(CONTINUITY, eps_power(offset, 5 / 8)))
    empty = is_traced & ~jnp.asarray(holds) & (path.length < MIN_LENGTH)
    failures = [int(Status.NO_CONVERGENCE), int(Status.LEFT_FORMATION)]
    status = jnp.select([detached, empty], failures, path.status)
    return strengthen_types((eqx.tree_at(lambda p: p.status, path, status), begin, end))


def strengthen_types(tree):
    """Remove weak types, which depend on how constants were written and would recompile the programs that follow."""
    return jax.tree.map(lambda a: jax.lax.convert_element_type(a, a.dtype), tree)
