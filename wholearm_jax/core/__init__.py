"""What knows nothing of robots: status, configuration, array helpers, small linear algebra, kept programs, files."""

from wholearm_jax.core.arrays import (
    array_module,
    as_concrete_array,
    as_device_array,
    as_strong_array,
    eps_power,
    is_traced,
    set_row,
    stack_trees,
    take_row,
    unstack_trees,
)
from wholearm_jax.core.atomic_files import write_atomically, write_together
from wholearm_jax.core.background_compile import BackgroundTask, compile_in_background, wait_for
from wholearm_jax.core.config import LOOPS_AS_KERNELS, configure
from wholearm_jax.core.errors import BadInput, DoubtfulInput, SceneError, StoreError
from wholearm_jax.core.executable_cache import discard_unreadable_entry, keep_compiled
from wholearm_jax.core.linear_programme import LinearProgramme, LinearProgrammeSolution
from wholearm_jax.core.program_cache import CachedJit, enable_program_cache
from wholearm_jax.core.root_finding import find_bracketed_root
from wholearm_jax.core.small_linalg import fused_matmul, inverse_and_determinant, linear_solve, null_vector
from wholearm_jax.core.staging import computed_at_once, on_host
from wholearm_jax.core.status import Status
from wholearm_jax.core.validation import require_positive, require_x64
