"""Tasks on background threads: once for each kind of arguments, after the next traced program, never lost."""

import threading

import jax.numpy as jnp
import numpy as np
import pytest

from wholearm_jax.core import background_compile
from wholearm_jax.core.program_cache import CachedJit


def trace_a_program():
    CachedJit(lambda x: x + 1)(np.ones(3))


@pytest.fixture
def no_tasks(monkeypatch):
    monkeypatch.setattr(background_compile, "_tasks", {})


@pytest.mark.usefixtures("no_tasks")
def test_tasks_run_once_for_each_kind_of_arguments_after_the_next_program_is_traced():
    called, all_made = [], threading.Event()

    def note(number, array):
        called.append((number, array.shape, threading.current_thread()))
        if len(called) == 3:
            all_made.set()

    calls = [
        background_compile.compile_in_background(note, number, jnp.zeros(size))
        for number, size in ((1, 2), (2, 2), (1, 2), (1, 3))
    ]
    assert calls[0] is calls[2]
    assert not called
    trace_a_program()
    assert all_made.wait(60)
    background_compile.wait_for(*calls)
    assert sorted((number, shape) for number, shape, _ in called) == [(1, (2,)), (1, (3,)), (2, (2,))]
    assert all(thread is not threading.current_thread() for *_, thread in called)


@pytest.mark.usefixtures("no_tasks")
def test_waiting_runs_tasks_that_have_not_begun():
    all_began, last_made, threads = threading.Barrier(background_compile.WORKERS + 1), threading.Event(), []

    def keep_busy(_):
        all_began.wait(60)
        assert last_made.wait(60)

    def last():
        threads.append(threading.current_thread())
        last_made.set()

    busy = [background_compile.compile_in_background(keep_busy, k) for k in range(background_compile.WORKERS)]
    calls = *busy, background_compile.compile_in_background(last)
    trace_a_program()
    all_began.wait(60)
    assert not last_made.is_set()
    background_compile.wait_for(*calls)
    assert threads == [threading.current_thread()]


@pytest.mark.usefixtures("no_tasks")
def test_waiting_raises_the_exception_of_a_task_which_may_be_tried_again():
    tries = []

    def interrupted():
        tries.append(1)
        if len(tries) == 1:
            raise KeyboardInterrupt("by who waits for it")

    with pytest.raises(KeyboardInterrupt, match="who waits"):
        background_compile.wait_for(background_compile.compile_in_background(interrupted))
    background_compile.wait_for(background_compile.compile_in_background(interrupted))
    background_compile.wait_for(background_compile.compile_in_background(interrupted))
    assert len(tries) == 2
