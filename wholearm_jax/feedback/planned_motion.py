"""The motion that a law is to bring about, and the contact forces that its torques cause on the way."""

import jax
import jax.numpy as jnp
import numpy as np

from wholearm_jax.dynamics import PathDynamics, evaluate, locate_panel
from wholearm_jax.feedback.controller import Controller, PhaseLaw
from wholearm_jax.feedback.path_table import tabulate_path
from wholearm_jax.phases import PhaseResult, Result, Trajectory, by_contact


def planned_motion(controller: Controller, prediction: Result) -> tuple[Trajectory, ...]:
    """Return every phase of a law's reference, for the nominal object, as if no phase took longer than planned.

    Args:
        controller: The law.
        prediction: Of the same plan; of it the paths alone count.
    """
    begins = np.cumsum([0.0, *(phase.duration for phase in controller.phases)])
    phases = zip(controller.phases, prediction.phases, begins[:-1], strict=True)
    return tuple(_along_path(law, phase, float(begin)) for law, phase, begin in phases)


def _along_path(law: PhaseLaw, phase: PhaseResult, begin: float) -> Trajectory:
    dynamics, count = phase.traced.dynamics, len(phase.contacts)
    table = tabulate_path(dynamics)
    segment = table.segment[np.clip(np.searchsorted(table.s, law.s_ref), 0, len(table.s) - 1)]
    parameter = np.interp(law.s_ref, table.s, table.parameter)
    w = law.v_ref * np.interp(law.s_ref, table.s, table.unit)
    rows = (jnp.asarray(a) for a in (begin + law.time, segment, parameter, w, law.torque))
    found = jax.device_get(_sample(dynamics, *rows))
    cn, ct = (np.where(np.arange(forces.shape[1]) < count, forces, np.nan) for forces in (found.cn, found.ct))
    return found._replace(cn=cn, ct=ct)


@jax.jit
def _sample(dynamics: PathDynamics, time, segment, parameter, w, torque) -> Trajectory:
    def at(segment, p, w, torque):
        panel, xi = locate_panel(dynamics, segment, p)
        terms = jnp.concatenate([jnp.stack([jnp.ones_like(w), w**2, w]), torque])
        cn, ct = by_contact(dynamics, segment, evaluate(dynamics.force, panel, xi) @ terms)
        return evaluate(dynamics.configuration, panel, xi), evaluate(dynamics.velocity, panel, xi) * w, torque, cn, ct

    return Trajectory(time, parameter, *jax.vmap(at)(segment, parameter, w, torque))
