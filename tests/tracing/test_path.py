"""Wires: where they start, how they end, what their tables hold."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import ending_at_its_kink, layered

import wholearm_jax as wa
from wholearm_jax.dynamics import evaluate, evaluate_dot, locate_panel
from wholearm_jax.files.scene_toml import to_dict
from wholearm_jax.model.kinematics import gaps, normal_jacobian, tangential_jacobian
from wholearm_jax.model.mechanics import scaled_mechanics
from wholearm_jax.model.scene import rigid_body
from wholearm_jax.phases.phase_ends import describe_end
from wholearm_jax.phases.phase_tracing import trace_phase
from wholearm_jax.tracing.path import Resolution
from wholearm_jax.tracing.segments import distribute_panels

ENDS = {
    "heptagon": ("finger2:v4 is made", "palm:v0 is made"),
    "hexagon": ("finger2:v4 is made", "palm:v1 is made"),
}


@pytest.fixture(scope="module", params=ENDS)
def traced(request):
    scene = layered(request.param)
    mechanics = [
        scaled_mechanics(rigid_body(scene.object), scene.hand, scene.gravity, p.formation) for p in scene.phases
    ]
    return request.param, scene, wa.trace(scene), mechanics


def test_starts_and_ends_touch(traced):
    name, scene, paths, mechanics = traced
    for phase, at, formation, end in zip(scene.phases, paths, mechanics, ENDS[name], strict=True):
        path = at.path
        assert float(jnp.abs(gaps(formation.contacts, path.start)).max()) <= 1e-13
        assert float(jnp.abs(gaps(formation.contacts, path.end)).max()) <= 1e-12
        assert describe_end(scene, phase, at) == end
        made = gaps(formation.candidates, path.end)[path.end_contact]
        assert abs(float(made)) <= 1e-10


def test_every_node_lies_on_the_path(traced):
    _, _, paths, mechanics = traced
    for at, formation in zip(paths, mechanics, strict=True):
        left = jax.vmap(jax.vmap(lambda z, f=formation: gaps(f.contacts, z)))(at.path.nodes)
        assert float(jnp.abs(left).max()) <= 1e-13


def test_the_table_holds_the_path_between_its_nodes(traced):
    _, _, paths, mechanics = traced
    for at, formation in zip(paths, mechanics, strict=True):
        dynamics = at.dynamics
        assert float(dynamics.error) < 1e-9
        for s in np.random.default_rng(1).uniform(0, float(dynamics.length), 50):
            segment = jnp.minimum((s >= dynamics.breakpoints[1:-1]).sum(), dynamics.count - 1)
            panel, xi = locate_panel(dynamics, segment, jnp.asarray(s))
            z = evaluate(dynamics.configuration, panel, xi) / formation.configuration_unit
            x = evaluate(dynamics.velocity, panel, xi) / formation.configuration_unit
            assert float(jnp.abs(gaps(formation.contacts, z)).max()) < 1e-10
            assert float(jnp.abs(normal_jacobian(formation.contacts, z) @ x).max()) < 1e-9


def test_slips_vanish_where_pieces_meet(traced):
    name, _, paths, mechanics = traced
    for at, formation in zip(paths, mechanics, strict=True):
        dynamics, path = at.dynamics, at.path
        for k in range(1, int(dynamics.count)):
            panel, xi = locate_panel(dynamics, jnp.asarray(k), dynamics.breakpoints[k])
            z = evaluate(dynamics.configuration, panel, xi) / formation.configuration_unit
            x = evaluate(dynamics.velocity, panel, xi) / formation.configuration_unit
            flipped = np.flatnonzero(np.asarray(path.slip_sign[k] != path.slip_sign[k - 1]))
            assert flipped.size > 0
            slip = np.asarray(tangential_jacobian(formation.contacts, z) @ x)
            assert np.abs(slip[flipped]).max() < 1e-10
    if name == "heptagon":
        assert int(paths[1].dynamics.count) == 2, "the heptagon's flip reverses a slip"


def changed(name, **phase):
    data = to_dict(layered(name))
    data["phase"] = [data["phase"][0] | phase]
    return wa.parse(data)


@pytest.mark.parametrize("beyond", [0.0, 2e-16, 1e-12, 1e-9])
def test_a_path_that_ends_at_a_kink_keeps_its_friction(beyond):
    """A piece that is too short to tell which way a contact slips has friction of the same size as the piece before."""
    scene, whole = ending_at_its_kink(beyond)
    dynamics = wa.trace(scene)[0].dynamics
    last = int(dynamics.count) - 1
    assert int(dynamics.status) == wa.Status.OK
    assert float(dynamics.length) == pytest.approx(float(whole.dynamics.breakpoints[1]), rel=1e-8)
    assert last == (beyond > 1e-10), "a kink at the end but for rounding cuts off no piece"
    np.testing.assert_array_equal(jnp.abs(dynamics.friction_ratio[last]), jnp.abs(whole.dynamics.friction_ratio[0]))


def test_until_ends_a_phase_early():
    at = wa.trace(changed("heptagon", until={"x": -0.01}))[0]
    assert int(at.dynamics.status) == wa.Status.OK
    assert float(at.end[0]) == pytest.approx(-0.01, abs=1e-12)


def test_the_other_way_along_the_path():
    ahead, back = wa.trace(changed("heptagon"))[0], wa.trace(changed("heptagon", toward="x+"))[0]
    panel, xi = locate_panel(ahead.dynamics, jnp.asarray(0), ahead.dynamics.breakpoints[0])
    start = float(evaluate(ahead.dynamics.configuration, panel, xi)[0])
    assert float(ahead.end[0]) < start - 0.01
    assert float(back.end[0]) > start + 0.001


def test_a_start_that_no_contact_can_reach_is_refused_by_status():
    scene = layered("heptagon")
    far = eqx.tree_at(lambda s: s.hand.joint, scene, jnp.array([[2.0, 0.0], [-2.0, 0.0]]))
    assert int(wa.trace(far)[0].dynamics.status) in (wa.Status.NO_CONVERGENCE, wa.Status.LEFT_FORMATION)


def test_statuses_name_what_happened():
    scene = changed("heptagon")
    even = wa.quasistatic(scene)

    def status(values, scene=scene):
        result = wa.simulate(scene, wa.torque_schedule(even.times, values))
        return result.phases[0].status, result.phases[0]

    assert status(0 * even.values)[0] is not wa.Status.OK
    assert status(-0.5 * jnp.abs(even.values))[0] in (wa.Status.REVERSED, wa.Status.CONTACT_LOST)
    late, phase = status(0.97 * even.values)
    assert late in (wa.Status.NOT_REACHED, wa.Status.STUCK)
    assert phase.time == pytest.approx(1.0) or late is wa.Status.STUCK
    early, phase = status(even.values * jnp.array([1.1, 1.0]))
    assert early in (wa.Status.LEFT_FORMATION, wa.Status.CONTACT_LOST)
    assert phase.time < 1.0
    assert "slide left" in phase.message
    assert early.label in phase.message


def test_a_path_passes_the_turning_point_of_theta1():
    data = to_dict(layered("heptagon"))
    contacts = ["palm:v0", "finger1:v3", "finger2:v5", "finger2:v6"]
    data["phase"] = [{"name": "turn", "contacts": contacts, "toward": "phi-", "duration": 1.0}]
    data["start"] = {"x": -0.0219, "y": 0.038, "phi": -1.0551, "theta1": 1.6714, "theta2": 1.133}
    at = wa.trace(wa.parse(data))[0]
    dynamics, path = at.dynamics, at.path
    assert int(dynamics.status) == wa.Status.OK
    np.testing.assert_array_equal(path.joint_sign[:2, 0], [-1.0, 1.0])
    panel, xi = locate_panel(dynamics, jnp.asarray(1), dynamics.breakpoints[1])
    assert abs(float(evaluate(dynamics.velocity, panel, xi)[3])) < 1e-10
    assert float(dynamics.breakpoints[1]) < float(dynamics.length) - 1e-3


@pytest.mark.parametrize(("toward", "contact", "x"), [("x-", "palm:v0", -0.02), ("x+", "palm:v1", 0.03)])
def test_a_vertex_leaves_the_palm_where_it_ends(toward, contact, x):
    """A block that is wider above slides between fingers whose joints lie below the palm's ends, 50 and 60 mm away."""
    finger = {"length": 0.12, "inertia": 2e-3, "torque_limit": 1.0}
    contacts = ["palm:v0", "palm:v1", "finger1:v2", "finger2:v3"]
    scene = wa.parse(
        {
            "title": "wider above",
            "gravity": 9.81,
            "hand": {"finger1": finger | {"joint": [0.06, -0.02]}, "finger2": finger | {"joint": [-0.05, -0.02]}},
            "object": {
                "vertices": [[-0.03, -0.03], [0.03, -0.03], [0.05, 0.03], [-0.05, 0.03]],
                "mass": 0.2,
                "friction": 0.1,
                "center_of_mass": [0.0, 0.0],
            },
            "start": {"x": 0.0, "y": 0.03, "phi": 0.0, "theta1": 1.7, "theta2": np.pi / 2},
            "phase": [{"name": "slide", "contacts": contacts, "toward": toward, "duration": 1.0}],
        }
    )
    (traced,) = wa.trace(scene)
    assert int(traced.dynamics.status) == wa.Status.OK
    assert describe_end(scene, scene.phases[0], traced) == f"{contact} leaves its feature"
    z = np.asarray(traced.end)
    np.testing.assert_allclose(z[:3], [x, 0.03, 0.0], atol=1e-12)


def test_combined_functions_have_the_derivatives_of_a_sum_of_products():
    """In every argument, in both modes, once and twice; the sum is written out here."""
    rng = np.random.default_rng(2)
    coefficients, terms, panel = rng.normal(size=(3, 8, 4, 5)), rng.normal(size=5), jnp.asarray(1)

    def plain(coefficients, xi, terms):
        return (coefficients[panel] * xi ** jnp.arange(8)[:, None, None]).sum(0) @ terms

    def ours(coefficients, xi, terms):
        return evaluate_dot(coefficients, panel, xi, terms)

    given = jnp.asarray(coefficients), jnp.asarray(0.3), jnp.asarray(terms)
    np.testing.assert_allclose(ours(*given), plain(*given), rtol=1e-13)
    for mode in (jax.jacfwd, jax.jacrev):
        for exact, found in zip(mode(plain, (0, 1, 2))(*given), mode(ours, (0, 1, 2))(*given), strict=True):
            np.testing.assert_allclose(found, exact, rtol=1e-12, atol=1e-14)
    twice = [jax.jacfwd(jax.jacrev(f, (1, 2)), (1, 2))(*given) for f in (plain, ours)]
    for exact, found in zip(*map(jax.tree.leaves, twice), strict=True):
        np.testing.assert_allclose(found, exact, rtol=1e-12, atol=1e-14)


def at_places(dynamics, shares):
    """All of a table's functions at shares of its path."""

    def one(s):
        segment = jnp.minimum((s >= dynamics.breakpoints[1:-1]).sum(), dynamics.count - 1)
        panel, xi = locate_panel(dynamics, segment, s)
        names = ("acceleration", "reverse_acceleration", "force", "configuration", "velocity")
        return [evaluate(getattr(dynamics, name), panel, xi) for name in names]

    return jax.vmap(one)(dynamics.breakpoints[0] + shares * dynamics.length)


@pytest.mark.parametrize("phase", [0, 1])
def test_a_table_knows_its_error(phase):
    """Against one with many panels, relative to each function's size; where it is told, it is not told for nothing."""
    scene, shares = layered("heptagon"), jnp.linspace(0.001, 0.999, 333)
    fine = at_places(traced_with(scene, phase, Resolution().panels), shares)
    told = []
    for panels in (8, 16):
        dynamics = traced_with(scene, phase, panels)
        errors = [
            float((jnp.abs(a - b).max(0) / jnp.maximum(jnp.abs(b).max(0), 1e-5 * jnp.abs(b).max())).max())
            for a, b in zip(at_places(dynamics, shares), fine, strict=True)
        ]
        told.append(float(dynamics.error))
        rounding = 2e-10  # of functions a hundred thousand times smaller than their companions
        assert max(errors) < max(told[-1], rounding)
        assert told[-1] < max(20 * max(errors), rounding)
    if phase == 1:  # the functions of the first are at rounding already
        assert told[0] > 100 * told[1]


def traced_with(scene, phase, panels):
    """One phase's table, not refined."""
    told, rough = scene.phases[phase], scene.start if phase == 0 else wa.trace(scene)[0].end
    resolution = Resolution(panels=panels)
    return trace_phase(
        rigid_body(scene.object), scene.hand, scene.gravity, told.formation, rough, told.target, resolution
    ).dynamics


@pytest.mark.parametrize(
    ("lengths", "panels"), [([2.0, 0.01], [3, 1]), ([0.01, 2.0], [1, 3]), ([0.01, 2.0, 0.01], [1, 2, 1]), ([1.0], [4])]
)
def test_panels_go_where_the_path_is_long(lengths, panels):
    """At least one to each piece that is used; what rounding leaves over goes to the longest."""
    segments, count = 4, len(lengths)
    breaks = jnp.pad(jnp.cumsum(jnp.asarray([0.0, *lengths])), (0, segments - count), mode="edge")
    first, shared, owner = distribute_panels(breaks, count, Resolution(segments, panels=4))
    assert shared[:count].tolist() == panels
    assert shared[count:].tolist() == [0] * (segments - count)
    assert first[:count].tolist() == np.cumsum([0, *panels])[:-1].tolist()
    assert owner.tolist() == np.repeat(np.arange(count), panels).tolist()


def test_tables_are_refined_until_they_are_good_enough_or_refused():
    """A path on which friction nearly wedges the object has functions that 512 panels do not serve."""
    scene, few = layered("heptagon"), Resolution(panels=8)
    panels = {}
    for tolerance in (1e-4, 1e-9):
        phase_dynamics = [one.dynamics for one in wa.trace(scene, resolution=few, tolerance=tolerance)]
        assert all(float(dynamics.error) <= tolerance for dynamics in phase_dynamics)
        panels[tolerance] = [dynamics.acceleration.shape[0] for dynamics in phase_dynamics]
    assert max(panels[1e-4]) < max(panels[1e-9]) < 512
    rough = eqx.tree_at(lambda s: s.object.friction, scene, jnp.full(3, 0.6))
    dynamics = wa.trace(rough, resolution=Resolution(panels=512))[1].dynamics
    assert wa.Status(int(dynamics.status)) is wa.Status.NO_CONVERGENCE
    assert float(dynamics.error) > 1e-9
    assert dynamics.acceleration.shape[0] == 512
