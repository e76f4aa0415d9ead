r"""What each thing that a scene or a question does not need costs: the same work with it over the work without it.

    python benchmarks/skipping.py [--quick]

On the heptagon's slide and flip under the piecewise-linear torques, warm and in turn. Rows are of two kinds: what the
package leaves out by itself (it is part of another call), and what it could leave out, tried here. A row near 1 does
not pay and is not in the package.
"""

import argparse
from functools import partial

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import measure
import numpy as np
from work_precision import problems

import wholearm_jax as wa
from wholearm_jax.dynamics import evaluate, locate_panel
from wholearm_jax.margin import contact_force, minimum_margin
from wholearm_jax.model import interval, rigid_body, torque_at
from wholearm_jax.phases import DEFAULT_SAMPLES, sample_phase, trace_phase
from wholearm_jax.simulation import Adjoint, TerminalEvent, integrate_adaptive, path_acceleration, simulate_motion
from wholearm_jax.tracing import Resolution

COARSE = Resolution(6, 16, 8)


@partial(jax.jit, static_argnames="adjoint")
def moved(dynamics, phase_schedule, duration, adjoint=Adjoint.NONE):
    """The motion alone."""
    return simulate_motion(dynamics, phase_schedule, duration, options=wa.IntegratorOptions(adjoint=adjoint))


@jax.jit
def scored(dynamics, phase_schedule, duration):
    """The motion and its margin."""
    options = wa.IntegratorOptions()
    return minimum_margin(
        dynamics,
        phase_schedule,
        duration,
        simulate_motion(dynamics, phase_schedule, duration, options=options),
        options,
    )


@partial(jax.jit, static_argnames="stop")
def bare(dynamics, phase_schedule, duration, stop=False):
    """One stage on the path's first piece; `stop` looks for the first tensile force at every step's end."""

    def field(u, y, _):
        tau = torque_at(phase_schedule, interval(phase_schedule, u), u)
        v = y[1] / duration
        panel, xi = locate_panel(dynamics, 0, y[0])
        terms = jnp.stack([jnp.ones_like(v), v**2, v, *tau])
        return jnp.stack([y[1], duration**2 * (evaluate(dynamics.acceleration, panel, xi) * terms).sum()])

    def ended(t, y, args, **_):
        over = y[0] > dynamics.breakpoints[1]
        if stop:
            row = interval(phase_schedule, t)
            over = over | (contact_force(dynamics, phase_schedule, duration, 0, row, t, y[0], y[1]).min() < 0)
        return over

    errors = dfx.PIDController(rtol=1e-10, atol=1e-10)
    return dfx.diffeqsolve(
        dfx.ODETerm(field),
        dfx.Dopri8(),
        0.0,
        1.0,
        1 / 32,
        jnp.stack([dynamics.breakpoints[0], jnp.zeros(())]),
        saveat=dfx.SaveAt(steps=True),
        stepsize_controller=dfx.ClipStepSizeController(errors, step_ts=phase_schedule.phase_time),
        event=dfx.Event(ended),
        adjoint=dfx.DirectAdjoint(),
        max_steps=256,
        throw=False,
    ).ys


@jax.jit
def stepped(dynamics, phase_schedule, duration):
    """The same stage with all terms, by the package's own loop."""

    def field(u, y, row):
        return jnp.stack([y[1], path_acceleration(dynamics, phase_schedule, duration, 0, row, u, y[0], y[1])])

    y, final = jnp.stack([dynamics.breakpoints[0], jnp.zeros(())]), jnp.ones(())
    stop = TerminalEvent(
        lambda y: y[0] > dynamics.breakpoints[1], lambda *_: jnp.asarray(False)
    )  # as much is watched there
    return integrate_adaptive(field, phase_schedule, wa.IntegratorOptions(), 0 * final, final, y, stop, final).y


def rows(problem, repeats: int) -> list[dict]:
    """Every comparison on one phase: times of both sides [s] and their ratio."""
    dynamics, phase_schedule, duration = problem.traced.dynamics, problem.phase_schedule, problem.duration
    scene, phase = problem.scene, problem.scene.phases[problem.phase]
    rough = wa.trace(scene)[problem.phase - 1].end if problem.phase else scene.start
    solid = rigid_body(scene.object)

    def prepared(resolution):
        return trace_phase(solid, scene.hand, scene.gravity, phase.formation, rough, phase.target, resolution)

    shares = np.linspace(0.0, 1.0, DEFAULT_SAMPLES)
    motion = moved(dynamics, phase_schedule, duration)
    gradient = jax.jit(jax.value_and_grad(lambda v: _margin(dynamics, phase_schedule, duration, v)))
    calls = {
        "tracing, when the path is known": (
            lambda: (prepared(Resolution()), scored(dynamics, phase_schedule, duration)),
            "margin",
        ),
        "a table of 64 panels, when 16 would do": (lambda: prepared(Resolution()), lambda: prepared(COARSE)),
        "the margin, when the motion is asked": (lambda: scored(dynamics, phase_schedule, duration), "move"),
        "the trajectory, when the margin is asked": (
            lambda: (
                scored(dynamics, phase_schedule, duration),
                sample_phase(dynamics, problem.schedule, problem.start, duration, motion, shares),
            ),
            "margin",
        ),
        "the gradient, when the margin is asked": (lambda: gradient(phase_schedule.values), "margin"),
        "repeatable steps, when no reverse mode is asked": (
            lambda: moved(dynamics, phase_schedule, duration, "both"),
            "move",
        ),
        "what diffeqsolve provides, when steps are asked": (
            lambda: bare(dynamics, phase_schedule, duration),
            lambda: stepped(dynamics, phase_schedule, duration),
        ),
        "looking for a tensile force at every step": (
            lambda: bare(dynamics, phase_schedule, duration, stop=True),
            lambda: bare(dynamics, phase_schedule, duration),
        ),
    }
    base = {
        "margin": lambda: scored(dynamics, phase_schedule, duration),
        "move": lambda: moved(dynamics, phase_schedule, duration),
    }
    compared = []
    for name, (with_it, without) in calls.items():
        without = base[without] if isinstance(without, str) else without
        times = measure.compare({"with": with_it, "without": without}, repeats=repeats)
        compared.append({"what": name, **times, "ratio": times["with"] / times["without"]})
    return compared


def _margin(dynamics, phase_schedule, duration, values):
    options = wa.IntegratorOptions(adjoint=Adjoint.BOTH)
    slope = (
        jnp.diff(values, axis=0)
        / jnp.where(jnp.diff(phase_schedule.phase_time) > 0, jnp.diff(phase_schedule.phase_time), 1.0)[:, None]
    )
    changed = eqx.tree_at(lambda w: (w.values, w.slope), phase_schedule, (values, slope))
    return minimum_margin(
        dynamics, changed, duration, simulate_motion(dynamics, changed, duration, options=options), options
    ).margin


def main() -> None:
    """Measure, save, print."""
    wa.configure()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer repeats; saves nothing")
    quick = parser.parse_args().quick
    repeats = 3 if quick else 9
    tables = {}
    for problem in problems(referred=False)[::2]:
        tables[problem.name] = rows(problem, repeats)
        print(f"\n{problem.name}: time with over time without")
        for row in tables[problem.name]:
            times = f"{1e3 * row['with']:.3f} against {1e3 * row['without']:.3f} ms"
            print(f"  {row['what']:50s}{row['ratio']:8.2f}   ({times})")
    if not quick:
        measure.save("skipping", tables)


if __name__ == "__main__":
    main()
