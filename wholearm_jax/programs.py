"""Programs: functions compiled once for every size of their arguments, and kept between processes where wanted.

JAX's own cache of compiled programs spares compiling, but not tracing Python into a program, which takes as long again.
`keep` names a folder where traced programs are kept too, exported by `jax.export`: a later process reads one in
milliseconds, and finds what it compiles to in JAX's cache. A file's name is the digest of everything that decides what
the program is: the package's source, the versions of what it is written with, the function, its static arguments, and
the shapes of its arrays. What cannot be named so (a function that closes over objects) is traced anew in each process.
"""

import contextlib
import functools
import hashlib
import os
import pickle
import types
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.core
import numpy as np
from jax import export

from wholearm_jax.writing import write_whole

WRITTEN_WITH = ("jax", "jaxlib", "diffrax", "equinox", "optax")
PLAIN = (bool, int, float, str, type(None))

_folder: Path | None = None


def keep(folder: Path | None) -> None:
    """Keep the programs of this process and of later ones in a folder; None: keep none."""
    global _folder
    _folder = folder


class Program:
    """`equinox.filter_jit` of a function, which also looks for what earlier processes have traced."""

    def __init__(self, function: Callable) -> None:
        functools.update_wrapper(self, function)
        self.plain = eqx.filter_jit(function)
        self._function, self._name = function, function.__qualname__
        self._found: dict[Any, Callable | None] = {}

    def __call__(self, *args):
        if _folder is None:
            return self.plain(*args)
        arrays, static = eqx.partition(args, _is_array)
        leaves, tree = jax.tree.flatten(arrays)
        if transformed(leaves):
            return self.plain(*args)
        settings = jax.tree.leaves(static)
        shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in leaves)
        key = tree, shapes, tuple((type(setting), setting) for setting in settings)
        if key not in self._found:
            self._found[key] = self._load(_folder, static, leaves, tree, settings)
        found = self._found[key]
        return self.plain(*args) if found is None else found(*leaves)

    def _load(self, folder: Path, static, leaves, tree, settings) -> Callable | None:
        """The kept program for arguments of one kind: read, or traced and written; None where none can be named."""
        names = [self._function.__module__, self._name, str(tree), *map(_identity, settings)]
        shapes = str([(leaf.shape, leaf.dtype) for leaf in leaves])
        if any(name is None or " at 0x" in name for name in names):
            return None
        named = "\n".join([_surroundings(), shapes, *map(str, names)])
        path = folder / f"{self._name}-{hashlib.sha256(named.encode()).hexdigest()}"
        with contextlib.suppress(Exception):  # a file of any kind that cannot be read is written anew
            shape, program = pickle.loads(path.read_bytes())
            return _callable(export.deserialize(program), shape)
        program, shape = self._trace(static, leaves, tree)
        with contextlib.suppress(OSError):  # a folder that cannot be written to: nothing is kept
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, pickle.dumps((shape, bytes(program.serialize()))))
        return _callable(program, shape)

    def _trace(self, static, leaves, tree):
        """The exported program, and its result's shape with the number of its array in every leaf."""
        shape = None

        def flat(*leaves):
            nonlocal shape
            result = self._function(*eqx.combine(jax.tree.unflatten(tree, leaves), static))
            found, structure = jax.tree.flatten(result)
            shape = jax.tree.unflatten(structure, range(len(found)))
            return found

        flat.__name__ = self._name
        abstract = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
        return export.export(jax.jit(flat))(*abstract), shape


def _callable(program: export.Exported, shape) -> Callable:
    # Compiled ahead: `jit` would compile again where a constant's type is weak.
    compiled = jax.jit(program.call).lower(*program.in_avals).compile()
    return lambda *leaves: jax.tree.map(compiled(*leaves).__getitem__, shape)


def transformed(*trees) -> bool:
    """Whether arrays stand for numbers in a transformation, rather than holding them."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def _is_array(leaf) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


def _identity(setting) -> str | None:
    """A text that says what a static argument is, the same in every process; None where there is none."""
    if isinstance(setting, PLAIN):
        return repr(setting)
    if isinstance(setting, types.FunctionType):
        code, package = setting.__code__, setting.__module__.partition(".")[0]
        held = [cell.cell_contents for cell in setting.__closure__ or ()]
        held = [_identity(value) for value in (*held, *(setting.__defaults__ or ()))]
        unknown = None in held or package not in (__package__, *WRITTEN_WITH)
        return None if unknown else f"{setting.__module__}.{setting.__qualname__}:{code.co_firstlineno}{held}"
    return None


@functools.cache
def _surroundings() -> str:
    """What else decides a program: the package's source, versions, devices, JAX's precision and XLA's flags."""
    source = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        source.update(path.read_bytes())
    versions = [version(name) for name in WRITTEN_WITH]
    flags = jax.config.values["jax_enable_x64"], os.environ.get("XLA_FLAGS")
    return f"{source.hexdigest()} {versions} {jax.default_backend()} {flags}"
