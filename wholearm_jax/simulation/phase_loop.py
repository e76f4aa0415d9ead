"""Prepare a closed-loop law for one phase: its reference over phase time, and its place along the scene's own path."""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from wholearm_jax.dynamics import PathDynamics, evaluate_polynomial, fit_panels
from wholearm_jax.model import LawTables, PhaseTables
from wholearm_jax.simulation.closed_loop import PhaseLoop, interpolate_rows
from wholearm_jax.tracing import chebyshev_points

PLACE_ITERATIONS = 4  # Newton steps of the projection on the law's curve


def loop_duration(law: LawTables, phase: PhaseTables) -> Float[Array, ""]:
    """Return the longest time [s] that a phase may take."""
    waits = (phase.reach > 0) | phase.flows
    return phase.time[-1] + jnp.where(waits, law.patience, 0.0)


def phase_loop(law: LawTables, phase: PhaseTables, dynamics: PathDynamics) -> PhaseLoop:
    """Prepare the law of one phase for the path of a scene.

    Args:
        law: The law; of its phases only `phase` counts.
        phase: The law of this phase.
        dynamics: Tabulated path dynamics of the scene.

    Returns:
        The law in phase time, of which one unit is `loop_duration`.
    """
    place = _place_along_path(phase, dynamics)
    begin = evaluate_polynomial(place[dynamics.first[0]], -jnp.ones_like(phase.length))
    duration = loop_duration(law, phase)
    times, first, last, presses = _reference_rows(phase, begin - phase.s_ref[0], duration)
    gap = jnp.diff(times)
    slope = jnp.where((gap > 0)[:, None], (last - first) / jnp.where(gap > 0, gap, 1.0)[:, None], 0.0) * duration
    return PhaseLoop(
        phase_time=times / duration,
        reference=first,
        slope=slope,
        presses=presses,
        first=jnp.asarray(0, int),
        last=jnp.asarray(times.shape[0] - 2, int),
        place=place,
        s=phase.s,
        gain=phase.gain,
        stiffness=law.stiffness,
        integral=law.integral,
        observer=law.observer,
        push=law.push,
        press=phase.press,
        torque_limit=law.torque_limit,
    )


def _reference_rows(phase: PhaseTables, offset, duration):
    """Return the times of the reference's rows, its values where intervals begin and end, and where `press` bounds.

    To the table's rows come the end of the approach, the end of the phase, and the moment at which the reference is
    within `reach` of the path's end.
    """
    end = phase.time[-1]
    approached = end + jnp.where(phase.reach > 0, phase.reach / jnp.where(phase.reach > 0, phase.approach, 1.0), 0.0)
    near = phase.length - phase.reach

    def place(t):
        return (
            interpolate_rows(phase.time, phase.s_ref, t)
            + jnp.clip(phase.approach * (t - end), 0.0, phase.reach)
            + offset * jnp.maximum(0.0, 1 - t / end)
        )

    times = jnp.minimum(jnp.concatenate([phase.time, approached[None], duration[None]]), duration)
    places = jax.vmap(place)(times)
    crosses = (places[1:] > near) & (places[:-1] <= near)
    k = jnp.argmax(crosses)
    rise = jnp.where(crosses[k], places[k + 1] - places[k], 1.0)
    crossing = jnp.where(crosses[k], times[k] + (near - places[k]) / rise * (times[k + 1] - times[k]), duration)
    times = jnp.sort(jnp.append(times, crossing))

    def values(t, is_late, v_late):
        v = jnp.where(is_late, v_late, interpolate_rows(phase.time, phase.v_ref, t))
        return jnp.concatenate([place(t)[None], v[None], interpolate_rows(phase.time, phase.torque, t)])

    middle = stop_gradient((times[1:] + times[:-1]) / 2)
    v_late = jnp.where(middle < approached, phase.approach, 0.0)
    first, last = (jax.vmap(values)(t, middle > end, v_late) for t in (times[:-1], times[1:]))
    return times, first, last, jax.vmap(place)(middle) > near


def _place_along_path(phase: PhaseTables, dynamics: PathDynamics) -> Float[Array, "panels powers"]:
    """Fit the place of the path's joint angles on the law's curve.

    Newton's method projects as the law does; it begins at the length of the path's own curve.
    """
    xi = jnp.asarray(chebyshev_points(dynamics.configuration.shape[1]), phase.s.dtype)
    angles = jax.vmap(jax.vmap(evaluate_polynomial, (None, 0)), (0, None))(dynamics.configuration[..., 3:], xi)
    flat = angles.reshape(-1, 2)
    steps = jnp.hypot(*jnp.diff(stop_gradient(flat), axis=0).T)
    guess = jnp.concatenate([jnp.zeros(1, flat.dtype), jnp.cumsum(steps)])

    def place_of(angles, s):
        for _ in range(PLACE_ITERATIONS):
            inside = jnp.clip(s, 0.0, phase.length)
            tangent = interpolate_rows(phase.s, phase.tangent, inside)
            s = s + tangent @ (angles - interpolate_rows(phase.s, phase.theta, inside) - (s - inside) * tangent)
        return s

    places = jax.vmap(place_of)(flat, guess).reshape(angles.shape[:2])
    return fit_panels({"place": places})[0]["place"]
