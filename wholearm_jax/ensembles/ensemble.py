"""Random ensembles of scenes.

Every draw is uniform within plus or minus a spread. Scene `i` is drawn from keys derived from the seed, the quantity
and `i` alone, so results depend neither on chunking nor on which other quantities vary.
"""

import zlib

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from wholearm_jax.ensembles.quantities import GEOMETRY, QUANTITIES, Spread, parameter_names, parse_spread
from wholearm_jax.model import Scene


class Ensemble(eqx.Module):
    """Endless sequence of random scenes like `scene`.

    `spreads` are pairs (quantity, half width of its draw); `seed` chooses the sequence.
    """

    scene: Scene
    spreads: tuple[tuple[str, Spread], ...] = eqx.field(static=True)
    seed: int = eqx.field(static=True, default=0)

    @property
    def nominal(self) -> Scene:
        """Scene about which the others are drawn."""
        return self.scene

    @property
    def has_common_paths(self) -> bool:
        """Whether all scenes have the same contact paths, because no geometry varies."""
        return GEOMETRY.isdisjoint(name for name, _ in self.spreads)

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the numbers that vary, in the order of `draw_offsets`; padding rows of vertices are among them."""
        return tuple(name for quantity, _ in self.spreads for name in parameter_names(self.scene, quantity))

    def draw(self, number: int | Int[Array, ""]) -> Scene:
        """Draw scene number `number`."""
        return self.apply_offsets(self.draw_offsets(number))

    def draw_offsets(self, number: int | Int[Array, ""]) -> Float[Array, "parameters"]:
        """Draw the offsets of scene `number`: one number in [-1, 1] per parameter, in units of its spread."""
        drawn = [jnp.zeros(0)]
        for quantity, _ in self.spreads:
            key = jax.random.fold_in(jax.random.key(self.seed), zlib.crc32(quantity.encode()))
            size = QUANTITIES[quantity].where(self.scene).size
            part = jax.random.uniform(jax.random.fold_in(key, number), (size,), float, -1.0, 1.0)
            if quantity == "vertices":
                part = jnp.where(jnp.arange(size) // 2 < self.scene.object.count, part, 0.0)
            drawn.append(part)
        return jnp.concatenate(drawn)

    def apply_offsets(self, offsets: Float[Array, "parameters"]) -> Scene:
        """Build the scene with the given offsets; an inertia that is given scales with the mass."""
        scene, first = self.scene, 0
        for quantity, spread in self.spreads:
            where = QUANTITIES[quantity].where
            value = where(scene)  # an inertia is already scaled by the mass
            part = spread.size * offsets[first : first + value.size].reshape(value.shape)
            first += value.size
            changed = value * (1 + part) if spread.relative else value + part
            if quantity == "vertices":  # padding rows repeat the last vertex
                count = self.scene.object.count
                changed = changed[jnp.minimum(jnp.arange(value.shape[0]), count - 1)]
            scene = eqx.tree_at(where, scene, changed)
            if quantity == "mass" and scene.object.inertia is not None:
                ratio = scene.object.mass / self.scene.object.mass
                scene = eqx.tree_at(lambda s: s.object.inertia, scene, scene.object.inertia * ratio)
        return scene


def make_ensemble(scene: Scene, amounts: dict[str, float | str], *, seed: int = 0) -> Ensemble:
    """Build an ensemble of scenes like `scene`.

    Args:
        scene: Nominal scene.
        amounts: Half width of the uniform draw of each quantity (keys of `quantities.QUANTITIES`): a number in the
            quantity's SI unit, or a percentage of its value such as `"20%"`.
        seed: Chooses the sequence of scenes.

    Raises:
        ValueError: For a quantity that the scene does not have, an amount that cannot be read, or one with which a
            drawn scene may be invalid (a mass that is not positive, a polygon that crosses itself).

    >>> from wholearm_jax.ensembles import make_ensemble
    >>> ensemble = make_ensemble(wa.load("heptagon"), {"vertices": 0.0005, "friction": "20%"}, seed=1)
    >>> len(ensemble.parameters)
    19
    """
    spreads = {name: parse_spread(scene, name, amount) for name, amount in amounts.items()}
    return Ensemble(scene, tuple((name, spreads[name]) for name in QUANTITIES if name in spreads), seed)
