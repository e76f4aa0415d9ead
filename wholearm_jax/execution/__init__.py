"""Virtual hardware: a MuJoCo model with Coulomb friction, rollouts, trials. Needs the extra `mujoco`."""

from wholearm_jax.execution.closed_loop import IDEAL, Hardware
from wholearm_jax.execution.executions import (
    Execution,
    ExecutionOutcome,
    Tolerance,
    clock,
    execute,
    motor_torques,
    require_wires,
    start_of,
    touching_contacts_at,
)
from wholearm_jax.execution.mujoco_model import CONVEX, ContactCompliance, build_mujoco_model
from wholearm_jax.execution.trials import (
    Amounts,
    PerturbedRun,
    TrialsResult,
    require_objects,
    rollout_in_parallel,
    run_trials,
    start_near,
)

__all__ = [
    "CONVEX",
    "IDEAL",
    "Amounts",
    "ContactCompliance",
    "Execution",
    "ExecutionOutcome",
    "Hardware",
    "PerturbedRun",
    "Tolerance",
    "TrialsResult",
    "build_mujoco_model",
    "clock",
    "execute",
    "motor_torques",
    "require_objects",
    "require_wires",
    "rollout_in_parallel",
    "run_trials",
    "start_near",
    "start_of",
    "touching_contacts_at",
]
