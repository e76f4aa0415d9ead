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
from wholearm_jax.dynamics.path_dynamics import evaluate, locate_panel
from wholearm_jax.margin.contact_forces import contact_force, minimum_margin
from wholearm_jax.model.scene import rigid_body
from wholearm_jax.model.schedule import interval, torque_at
from wholearm_jax.phases.phase import trace_phase
from wholearm_jax.phases.sampling import DEFAULT_SAMPLES, sample_phase
from wholearm_jax.simulation.event_step import path_acceleration
from wholearm_jax.simulation.integrator import TerminalEvent, integrate_adaptive
from wholearm_jax.simulation.phase_motion import simulate_motion
from wholearm_jax.tracing.path import Resolution

COARSE = Resolution(6, 16, 8)


@partial(jax.jit, static_argnames="adjoint")
def moved(table, seen, duration, adjoint="none"):
    """The motion alone."""
    return simulate_motion(table, seen, duration, how=wa.Integration(adjoint=adjoint))


@jax.jit
def scored(table, seen, duration):
    """The motion and its margin."""
    how = wa.Integration()
    return minimum_margin(table, seen, duration, simulate_motion(table, seen, duration, how=how), how)


@partial(jax.jit, static_argnames="stop")
def bare(table, seen, duration, stop=False):
    """One stage on the wire's first piece; `stop` looks for the first tensile force at every step's end."""

    def field(u, y, _):
        tau = torque_at(seen, interval(seen, u), u)
        v = y[1] / duration
        panel, xi = locate_panel(table, 0, y[0])
        terms = jnp.stack([jnp.ones_like(v), v**2, v, *tau])
        return jnp.stack([y[1], duration**2 * (evaluate(table.acceleration, panel, xi) * terms).sum()])

    def ended(t, y, args, **_):
        over = y[0] > table.breaks[1]
        if stop:
            row = interval(seen, t)
            over = over | (contact_force(table, seen, duration, 0, row, t, y[0], y[1]).min() < 0)
        return over

    errors = dfx.PIDController(rtol=1e-10, atol=1e-10)
    return dfx.diffeqsolve(
        dfx.ODETerm(field),
        dfx.Dopri8(),
        0.0,
        1.0,
        1 / 32,
        jnp.stack([table.breaks[0], jnp.zeros(())]),
        saveat=dfx.SaveAt(steps=True),
        stepsize_controller=dfx.ClipStepSizeController(errors, step_ts=seen.share),
        event=dfx.Event(ended),
        adjoint=dfx.DirectAdjoint(),
        max_steps=256,
        throw=False,
    ).ys


@jax.jit
def stepped(table, seen, duration):
    """The same stage with all terms, by the package's own loop."""

    def field(u, y, row):
        return jnp.stack([y[1], path_acceleration(table, seen, duration, 0, row, u, y[0], y[1])])

    y, final = jnp.stack([table.breaks[0], jnp.zeros(())]), jnp.ones(())
    stop = TerminalEvent(lambda y: y[0] > table.breaks[1], lambda *_: jnp.asarray(False))  # as much is watched there
    return integrate_adaptive(field, seen, wa.Integration(), 0 * final, final, y, stop, final).y


def rows(problem, repeats: int) -> list[dict]:
    """Every comparison on one phase: times of both sides [s] and their ratio."""
    table, seen, duration = problem.traced.table, problem.seen, problem.duration
    scene, phase = problem.scene, problem.scene.phases[problem.phase]
    rough = wa.trace(scene)[problem.phase - 1].end if problem.phase else scene.start
    solid = rigid_body(scene.object)

    def prepared(resolution):
        return trace_phase(solid, scene.hand, scene.gravity, phase.formation, rough, phase.heading, resolution)

    shares = np.linspace(0.0, 1.0, DEFAULT_SAMPLES)
    motion = moved(table, seen, duration)
    gradient = jax.jit(jax.value_and_grad(lambda v: _margin(table, seen, duration, v)))
    calls = {
        "tracing, when the wire is known": (lambda: (prepared(Resolution()), scored(table, seen, duration)), "margin"),
        "a table of 64 panels, when 16 would do": (lambda: prepared(Resolution()), lambda: prepared(COARSE)),
        "the margin, when the motion is asked": (lambda: scored(table, seen, duration), "move"),
        "the trajectory, when the margin is asked": (
            lambda: (
                scored(table, seen, duration),
                sample_phase(table, problem.schedule, problem.start, duration, motion, shares),
            ),
            "margin",
        ),
        "the gradient, when the margin is asked": (lambda: gradient(seen.values), "margin"),
        "repeatable steps, when no reverse mode is asked": (lambda: moved(table, seen, duration, "both"), "move"),
        "what diffeqsolve provides, when steps are asked": (
            lambda: bare(table, seen, duration),
            lambda: stepped(table, seen, duration),
        ),
        "looking for a tensile force at every step": (
            lambda: bare(table, seen, duration, stop=True),
            lambda: bare(table, seen, duration),
        ),
    }
    base = {"margin": lambda: scored(table, seen, duration), "move": lambda: moved(table, seen, duration)}
    compared = []
    for name, (with_it, without) in calls.items():
        without = base[without] if isinstance(without, str) else without
        times = measure.compare({"with": with_it, "without": without}, repeats=repeats)
        compared.append({"what": name, **times, "ratio": times["with"] / times["without"]})
    return compared


def _margin(table, seen, duration, values):
    how = wa.Integration(adjoint="both")
    slope = jnp.diff(values, axis=0) / jnp.where(jnp.diff(seen.share) > 0, jnp.diff(seen.share), 1.0)[:, None]
    changed = eqx.tree_at(lambda w: (w.values, w.slope), seen, (values, slope))
    return minimum_margin(table, changed, duration, simulate_motion(table, changed, duration, how=how), how).margin


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
