"""Compilation in background threads.

Python traces one program at a time, whatever the number of threads, but XLA can compile several. A command queues calls
that compile the programs it will need later; the queue starts once the first program has been traced.
"""

import functools
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import numpy as np

WORKERS = 2
ARRAY_TYPES = (jax.Array, np.ndarray, np.generic)


class BackgroundTask:
    """A call made on a background thread for the programs that it compiles; its return value is dropped."""

    def __init__(self, function: Callable, args: tuple) -> None:
        self._calls, self._done = [(function, args)], Future()

    def run(self) -> None:
        """Run the call on this thread, unless it has begun on another."""
        try:
            function, args = self._calls.pop()  # atomic: exactly one thread gets it
        except IndexError:
            return
        try:
            function(*args)
            self._done.set_result(None)
        except BaseException as raised:  # raised again by `result`
            self._done.set_exception(raised)

    def failed(self) -> bool:
        """Say whether the call has raised."""
        return self._done.done() and self._done.exception() is not None

    def result(self) -> None:
        """Wait for the call, and raise the exception that it raised."""
        self._done.result()


def compile_in_background(function: Callable, *args) -> BackgroundTask:
    """Queue `function(*args)` for the background threads and return its task.

    The same function and argument shapes give the same task, unless it failed. The queue starts when the next program
    has been traced, or at `wait_for`.
    """
    leaves, tree = jax.tree.flatten(args)
    kinds = [(leaf.shape, leaf.dtype) if isinstance(leaf, ARRAY_TYPES) else (type(leaf), leaf) for leaf in leaves]
    key = function, tree, tuple(kinds)
    if key not in _tasks or _tasks[key].failed():
        _tasks[key] = BackgroundTask(function, args)
        _queue.append(_tasks[key])
    return _tasks[key]


def wait_for(*tasks: BackgroundTask) -> None:
    """Wait for tasks. Those that have not begun run on this thread, the last first."""
    start_queued()
    for task in reversed(tasks):
        task.run()
    for task in tasks:
        task.result()


def start_queued() -> None:
    """Hand the queued tasks to the background threads."""
    with _queue_lock:
        while _queue:
            _threads().submit(_queue.pop(0).run)


_tasks: dict[Any, BackgroundTask] = {}
_queue: list[BackgroundTask] = []
_queue_lock = threading.Lock()


@functools.cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(WORKERS)
