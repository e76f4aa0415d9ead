r"""The direct way, to compare with: the C-functions are solved by Newton's method inside the vector field.

State `(s, w)` as in `wholearm_jax.simulation.phase_motion`; at every stage of every step

    C_n(z) = 0,  u . z = s            Newton's method, from the nearest of a few places known on the path,
    G_n x = 0,  u . x = 1             the path's tangent, and its derivative x',
    [ M x , -(G_n - Xi U G_t)^T ] [a ; c_n] = E tau + g - M x' v^2 - B x v - D sgn(x v)

and nothing is tabulated. Torque knots, slip reversals and the path's end are treated as the package treats them, so
that the order is kept: steps end on knots, and the step that passes a reversal is taken again with the length that
lands on it. Where they lie on the path is given for free; waiting and friction at rest are left out.
"""

from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from wholearm_jax.core import CachedJit
from wholearm_jax.dynamics import PathDynamics, equations_of_motion, evaluate, locate_panel
from wholearm_jax.model import PhaseSchedule, ScaledMechanics, interval, torque_at
from wholearm_jax.tracing import ContactPath, path_derivatives, solve_on_path

PLACES = 33  # known places of the path: Newton's method starts within a sixty-fourth of its length


class Direct(eqx.Module):
    """What the direct way knows of a path: its chart, signs, where its pieces end, and a few places to start from."""

    mechanics: ScaledMechanics
    chart: Float[Array, "5"]
    anchor: Float[Array, "5"]
    anchor_s: Float[Array, ""]
    slip_sign: Float[Array, "segments contacts"]
    joint_sign: Float[Array, "segments 2"]
    breakpoints: Float[Array, "segments_1"]
    s: Float[Array, "places"]
    z: Float[Array, "places 5"]
    x: Float[Array, "places 5"]


class Path(NamedTuple):
    """Accepted steps of each piece, `count[k]` of them: rows (share, s, w), the piece's start not among them."""

    steps: Float[Array, "segments steps 3"]
    count: Int[Array, "segments"]


def direct(mechanics: ScaledMechanics, path: ContactPath, dynamics: PathDynamics) -> Direct:
    """The direct way's view of a path of one chart."""
    segments = int(dynamics.count)
    if not np.all(np.asarray(path.chart[:segments]) == np.asarray(path.chart[0])):
        raise ValueError("the direct way is written for paths of one chart")
    s = jnp.linspace(path.breakpoints[0], path.breakpoints[segments], PLACES)

    def place(s):
        segment = jnp.minimum((s >= path.breakpoints[1:segments]).sum(), segments - 1)
        panel, xi = locate_panel(dynamics, segment, s)
        z = evaluate(dynamics.configuration, panel, xi) / mechanics.configuration_unit
        return z, path_derivatives(mechanics, z, path.chart[0]).x

    z, x = jax.vmap(place)(s)
    signs = path.slip_sign[:segments], path.joint_sign[:segments]
    return Direct(
        mechanics, path.chart[0], path.anchor[0], path.anchor_s[0], *signs, path.breakpoints[: segments + 1], s, z, x
    )


def solve(way: Direct, segment, s, w, tau, duration):
    """`z`, `x`, `a` and `c_n` [N] at one state, from nothing but the C-functions and the 5x5 system."""
    near = jnp.argmin(jnp.abs(way.s - s))
    height = way.chart @ way.anchor + s - way.anchor_s

    def above(mechanics, z, x, height):
        return way.chart @ z - height

    z = solve_on_path(above, way.mechanics, way.z[near] + way.x[near] * (s - way.s[near]), way.chart, height).z
    at = path_derivatives(way.mechanics, z, way.chart)
    matrix, right = equations_of_motion(
        way.mechanics, z, at.x, at.curvature, way.slip_sign[segment], way.joint_sign[segment]
    )
    v = w / duration
    terms = jnp.concatenate([jnp.stack([jnp.ones_like(v), v**2, v]), tau / way.mechanics.torque_unit])
    answer = jnp.linalg.solve(matrix, right @ terms)
    return z, at.x, answer[0], answer[1:] * way.mechanics.force_unit


@CachedJit
def move(
    way: Direct, phase_schedule: PhaseSchedule, duration, solver: dfx.AbstractSolver, tolerance, max_steps: int
) -> Path:
    """Move from rest at the path's start to its end or to the end of time."""
    share, y = jnp.zeros(()), jnp.stack([way.breakpoints[0], jnp.zeros(())])
    steps, counts = [], []
    for segment in range(way.slip_sign.shape[0]):
        solution = _until(way, phase_schedule, duration, solver, tolerance, max_steps, segment, share, y)
        taken, passed = solution.stats["num_accepted_steps"], dfx.is_event(solution.result)
        rows = jnp.concatenate([solution.ts[:, None], solution.ys], axis=1)
        before = jnp.where(taken > 1, rows[jnp.maximum(taken - 2, 0)], jnp.concatenate([share[None], y]))
        landed = _land(
            way, phase_schedule, duration, solver, segment, before, rows[taken - 1, 0], way.breakpoints[segment + 1]
        )
        last = jnp.where(passed, landed, rows[taken - 1])
        steps.append(rows.at[taken - 1].set(last))
        # Where time is over in an earlier piece there is nothing left to do.
        counts.append(jnp.where(share < 1, taken, 0))
        share, y = jnp.where(passed, last[0], 1.0), last[1:]
    return Path(jnp.stack(steps), jnp.stack(counts))


@CachedJit
def moves(
    way: Direct, phase_schedule: PhaseSchedule, durations, solver: dfx.AbstractSolver, tolerance, max_steps: int
) -> Path:
    """One phase after the other, in one program."""
    return jax.lax.map(lambda duration: move(way, phase_schedule, duration, solver, tolerance, max_steps), durations)


@CachedJit
def states(way: Direct, phase_schedule: PhaseSchedule, duration, path: Path):
    """`z` and `z_dot` (SI) and `c_n` [N] at every step of a path."""

    def one(segment, row):
        share, s, w = row
        # A step that ends on a knot belongs to the interval before it; the torque is continuous.
        tau = torque_at(phase_schedule, interval(phase_schedule, share), share)
        z, x, _, cn = solve(way, segment, s, w, tau, duration)
        unit = way.mechanics.configuration_unit
        return z * unit, x * w / duration * unit, cn

    segments = jnp.arange(path.count.shape[0])
    return jax.vmap(jax.vmap(one, (None, 0)))(segments, path.steps)


def _field(way, phase_schedule, duration, segment, row):
    def field(u, y, args):
        tau = torque_at(phase_schedule, interval(phase_schedule, u) if row is None else row, u)
        return jnp.stack([y[1], duration**2 * solve(way, segment, y[0], y[1], tau, duration)[2]])

    return dfx.ODETerm(field)


def _until(way, phase_schedule, duration, solver, tolerance, max_steps, segment, share, y):
    """Steps until the first that passes the piece's end, or to the end of time."""
    errors = dfx.PIDController(rtol=tolerance, atol=tolerance)
    return dfx.diffeqsolve(
        _field(way, phase_schedule, duration, segment, None),
        solver,
        jnp.minimum(share, 1 - 1e-9),
        1.0,
        1 / 32,
        y,
        saveat=dfx.SaveAt(steps=True),
        stepsize_controller=dfx.ClipStepSizeController(errors, step_ts=phase_schedule.phase_time),
        event=dfx.Event(lambda t, y, args, **_: y[0] > way.breakpoints[segment + 1]),
        adjoint=dfx.DirectAdjoint(),
        max_steps=max_steps,
        throw=False,
    )


def _land(way, phase_schedule, duration, solver, segment, before, end, goal):
    """The step from `before` with the length, found by Newton's method, that lands on `s = goal`."""
    share, y = before[0], before[1:]
    term = _field(way, phase_schedule, duration, segment, interval(phase_schedule, (share + end) / 2))
    solver = eqx.tree_at(lambda x: x.scan_kind, solver, "bounded", is_leaf=lambda x: x is None)

    def step(length):
        state = solver.init(term, share, share + length, y, None)
        return solver.step(term, share, share + length, y, None, state, made_jump=True)[0]

    def narrow(_, length):
        at = step(length)
        return jnp.clip(length + (goal - at[0]) / at[1], 0.0, end - share)

    length = jax.lax.fori_loop(0, 8, narrow, (end - share) / 2)
    at = step(length)
    return jnp.stack([share + length, goal, at[1]])
