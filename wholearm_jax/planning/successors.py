"""Which formation next? All formations of four constraints that hold at a configuration, with where their paths lead.

What touches at a configuration (within `CONTACT_TOL`) is combined by fours. Each combination has a path through the
configuration, and two ways along it; a way that would push another touching contact together ends at once and is left
out. What remains is what a plan can do next.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core import Status, as_device_array, require_x64
from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel, resolve_impact
from wholearm_jax.margin import MarginBound, best_quasistatic_torque, margin_upper_bound
from wholearm_jax.model import (
    LINKS,
    Phase,
    Scene,
    contact_candidates,
    contact_formation,
    contact_kinematics,
    contact_name,
    path_target,
    rigid_body,
    scaled_mechanics,
)
from wholearm_jax.phases import IMPULSE_ROUNDING, TracedPhase, describe_end, trace_phase
from wholearm_jax.planning.path_choices import path_choices
from wholearm_jax.tracing import Resolution

CONTACT_TOL = 1e-7  # gap, in the object's radius, below which a contact touches
MIN_PATH_LENGTH = 1e-3  # path length, in the object's radius, below which a way leads nowhere


@dataclass(frozen=True)
class Successor:
    """A formation and a way along its path.

    `toward` is the way as scene files write it; `length` the path's, in the object's radii; `ends` says why it ends, at
    `end` (SI). `static` [N] is the best least force at rest at the start (`-inf`: torques cannot hold it there),
    `bound` [N] the certificate for a second's motion from rest to rest. `speed` is `ds/dt` after an impact at
    the `z_dot` given to `successor_formations` (0 without one), `pulls` whether an impulse of it would pull.
    """

    contacts: tuple[str, ...]
    toward: str
    status: Status
    length: float
    ends: str
    end: Float[Array, "5"]
    static: float
    bound: float
    speed: float
    pulls: bool
    traced: TracedPhase

    @property
    def entering(self) -> str:
        """What happens to an object that arrives at speed, in words."""
        if self.speed == 0 or self.status is not Status.OK:
            return "-"
        return "pulls" if self.pulls else "turns back" if self.speed < 0 else f"{100 * self.speed:.0f} %"


@jax.jit
def exit_velocity(dynamics: PathDynamics) -> Float[Array, "5"]:
    """`z_dot` (SI) at a path's end for `ds/dt = 1`."""
    panel, xi = locate_panel(dynamics, dynamics.count - 1, dynamics.breakpoints[-1])
    return evaluate(dynamics.velocity, panel, xi)


def touching_contacts(scene: Scene, z: Float[Array, "5"], tolerance: float = CONTACT_TOL) -> tuple[str, ...]:
    """Return the names of all contacts that touch at a configuration (SI): a gap below `tolerance` object radii."""
    require_x64(scene, z)
    capacity = scene.object.vertices.shape[0]
    pairs = contact_candidates(capacity)
    near = np.asarray(_near(scene, z, pairs, tolerance))
    rows = zip(*(np.asarray(a)[near] for a in (pairs.link, pairs.kind, pairs.feature)), strict=True)
    return tuple(contact_name(*(int(v) for v in row)) for row in rows)


def flush_sides(scene: Scene, touching: Sequence[str]) -> tuple[str, ...]:
    """Name the sides of the object that lie flush on a link: both ends of an edge touch it.

    Args:
        scene: the object.
        touching: names of contacts, as `touching_contacts` returns them.

    Returns:
        Lines such as `e5 on palm`. A formation holds one of the two vertices, or both.
    """
    count, names = int(scene.object.count), {*touching}
    pairs = [(link, k) for link in LINKS for k in range(count)]
    return tuple(f"e{k} on {link}" for link, k in pairs if {f"{link}:v{k}", f"{link}:v{(k + 1) % count}"} <= names)


@eqx.filter_jit
def _near(scene, z, pairs, slack):
    solid = rigid_body(scene.object)
    mechanics = scaled_mechanics(solid, scene.hand, scene.gravity, jax.tree.map(lambda a: a[:4], pairs))
    held = jax.tree.map(lambda a: a[: pairs.link.shape[0]], mechanics.candidates)
    at = contact_kinematics(held, z / mechanics.configuration_unit)
    inside = (at.along >= held.lower - slack) & (at.along <= held.upper + slack)
    return inside & (jnp.abs(at.gap) < slack) & (pairs.feature < solid.count)


def successor_formations(
    scene: Scene,
    z: Float[Array, "5"],
    z_dot: Float[Array, "5"] | None = None,
    *,
    rolling: bool = False,
    touching: Sequence[str] | None = None,
) -> tuple[Successor, ...]:
    """Return every formation of contacts that touch at a configuration, in both directions, best static margin first.

    Args:
        scene: the hand and the object.
        z: configuration (SI).
        z_dot: velocity (SI) with which the object arrives there, if it does.
        rolling: whether to list formations with rolling contacts, too, each of which takes two of the four constraints.
        touching: the contacts to combine, instead of those that touch at `z`: from each combination's nearest
            configuration, as at the start of a plan. Those without one are left out.
    """
    require_x64(scene, z)
    contacts = touching_contacts(scene, z) if touching is None else touching
    successors = []
    for names, toward in path_choices(scene, z, contacts, rolling=rolling):
        formation = contact_formation(names)
        lists_failures = touching is None and not bool(np.any(formation.tangential))
        successor = _successor(scene, z, z_dot, names, formation, toward)
        if successor is not None and (successor.status is Status.OK or lists_failures):
            successors.append(successor)
    return tuple(sorted(successors, key=lambda successor: -successor.static))


def _successor(scene, z, z_dot, names, chosen, toward: str) -> Successor | None:
    """Trace one way; None where it leads nowhere."""
    onward = path_target(toward)
    problem, begins_plan = (
        (rigid_body(scene.object), scene.hand, scene.gravity, chosen, z, onward),
        as_device_array(True),
    )
    traced = trace_phase(*problem, Resolution(), begins_plan, begins_plan)  # as `trace` does: one program
    dynamics = traced.dynamics
    status, length = Status(int(dynamics.status)), float(dynamics.length)
    if status is Status.OK and length < MIN_PATH_LENGTH:
        return None
    phase = Phase("", chosen, onward, jnp.ones(()))
    known = status is Status.OK
    top, static = (float(v) for v in _value(dynamics)) if known else (float("-inf"), float("-inf"))
    entered = resolve_impact(dynamics, jnp.zeros(5) if z_dot is None else z_dot)
    impulse = np.asarray(entered.impulse)
    return Successor(
        contacts=tuple(names),
        toward=toward,
        status=status,
        length=length,
        ends=describe_end(scene, phase, traced) if known else status.label,
        end=traced.end,
        static=static,
        bound=top,
        speed=float(entered.speed),
        pulls=bool(impulse.min() < -IMPULSE_ROUNDING * float(entered.size)),
        traced=traced,
    )


@jax.jit
def _value(dynamics):
    top: MarginBound = margin_upper_bound(dynamics, jnp.ones(()))
    return top.value, best_quasistatic_torque(dynamics, dynamics.breakpoints[0]).margin
