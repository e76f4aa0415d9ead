"""Stores of checks hold numbers alone: what another program left in its place is refused, and none of it is run."""

import json
from pathlib import Path

import numpy as np
import pytest
import zarr
from numcodecs import Pickle

from wholearm_jax.core.errors import StoreError
from wholearm_jax.files.check_store import TYPES, open_store, store_metadata
from wholearm_jax.files.polygons_npz import count_polygons

METADATA = store_metadata(4, 2)


class RunsCode:
    """An object that, unpickled, would write a file."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return Path.touch, (self.target,)


def test_a_store_of_pickles_is_not_opened(tmp_path):
    written, path = tmp_path / "written", tmp_path / "store"
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    group.attrs["identity"] = METADATA
    array = {"zarr_format": 2, "shape": [1], "chunks": [1], "dtype": "|O", "compressor": None, "fill_value": None}
    (path / "done").mkdir()
    (path / "done" / ".zarray").write_text(json.dumps(array | {"order": "C", "filters": [Pickle().get_config()]}))
    (path / "done" / "0").write_bytes(Pickle().encode(np.array([RunsCode(written)], object)))
    with pytest.raises(StoreError, match="exists and is not a store"):
        open_store(path, METADATA)
    assert not written.exists()


@pytest.mark.parametrize(("name", "kind"), [("done", "float64"), ("margin", "int64"), ("status", "uint8")])
def test_an_array_of_another_type_is_refused(name, kind, tmp_path):
    store = open_store(tmp_path / "store", METADATA)
    del store.group[name]
    store.group.create_array(name, shape=(4,), chunks=(2,), dtype=kind)
    again = open_store(tmp_path / "store", METADATA)
    with pytest.raises(StoreError, match=f"{name} is not an array of a check"):
        again.array(name)


def test_a_missing_array_is_refused(tmp_path):
    store = open_store(tmp_path / "store", METADATA)
    del store.group["margin"]
    with pytest.raises(StoreError, match="margin is not an array of a check"):
        open_store(tmp_path / "store", METADATA).read(0)


def test_what_a_store_holds_is_numbers(tmp_path):
    open_store(tmp_path / "store", METADATA, torques=3)
    kinds = {json.loads(p.read_text()).get("data_type") for p in (tmp_path / "store").rglob("zarr.json")}
    assert kinds == {None, "uint8", *TYPES.values()}


def test_polygons_that_are_pickled_are_not_read(tmp_path):
    written, path = tmp_path / "written", tmp_path / "polygons.npz"
    np.savez(path, vertices=np.array([RunsCode(written)], object))
    assert count_polygons(path) == 0
    assert not written.exists()
