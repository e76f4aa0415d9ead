"""Sources of scenes for a check: scenes stacked along a leading axis, and the interface shared with ensembles."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Int

from wholearm_jax.core import array_module, as_device_array, stack_trees
from wholearm_jax.model import Scene


@runtime_checkable
class SceneSource(Protocol):
    """Numbered scenes to check: an `Ensemble`, or a `SceneBatch`."""

    @property
    def nominal(self) -> Scene:
        """Scene, or stacked scenes, with the phases, names and arrivals that all scenes have in common."""
        ...

    @property
    def has_common_paths(self) -> bool:
        """Whether all scenes have the same contact paths."""
        ...

    def draw(self, number: int | Int[Array, ""]) -> Scene:
        """Return scene number `number`."""
        ...


class SceneBatch(eqx.Module):
    """Scenes stacked along a leading axis (`stack_scenes`)."""

    scenes: Scene

    @property
    def nominal(self) -> Scene:
        """The stacked scenes."""
        return self.scenes

    @property
    def has_common_paths(self) -> bool:
        """False: unknown, so every scene is traced."""
        return False

    @property
    def count(self) -> int:
        """Number of scenes."""
        return self.scenes.object.mass.shape[0]

    def draw(self, number: int | Int[Array, ""]) -> Scene:
        """Return scene number `number`."""
        return jax.tree.map(lambda leaf: leaf[number, ...], self.scenes)

    def select(self, numbers: np.ndarray) -> "SceneBatch":
        """Return the batch of some of the scenes, renumbered from 0."""
        # Chosen in NumPy: no program for each shape.
        return SceneBatch(jax.tree.map(lambda leaf: as_device_array(np.asarray(leaf)[numbers]), self.scenes))


def stack_scenes(scenes: Sequence[Scene]) -> Scene:
    """Stack scenes along a leading axis of every array; polygons are padded to the largest.

    Names and titles are the first scene's. Raises ValueError for no scenes, and for scenes that differ in their number
    of phases, in how a phase arrives or regrasps, or in whether inertia and centre of mass are given.
    """
    if not scenes:
        raise ValueError("there are no scenes to stack")
    capacity = max(s.object.vertices.shape[0] for s in scenes)
    alike = [_with_names_of(_pad_polygon(s, capacity), scenes[0]) for s in scenes]
    if len({jax.tree.structure(s) for s in alike}) > 1:
        raise ValueError("stacked scenes need the same phases (number, arrival) and the same optional entries")
    return stack_trees(alike)


def _pad_polygon(scene: Scene, capacity: int) -> Scene:
    """Pad the polygon to `capacity` rows by repeating its last vertex."""
    xp = array_module(scene.object)
    vertices = xp.asarray(scene.object.vertices)
    padding = xp.broadcast_to(vertices[-1], (capacity - vertices.shape[0], 2))
    return eqx.tree_at(lambda s: s.object.vertices, scene, xp.concatenate([vertices, padding]))


def _with_names_of(scene: Scene, other: Scene) -> Scene:
    """Return the scene with the title and phase names of another; they do not affect what is computed."""
    if len(scene.phases) != len(other.phases):
        return scene
    pairs = zip(scene.phases, other.phases, strict=True)
    return replace(scene, title=other.title, phases=tuple(replace(p, name=q.name) for p, q in pairs))
