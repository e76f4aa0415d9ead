"""What tests of several folders share: scenes of layered hands, a torque that passes a path's end, differences."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import wholearm_jax as wa
from benchmarks.layered_scenes import layered, layered_file
from wholearm_jax.dynamics import evaluate, locate_panel
from wholearm_jax.files import to_dict
from wholearm_jax.margin import best_quasistatic_torque_batch
from wholearm_jax.phases import has_torque_jumps, margin
from wholearm_jax.simulation import IntegratorOptions

__all__ = ["layered", "layered_file"]  # for the tests
DURATION = 1.0


@functools.cache
def optimised(name: str):
    """The best schedule of a bundled scene, found once a process."""
    return wa.optimise(wa.load(name))


def passing(dynamics, knots=9):
    """Torques that carry the object along a path and past its end: the best squeeze for a steady acceleration."""
    u = 1.1 * jnp.linspace(0.0, 1.0, knots)  # aimed to arrive early
    length, rate = dynamics.length, 1.1 / DURATION
    places = dynamics.breakpoints[0] + length * jnp.minimum(u, 1.0) ** 2
    held = best_quasistatic_torque_batch(dynamics, places, 2 * length * u * rate, jnp.full(knots, 2 * length * rate**2))
    return wa.torque_schedule(np.linspace(0.0, DURATION, knots), held.torque)


def richardson(function, largest):
    """Central differences at three step sizes, extrapolated twice."""
    steps = (largest, largest / 2, largest / 4)
    rows = [(function(h) - function(-h)) / (2 * h) for h in steps]
    once = [(4 * fine - coarse) / 3 for coarse, fine in itertools.pairwise(rows)]
    return (16 * once[1] - once[0]) / 15


# Step sizes: curvature spoils the large ones, rounding the small.
LADDER = (3.2e-3, 1.6e-3, 8e-4, 4e-4, 2e-4, 1e-4, 5e-5, 2.5e-5, 1.25e-5)


def steadiest_difference(function):
    """The derivative of `function(h)` at 0 by Richardson's differences, where two neighbours of the ladder agree best.

    The choice sees the differences alone, not the derivative that they are to judge.
    """
    ladder = [richardson(function, h) for h in LADDER]
    jumps = [abs(after - before) for before, after in itertools.pairwise(ladder)]
    return ladder[jumps.index(min(jumps)) + 1]


def assert_modes_and_differences_agree(scene, torque, seed=3):
    """Slopes of the margin along a random direction of every input but the schedule's times."""
    floats, rest = eqx.partition((scene, torque), eqx.is_inexact_array)
    steps = has_torque_jumps(scene, torque)

    def value(floats, adjoint):
        # A tolerance that is an array is data: whoever differentiates a plan like this one shares the programs.
        options = IntegratorOptions(adjoint=adjoint, tolerance=jnp.asarray(1e-12), has_jumps=steps)
        return margin(*eqx.combine(floats, rest), options=options)

    reverse = jax.grad(lambda floats: value(floats, "both"))(floats)
    assert all(bool(jnp.all(jnp.isfinite(g))) for g in jax.tree.leaves(reverse))
    rng = np.random.default_rng(seed)
    leaves, shape = jax.tree.flatten(floats)
    for which, leaf in enumerate(leaves):
        if leaf is torque.times:
            continue
        way = [np.zeros(leaf.shape) for leaf in leaves]
        way[which] = rng.normal(size=leaf.shape) * (np.abs(leaf).max() + 1e-3) * 0.1
        way = jax.tree.unflatten(shape, [jnp.asarray(w) for w in way])
        _, forward = jax.jvp(lambda floats: value(floats, "forward"), (floats,), (way,))
        pairs = zip(jax.tree.leaves(reverse), jax.tree.leaves(way), strict=True)
        # Both modes round: along the start, which moves the place where a slip reverses, they differ by up to 1.3e-10.
        assert forward == pytest.approx(sum(float((a * b).sum()) for a, b in pairs), rel=3e-10, abs=1e-12)

        def moved(h, way=way):
            return float(value(jax.tree.map(lambda start, step: start + h * step, floats, way), "none"))

        assert forward == pytest.approx(steadiest_difference(moved), rel=1e-7, abs=1e-9)


def ending_at_its_kink(beyond):
    """The heptagon's flip alone, until `phi` is just beyond the place where a slip reverses, and that flip whole."""
    data = to_dict(layered("heptagon"))
    slide, flip = wa.trace(layered("heptagon"))
    panel, xi = locate_panel(flip.dynamics, jnp.asarray(0), flip.dynamics.breakpoints[1])
    kink = evaluate(flip.dynamics.configuration, panel, xi)
    speed = evaluate(flip.dynamics.velocity, panel, xi)
    data["start"] = dict(zip(data["start"], slide.end.tolist(), strict=True))
    data["phase"] = [data["phase"][1] | {"until": {"phi": float(kink[2] + beyond * jnp.sign(speed[2]))}}]
    return wa.parse(data), flip
