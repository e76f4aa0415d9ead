"""Gradients of the margin of random scenes, in both modes."""

import numpy as np

from benchmarks.stability import checks
from benchmarks.stability.levels import batches, flag, to_device
from benchmarks.stability.programs import FLOATS, forward, reverse
from benchmarks.stability.scenes import Scenes
from tests.reference.mechanics import Model
from wholearm_jax.simulation import Adjoint, IntegratorOptions

DIFFERENTIATED = 32  # scenes whose gradients are computed at once


def check_gradients(found, scenes, stepped, precision):
    """Gradients of the margin wherever a plan succeeds at the first level: finite, and the same in both modes.

    The margin that comes with them, from steps that are taken again, must be that of the simulation.
    """
    level, limits = precision.levels[0], precision.limits
    good = (found["status"] == checks.OK) & found["moved"] & (found["level"] == 0) & (scenes.stepped == stepped)
    rows = np.flatnonzero(good)
    how = IntegratorOptions(
        max_steps=level.steps, max_stages=8, tolerance=level.tolerance, has_jumps=stepped, adjoint=Adjoint.BOTH
    )
    for batch, real in batches(len(rows), DIFFERENTIATED):
        some = to_device(Scenes(*scenes[rows[batch]]))
        floats = {name: getattr(some, name) for name in FLOATS} | {"torque": to_device(found["torque"][rows[batch]])}
        rng = np.random.default_rng(rows[batch][0])
        way = {name: a * rng.uniform(-1.0, 1.0, a.shape).astype(a.dtype) for name, a in floats.items()}
        margin, along = (np.asarray(a)[:real] for a in forward(how)(floats, way, some))
        here = rows[batch][:real]
        newtons = checks.Units.of(Model.of(scenes[here])).force
        scale = found["scale"][here] * newtons
        slopes = {name: np.asarray(a) for name, a in reverse(how)(floats, some).items()}
        terms = [(slopes[name] * way[name]).reshape(len(batch), -1)[:real] for name in floats]
        size = sum(np.abs(t).sum(1) for t in terms) + scale
        apart = np.abs(sum(t.sum(1) for t in terms) - along) / np.maximum(size, 1e-300)
        finite = np.all([np.isfinite(t).all(1) for t in terms], axis=0) & np.isfinite(along)
        found["gradient"][here] = apart
        flag(found, here, "gradient not finite", ~finite)
        flag(found, here, "modes of gradients differ", finite & (apart > limits.gradient))
        other = np.abs(margin - found["margin"][here] * newtons) > limits.motion * scale
        flag(found, here, "margin that comes with a gradient", other)
