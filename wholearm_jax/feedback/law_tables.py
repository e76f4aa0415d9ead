"""A controller as arrays for the model of its closed loop, differentiable in every number."""

import numpy as np

from wholearm_jax.core import as_device_array
from wholearm_jax.feedback.controller import Controller
from wholearm_jax.model import LawTables, PhaseTables, Scene, round_up
from wholearm_jax.simulation import SEARCH_BLOCK


def law_tables(controller: Controller) -> LawTables:
    """Return a controller's numbers as a tree of arrays, its phases stacked.

    Args:
        controller: The controller.

    Returns:
        The law for `check`, and for `closed_loop_margin`, which can be differentiated with respect to it.
    """
    phases = controller.phases
    nodes = round_up(max(len(phase.s) for phase in phases), SEARCH_BLOCK)
    times = max(len(phase.time) for phase in phases)

    def along(name: str):
        return _stack([_repeat_last(getattr(phase, name), nodes) for phase in phases])

    def over_time(name: str):
        return _stack([_repeat_last(getattr(phase, name), times) for phase in phases])

    def numbers(name: str):
        return _stack([getattr(phase, name) for phase in phases])

    tables = PhaseTables(
        **{name: along(name) for name in ("s", "theta", "tangent", "gain")},
        **{name: over_time(name) for name in ("time", "s_ref", "v_ref", "torque")},
        **{name: numbers(name) for name in ("length", "flows", "reach", "approach", "press")},
    )
    names = "stiffness", "integral", "observer", "push", "patience"
    constants = {name: float(getattr(controller, name)) for name in names}  # a whole number may be an integer
    return LawTables(
        phases=tables,
        settle=as_device_array(float(controller.felt[1])),
        torque_limit=as_device_array(controller.torque_limit),
        **{name: as_device_array(value) for name, value in constants.items()},
    )


def require_same_plan(controller: Controller, scene: Scene) -> None:
    """Raise ValueError where a controller is for other contact formations than a scene's."""
    ours = [phase.formation.names for phase in scene.phases]
    theirs = [phase.contacts for phase in controller.phases]
    if ours != theirs:
        raise ValueError(f"the controller is for another plan ('{controller.title}'): its contact formations differ")


def _repeat_last(rows, count: int) -> np.ndarray:
    """Fill a table up to `count` rows by repeating its last."""
    rows = np.asarray(rows)
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)])


def _stack(rows):
    """Stack one value a phase."""
    return as_device_array(np.stack([np.asarray(row) for row in rows]))
