"""The simulation of a plan in closed loop as a `Result`, with the torques that the law has exerted as its schedule."""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from wholearm_jax.core import Status, as_device_array, on_host, require_positive, require_x64
from wholearm_jax.model import LawTables, Scene, TorqueSchedule, uniform_schedule
from wholearm_jax.phases.closed_loop import CLOSED_LOOP_ARRIVAL, CLOSED_LOOP_STEPS, simulate_closed_loop
from wholearm_jax.phases.phase_simulation import SimulatedPhase, simulate_with_enough_steps
from wholearm_jax.phases.phase_tracing import TracedPhase
from wholearm_jax.phases.plan_schedule import require_motion
from wholearm_jax.phases.plan_tracing import trace
from wholearm_jax.phases.result import Result, build_result
from wholearm_jax.simulation import IntegratorOptions, Motion, PhaseLoop, phase_loop, torques_of_step


@on_host("wholearm_jax.phases.closed_loop_margin is the margin as a number that can be transformed")
def closed_loop_result(
    scene: Scene,
    law: LawTables,
    *,
    tolerance: float = 1e-9,
    traced: tuple[TracedPhase, ...] = (),
    arrival: float = CLOSED_LOOP_ARRIVAL,
) -> Result:
    """Simulate a plan in closed loop, and assess every phase, as `simulate` does under a schedule.

    Args:
        scene: Scene with its plan.
        law: The controller's tables (`feedback.law_tables`).
        tolerance: Tolerance of the integrator.
        traced: Result of `trace`, to reuse.
        arrival: Distance from its path's end within which a phase must end, in path lengths.

    Returns:
        The result; its `torque` is what the law has exerted, at the ends of the integrator's steps.

    Raises:
        ValueError: For a law of another number of phases, a phase that holds the object, or numbers that are not
            positive.
    """
    require_x64(scene, law)
    require_positive(tolerance=tolerance, arrival=arrival)
    require_motion(scene)
    traced = traced or trace(scene)
    steps = CLOSED_LOOP_STEPS
    options = IntegratorOptions(tolerance=tolerance, max_steps=steps, max_stages=steps // 64)
    simulated = partial(simulate_closed_loop, scene, law, traced, arrival=arrival)
    phases = simulate_with_enough_steps(simulated, options)
    return build_result(scene, _exerted(law, traced, phases), traced, phases)


def _exerted(law: LawTables, traced: tuple[TracedPhase, ...], phases: Sequence[SimulatedPhase]) -> TorqueSchedule:
    """Return the torques of the law at both ends of a motion's steps; the last one holds to the phase's end."""
    times, torques = [], []
    for k, (path, one) in enumerate(zip(traced, phases, strict=True)):
        motion, count = one.motion, int(one.motion.count)
        if count == 0 or int(path.dynamics.status) != Status.OK:
            continue
        tables = jax.tree.map(lambda leaf, k=k: leaf[k], law.phases)
        both = _step_torques(phase_loop(law, tables, path.dynamics), motion)
        nodes = np.stack([np.asarray(motion.phase_time[:-1]), np.asarray(motion.phase_time[1:])], axis=1)[:count]
        exerted = np.asarray(both)[:count].reshape(-1, 2)
        times.append(float(one.start) + float(one.duration) * np.append(nodes, max(nodes[-1, 1], 1.0)))
        torques.append(np.concatenate([exerted, exerted[-1:]]))
    if not times:
        return uniform_schedule(1.0, np.zeros((2, 2)))
    return TorqueSchedule(as_device_array(np.concatenate(times)), as_device_array(np.concatenate(torques)))


@jax.jit
def _step_torques(loop: PhaseLoop, motion: Motion):
    """Evaluate the torque at both ends of every step: (steps, 2, 2)."""
    return jax.vmap(torques_of_step, (None, None, 0))(loop, motion, jnp.arange(motion.row.shape[0]))
