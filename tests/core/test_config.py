"""What XLA is told: every loop compiled as one function, whatever a user has set left alone."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import wholearm_jax as wa
from wholearm_jax.core import config
from wholearm_jax.optimisation.lq_problem import LQStages, ParametricLQ, stage_layout
from wholearm_jax.optimisation.riccati import _backward_pass

LOOKING = """
import jax
import wholearm_jax as wa

wa.configure()
ones = jax.numpy.ones((2000, 2000))
long = jax.jit(lambda a: a @ a).lower(ones).compile()
print("here" if long(ones).is_ready() else "handed over")
"""


@pytest.fixture(autouse=True)
def _jax_has_begun():
    """What these tests write to the environment comes too late for this process."""
    jax.devices()
    names = "jax_traceback_in_locations_limit", "jax_cpu_enable_async_dispatch"
    before = {name: jax.config.values[name] for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_a_loop_is_one_function():
    def go(x):
        return jax.lax.fori_loop(0, 100, lambda _, x: jnp.sin(x), x)

    assert "xla_cpu_small_call" in jax.jit(go).lower(jnp.ones(1000)).compile().as_text()


def test_the_recursion_over_knots_is_one_function():
    """Calls of libraries, as for products of matrices, would keep the loop about them in pieces."""
    at = stage_layout(1, 9)
    stages = LQStages(*(jnp.ones((1, 8, rows, at.size + 2)) for rows in (at.size + 2, 4, 2)))
    quadratic = ParametricLQ(*(jnp.ones(()) for _ in ParametricLQ._fields))
    text = jax.jit(lambda stages: _backward_pass(at, stages, quadratic)).lower(stages).compile().as_text()
    assert text.count(" while(") == text.count('xla_cpu_small_call="true"') > 0


@pytest.mark.parametrize(
    ("optimise_for", "given", "left"),
    [
        ("compile_time", "", [*config.FLAGS_ALWAYS, *config.FLAGS_FOR_COMPILE_TIME]),
        ("run_time", "", [*config.FLAGS_ALWAYS]),
        ("run_time", "--xla_dump_to=here", ["--xla_dump_to=here", *config.FLAGS_ALWAYS]),
        (
            "compile_time",
            "--xla_cpu_use_fusion_emitters=true --xla_backend_extra_options=one=2",
            [
                "--xla_cpu_use_fusion_emitters=true",
                "--xla_backend_extra_options=one=2",
                *config.FLAGS_FOR_COMPILE_TIME[1:],
            ],
        ),
    ],
)
def test_what_a_user_has_set_stays(monkeypatch, optimise_for, given, left):
    monkeypatch.setenv("XLA_FLAGS", given)
    wa.configure(optimise_for=optimise_for)
    assert os.environ["XLA_FLAGS"].split() == left
    wa.configure(optimise_for=optimise_for)
    assert os.environ["XLA_FLAGS"].split() == left


@pytest.mark.parametrize(
    ("optimise_for", "given", "carried"),
    [("compile_time", None, False), ("compile_time", "3", True), ("run_time", None, True)],
)
def test_programs_carry_lines_of_python_where_they_are_wanted(monkeypatch, optimise_for, given, carried):
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.delenv("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", raising=False)
    jax.config.update("jax_traceback_in_locations_limit", 3)  # as JAX reads it from its environment when imported
    if given:
        monkeypatch.setenv("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", given)
    wa.configure(optimise_for=optimise_for)
    traced = jax.jit(lambda x: jnp.sin(x) + 1.0).lower(1.0)
    assert (Path(__file__).name in traced.as_text(debug_info=True)) == carried


@pytest.mark.parametrize(("given", "handed_over"), [(None, False), ("true", True)])
def test_programs_run_in_the_thread_that_calls_them(given, handed_over):
    """As told to the client, which a new process makes once `configure` has spoken."""
    told = {name: value for name, value in os.environ.items() if name != "JAX_CPU_ENABLE_ASYNC_DISPATCH"}
    if given:
        told["JAX_CPU_ENABLE_ASYNC_DISPATCH"] = given
    looking = subprocess.run([sys.executable, "-c", LOOKING], env=told, capture_output=True, text=True, check=True)
    assert (looking.stdout.strip() == "handed over") == handed_over


def test_another_version_of_jax_is_told_nothing(monkeypatch):
    """XLA refuses flags that it does not know."""
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(jax, "__version_info__", (0, 99, 0))
    wa.configure()
    assert os.environ["XLA_FLAGS"] == ""
    assert jnp.zeros(()).dtype == jnp.float64
