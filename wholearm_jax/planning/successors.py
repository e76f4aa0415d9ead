"""Which formation next? All formations of four constraints that hold at a configuration, with where their wires lead.

What touches at a configuration (within `TOUCHING`) is combined by fours. Each combination has a wire through the
configuration, and two ways along it; a way that would push another touching contact together ends at once and is left
out. What remains is what a plan can do next.
"""

import itertools
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core.arrays import array
from wholearm_jax.core.status import Status
from wholearm_jax.dynamics.path_dynamics import Table, change, on_panel, powers
from wholearm_jax.margin.quasistatic import Bound, bound, hold
from wholearm_jax.model.contact_kinematics import every_contact, frames, normal_rows
from wholearm_jax.model.mechanics import system
from wholearm_jax.model.scene import COORDINATES, Phase, Scene, body, contact_name, formation, heading
from wholearm_jax.phases.assessment import PULL
from wholearm_jax.phases.phase import Traced, ending, prepare
from wholearm_jax.tracing.path import Resolution

TOUCHING = 1e-7  # gap, in the object's radius, below which a contact touches
SHORTEST = 1e-3  # wire length, in the object's radius, below which a way leads nowhere
WEDGED = 1e-6  # share of the largest entry below which four contacts do not fix a wire


@dataclass(frozen=True)
class Way:
    """A formation and a way along its wire.

    `toward` is the way as scene files write it; `length` the wire's, in the object's radii; `ends` says why it ends, at
    `end` (SI). `static` [N] is the best least force at rest at the start (`-inf`: torques cannot hold it there),
    `bound` [N] the certificate for a second's motion from rest to rest. `speed` is `ds/dt` after an impact at
    the `z_dot` given to `ways` (0 without one), `pulls` whether an impulse of it would pull.
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
    traced: Traced

    @property
    def entering(self) -> str:
        """What happens to an object that arrives at speed, in words."""
        if self.speed == 0 or self.status is not Status.OK:
            return "-"
        return "pulls" if self.pulls else "turns back" if self.speed < 0 else f"{100 * self.speed:.0f} %"


@jax.jit
def leaving(table: Table) -> Float[Array, "5"]:
    """`z_dot` (SI) at a wire's end for `ds/dt = 1`."""
    panel, xi = powers(table, table.count - 1, table.breaks[-1])
    return on_panel(table.velocity, panel, xi)


def touching(scene: Scene, z: Float[Array, "5"]) -> tuple[str, ...]:
    """Names of all contacts that touch at a configuration (SI)."""
    capacity = scene.object.vertices.shape[0]
    pairs = every_contact(capacity)
    near = np.asarray(_near(scene, z, pairs))
    rows = zip(*(np.asarray(a)[near] for a in (pairs.link, pairs.kind, pairs.feature)), strict=True)
    return tuple(contact_name(*(int(v) for v in row)) for row in rows)


@eqx.filter_jit
def _near(scene, z, pairs):
    solid = body(scene.object)
    mechanics = system(solid, scene.hand, scene.gravity, jax.tree.map(lambda a: a[:4], pairs))
    held = jax.tree.map(lambda a: a[: pairs.link.shape[0]], mechanics.candidates)
    at = frames(held, z / mechanics.configuration_unit)
    slack = TOUCHING
    inside = (at.along >= held.lower - slack) & (at.along <= held.upper + slack)
    return inside & (jnp.abs(at.gap) < TOUCHING) & (pairs.feature < solid.count)


def ways(scene: Scene, z: Float[Array, "5"], z_dot: Float[Array, "5"] | None = None) -> tuple[Way, ...]:
    """Every formation of four contacts that touch at `z` (SI), both ways, best static margin first.

    `z_dot` (SI) is the speed with which the object arrives there, if it does.
    """
    found = []
    for four in itertools.combinations(touching(scene, z), 4):
        chosen = formation(four)
        tangent = _tangent(scene, z, chosen)
        if tangent is None:
            continue
        steepest = int(np.argmax(np.abs(tangent)))
        for sign in ("-", "+"):
            way = _way(scene, z, z_dot, four, chosen, COORDINATES[steepest] + sign)
            if way is not None:
                found.append(way)
    return tuple(sorted(found, key=lambda way: -way.static))


def _tangent(scene, z, chosen):
    """The wire's direction in the object's units, or None where the four contacts do not fix one."""
    rows = np.asarray(_rows(scene, z, chosen))
    _, values, right = np.linalg.svd(rows)
    return right[4] if values[-1] > WEDGED * values[0] else None


@eqx.filter_jit
def _rows(scene, z, chosen):
    mechanics = system(body(scene.object), scene.hand, scene.gravity, chosen)
    return normal_rows(mechanics.contacts, z / mechanics.configuration_unit)


def _way(scene, z, z_dot, names, chosen, toward: str) -> Way | None:
    """Trace one way; None where it leads nowhere."""
    onward = heading(toward)
    told, plain = (body(scene.object), scene.hand, scene.gravity, chosen, z, onward), array(True)
    traced = prepare(*told, Resolution(), plain, plain)  # as `trace` does: one program
    table = traced.table
    status, length = Status(int(table.status)), float(table.length)
    if status is Status.OK and length < SHORTEST:
        return None
    phase = Phase("", chosen, onward, jnp.ones(()))
    known = status is Status.OK
    top, static = (float(v) for v in _value(table)) if known else (float("-inf"), float("-inf"))
    entered = change(table, jnp.zeros(5) if z_dot is None else z_dot)
    impulse = np.asarray(entered.impulse)
    return Way(
        contacts=tuple(names),
        toward=toward,
        status=status,
        length=length,
        ends=ending(traced, phase, scene.object.vertices.shape[0]) if known else status.label,
        end=traced.end,
        static=static,
        bound=top,
        speed=float(entered.speed),
        pulls=bool(impulse.min() < -PULL * float(entered.size)),
        traced=traced,
    )


@jax.jit
def _value(table):
    top: Bound = bound(table, jnp.ones(()))
    return top.value, hold(table, table.breaks[0]).margin
