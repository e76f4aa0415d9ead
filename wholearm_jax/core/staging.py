"""Functions of the host within JAX's transformations: what they are given must be numbers, and is computed at once."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.core
import numpy as np

from wholearm_jax.core.arrays import is_traced

Function = TypeVar("Function", bound=Callable[..., Any])


def is_staged() -> bool:
    """Say whether operations on numbers are recorded into a program, as within `jit`, instead of computed."""
    return isinstance(jax.device_put(np.zeros(())), jax.core.Tracer)


def computed_at_once(function: Function) -> Function:
    """Compute a function of numbers at once also where a program is being recorded, as within `jit`."""

    @functools.wraps(function)
    def compute(*args, **kwargs):
        if not is_staged():
            return function(*args, **kwargs)
        with jax.ensure_compile_time_eval():
            return function(*args, **kwargs)

    return compute  # pyright: ignore[reportReturnType]


def on_host(instead: str) -> Callable[[Function], Function]:
    """Make a function that decides on the host usable within transformations, as long as it is given numbers.

    Args:
        instead: What to do where an argument is being transformed: the error says so.
    """

    def decorate(function: Function) -> Function:
        compute = computed_at_once(function)

        @functools.wraps(function)
        def check(*args, **kwargs):
            if is_traced(args, kwargs):
                name = function.__name__
                raise TypeError(
                    f"{name} decides on the host and cannot be transformed by JAX (jit, grad, vmap): {instead}"
                )
            return compute(*args, **kwargs)

        return check  # pyright: ignore[reportReturnType]

    return decorate
