"""Settings: what JAX and XLA are told before they start, by the command line as by a script or a notebook."""

import os
from typing import Literal

import jax

FLAGS_ALWAYS = ("--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000",)
FLAGS_FOR_COMPILE_TIME = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_backend_optimization_level=1",
    "--xla_disable_hlo_passes=while-loop-invariant-code-motion",
)
MEASURED_JAX_VERSION = (
    0,
    10,
)  # XLA refuses flags that it does not know: these are for the version of JAX that was measured


def configure(*, compiled: Literal["quickly", "well"] = "quickly") -> None:
    """Set JAX to 64 bits, and tell XLA how to compile for a CPU. Call it before JAX computes anything.

    Every loop becomes one function: by default XLA runs a loop of such small steps as a sequence of kernels, each of
    which costs more to start than it computes. A margin takes 0.75 of the time then, its gradient 0.2 to 0.3. Compiled
    `"quickly"`, as suits single scenes, kernels come from XLA's older emitters and are optimised little, and programs
    do not carry the lines of Python that a profiler would show: half of the compile time. Compiled `"well"`, as suits
    `check`, very many scenes run faster by an eighth. Programs run in the thread that calls them: handing each to
    another costs more than it overlaps (a motion takes 0.66 of the time). What the environment says already stays as
    it is: `XLA_FLAGS`, `JAX_TRACEBACK_IN_LOCATIONS_LIMIT`, `JAX_CPU_ENABLE_ASYNC_DISPATCH`.

    >>> wa.configure()
    """
    jax.config.update("jax_enable_x64", True)
    if jax.__version_info__[:2] != MEASURED_JAX_VERSION:
        return
    if "JAX_CPU_ENABLE_ASYNC_DISPATCH" not in os.environ:
        jax.config.update("jax_cpu_enable_async_dispatch", False)
    given = os.environ.get("XLA_FLAGS", "")
    quickly = compiled == "quickly"
    if quickly and "JAX_TRACEBACK_IN_LOCATIONS_LIMIT" not in os.environ:
        jax.config.update("jax_traceback_in_locations_limit", 0)
    wanted = (*FLAGS_ALWAYS, *(FLAGS_FOR_COMPILE_TIME if quickly else ()))
    added = [flag for flag in wanted if flag.partition("=")[0] not in given]
    os.environ["XLA_FLAGS"] = " ".join([given, *added]).strip()
