"""Derivatives of the margin: forward mode, reverse mode and Richardson-extrapolated differences agree."""

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_trace import ending_at_its_kink

import wholearm_jax as wa
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.margin.contact_forces import minimum_margin
from wholearm_jax.model.schedule import TorqueSchedule, restrict_to_phase
from wholearm_jax.phases.gradients import torque_gradient
from wholearm_jax.phases.plan import margin, has_torque_jumps
from wholearm_jax.simulation.integrator import IntegratorOptions
from wholearm_jax.simulation.phase_motion import simulate_motion


def richardson(function, largest):
    """Central differences at three step sizes, extrapolated twice."""
    steps = (largest, largest / 2, largest / 4)
    rows = [(function(h) - function(-h)) / (2 * h) for h in steps]
    once = [(4 * fine - coarse) / 3 for coarse, fine in pairwise(rows)]
    return (16 * once[1] - once[0]) / 15


def nearest_difference(function, value):
    """Of a ladder of step sizes (rounding on one side, curvature on the other) the difference nearest to `value`."""
    return min((richardson(function, h) for h in (1.6e-3, 4e-4, 1e-4)), key=lambda d: abs(d - value))


def one_phase(name, row, push, change=lambda data: None, duration=0.6):
    """A scene with one phase of a bundled plan, starting where that phase starts, and torques that carry it out."""
    scene = wa.load(name)
    if row:
        end = wa.trace(scene)[0]
        start = end.end
        scene = eqx.tree_at(lambda s: (s.start, s.phases), scene, (start, scene.phases[row:]))
    data = to_dict(scene)
    data["phase"] = data["phase"][:1]
    data["phase"][0]["duration"] = duration
    change(data)
    scene = wa.parse(data)
    even = wa.quasistatic(scene)
    # The schedule goes on beyond the phase, so that its last row is no kink at the phase's end.
    return scene, TorqueSchedule(1.01 * even.times, push * even.values)


def stepping(scene, torque):
    """The same torques, held through each third interval: they step at its end."""
    rows = np.arange(len(torque.times))
    held = np.where(rows % 3 == 2, rows - 1, rows)
    times, values = np.asarray(torque.times), np.asarray(torque.values)
    doubled = np.sort(np.append(rows, rows[2:-1:3]))
    late = np.append(doubled[1:] == doubled[:-1], False)  # the first of two rows at one time
    return scene, TorqueSchedule(jnp.asarray(times[doubled]), jnp.asarray(values[np.where(late, held[doubled], doubled)]))


def assert_modes_and_differences_agree(scene, torque, seed=3):
    """Slopes of the margin along a random direction of every input but the schedule's times."""
    floats, rest = eqx.partition((scene, torque), eqx.is_inexact_array)
    steps = has_torque_jumps(scene, torque)

    def value(floats, adjoint):
        # A tolerance that is an array is data: whoever differentiates a plan like this one shares the programs.
        how = IntegratorOptions(adjoint=adjoint, tolerance=jnp.asarray(1e-12), steps=steps)
        return margin(*eqx.combine(floats, rest), how=how)

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

        assert forward == pytest.approx(nearest_difference(moved, forward), rel=1e-7, abs=1e-9)


CASES = {
    "time runs out": ("heptagon", 0, 0.99),
    "past the slip reversal": ("heptagon", 1, 1.01),
    "frictionless": ("hexagon", 0, 1.01, lambda data: data["object"].update(friction=0.0)),
    "undamped": ("hexagon", 0, 1.0, lambda data: [f.update(viscous=0.0, dry=0.0) for f in data["hand"].values()]),
}


@pytest.fixture(scope="module", params=[*CASES, "torques that step"])
def case(request):
    if request.param == "torques that step":
        return stepping(*one_phase(*CASES["time runs out"]))
    return one_phase(*CASES[request.param])


def test_the_margin_is_that_of_the_simulation_whatever_it_will_be_differentiated_by(case):
    scene, torque = case
    simulated = wa.simulate(scene, torque).margin
    assert float(margin(scene, torque)) == pytest.approx(simulated, rel=1e-9)
    assert float(torque_gradient(scene, torque)[0]) == pytest.approx(simulated, rel=1e-9)


def test_modes_and_differences_agree_along_random_directions(case):
    assert_modes_and_differences_agree(*case)


@pytest.mark.parametrize("beyond", [1e-14, 2e-14, 1e-12])
def test_a_margin_where_a_wire_ends_beside_a_kink_has_its_derivative(beyond):
    """Forces at the wire's end do not depend on how long the phase might have gone on, however near to it a slip
    reverses: there is no piece in which forces, and the place of the least, would vary by rounding alone."""
    scene, _ = ending_at_its_kink(beyond)
    torques = wa.torque([0.0, 1.0], [[1.5, -0.9], [-1.2, 0.0]])
    how = IntegratorOptions(adjoint="forward", tolerance=1e-10)
    (traced,) = wa.trace(scene)

    @jax.jit
    def ends(duration):
        seen = restrict_to_phase(torques, jnp.asarray(0.0), duration)
        motion = simulate_motion(traced.table, seen, duration, how=how, speed=7.6)
        found = minimum_margin(traced.table, seen, duration, motion, how)
        return found.margin, (found.share - motion.share[motion.count], motion.status)

    _, change, (early, status) = jax.jvp(ends, (jnp.asarray(1.5),), (jnp.asarray(1.0),), has_aux=True)
    assert int(status) == wa.Status.LEFT_FORMATION
    assert abs(float(early)) < 1e-12, "the margin is not at the end: it is no test"
    assert abs(float(change)) < 1e-7
