r"""Statics of an object that friction holds at rest, and the margin of the contacts.

At rest at `z` the forces of the contacts, `c_n` and `c_t` of each, and the dry friction `d` of the joints balance

    g + E tau + d + G_n^T c_n + G_t^T c_t = 0,     |c_t| <= mu c_n,     |d_i| <= D_i.

These are five equations for ten unknowns: the forces are not determined. The *margin* at rest is by definition the
largest `m` for which some forces within these limits have `c_n >= m` at every contact: the value of a linear programme.
Where no forces are possible, it is minus the least adhesion `a` with which some would be, `|c_t| <= mu (c_n + a)`. Both
are concave functions of the torque. Derivation: section 4 of `docs/derivation.md`.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

from wholearm_jax.core import CachedJit, LinearProgramme, LinearProgrammeSolution
from wholearm_jax.model import (
    ContactFormation,
    Scene,
    normal_jacobian,
    rigid_body,
    scaled_mechanics,
    tangential_jacobian,
)

MARGIN_CAP = 1e6  # the largest margin, over the unit of force: friction may let forces grow without end
NO_ROWS = np.zeros((0, 3))
MIN_REST_MARGIN = 0.01  # distance of torques at rest from those that would move the object, over the limits
MARGIN_TIE = 0.99  # fraction of the best margin that a torque farther from those that move the object may keep


class StaticMargin(NamedTuple):
    """The margin at rest."""

    margin: float  # [N]
    contact: str  # that limits it
    torque: Float[np.ndarray, "2"]  # with which it is attained [N m]


class RestAccelerations(NamedTuple):
    """Accelerations `d2s/dt2` at rest, linear in `(1, tau1, tau2)`.

    An object stays while the forward one is not positive and the backward one not negative.
    """

    ahead: Float[np.ndarray, "3"]  # with the friction of travel forward
    behind: Float[np.ndarray, "3"]  # with the friction of travel backward

    def rest_rows(self, torque_unit: float | np.ndarray = 1.0) -> Float[np.ndarray, "2 3"]:
        """Return rows with `row @ (1, torque) <= 0` while the object stays, of unit size in the torque."""
        rows = np.stack([self.ahead, -self.behind])
        rows[:, 1:] *= torque_unit
        return rows / np.linalg.norm(rows[:, 1:], axis=1, keepdims=True)


@dataclass(frozen=True)
class Statics:
    """The balance of forces at one configuration: `wrench @ (c_n, c_t, d) + load @ (1, tau1, tau2) = 0`.

    Its rows are forces over `unit`, or torques over the object's radius and `unit`.
    """

    names: tuple[str, ...]  # of the contacts
    wrench: Float[np.ndarray, "5 unknowns"]
    load: Float[np.ndarray, "5 3"]  # of weight and torques [N m]
    friction: Float[np.ndarray, "contacts"]  # coefficients
    dry: Float[np.ndarray, "2"]  # largest dry friction of the joints
    torque_limit: Float[np.ndarray, "2"]  # [N m]
    unit: float  # [N]
    mass: Float[np.ndarray, "5"]  # diagonal of the mass matrix, over `unit`; accelerations are in object radii

    def margin_under(self, torque) -> StaticMargin:
        """Compute the margin under a given torque [N m]."""
        return self._best(np.column_stack([torque, torque]))

    def best(self, departure: RestAccelerations | None = None) -> StaticMargin:
        """Compute the largest margin of all torques within limits, or with a `departure` of those that move nothing."""
        return self._best(self._torque_range, NO_ROWS if departure is None else departure.rest_rows())

    def best_against(self, acceleration, least: float) -> StaticMargin:
        """Compute the largest margin of all torques within limits that give `acceleration @ (1, torque) >= least`.

        It is minus infinity where no torque does.
        """
        return self._best(self._torque_range, np.array([[least, 0.0, 0.0]]) - acceleration)

    def most_central_torque(self, departure: RestAccelerations) -> StaticMargin:
        """Compute a torque with `MARGIN_TIE` of the largest margin, farthest from those that move the object."""
        limits, rest_rows = self._torque_range, departure.rest_rows()
        top = self._best(limits, rest_rows)
        if not top.margin > 0:
            return top
        floor = MARGIN_TIE * top.margin / self.unit
        central = self._maximise(limits, (0.0, np.inf), floor=floor, rest_rows=rest_rows, apart=1.0)
        return top if central is None else self.margin_under(central.values["torque"])

    def loss_fraction(self, before, after) -> float:
        """Compute the fraction of the way between two torques from which no forces hold the object (1: none)."""
        ends = np.stack([before, after])
        limits = np.column_stack([ends.min(0), ends.max(0)])
        last = self._maximise(limits, (0.0, 1.0), path=ends)
        return 0.0 if last is None else float(last.values["m"][0])

    @property
    def _torque_range(self) -> Float[np.ndarray, "2 2"]:
        """The least and the largest torque of each joint [N m]."""
        return np.column_stack([-self.torque_limit, self.torque_limit])

    def _best(self, limits, rest_rows=NO_ROWS) -> StaticMargin:
        """Maximise the margin; where no forces are possible, minus the least adhesion."""
        best = self._maximise(limits, (0.0, MARGIN_CAP), press=1.0, rest_rows=rest_rows)
        if best is None:
            best = self._maximise(limits, (-np.inf, 0.0), press=1.0, adhesion=1.0, rest_rows=rest_rows)
        if best is None:
            return StaticMargin(-np.inf, self.names[0], limits.mean(1))
        margin, multipliers = float(best.values["m"][0]), best.multipliers
        # Each contact's part in what limits the margin: its pressure, and where it adheres its friction cone.
        cone = self.friction * (multipliers["cone_above"] + multipliers["cone_below"])
        weakest = int(np.argmax(multipliers["pressure"] + cone * (margin < 0)))
        return StaticMargin(margin * self.unit, self.names[weakest], best.values["torque"])

    def _maximise(
        self, limits, bounds, *, press=0.0, floor=0.0, adhesion=0.0, rest_rows=NO_ROWS, apart=0.0, path=None
    ) -> LinearProgrammeSolution | None:
        """Maximise `m` within `bounds` over forces as in `add_forces`, with `rest_rows @ (1, torque) <= -apart m`.

        Along a `path`, `torque = path[0] + m (path[1] - path[0])`.
        """
        programme = LinearProgramme()
        self.add_forces(programme, level="m", press=press, floor=floor, adhesion=adhesion)
        programme.add_variables("torque", *limits.T)
        programme.add_variables("m", *bounds)
        programme.at_most("rest", -rest_rows[:, 0], torque=rest_rows[:, 1:], m=apart)
        if path is not None:
            programme.equal("path", path[0], torque=np.eye(2), m=path[0] - path[1])
        return programme.maximise("m")

    def add_forces(
        self,
        programme: LinearProgramme,
        *,
        level: str,
        press: float = 0.0,
        floor: float = 0.0,
        adhesion: float = 0.0,
        torque: str = "torque",
        torque_unit: float | np.ndarray = 1.0,
        prefix: str = "",
    ) -> None:
        """Add the forces of the object at rest to a linear programme:

            c_n >= press m + floor,     |c_t| <= mu (c_n - adhesion m),     |d| <= D,     and their balance.

        Args:
            programme: gets the blocks `c_n`, `c_t` and `d`, in units of `unit`.
            level: name of the block `m`.
            press, floor, adhesion: as above.
            torque: name of the block of torques.
            torque_unit: unit of this block [N m].
            prefix: of the names of all blocks and rows that are added.
        """
        count = len(self.names)
        one, cone, zero, unbounded = np.eye(count), np.diag(self.friction), np.zeros(count), np.full(count, np.inf)
        c_n, c_t, d = (prefix + name for name in ("c_n", "c_t", "d"))
        programme.add_variables(c_n, -unbounded, unbounded)
        programme.add_variables(c_t, -unbounded, unbounded)
        programme.add_variables(d, -self.dry, self.dry)
        programme.at_most(prefix + "pressure", zero - floor, **{c_n: -one, level: press})
        for name, side in (("cone_above", one), ("cone_below", -one)):
            programme.at_most(prefix + name, zero, **{c_n: -cone, c_t: side, level: adhesion * self.friction})
        forces = dict(zip((c_n, c_t, d), np.split(self.wrench, [count, 2 * count], axis=1), strict=True))
        programme.equal(prefix + "balance", -self.load[:, 0], **forces, **{torque: self.load[:, 1:] * torque_unit})


def contact_statics(scene: Scene, formation: ContactFormation, z: Float[Array | np.ndarray, "5"]) -> Statics:
    """Assemble the balance of forces of an object at rest at `z` (SI), in a formation of any number of contacts."""
    mechanics, normal, slip = jax.device_get(_contact_rows(scene, formation, z))
    rows, joints = list(formation.normal_rows), np.eye(5)[:, 3:]
    force, radius = float(mechanics.force_unit), float(mechanics.length)
    weight = np.append(mechanics.inertia[0] * mechanics.gravity * force, np.zeros(3))
    unit = float(np.abs(weight).max() + mechanics.torque_limit.max() / radius)
    return Statics(
        names=formation.names,
        wrench=np.hstack([normal[rows].T, slip[rows].T, joints]),
        load=np.column_stack([weight, joints / radius]) / unit,
        friction=np.asarray(mechanics.contacts.friction)[rows],
        dry=np.asarray(mechanics.dry) * force / unit,
        torque_limit=np.asarray(mechanics.torque_limit),
        unit=unit,
        mass=np.asarray(mechanics.inertia) * force / unit,
    )


def without_joint(statics: Statics, finger: int) -> Statics:
    """Return the balance without that of finger 1's or 2's joint, which moves."""
    wrench, load = statics.wrench.copy(), statics.load.copy()
    wrench[2 + finger], load[2 + finger] = 0.0, 0.0
    return replace(statics, wrench=wrench, load=load)


@CachedJit
def _contact_rows(scene: Scene, formation: ContactFormation, z):
    mechanics = scaled_mechanics(rigid_body(scene.object), scene.hand, scene.gravity, formation)
    here = z / mechanics.configuration_unit
    return mechanics, normal_jacobian(mechanics.contacts, here), tangential_jacobian(mechanics.contacts, here)
