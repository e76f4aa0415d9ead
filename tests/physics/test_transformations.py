"""Public functions under JAX's transformations, with the scene or the torque closed over, as arguments, partly traced.

Every combination is recorded as a program, which is where a function that needs numbers fails; a few are compiled and
compared with the plain function, one of each kind. One phase, a coarse integrator: programs stay small.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import layered

import wholearm_jax as wa
from wholearm_jax.core import staging
from wholearm_jax.files import to_dict
from wholearm_jax.phases import trace
from wholearm_jax.phases.gradients import torque_gradient
from wholearm_jax.phases.plan_tracing import COARSE_TABLES
from wholearm_jax.simulation import Adjoint
from wholearm_jax.tracing import Resolution

OPTIONS = wa.IntegratorOptions(tolerance=1e-7, max_steps=32, max_stages=4, adjoint=Adjoint.BOTH)
FORWARD = wa.IntegratorOptions(tolerance=1e-7, max_steps=32, max_stages=4, adjoint=Adjoint.FORWARD)
PLAIN = wa.IntegratorOptions(tolerance=1e-7, max_steps=32, max_stages=4)
SIZES = Resolution(segments=3, panels=16, nodes=8)
COARSE = Resolution(segments=3, panels=4, nodes=8)
KNOTS = 4


@pytest.fixture(scope="module")
def scene():
    data = to_dict(layered("heptagon"))
    data["phase"] = data["phase"][:1]
    return wa.parse(data)


@pytest.fixture(scope="module")
def torque(scene):
    return wa.quasistatic(scene, knots=KNOTS)


def with_friction(scene, friction):
    return eqx.tree_at(lambda s: s.object.friction, scene, friction)


def with_mass(scene, mass):
    return eqx.tree_at(lambda s: s.object.mass, scene, mass)


def margin_of_torque(scene, torque):
    """Return the margin as a function of torques, with the scene and the times closed over, and torques."""

    def value(values, options=OPTIONS):
        return wa.margin(scene, wa.torque_schedule(torque.times, values), options=options, resolution=SIZES)

    return value, torque.values


def margin_of_friction(scene, torque):
    """Return the margin as a function of friction, with a scene that is partly traced and the torque closed over."""

    def value(friction, options=OPTIONS):
        return wa.margin(with_friction(scene, friction), torque, options=options, resolution=SIZES)

    return value, scene.object.friction


def bound_of_mass(scene, torque):
    return lambda mass, options=None: wa.bounds(with_mass(scene, mass))[0].value, scene.object.mass


def quasistatic_of_mass(scene, torque):
    return lambda mass, options=None: wa.quasistatic(
        with_mass(scene, mass), knots=KNOTS
    ).values.sum(), scene.object.mass


def length_of_friction(scene, torque):
    def value(friction, options=None):
        return trace(with_friction(scene, friction), resolution=SIZES)[0].dynamics.friction_ratio.sum()

    return value, scene.object.friction


def gradient_of_torque(scene, torque):
    def value(values, options=None):
        return torque_gradient(scene, wa.torque_schedule(torque.times, values))[1].sum()

    return value, torque.values


def scanned(function):
    """Return a function whose value is a sum over a scan, the body of which is recorded once."""

    def value(x):
        return jax.lax.scan(lambda total, scale: (total + function(scale * x), None), 0.0, jnp.ones(2))[0] / 2

    return value


VALUES = {
    "jit": jax.jit,
    "vmap": lambda f: lambda x: jax.vmap(f)(jnp.stack([x, x]))[1],
    "scan": scanned,
    "checkpoint": jax.checkpoint,
}
GRADIENTS = {
    "value_and_grad": lambda f: lambda x: jax.value_and_grad(f)(x)[1],
    "grad of checkpoint": lambda f: jax.grad(jax.checkpoint(f)),
    "grad of scan": lambda f: jax.grad(scanned(f)),
    "vmap of grad": lambda f: lambda x: jax.vmap(jax.grad(f))(jnp.stack([x, x]))[0],
    "jacfwd": lambda f: jax.jacfwd(lambda x: f(x, FORWARD)),
}
FUNCTIONS = [margin_of_torque, margin_of_friction, bound_of_mass, quasistatic_of_mass, length_of_friction]
LONG = (margin_of_torque, margin_of_friction, gradient_of_torque)
QUICK = ("value_and_grad", "grad of scan")  # of the gradients of whole margins, which take long to record


def gradient_cases():
    """Every function with every transformation; what takes longest and differs least from others is slow."""
    for function in FUNCTIONS:
        for name, transform in GRADIENTS.items():
            quick = QUICK if function is margin_of_friction else QUICK[:1]
            is_slow = function in LONG and name not in quick
            marks = pytest.mark.slow if is_slow else ()
            yield pytest.param(function, transform, id=f"{function.__name__}-{name}", marks=marks)


def value_cases():
    """Every function with every transformation; of what takes long to record, those that differ least are slow."""
    for function in (*FUNCTIONS, gradient_of_torque):
        for name, transform in VALUES.items():
            quick = ("scan",) if function is gradient_of_torque else ("vmap", "scan")
            is_slow = function in LONG and name not in quick
            marks = pytest.mark.slow if is_slow else ()
            yield pytest.param(function, transform, id=f"{function.__name__}-{name}", marks=marks)


@pytest.mark.parametrize(("function", "transform"), [*value_cases()])
def test_values_can_be_recorded(function, transform, scene, torque):
    value, argument = function(scene, torque)
    assert jax.eval_shape(transform(value), argument).shape == ()


@pytest.mark.parametrize(("function", "transform"), [*gradient_cases()])
def test_gradients_can_be_recorded(function, transform, scene, torque):
    value, argument = function(scene, torque)
    assert jax.eval_shape(transform(value), argument).shape == argument.shape


def test_the_margin_with_all_of_it_as_arguments_can_be_recorded(scene, torque):
    """Also the integers of the formation are being transformed then."""
    assert jax.eval_shape(lambda s, t: wa.margin(s, t, options=OPTIONS, resolution=SIZES), scene, torque).shape == ()
    pair = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (scene, torque))
    both = jax.eval_shape(jax.vmap(lambda s, t: wa.margin(s, t, options=OPTIONS, resolution=SIZES)), *pair)
    assert both.shape == (2,)
    assert jax.eval_shape(wa.bounds, scene)[0].value.shape == ()


def test_the_case_of_a_jitted_loss(scene, torque):
    """As a user writes it."""
    loss = jax.jit(lambda values: -wa.margin(scene, wa.TorqueSchedule(torque.times, values), options=PLAIN))
    assert float(loss(torque.values)) == pytest.approx(-float(wa.margin(scene, torque, options=PLAIN)), rel=1e-9)


def test_the_margin_with_all_of_it_closed_over(scene, torque):
    """A table that needs more panels gets them: its numbers are known."""
    inner = jax.jit(lambda x: x * wa.margin(scene, torque, options=PLAIN, resolution=COARSE))
    plain = float(wa.margin(scene, torque, options=PLAIN))
    assert float(inner(2.0)) == pytest.approx(2 * plain, rel=1e-7)


def test_tables_under_grad_get_the_panels_that_they_need(scene):
    def ratio(friction):
        dynamics = trace(with_friction(scene, friction), resolution=COARSE)[0].dynamics
        return dynamics.friction_ratio.sum(), dynamics

    (_, dynamics), _ = jax.value_and_grad(ratio, has_aux=True)(scene.object.friction)
    assert dynamics.configuration.shape[0] > COARSE.panels
    assert float(dynamics.error) <= 1e-9


@pytest.mark.parametrize("transform", [jax.jit, lambda f: lambda x: jax.vmap(f)(x[None])], ids=["jit", "vmap"])
def test_tables_that_cannot_get_more_panels_are_a_clear_error(transform, scene, torque):
    def value(friction):
        return wa.margin(with_friction(scene, friction), torque, options=PLAIN, resolution=COARSE)

    with pytest.raises(Exception, match=COARSE_TABLES[:60]):
        jax.block_until_ready(transform(value)(scene.object.friction))


def test_bounds_keep_value_and_gradient(scene):
    value, mass = float(wa.bounds(scene)[0].value), scene.object.mass

    def bound(mass):
        return wa.bounds(with_mass(scene, mass))[0].value

    assert float(jax.jit(bound)(mass)) == pytest.approx(value, rel=1e-9)
    slope = (float(bound(mass * 1.001)) - float(bound(mass * 0.999))) / (0.002 * float(mass))
    assert float(jax.jit(jax.grad(bound))(mass)) == pytest.approx(slope, rel=1e-3)


def test_quasistatic_torques_keep_their_values(scene, torque):
    inside = jax.jit(lambda x: x * wa.quasistatic(scene, knots=KNOTS).values)(1.0)
    np.testing.assert_array_equal(inside, torque.values)
    traced = jax.jit(lambda mass: wa.quasistatic(with_mass(scene, mass), knots=KNOTS))(scene.object.mass)
    np.testing.assert_allclose(traced.values, torque.values, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(traced.times, torque.times, rtol=1e-12)


# --- functions that decide on the host --------------------------------------------------------------------------------

HOST = {
    "simulate": lambda s, t: wa.simulate(s, t),
    "optimise": lambda s, t: wa.optimise(s, knots=4),
    "search_by_steps": lambda s, t: wa.search_by_steps(s),
    "check": lambda s, t: wa.check([s], t),
}


@pytest.mark.parametrize(("name", "function"), HOST.items())
def test_functions_of_the_host_say_that_they_cannot_be_transformed(name, function, scene, torque):
    with pytest.raises(TypeError, match=f"{name} decides on the host and cannot be transformed"):
        jax.jit(lambda s, t: function(s, t) and None)(scene, torque)
    with pytest.raises(TypeError, match=f"{name} decides on the host and cannot be transformed"):
        jax.grad(lambda mass: function(with_mass(scene, mass), torque) and 0.0)(scene.object.mass)


@pytest.mark.parametrize("function", [wa.bounds, wa.quasistatic])
def test_a_phase_that_holds_cannot_be_transformed(function, scene):
    data = to_dict(scene)
    data["phase"].append({"name": "pause", "contacts": data["phase"][0]["contacts"], "hold": True, "duration": 0.5})
    with pytest.raises(TypeError, match=r"cannot be transformed .* with phase 'pause'"):
        jax.eval_shape(lambda mass: function(with_mass(wa.parse(data), mass)), scene.object.mass)


def test_functions_of_the_host_work_on_numbers_within_jit(scene, torque):
    def inner(x):
        result = wa.simulate(scene, torque)
        return x * result.phases[0].duration * len(wa.trajectory(result, 3)[0].time)

    assert float(jax.jit(inner)(1.0)) == 3.0


def test_what_is_recorded_is_told_from_what_is_computed():
    states = []
    jax.grad(lambda x: states.append(staging.is_staged()) or x)(1.0)
    jax.jit(lambda x: states.append(staging.is_staged()) or x)(1.0)
    jax.vmap(lambda x: states.append(staging.is_staged()) or x)(jnp.ones(2))
    assert states == [False, True, False]
