r"""Reduce: the equations of motion on a wire as one scalar ODE and four contact forces.

With `x = dz/ds`, `x' = d2z/ds2`, `v = ds/dt`, `a = dv/dt` the motion is `z_dot = x v`, `z_ddot = x a + x' v^2`, and
at each `s` one 5x5 linear system gives everything (the paper's eqs. 1-4 and 12-16 in one line):

    [ M x , -(G_n - Xi U G_t)^T ] [a ; c_n] = E tau + g - M x' v^2 - B x v - D sgn(x v)

A contact that rolls has no friction law, `Xi = 0`, but a column `-G_t^T` with its tangential force `c_t` as unknown.
The answer is linear in `(1, v^2, v, tau1, tau2)`. For forward travel the coefficients are functions of `s` alone, here
tabulated as one polynomial a panel of the wire.

Derivation: section 4 of `docs/derivation.md`.
"""

import functools
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from wholearm_jax.core import (
    Status,
    as_device_array,
    eps_power,
    fused_matmul,
    inverse_and_determinant,
    null_vector,
    take_row,
)
from wholearm_jax.model import ScaledMechanics, configuration_unit, constraint_jacobian, tangential_jacobian
from wholearm_jax.tracing import ContactPath, Resolution, chebyshev_points, path_derivatives

TERMS = 5  # 1, v^2, v, tau1, tau2


class PathDynamics(eqx.Module):
    """A reduced wire: polynomials in the panel coordinate `xi` in [-1, 1], lowest power first, SI units.

    `path_acceleration[p, k]` are the coefficients of `a = ds^2/dt^2` in `(1, v^2, v, tau1, tau2)`, `contact_force[p,
    k, i]` those of
    the force in constraint `i` [N]: `c_n`, or `c_t` where `tangential` (a contact that rolls), with `rolling_friction`
    its friction
    coefficient (0 elsewhere). `configuration[p, k]` are those of `z`, `velocity[p, k]` those of `dz/ds`.
    `reverse_acceleration[p, k]` are those of `a` in `(1, tau1, tau2)` for travel the other way at rest, times the
    square of the 5x5
    determinant (against that without friction): the same sign, and smooth where friction would wedge the object on its
    way back. `friction_ratio[piece, i]` is `c_t / c_n` (eq. 3) where a contact slides.
    `impact_map` serves an object that arrives with `z_dot` from another formation: its rows times `z_dot` are `ds/dt`
    after
    the inelastic impact and the contacts' impulses [N s] (see `resolve_impact`).
    `error` is the largest interpolation error, relative to each function's own size; `condition` the largest
    condition number of the 5x5 matrix.
    """

    breakpoints: Float[Array, "segments_1"]
    count: Int[Array, ""]
    speed_ratio: Float[Array, "segments"]
    first: Int[Array, "segments"]
    panels: Int[Array, "segments"]
    acceleration: Float[Array, "panels powers 5"]
    reverse_acceleration: Float[Array, "panels powers 3"]
    force: Float[Array, "panels powers rows 5"]
    configuration: Float[Array, "panels powers 5"]
    velocity: Float[Array, "panels powers 5"]
    friction_ratio: Float[Array, "segments rows"]
    tangential: Bool[Array, "rows"]
    rolling_friction: Float[Array, "rows"]
    impact_map: Float[Array, "5 5"]
    torque_limit: Float[Array, "2"]
    error: Float[Array, ""]
    condition: Float[Array, ""]
    status: Int[Array, ""]

    @property
    def length(self) -> Float[Array, ""]:
        """The wire's extent in `s`."""
        return self.breakpoints[..., -1] - self.breakpoints[..., 0]


def equations_of_motion(mechanics: ScaledMechanics, z, x, curvature, slip_sign, joint_sign):
    """The 5x5 matrix and its right-hand sides for `(1, v^2, v, tau1, tau2)` at one place of the wire (object units).

    `x = dz/ds`, `bend = x'`; `slip_sign` is Xi, `joint_sign` the signs of the joint speeds.
    """
    friction = (mechanics.contacts.friction * slip_sign)[:, None] * tangential_jacobian(mechanics.contacts, z)
    wrench = (constraint_jacobian(mechanics.contacts, z) - friction).T
    matrix = jnp.concatenate([(mechanics.inertia * x)[:, None], -wrench], axis=1)
    none, weight = jnp.zeros(3, z.dtype), mechanics.inertia[0] * mechanics.gravity
    dry = jnp.concatenate([weight, jnp.zeros(1, z.dtype), -mechanics.dry * joint_sign])
    viscous = jnp.concatenate([none, -mechanics.viscous * x[3:]])
    torque = jnp.eye(5, dtype=z.dtype)[3:]
    return matrix, jnp.stack([dry, -mechanics.inertia * curvature, viscous, *torque], axis=1)


def tabulate_path_dynamics(mechanics: ScaledMechanics, path: ContactPath) -> PathDynamics:
    """Solve the 5x5 system at every node of a wire, and at its start for those who enter with speed; tabulate."""
    shape = path.nodes.shape[:2]
    place = jnp.concatenate([path.nodes.reshape(-1, 5), path.start[None]])
    segment_of_panel = jnp.append(jnp.repeat(path.segment_of_panel, shape[1]), 0)
    chart, xi, turn = path.chart[segment_of_panel], path.slip_sign[segment_of_panel], path.joint_sign[segment_of_panel]

    def node(z, u, slip_sign, joint_sign):
        along = path_derivatives(mechanics, z, u)
        x, curvature = along.x, along.curvature
        matrix, right = equations_of_motion(mechanics, z, x, curvature, slip_sign, joint_sign)
        back, resting = equations_of_motion(mechanics, z, x, curvature, -slip_sign, -joint_sign)
        ahead, with_friction = inverse_and_determinant(matrix)
        # Friction may turn the determinant's sign only by passing through a singular matrix. Without friction,
        # det [M x, -G^T] = x.M x det [G; u]: of M x only the part along x is not in the span of G^T.
        without = stop_gradient(mechanics.inertia @ x**2 * along.determinant)
        upright = stop_gradient(with_friction) * without
        solution = fused_matmul(ahead, right)
        # Orthogonal to the contacts' wrenches nothing but M x a is left.
        across = null_vector(back[:, 1:].T)
        behind = fused_matmul(resting[:, jnp.array([0, 3, 4])].T, across) * (across @ back[:, 0]) / without**2
        condition = jnp.abs(matrix).sum(0).max() * jnp.abs(ahead).sum(0).max()
        entry = ahead * mechanics.inertia
        return entry, (x, solution[0], solution[1:], behind, condition, upright)

    entry, found = jax.vmap(node)(place, chart, xi, turn)
    x, ahead, force, behind, condition, upright = (a[:-1].reshape(*shape, *a.shape[1:]) for a in found)

    torque, newtons = mechanics.torque_unit, mechanics.force_unit
    per_term = jnp.stack([jnp.ones_like(torque), jnp.ones_like(torque), jnp.ones_like(torque), 1 / torque, 1 / torque])
    unit = configuration_unit(mechanics.length)
    # Apart from what friction and mass change, so that scenes that differ in these alone share their wires.
    places, by_places = _fit_panels({"configuration": path.nodes * unit, "velocity": x * unit})
    dynamics, by_dynamics = _fit_panels(
        {
            "acceleration": ahead * per_term,
            "reverse_acceleration": behind * per_term[jnp.array([0, 3, 4])],
            "force": force * per_term * newtons,
        }
    )
    worst = condition.max()
    eps = jnp.finfo(x.dtype).eps
    broken = (worst > 0.01 / eps) | ~(upright.min() > 0)
    return PathDynamics(
        breakpoints=path.breakpoints,
        count=path.count,
        speed_ratio=path.speed_ratio,
        first=path.first,
        panels=path.panels,
        **places,
        **dynamics,
        friction_ratio=-mechanics.contacts.friction * path.slip_sign,
        tangential=mechanics.contacts.tangential,
        rolling_friction=jnp.where(mechanics.contacts.tangential, mechanics.contacts.friction, 0.0),
        impact_map=entry[-1] * jnp.append(1.0, jnp.full(4, newtons))[:, None] / unit,
        torque_limit=mechanics.torque_limit,
        error=jnp.maximum(by_places, by_dynamics),
        condition=worst,
        status=jnp.where(path.status > 0, path.status, jnp.where(broken, int(Status.SINGULAR), 0)),
    )


def placeholder_dynamics(resolution: Resolution, contacts: int = 4) -> PathDynamics:
    """A table of the right shapes that holds no wire: something to compile with."""
    segments, panels, nodes, _ = resolution
    zero, whole, one = as_device_array(0.0), as_device_array(0), as_device_array(1)
    each = {name: np.zeros((panels, nodes, n)) for name, n in (("acceleration", 5), ("reverse_acceleration", 3))}
    each |= {name: np.zeros((panels, nodes, 5)) for name in ("configuration", "velocity")}
    each |= {"force": np.zeros((panels, nodes, contacts, TERMS)), "friction_ratio": np.zeros((segments, contacts))}
    each |= {"breakpoints": np.arange(segments + 1.0), "speed_ratio": np.ones(segments), "torque_limit": np.ones(2)}
    each |= {"tangential": np.zeros(contacts, bool), "rolling_friction": np.zeros(contacts)}
    each |= {"impact_map": np.zeros((5, 5)), "first": np.zeros(segments, int), "panels": np.ones(segments, int)}
    filled = {name: as_device_array(value) for name, value in each.items()}
    return PathDynamics(count=one, error=zero, condition=zero, status=whole, **filled)


class Impact(NamedTuple):
    """Entering a formation with speed: `ds/dt` [1/s] after the impact and the contacts' impulses [N s].

    `size` [N s] is the largest sum of magnitudes that makes up an impulse: against it rounding is judged.
    """

    speed: Float[Array, ""]
    impulse: Float[Array, "rows"]
    size: Float[Array, ""]


def resolve_impact(dynamics: PathDynamics, z_dot: Float[Array, "5"]) -> Impact:
    """The inelastic impact by which a formation takes over from another that moves with `z_dot` (SI).

    Velocities after it are the new wire's, `x v`; impulses `p` obey the friction of forward travel:

        [ M x , -(G_n - Xi U G_t)^T ] [v ; p] = M z_dot_minus

    the 5x5 system of the equations of motion with momenta in place of forces. Kinetic energy never grows: with
    `z_dot_plus = x v` and compressive `p`, what is lost is that of `z_dot_plus - z_dot_minus` and the work of friction.
    """
    after = dynamics.impact_map @ z_dot
    return Impact(after[0], after[1:], (jnp.abs(dynamics.impact_map) @ jnp.abs(z_dot))[1:].max())


def locate_panel(
    dynamics: PathDynamics, segment: Int[Array, ""], s: Float[Array, ""]
) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The panel of `segment` that serves `s` (the nearest one beyond the piece's ends) and the panel coordinate.

    More than a panel beyond the piece its functions stay what they are there: only steps that will be taken again, and
    intervals of an optimisation under way, come so far.
    """
    low, high, panels = (
        take_row(dynamics.breakpoints, segment),
        take_row(dynamics.breakpoints, segment + 1),
        take_row(dynamics.panels, segment),
    )
    width = jnp.where(high > low, high - low, 1.0)
    share = (s - low) / width * panels
    local = jnp.clip(jnp.floor(jax.lax.stop_gradient(share)), 0, jnp.maximum(panels - 1, 0))
    return take_row(dynamics.first, segment) + local.astype(int), jnp.clip(2 * (share - local) - 1, -3.0, 3.0)


def evaluate_polynomial(coefficients: Float[Array, "powers ..."], xi: Float[Array, ""]) -> Float[Array, "..."]:
    """The value of a polynomial, lowest power first."""
    while (count := coefficients.shape[0]) > 1:
        even, odd = coefficients[0::2], coefficients[1::2]
        rest = xi * odd
        even = even + rest if count % 2 == 0 else jnp.concatenate([even[:-1] + rest, even[-1:]])
        coefficients, xi = even, xi * xi
    return coefficients[0]


def differentiate_polynomial(coefficients: Float[Array, "powers ..."]) -> Float[Array, "powers_1 ..."]:
    """The coefficients of a polynomial's derivative, lowest power first."""
    power = jnp.arange(1.0, coefficients.shape[0], dtype=coefficients.dtype)
    return coefficients[1:] * power.reshape(-1, *(1,) * (coefficients.ndim - 1))


def evaluate(coefficients: Float[Array, "panels powers ..."], panel: Int[Array, ""], xi: Float[Array, ""]):
    """The value of one of a table's functions at the place that `locate_panel` tells."""
    return evaluate_polynomial(take_row(coefficients, panel), xi)


def evaluate_dot(
    coefficients: Float[Array, "panels powers *rows terms"], panel: Int[Array, ""], xi, terms: Float[Array, "terms"]
) -> Float[Array, "*rows"]:
    """The sum of one of a table's functions times `terms`, at the place that `locate_panel` tells."""
    return _evaluate_dot(take_row(coefficients, panel), xi, terms)


@jax.custom_jvp
def _evaluate_dot(coefficients, xi, terms):
    return evaluate_polynomial(coefficients, xi) @ terms


def _evaluate_dot_jvp(primals, tangents):
    """The slope in `xi` is summed before it is multiplied by the many directions there may be."""
    coefficients, xi, terms = primals
    zero = jax.custom_derivatives.SymbolicZero
    change, rate, turn = (None if isinstance(tangent, zero) else tangent for tangent in tangents)
    values = evaluate_polynomial(coefficients, xi)
    total = jnp.zeros(values.shape[:-1], values.dtype)
    if turn is not None:
        total = values @ turn
    if rate is not None:
        total = total + evaluate_polynomial(differentiate_polynomial(coefficients), xi) @ terms * rate
    if change is not None:
        total = total + evaluate_polynomial(change, xi) @ terms
    return values @ terms, total


_evaluate_dot.defjvp(_evaluate_dot_jvp, symbolic_zeros=True)


def _fit_panels(columns: dict[str, Float[Array, "panels nodes *shape"]]) -> tuple[dict[str, Array], Float[Array, ""]]:
    """Polynomials through the values of functions at the nodes, and the largest of their errors
    (`_interpolation_error`)."""
    every = jnp.concatenate([c.reshape(*c.shape[:2], -1) for c in columns.values()], axis=2)
    to_powers, to_last = _chebyshev_transforms(every.shape[1])
    ends = np.cumsum([math.prod(c.shape[2:]) for c in columns.values()])[:-1]
    # A product that is left to a library keeps a loop over phases in pieces: whole, it takes twice as long to compile.
    powers, lasts = (
        jnp.split(jnp.asarray(matrix) @ values, ends, axis=2)
        for matrix, values in ((to_powers, every), (to_last, stop_gradient(every)))
    )
    fitted = {name: each.reshape(c.shape) for (name, c), each in zip(columns.items(), powers, strict=True)}
    errors = [
        _interpolation_error(c.reshape(*c.shape[:2], -1), last) for c, last in zip(columns.values(), lasts, strict=True)
    ]
    return fitted, jnp.stack(errors).max()


def _interpolation_error(values: Float[Array, "panels nodes functions"], last: Float[Array, "panels four functions"]):
    """The largest error of polynomials, relative to the largest value of each function, by the last four Chebyshev
    coefficients of every panel.

    Two by two they shrink by `r`, and if those beyond do so, too, their sum is `r / (1 - r)` times that of the last
    two; twice that bounds the error of interpolation. Where they hardly shrink, as by rounding, the last two count
    themselves.

    Functions a hundred thousand times smaller than their largest companion (in float32, two hundred times: what should
    be zero is rounding) are judged against that.
    """
    before, tail = jnp.abs(last[:, :2]).sum(1), jnp.abs(last[:, 2:]).sum(1)
    beyond = jnp.where(3 * tail < before, 2 * tail / jnp.where(tail < before, before - tail, 1.0), 1.0)
    size = jnp.abs(stop_gradient(values)).max((0, 1))
    least = eps_power(values, 1 / 3) * size.max() + jnp.finfo(values.dtype).tiny
    return ((tail * beyond).max(0) / jnp.maximum(size, least)).max()


@functools.cache
def _chebyshev_transforms(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """From values at Chebyshev nodes to the coefficients of powers, and to the last four Chebyshev coefficients."""
    x = chebyshev_points(nodes)
    to_chebyshev = np.linalg.inv(np.polynomial.chebyshev.chebvander(x, nodes - 1))
    series = [np.polynomial.chebyshev.cheb2poly(np.eye(nodes)[k]) for k in range(nodes)]
    to_powers = np.stack([np.pad(p, (0, nodes - len(p))) for p in series], axis=1) @ to_chebyshev
    return to_powers, to_chebyshev[-4:]
