"""Vary: ensembles of scenes, endless and the same however they are cut: scene number `i` is drawn from its own key.

Every draw is uniform within plus or minus an amount, of the value itself (`friction=20%`) or in its unit
(`vertices=0.0005`). The key of a quantity in scene `i` is the seed's, folded with the quantity and with `i`; it
depends neither on the chunk that `i` is computed in nor on what else varies.
"""

import math
import zlib
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.model import COORDINATES, LINKS, Scene, remains_simple
from wholearm_jax.phases import stack_trees

FINGERS = ("finger 1", "finger 2")


class Quantity(NamedTuple):
    """Where floats of a scene that may vary are, what their entries are called, and which values a scene allows."""

    where: Callable
    entries: tuple[str, ...] | None = None
    allowed: Literal["any", "positive", "not negative"] = "any"


QUANTITIES = {
    "vertices": Quantity(lambda s: s.object.vertices),
    "mass": Quantity(lambda s: s.object.mass, allowed="positive"),
    "friction": Quantity(lambda s: s.object.friction, LINKS, "not negative"),
    "inertia": Quantity(lambda s: s.object.inertia, allowed="positive"),
    "center_of_mass": Quantity(lambda s: s.object.center_of_mass, ("x", "y")),
    "joint": Quantity(lambda s: s.hand.joint, tuple(f"{f} {c}" for f in FINGERS for c in "xy")),
    "length": Quantity(lambda s: s.hand.length, FINGERS, "positive"),
    "offset": Quantity(lambda s: s.hand.offset, FINGERS),
    "finger_inertia": Quantity(lambda s: s.hand.inertia, FINGERS, "positive"),
    "viscous": Quantity(lambda s: s.hand.viscous, FINGERS, "not negative"),
    "dry": Quantity(lambda s: s.hand.dry, FINGERS, "not negative"),
    "gravity": Quantity(lambda s: s.gravity, ("x", "y")),
    "start": Quantity(lambda s: s.start, COORDINATES),
}


GEOMETRY = frozenset({"vertices", "center_of_mass", "joint", "length", "offset", "start"})
"""Those that wires depend on."""


class Spread(NamedTuple):
    """Half the width of a uniform draw: a share of the value where `relative`, otherwise in the value's unit."""

    size: float
    relative: bool


class Ensemble(eqx.Module):
    """Scenes like `scene` in which the quantities named in `amounts` vary; `seed` chooses which."""

    scene: Scene
    amounts: tuple[tuple[str, Spread], ...] = eqx.field(static=True)
    seed: int = eqx.field(static=True, default=0)

    @property
    def nominal(self) -> Scene:
        """The scene about which the others are drawn."""
        return self.scene

    @property
    def same_wires(self) -> bool:
        """Whether all scenes have the wires of one."""
        return GEOMETRY.isdisjoint(name for name, _ in self.amounts)

    @property
    def parameters(self) -> tuple[str, ...]:
        """The names of the numbers that vary, in the order of `draw_offsets`; rows of vertices that pad are among them."""
        return tuple(name for quantity, _ in self.amounts for name in _names(self.scene, quantity))

    def draw(self, number: Int[Array, ""]) -> Scene:
        """Scene number `number`."""
        return self.apply_offsets(self.draw_offsets(number))

    def draw_offsets(self, number: Int[Array, ""]) -> Float[Array, "parameters"]:
        """What is drawn for scene number `number`: one number in [-1, 1] a parameter, to be scaled by its amount."""
        drawn = [jnp.zeros(0)]
        for quantity, _ in self.amounts:
            key = jax.random.fold_in(jax.random.key(self.seed), zlib.crc32(quantity.encode()))
            size = QUANTITIES[quantity].where(self.scene).size
            part = jax.random.uniform(jax.random.fold_in(key, number), (size,), float, -1.0, 1.0)
            if quantity == "vertices":
                part = jnp.where(jnp.arange(size) // 2 < self.scene.object.count, part, 0.0)
            drawn.append(part)
        return jnp.concatenate(drawn)

    def apply_offsets(self, shifts: Float[Array, "parameters"]) -> Scene:
        """The scene that a draw stands for."""
        scene, at = self.scene, 0
        for quantity, amount in self.amounts:
            where = QUANTITIES[quantity].where
            value = where(scene)  # an inertia that the mass has scaled
            part, at = amount.size * shifts[at : at + value.size].reshape(value.shape), at + value.size
            changed = value * (1 + part) if amount.relative else value + part
            if quantity == "vertices":  # rows that pad repeat the last vertex
                count = self.scene.object.count
                changed = changed[jnp.minimum(jnp.arange(value.shape[0]), count - 1)]
            scene = eqx.tree_at(where, scene, changed)
            if quantity == "mass" and scene.object.inertia is not None:
                ratio = scene.object.mass / self.scene.object.mass
                scene = eqx.tree_at(lambda s: s.object.inertia, scene, scene.object.inertia * ratio)
        return scene


def make_ensemble(scene: Scene, amounts: dict[str, float | str], *, seed: int = 0) -> Ensemble:
    """Build an ensemble from amounts such as `{"vertices": 0.0005, "friction": "20%"}`.

    Raises ValueError for a quantity that the scene does not have, an amount that is not one, or one by which what is
    drawn may be no scene: a mass that is not positive, a polygon that crosses itself.
    """
    checked = {name: _amount(scene, name, given) for name, given in amounts.items()}
    return Ensemble(scene, tuple((name, checked[name]) for name in QUANTITIES if name in checked), seed)


def stack(scenes: Sequence[Scene]) -> Scene:
    """Scenes along a leading axis of every array; polygons are padded to the largest.

    Names and titles are the first scene's. Raises ValueError for no scenes, and for scenes that differ in their number
    of phases, in how a phase arrives, or in whether inertia and centre of mass are given.
    """
    if not scenes:
        raise ValueError("there are no scenes to stack")
    capacity = max(s.object.vertices.shape[0] for s in scenes)
    alike = [_renamed(_padded(s, capacity), scenes[0]) for s in scenes]
    if len({jax.tree.structure(s) for s in alike}) > 1:
        raise ValueError("stacked scenes need the same phases (number, arrival) and the same optional entries")
    return stack_trees(alike)


def _padded(scene: Scene, capacity: int) -> Scene:
    """A scene whose polygon has room for `capacity` vertices."""
    held = scene.object.vertices
    more = jnp.broadcast_to(held[-1], (capacity - held.shape[0], 2))
    return eqx.tree_at(lambda s: s.object.vertices, scene, jnp.concatenate([held, more]))


def _renamed(scene: Scene, like: Scene) -> Scene:
    """A scene with the title and the phases' names of another, which make no difference to what is computed."""
    if len(scene.phases) != len(like.phases):
        return scene
    pairs = zip(scene.phases, like.phases, strict=True)
    phases = tuple(type(p)(q.name, p.formation, p.target, p.duration, p.arrive) for p, q in pairs)
    return Scene(like.title, scene.gravity, scene.hand, scene.object, scene.start, phases)


def _names(scene: Scene, quantity: str) -> tuple[str, ...]:
    entries = QUANTITIES[quantity].entries
    if quantity == "vertices":
        entries = tuple(f"{k} {c}" for k in range(scene.object.vertices.shape[0]) for c in "xy")
    return (quantity,) if entries is None else tuple(f"{quantity} {entry}" for entry in entries)


def _amount(scene: Scene, name: str, given: float | str) -> Spread:
    if name not in QUANTITIES:
        raise ValueError(f"{name}: not a quantity that varies; these do: {', '.join(QUANTITIES)}")
    if QUANTITIES[name].where(scene) is None:
        raise ValueError(f"{name}: the scene does not give it")
    text = str(given)
    try:
        size = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        size = math.nan
    if not 0 <= size < math.inf:
        raise ValueError(f"{name}={text}: write an amount such as 0.0005, in SI units, or 20%")
    amount = Spread(size, text.endswith("%"))
    trouble = _trouble(scene, name, amount)
    if trouble is not None:
        raise ValueError(f"{name}={text}: too much, {trouble}")
    return amount


def _trouble(scene: Scene, name: str, amount: Spread) -> str | None:
    """What may be wrong with scenes that are drawn with an amount."""
    value, allowed = np.asarray(QUANTITIES[name].where(scene)), QUANTITIES[name].allowed
    width = amount.size * (np.abs(value) if amount.relative else np.ones_like(value))
    least = np.min(value - width)
    if allowed != "any" and (least < 0 or (allowed == "positive" and least == 0)):
        return "it could become negative" if allowed == "not negative" else "it could become negative or 0"
    if name == "joint" and value[0, 0] - width[0, 0] <= value[1, 0] + width[1, 0]:
        return "the fingers could change sides"
    if name == "vertices":
        count = int(scene.object.count)
        if not remains_simple(value[:count], np.hypot(*width[:count].T)):
            return "edges of the polygon could cross"
    return None
