"""Compiled functions, one program for each kind of arguments, kept between processes in a folder if one is given.

JAX's own compilation cache saves compiling, but not tracing Python into a program, which takes as long again.
`enable_program_cache` names a folder for traced programs, exported by `jax.export`: a later process reads one in
milliseconds and finds its compiled form in JAX's cache. A file's name is the digest of everything that decides the
program: the package's source, the versions of its dependencies, the function, its static arguments and the shapes of
its arrays. A function that closes over objects without a stable name is traced anew in each process.

A file is a header, JSON and the bytes of `jax.export`: reading it runs no code. A file that is damaged, or not the one
that its name stands for, is ignored and written anew.
"""

import contextlib
import enum
import functools
import gc
import hashlib
import json
import os
import threading
import types
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jax import export

from wholearm_jax.core.arrays import is_traced
from wholearm_jax.core.atomic_files import write_atomically
from wholearm_jax.core.background_compile import ARRAY_TYPES, start_queued
from wholearm_jax.core.result_structure import PLAIN_TYPES, build_structure, describe_structure

PACKAGE_ROOT = Path(__file__).parents[1]
PACKAGE_NAME = __name__.partition(".")[0]
KEYED_PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "optax")
FILE_HEADER = b"wholearm_jax program, format 1"

DATA_TYPES = (*ARRAY_TYPES, jax.ShapeDtypeStruct)  # arguments that are data, or stand for it

_folder: Path | None = None


def enable_program_cache(folder: Path | None) -> None:
    """Keep traced programs in a folder, from this process and for later ones; None: keep none."""
    global _folder
    _folder = folder


class CachedJit:
    """A function compiled once for every kind of arguments: arrays are data, all other leaves are settings.

    It does what `equinox.filter_jit` does, with a quarter of its overhead for each call, and looks in the folder of
    `enable_program_cache` for programs that earlier processes have traced. `compiler_options` are XLA's, for programs
    that are compiled on their own.
    """

    def __init__(self, function: Callable, *, compiler_options: dict[str, Any] | None = None) -> None:
        functools.update_wrapper(self, function)
        self._function, self._name = function, function.__qualname__
        self._compiler_options = compiler_options
        self._programs: dict[Any, Callable] = {}
        self._embedded: dict[Any, Callable] = {}
        self._locks: dict[Any, threading.Lock] = {}

    def __call__(self, *args):
        arrays, tree, settings = _separate(args)
        traced = is_traced(arrays)  # this call is a part of another program
        folder = None if traced else _folder
        shapes = folder and tuple([(array.shape, array.dtype) for array in arrays])
        key = tree, settings, folder, shapes
        program = self._programs.get(key)
        if program is None:
            with self._locks.setdefault(key, threading.Lock()):  # another thread may be compiling it
                program = self._programs.get(key)
                if program is None:
                    program = self._build(arrays, tree, settings, folder, traced)
                    results = program(*arrays)  # compiles, unless it is from the folder
                    self._programs[key] = program
                    return results
        return program(*arrays)

    def embedded(self, *args) -> Callable:
        """Return the function as a part of another program, for arguments like these (shapes alone serve, too).

        Where programs are kept it is not traced again but comes from the folder, and then it has no derivatives.
        """
        arrays, tree, settings = _separate(args)
        key = tree, settings, _folder, tuple([(array.shape, array.dtype) for array in arrays])
        with self._locks.setdefault(key, threading.Lock()):
            if key not in self._embedded:
                kept = self._read_or_export(_folder, arrays, tree, settings) if _folder else None
                self._embedded[key] = _call_within(*kept) if kept else self
        return self._embedded[key]

    def _build(self, arrays, tree, settings, folder, traced: bool) -> Callable:
        """Return the program for such arguments, compiled where it comes from a folder."""
        kept = self._read_or_export(folder, arrays, tree, settings) if folder else None
        if kept:
            program, structure = kept
            lowered = jax.jit(program.call).lower(*program.in_avals)
            start_queued()
            return _compile(lowered, structure, self._compiler_options)
        if traced:
            return jax.jit(self._of_arrays(tree, settings))
        program = jax.jit(self._of_arrays(tree, settings), compiler_options=self._compiler_options)
        with _garbage_collection_paused():
            program.trace(*arrays).lower()  # all that needs Python; the first call compiles it
        start_queued()
        return program

    def compiled_count(self) -> int:
        """Return the number of programs that it has compiled, without those read from files."""
        return sum(call._cache_size() for call in self._programs.values() if hasattr(call, "_cache_size"))

    def _of_arrays(self, tree, settings) -> Callable:
        """Return the function of its arrays alone."""

        def flat(*arrays):
            remaining = iter(arrays)
            leaves = [next(remaining) if setting is None else setting[1] for setting in settings]
            return self._function(*jax.tree.unflatten(tree, leaves))

        flat.__name__ = self._name
        return flat

    def _read_or_export(self, folder: Path, arrays, tree, settings):
        """Return the program and its result's structure, read from its file or exported and written to it.

        None where the program has no name, or its result no description.
        """
        name = self._file_name(arrays, tree, settings)
        if name is None:
            return None
        path = folder / name
        with contextlib.suppress(Exception):  # a file that cannot be read is written anew
            return _read_program(path)
        program, structure = self._exported(arrays, tree, settings)
        description = describe_structure(structure)
        if description is None:
            return None
        with contextlib.suppress(OSError):  # a folder that cannot be written to keeps nothing
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_program(path, program, description)
        return program, structure

    def _file_name(self, arrays, tree, settings) -> str | None:
        """Return the name of the file of a program; None where a setting has no stable name."""
        own = [_setting_key(setting[1]) for setting in settings if setting is not None]
        names = [self._function.__module__, self._name, str(tree), *own]
        shapes = str([(array.shape, array.dtype) for array in arrays])
        if any(name is None or " at 0x" in name for name in names):
            return None
        key = "\n".join([_environment_key(), shapes, *map(str, names)])
        return f"{self._name}-{hashlib.sha256(key.encode()).hexdigest()}"

    def _exported(self, arrays, tree, settings):
        """Export the program; return it and the structure of its result."""
        structure, function = None, self._of_arrays(tree, settings)

        def flat(*arrays):
            nonlocal structure
            results, structure = jax.tree.flatten(function(*arrays))
            return results

        flat.__name__ = self._name
        abstract = [jax.ShapeDtypeStruct(array.shape, array.dtype) for array in arrays]
        with _garbage_collection_paused():
            return export.export(jax.jit(flat))(*abstract), structure


def _write_program(path: Path, program: export.Exported, description) -> None:
    """Write a program: header, the file's name, a digest of the rest; its result's description; its bytes."""
    content = json.dumps(description).encode() + b"\n" + bytes(program.serialize())
    digest = hashlib.sha256(content).hexdigest()
    write_atomically(path, b"\n".join([FILE_HEADER, path.name.encode(), digest.encode(), content]))


def _read_program(path: Path):
    """Read a program and its result's structure. Raises an exception for any file but what was written there."""
    header, name, digest, content = path.read_bytes().split(b"\n", 3)
    if header != FILE_HEADER or name.decode() != path.name:
        raise ValueError("another file")
    if digest.decode() != hashlib.sha256(content).hexdigest():
        raise ValueError("a damaged file")
    description, _, program = content.partition(b"\n")
    return export.deserialize(bytearray(program)), build_structure(json.loads(description))


def _separate(args) -> tuple[list, Any, tuple]:
    """Return the arrays among arguments, their structure, and all other leaves with their types."""
    leaves, tree = jax.tree.flatten(args)
    arrays = [leaf for leaf in leaves if isinstance(leaf, DATA_TYPES)]
    return arrays, tree, tuple([None if isinstance(leaf, DATA_TYPES) else (type(leaf), leaf) for leaf in leaves])


def _call_within(program: export.Exported, structure) -> Callable:
    return lambda *args: jax.tree.unflatten(structure, program.call(*_separate(args)[0]))


def _compile(lowered, structure, compiler_options) -> Callable:
    # Ahead of time: `jit` would compile again where a constant's type is weak.
    compiled = lowered.compile(compiler_options=compiler_options)
    return lambda *arrays: jax.tree.unflatten(structure, compiled(*arrays))


@contextlib.contextmanager
def _garbage_collection_paused():
    """Pause the collector of cycles, which would go through all objects that tracing has made again and again."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


def _setting_key(setting) -> str | None:
    """Return a text that identifies a static argument in every process; None where there is none."""
    if isinstance(setting, enum.Enum):
        return f"{type(setting).__module__}.{type(setting).__qualname__}.{setting.name}"
    if isinstance(setting, PLAIN_TYPES):
        return repr(setting)
    if isinstance(setting, types.FunctionType):
        code, package = setting.__code__, setting.__module__.partition(".")[0]
        closure = [cell.cell_contents for cell in setting.__closure__ or ()]
        keys = [_setting_key(value) for value in (*closure, *(setting.__defaults__ or ()))]
        unknown = None in keys or package not in (PACKAGE_NAME, *KEYED_PACKAGES)
        return None if unknown else f"{setting.__module__}.{setting.__qualname__}:{code.co_firstlineno}{keys}"
    return None


@functools.cache
def _environment_key() -> str:
    """Return the rest of what decides a program: the package's source, versions, backend, precision and XLA's flags."""
    versions = [version(name) for name in KEYED_PACKAGES]
    flags = jax.config.values["jax_enable_x64"], os.environ.get("XLA_FLAGS")
    return f"{_source_digest(PACKAGE_ROOT)} {versions} {jax.default_backend()} {flags}"


def _source_digest(root: Path) -> str:
    """Return a digest of every Python file below a folder, names and contents."""
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode() + path.read_bytes())
    return digest.hexdigest()
