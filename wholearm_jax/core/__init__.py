"""What knows nothing of robots: status, configuration, array helpers, small linear algebra, kept programs, files."""

from wholearm_jax.core.arrays import as_device_array, as_strong_array, eps_power
from wholearm_jax.core.atomic_files import write_atomically
from wholearm_jax.core.config import configure
from wholearm_jax.core.lookup import set_row, take_row
from wholearm_jax.core.programs import (
    BackgroundCall,
    Program,
    call_in_background,
    is_transformed,
    keep_programs,
    wait_for,
)
from wholearm_jax.core.small_linalg import fused_matmul, inverse_and_determinant, null_vector, solve
from wholearm_jax.core.status import Status
from wholearm_jax.core.validation import require_positive, require_x64
