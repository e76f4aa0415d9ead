"""Numbers of a valid scene that may be meant otherwise: lengths in millimetres, gravity with a sign."""

from collections.abc import Iterator

import numpy as np

from wholearm_jax.files.scene_schema import SceneTables

LARGE_OBJECT = 20.0  # [m], and in lengths of a finger: an object of this size is noted


def doubtful_units(scene: SceneTables) -> Iterator[str]:
    """Yield a note for an object that is very large, and for gravity along +y that is given as a number."""
    width = float(np.max(np.ptp(np.asarray(scene.object.vertices), axis=0)))
    length = max(scene.hand.finger1.length, scene.hand.finger2.length)
    if width > LARGE_OBJECT * min(1.0, length):
        sizes = f"the object is {width:.3g} m wide, the fingers are {length:.3g} m long"
        yield f"object.vertices: {sizes}; lengths in a scene are metres"
    if isinstance(scene.gravity, float | int) and scene.gravity < 0:
        yield f"gravity: {scene.gravity:g} points up; a number is along -y, so 9.81 points down"
