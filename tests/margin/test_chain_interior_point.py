"""The convex programme of a path against general solvers, its derivatives against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference.conic import ConicProgramme
from support import layered

import wholearm_jax as wa
from wholearm_jax.margin import chain_interior_point, path_programme
from wholearm_jax.margin.chain_constraints import duration, inequalities
from wholearm_jax.margin.path_programme import SpeedRange, rest_to_rest
from wholearm_jax.phases import configuration

INTERVALS = 80
discretise = jax.jit(path_programme.discretise, static_argnames="intervals")
SCENES = [("heptagon", 0), ("heptagon", 1), ("hexagon", 0), ("hexagon", 1)]
ANY, REST = jnp.asarray(jnp.nan), jnp.asarray(0.0)


@jax.jit
def solve(programme, margin=ANY):
    """Solve for the largest margin, or for the shortest time with one."""
    return chain_interior_point.solve_chain(programme, margin)


@pytest.fixture(scope="module")
def paths():
    """Tables of the bundled phases."""
    scenes = {name: layered(name) for name in ("heptagon", "hexagon")}
    traced = {name: wa.trace(scene) for name, scene in scenes.items()}
    return {(name, k): at.dynamics for name, phases in traced.items() for k, at in enumerate(phases)}


def programme(dynamics, seconds=jnp.inf, speeds=None, limits=None):
    """A path's programme, for other torque limits if given."""
    if limits is not None:
        dynamics = eqx.tree_at(lambda d: d.torque_limit, dynamics, jnp.asarray(limits))
    return discretise(dynamics, jnp.asarray(seconds), speeds or rest_to_rest(), intervals=INTERVALS)


@pytest.mark.parametrize("limits", [(1.0, 1.0), (0.45, 0.5)], ids=["wide limits", "narrow limits"])
@pytest.mark.parametrize("key", SCENES)
def test_the_largest_margin_is_that_of_a_linear_programme(paths, key, limits):
    p = programme(paths[key], limits=limits)
    found = solve(p)
    assert bool(found.converged)
    reference = ConicProgramme(p, found.unknowns.b).largest_margin_at_any_time()
    assert float(found.unknowns.m) == pytest.approx(reference, abs=1e-8)


@pytest.mark.parametrize(("start", "end"), [(ANY, ANY), (REST, ANY), (jnp.asarray(2.0), REST)])
def test_speeds_at_the_ends_are_as_given(paths, start, end):
    p = programme(paths["heptagon", 0], 0.2, SpeedRange(start, end, jnp.full(2, 8.0)))
    found = solve(p)
    assert bool(found.converged)
    v = np.sqrt(np.asarray(found.unknowns.b)) * np.asarray(p.speed_unit[:1])
    for given, reached in zip((start, end), (v[0], v[-1]), strict=True):
        assert bool(jnp.isnan(given)) or reached == pytest.approx(float(given), abs=1e-9)
    pytest.importorskip("clarabel")
    reference = ConicProgramme(p, found.unknowns.b).solve_with_time()
    assert float(found.unknowns.m) == pytest.approx(reference, abs=1e-6)


@pytest.mark.parametrize("seconds", [0.3, 0.15])
@pytest.mark.parametrize("key", SCENES)
def test_margin_in_limited_time_and_time_with_a_margin_are_a_conic_solvers(paths, key, seconds):
    pytest.importorskip("clarabel")
    p = programme(paths[key], seconds)
    found = solve(p)
    reference = ConicProgramme(p, found.unknowns.b).solve_with_time()
    assert bool(found.converged)
    assert float(found.unknowns.m) == pytest.approx(reference, abs=1e-6)
    target = 0.9 * found.unknowns.m
    fastest = solve(p, target)
    reference = ConicProgramme(p, fastest.unknowns.b).solve_with_time(float(target))
    assert bool(fastest.converged)
    assert float(fastest.duration) == pytest.approx(reference, rel=1e-6)


def test_solutions_are_feasible_and_margin_and_time_are_one_curve(paths):
    p = programme(paths["heptagon", 0], 0.15)
    found = solve(p)
    value = inequalities(p, found.unknowns)
    assert min(float(each.min()) for each in value) >= -1e-8
    assert float(duration(p, found.unknowns.b)) == pytest.approx(float(p.duration), rel=1e-8)
    fastest = solve(p, found.unknowns.m)
    assert float(fastest.duration) == pytest.approx(float(p.duration), rel=1e-7)


def test_what_no_torque_can_do_does_not_converge(paths):
    found = solve(programme(paths["hexagon", 1], 0.05))
    assert not bool(found.converged)


@pytest.mark.parametrize("distance", [1e-9, 1e-7, 1e-5])
def test_a_start_next_to_a_reversal_has_the_margin_of_a_start_at_it(distance):
    """The first segment is shorter than any interval should be: one of mere rounding is not divided."""
    scene = wa.load("heptagon")
    dynamics = wa.trace(scene)[0].dynamics

    def best(s):
        z = configuration(dynamics, jnp.asarray(0), s)
        (path,) = wa.trace(eqx.tree_at(lambda of: (of.start, of.phases), scene, (z, scene.phases[:1])))
        p = programme(path.dynamics)
        found = solve(p)
        assert bool(found.converged)
        return int(path.dynamics.count), float(found.unknowns.m * p.force_unit)

    kink = dynamics.breakpoints[1]
    (count, margin), (whole, beyond) = best(kink - distance), best(kink + 1e-9)
    assert (count, whole) == (2, 1)
    assert margin == pytest.approx(beyond, rel=1e-6 + 2 * distance)


def test_margins_converge_with_the_square_of_the_interval(paths):
    """Richardson's rule: the error falls to a quarter, or both are tiny."""
    margins = []
    for intervals in (50, 100, 200, 400):
        p = discretise(paths["hexagon", 0], jnp.asarray(0.15), rest_to_rest(), intervals=intervals)
        margins.append(float(solve(p).unknowns.m * p.force_unit))
    steps = np.abs(np.diff(margins))
    assert steps[-1] < 2e-4 * margins[-1]
    assert steps[-1] < steps[0]


@pytest.mark.parametrize("fast", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["margin", "time"])
def test_derivatives_are_those_of_differences(paths, fast):
    """With respect to every coefficient of the table along a random direction, and to torque limits and time."""
    dynamics = paths["heptagon", 1]
    rng = np.random.default_rng(3)
    force, limit = jnp.asarray(rng.normal(size=dynamics.force.shape)), jnp.asarray([0.3, -0.2])

    @jax.jit
    def optimum(x):
        changed = eqx.tree_at(
            lambda d: (d.force, d.torque_limit, d.acceleration),
            dynamics,
            (
                dynamics.force * (1 + x * force),
                dynamics.torque_limit + x * limit,
                dynamics.acceleration * (1 + x * force[:, :, 0]),
            ),
        )
        p = path_programme.discretise(changed, 0.15 * (1 + x), rest_to_rest(), intervals=40)
        margin = (0.5 + x) / p.force_unit if fast else jnp.nan
        value = chain_interior_point.lagrangian(p, chain_interior_point.solve_chain(p, margin), margin)
        return value * (p.time_unit if fast else p.force_unit)

    step = 1e-5
    difference = (float(optimum(step)) - float(optimum(-step))) / (2 * step)
    assert float(jax.grad(optimum)(0.0)) == pytest.approx(difference, rel=1e-5)
    assert float(jax.jvp(optimum, (0.0,), (1.0,))[1]) == pytest.approx(difference, rel=1e-5)


def test_many_at_once_are_each_alone(paths):
    p = [programme(paths[key], 0.2) for key in SCENES]
    together = jax.jit(jax.vmap(solve))(jax.tree.map(lambda *each: jnp.stack(each), *p))
    for k, one in enumerate(p):
        assert float(together.unknowns.m[k]) == pytest.approx(float(solve(one).unknowns.m), abs=1e-9)


def test_few_iterations_are_needed_whatever_the_time_allowed(paths):
    """A barrier that waited for each step's residual to vanish would take a third more."""
    taken = [int(solve(programme(paths[key], seconds)).iterations) for key in SCENES for seconds in (1.0, 0.3, 0.15)]
    assert np.mean(taken) < 20
    assert max(taken) < 30
