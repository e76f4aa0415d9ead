"""Virtual hardware: a MuJoCo model with Coulomb friction, rollouts, trials. Needs the extra `mujoco`."""

from wholearm_jax.execution.closed_loop import IDEAL, Hardware
from wholearm_jax.execution.disturbances import DisturbanceMap, friction_map, push_map, start_map
from wholearm_jax.execution.executed_motion import touching_contacts_at
from wholearm_jax.execution.executions import (
    Execution,
    ExecutionOutcome,
    Tolerance,
    clock,
    execute,
    motor_torques,
    require_paths,
    start_of,
)
from wholearm_jax.execution.mujoco_model import CONVEX, ContactCompliance, build_mujoco_model
from wholearm_jax.execution.pushes import Push, push
from wholearm_jax.execution.trials import (
    Amounts,
    Copy,
    PerturbedRun,
    TrialsResult,
    require_objects,
    rollout_in_parallel,
    run_copies,
    run_trials,
    start_near,
)

__all__ = [
    "CONVEX",
    "IDEAL",
    "Amounts",
    "ContactCompliance",
    "Copy",
    "DisturbanceMap",
    "Execution",
    "ExecutionOutcome",
    "Hardware",
    "PerturbedRun",
    "Push",
    "Tolerance",
    "TrialsResult",
    "build_mujoco_model",
    "clock",
    "execute",
    "friction_map",
    "motor_torques",
    "push",
    "push_map",
    "require_objects",
    "require_paths",
    "rollout_in_parallel",
    "run_copies",
    "run_trials",
    "start_map",
    "start_near",
    "start_of",
    "touching_contacts_at",
]
