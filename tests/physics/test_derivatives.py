"""Derivatives of the margin: forward mode, reverse mode and Richardson-extrapolated differences agree."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import assert_modes_and_differences_agree, ending_at_its_kink, layered

import wholearm_jax as wa
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.margin import minimum_margin
from wholearm_jax.model.schedule import TorqueSchedule, restrict_to_phase
from wholearm_jax.phases.compressive_margin import margin
from wholearm_jax.phases.gradients import torque_gradient
from wholearm_jax.simulation import Adjoint, IntegratorOptions, simulate_motion


def one_phase(name, row, push, change=lambda data: None, duration=0.6):
    """A scene with one phase of a bundled plan, starting where that phase starts, and torques that carry it out."""
    scene = layered(name)
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
    return scene, TorqueSchedule(
        jnp.asarray(times[doubled]), jnp.asarray(values[np.where(late, held[doubled], doubled)])
    )


CASES = {
    "time runs out": ("heptagon", 0, 0.99),
    "past the slip reversal": ("heptagon", 1, 1.01),
    "frictionless": ("hexagon", 0, 1.01, lambda data: data["object"].update(friction=0.0)),
    "undamped": (
        "hexagon",
        0,
        1.0,
        lambda data: [data["hand"][f].update(viscous=0.0, dry=0.0) for f in ("finger1", "finger2")],
    ),
}


SLOW_CASES = ("undamped", "torques that step")


@pytest.fixture(
    scope="module",
    params=[
        name if name not in SLOW_CASES else pytest.param(name, marks=pytest.mark.slow)
        for name in (*CASES, "torques that step")
    ],
)
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
def test_a_margin_where_a_path_ends_beside_a_kink_has_its_derivative(beyond):
    """Forces at the path's end do not depend on how long the phase might have gone on, however near to it a slip
    reverses: there is no piece in which forces, and the place of the least, would vary by rounding alone."""
    scene, _ = ending_at_its_kink(beyond)
    torques = wa.torque_schedule([0.0, 1.0], [[1.5, -0.9], [-1.2, 0.0]])
    options = IntegratorOptions(adjoint=Adjoint.FORWARD, tolerance=1e-10)
    (traced,) = wa.trace(scene)

    @jax.jit
    def ends(duration):
        phase_schedule = restrict_to_phase(torques, jnp.asarray(0.0), duration)
        motion = simulate_motion(traced.dynamics, phase_schedule, duration, options=options, speed=7.6)
        found = minimum_margin(traced.dynamics, phase_schedule, duration, motion, options)
        return found.margin, (found.phase_time - motion.phase_time[motion.count], motion.status)

    _, change, (early, status) = jax.jvp(ends, (jnp.asarray(1.5),), (jnp.asarray(1.0),), has_aux=True)
    assert int(status) == wa.Status.LEFT_FORMATION
    assert abs(float(early)) < 1e-12, "the margin is not at the end: it is no test"
    assert abs(float(change)) < 1e-7
