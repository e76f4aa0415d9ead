"""Configuration of JAX and XLA before they start, for the command line as for a script or a notebook."""

import os
from typing import Literal

import jax

FLAGS_ALWAYS = ("--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000",)
FLAGS_FOR_COMPILE_TIME = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_backend_optimization_level=1",
    "--xla_disable_hlo_passes=while-loop-invariant-code-motion",
)
# For a program whose loops make few, large steps, against FLAGS_ALWAYS: half the time to compile, half more to run.
LOOPS_AS_KERNELS = {"xla_backend_extra_options": ""}
MEASURED_JAX_VERSION = (0, 10)  # XLA refuses flags that it does not know, so other versions get none


def configure(*, optimise_for: Literal["compile_time", "run_time"] = "compile_time") -> None:
    """Enable float64, and set XLA's flags for a CPU. Call it before JAX computes anything.

    Every loop is compiled as one function instead of many small kernels, and programs run in the thread that calls
    them: a step of these simulations costs less than starting a kernel or handing a program over. What the environment
    already sets stays: `XLA_FLAGS`, `JAX_TRACEBACK_IN_LOCATIONS_LIMIT`, `JAX_CPU_ENABLE_ASYNC_DISPATCH`
    (`docs/performance.md`).

    Args:
        optimise_for: `"compile_time"`, for single scenes: XLA's older emitters, optimisation level 1, no source lines
            in programs. `"run_time"`: XLA's defaults, for `check` of hundreds of thousands of scenes.

    >>> wa.configure()
    """
    jax.config.update("jax_enable_x64", True)
    if jax.__version_info__[:2] != MEASURED_JAX_VERSION:
        return
    if "JAX_CPU_ENABLE_ASYNC_DISPATCH" not in os.environ:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
    for_compile_time = optimise_for == "compile_time"
    if for_compile_time and "JAX_TRACEBACK_IN_LOCATIONS_LIMIT" not in os.environ:
        jax.config.update("jax_traceback_in_locations_limit", 0)
    environment = os.environ.get("XLA_FLAGS", "")
    flags = (*FLAGS_ALWAYS, *(FLAGS_FOR_COMPILE_TIME if for_compile_time else ()))
    added = [flag for flag in flags if flag.partition("=")[0] not in environment]
    os.environ["XLA_FLAGS"] = " ".join([environment, *added]).strip()
