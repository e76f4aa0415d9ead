"""Programs: functions compiled once for every size of their arguments, and kept between processes where wanted.

JAX's own cache of compiled programs spares compiling, but not tracing Python into a program, which takes as long again.
`keep_programs` names a folder where traced programs are kept too, exported by `jax.export`: a later process reads one
in
milliseconds, and finds what it compiles to in JAX's cache. A file's name is the digest of everything that decides what
the program is: the package's source, the versions of what it is written with, the function, its static arguments, and
the shapes of its arrays. What cannot be named so (a function that closes over objects) is traced anew in each process.

Python traces one program at a time, whatever the number of threads, but XLA compiles several: what will be wanted is
compiled `call_in_background`, as soon as the first program has been traced.
"""

import contextlib
import functools
import gc
import hashlib
import os
import pickle
import threading
import types
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.core
import numpy as np
from jax import export

from wholearm_jax.core.atomic_files import write_atomically

KEYED_PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "optax")
PLAIN_TYPES = (bool, int, float, str, type(None))
ARRAY_TYPES = (jax.Array, np.ndarray, np.generic)

_kept_folder: Path | None = None


def keep_programs(folder: Path | None) -> None:
    """Keep the programs of this process and of later ones in a folder; None: keep none."""
    global _kept_folder
    _kept_folder = folder


class Program:
    """A function compiled for every kind of its arguments: arrays are data, all else is a setting of the program.

    It does what `equinox.filter_jit` does, in a quarter of the time that this takes to call, and looks for what earlier
    processes have traced.
    """

    def __init__(self, function: Callable) -> None:
        functools.update_wrapper(self, function)
        self._function, self._name = function, function.__qualname__
        self._calls: dict[Any, Callable] = {}

    def __call__(self, *args):
        leaves, tree = jax.tree.flatten(args)
        arrays = [leaf for leaf in leaves if isinstance(leaf, ARRAY_TYPES)]
        settings = tuple([None if isinstance(leaf, ARRAY_TYPES) else (type(leaf), leaf) for leaf in leaves])
        within = is_transformed(arrays)  # another program
        folder = None if within else _kept_folder
        shapes = folder and tuple([(array.shape, array.dtype) for array in arrays])
        key = tree, settings, folder, shapes
        call = self._calls.get(key)
        if call is None:
            kept = self._kept(folder, arrays, tree, settings) if folder else None
            call = jax.jit(self._of_arrays(tree, settings))
            if not (within or kept):
                with _garbage_collection_paused():
                    call.trace(*arrays).lower()  # all that needs Python: calling it compiles it
            if not within:
                _start_queued()
            call = self._calls[key] = _compiled(*kept) if kept else call
        return call(*arrays)

    def sizes(self) -> int:
        """How many programs it has compiled, other than those read."""
        return sum(call._cache_size() for call in self._calls.values() if hasattr(call, "_cache_size"))

    def _of_arrays(self, tree, settings) -> Callable:
        """The function of its arrays alone."""

        def flat(*arrays):
            given = iter(arrays)
            leaves = [next(given) if setting is None else setting[1] for setting in settings]
            return self._function(*jax.tree.unflatten(tree, leaves))

        flat.__name__ = self._name
        return flat

    def _kept(self, folder: Path, arrays, tree, settings):
        """The kept program for arguments of one kind, lowered, and its result's structure: read, or traced and written.
        None where none can be named."""
        own = [_setting_key(setting[1]) for setting in settings if setting is not None]
        names = [self._function.__module__, self._name, str(tree), *own]
        shapes = str([(array.shape, array.dtype) for array in arrays])
        if any(name is None or " at 0x" in name for name in names):
            return None
        named = "\n".join([_environment_key(), shapes, *map(str, names)])
        path = folder / f"{self._name}-{hashlib.sha256(named.encode()).hexdigest()}"
        with contextlib.suppress(Exception):  # a file of any kind that cannot be read is written anew
            shape, program = pickle.loads(path.read_bytes())
            return _lowered(export.deserialize(program), shape)
        program, shape = self._exported(arrays, tree, settings)
        with contextlib.suppress(OSError):  # a folder that cannot be written to: nothing is kept
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, pickle.dumps((shape, bytes(program.serialize()))))
        return _lowered(program, shape)

    def _exported(self, arrays, tree, settings):
        """The exported program, and its result's shape with the number of its array in every leaf."""
        shape, function = None, self._of_arrays(tree, settings)

        def flat(*arrays):
            nonlocal shape
            found, structure = jax.tree.flatten(function(*arrays))
            shape = jax.tree.unflatten(structure, range(len(found)))
            return found

        flat.__name__ = self._name
        abstract = [jax.ShapeDtypeStruct(array.shape, array.dtype) for array in arrays]
        with _garbage_collection_paused():
            return export.export(jax.jit(flat))(*abstract), shape


@contextlib.contextmanager
def _garbage_collection_paused():
    """Without Python's collector of cycles, which would go through all that tracing has made so far again and again."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


class BackgroundCall:
    """A call that is made in a thread of its own, for the programs that it compiles: what it returns is dropped."""

    def __init__(self, function: Callable, args: tuple) -> None:
        self._calls, self._done = [(function, args)], Future()

    def make(self) -> None:
        """Make it here and now, unless it has begun elsewhere."""
        try:
            function, args = self._calls.pop()  # by one thread alone
        except IndexError:
            return
        try:
            function(*args)
            self._done.set_result(None)
        except BaseException as raised:  # told to who waits for it
            self._done.set_exception(raised)

    def failed(self) -> bool:
        """Whether it was made and raised."""
        return self._done.done() and self._done.exception() is not None

    def result(self) -> None:
        """Nothing, once it is made; raises what it raised."""
        self._done.result()


def call_in_background(function: Callable, *args) -> BackgroundCall:
    """Call a function in a thread of its own, once for every kind of arguments unless it raises: after what was put
    beside before, and as soon as the next program has been traced, or one waits for it."""
    leaves, tree = jax.tree.flatten(args)
    kind = [(leaf.shape, leaf.dtype) if isinstance(leaf, ARRAY_TYPES) else (type(leaf), leaf) for leaf in leaves]
    key = function, tree, tuple(kind)
    if key not in _background_calls or _background_calls[key].failed():
        _background_calls[key] = BackgroundCall(function, args)
        _queue.append(_background_calls[key])
    return _background_calls[key]


def wait_for(*several: BackgroundCall) -> None:
    """Wait for what was put beside; what has not begun by then is made here, the last first."""
    _start_queued()
    for one in reversed(several):
        one.make()
    for one in several:
        one.result()


def _start_queued() -> None:
    """Begin with what waits to be made."""
    with _queue_lock:
        while _queue:
            _thread().submit(_queue.pop(0).make)


_background_calls: dict[Any, BackgroundCall] = {}
_queue: list[BackgroundCall] = []
_queue_lock = threading.Lock()


@functools.cache
def _thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1)


def _lowered(program: export.Exported, shape):
    return jax.jit(program.call).lower(*program.in_avals), jax.tree.structure(shape)


def _compiled(lowered, structure) -> Callable:
    compiled = lowered.compile()  # ahead: `jit` would compile again where a constant's type is weak
    return lambda *arrays: jax.tree.unflatten(structure, compiled(*arrays))


def is_transformed(*trees) -> bool:
    """Whether arrays stand for numbers in a transformation, rather than holding them."""
    return any([isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees)])


def _setting_key(setting) -> str | None:
    """A text that says what a static argument is, the same in every process; None where there is none."""
    if isinstance(setting, PLAIN_TYPES):
        return repr(setting)
    if isinstance(setting, types.FunctionType):
        code, package = setting.__code__, setting.__module__.partition(".")[0]
        held = [cell.cell_contents for cell in setting.__closure__ or ()]
        held = [_setting_key(value) for value in (*held, *(setting.__defaults__ or ()))]
        unknown = None in held or package not in (__name__.partition(".")[0], *KEYED_PACKAGES)
        return None if unknown else f"{setting.__module__}.{setting.__qualname__}:{code.co_firstlineno}{held}"
    return None


@functools.cache
def _environment_key() -> str:
    """What else decides a program: the package's source, versions, devices, JAX's precision and XLA's flags."""
    source = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        source.update(path.read_bytes())
    versions = [version(name) for name in KEYED_PACKAGES]
    flags = jax.config.values["jax_enable_x64"], os.environ.get("XLA_FLAGS")
    return f"{source.hexdigest()} {versions} {jax.default_backend()} {flags}"
