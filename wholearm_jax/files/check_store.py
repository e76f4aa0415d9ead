"""Results of checks in a Zarr (version 3) store, one chunk of scenes after the other.

A chunk of every array is one file, written whole by one process; the chunk's entry in `done` is written last. A process
that is stopped, at any moment, leaves a store that can be read; opened again, it continues with the chunks that are not
done. The store is identified (`store_metadata`): another scene, schedule, seed, setting or version is refused.
Arrays hold numbers alone, and a store of another format is not opened: reading one runs no code.
"""

import hashlib
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
import zarr
from zarr.errors import GroupNotFoundError

from wholearm_jax.core import StoreError
from wholearm_jax.ensembles import BatchResult

KIND = "wholearm_jax check"
# Status, contact and phase numbers are small; -1 marks "none".
TYPES = {"status": "int8", "margin": "float64", "time": "float64", "contact": "int8", "phase": "int8", "end": "float64"}
OTHER_TYPES = {"torque": "float64", "done": "uint8"}


def fingerprint(*trees: Any) -> str:
    """Return a digest of every number, name and structure in pytrees."""
    digest = hashlib.sha256()
    for tree in trees:
        leaves, structure = jax.tree.flatten(tree)
        digest.update(str(structure).encode())
        for leaf in leaves:
            array = np.asarray(leaf)
            digest.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


class Store:
    """Results of `count` scenes in chunks of `chunk`; with `torques`, a schedule of that many rows a scene."""

    def __init__(self, path: Path, group: zarr.Group, count: int, chunk: int):
        self.path, self.group, self.count, self.chunk = path, group, count, chunk

    @property
    def chunks(self) -> int:
        """The number of chunks."""
        return -(-self.count // self.chunk)

    def done(self) -> np.ndarray:
        """Return which chunks are complete."""
        return np.asarray(self.array("done")[:]).astype(bool)

    def array(self, name: str) -> zarr.Array:
        """Return one of the arrays, on disk. Raises `StoreError` for one that does not hold its type of numbers."""
        array = self.group.get(name)
        if not isinstance(array, zarr.Array) or str(array.dtype) != (TYPES | OTHER_TYPES)[name]:
            raise StoreError(f"{self.path}: {name} is not an array of a check")
        return array

    def rows(self, number: int) -> slice:
        """Return the rows of a chunk."""
        return slice(number * self.chunk, min(self.count, (number + 1) * self.chunk))

    def write(self, number: int, values: Mapping[str, np.ndarray]) -> None:
        """Write a chunk of every array, then mark it as done."""
        try:
            for name, column in values.items():
                array = self.array(name)
                array[self.rows(number)] = np.asarray(column).astype(array.dtype)
            self.array("done")[number] = 1
        except OSError as error:
            raise StoreError(f"{self.path}: cannot be written: {error.strerror or error}") from None

    def read(self, number: int) -> BatchResult:
        """Return a chunk's results."""
        return BatchResult(*(np.asarray(self.array(name)[self.rows(number)]) for name in BatchResult._fields))


def store_metadata(count: int, chunk: int, **settings: Any) -> dict[str, Any]:
    """Return what identifies a store: its scenes, settings and the package's version, as JSON can hold them."""
    whole = {"kind": KIND, "version": version("wholearm_jax"), "jax": version("jax"), "count": count, "chunk": chunk}
    return json.loads(json.dumps(whole | settings))


def open_store(path: Path, metadata: Mapping[str, Any], torques: int = 0) -> Store:
    """Open a store to continue, or make it. Raises `StoreError` for a path that holds something else."""
    if path.exists() and not path.is_dir():
        raise StoreError(f"{path}: exists and is not a store")
    try:
        group = zarr.open_group(str(path), mode="r+", zarr_format=3)
    except (FileNotFoundError, GroupNotFoundError):
        return _create_store(path, metadata, torques)
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: not a store: {error}") from None
    stored = dict(group.attrs).get("identity")
    if stored is None and not group.attrs and {*group.keys()} <= {*TYPES, *OTHER_TYPES}:
        return _create_store(path, metadata, torques, again=True)
    if not isinstance(stored, Mapping) or stored.get("kind") != KIND:
        raise StoreError(f"{path}: holds something else than a check")
    other = sorted(key for key in {*stored, *metadata} if stored.get(key) != metadata.get(key))
    if other:
        raise StoreError(f"{path}: is of another {', '.join(other)}; give another --out, or the same command")
    return Store(path, group, int(metadata["count"]), int(metadata["chunk"]))


def _create_store(path: Path, metadata: Mapping[str, Any], torques: int, again: bool = False) -> Store:
    """Make a store. Its metadata is written last, so that a store that was left half made is made `again`."""
    if not again and path.exists() and (not path.is_dir() or any(p.suffix != ".partial" for p in path.iterdir())):
        raise StoreError(f"{path}: exists and is not a store")
    count, chunk = int(metadata["count"]), int(metadata["chunk"])
    try:
        group = zarr.create_group(str(path), overwrite=True)
        for name, kind in TYPES.items():
            fill = np.nan if kind == "float64" else -1
            _add_array(group, name, kind, fill, (count, 5) if name == "end" else (count,), chunk)
        if torques:
            _add_array(group, "torque", "float64", np.nan, (count, torques, 3), chunk)
        _add_array(group, "done", "uint8", 0, (-(-count // chunk),), 1)
        group.attrs["identity"] = dict(metadata)
    except OSError as error:
        raise StoreError(f"{path}: cannot be written: {error.strerror or error}") from None
    return Store(path, group, count, chunk)


def _add_array(group: zarr.Group, name: str, kind: str, fill, shape: tuple[int, ...], chunk: int) -> None:
    """Add an array, cut into chunks along its first axis."""
    chunks = (min(chunk, shape[0]), *shape[1:])
    group.create_array(name, shape=shape, chunks=chunks, dtype=kind, fill_value=fill)
