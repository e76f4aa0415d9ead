"""`wholearm check` as users run it: killed at any moment, by several processes, on a full disk."""

import errno
import os
import random
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from support import layered_file

from wholearm_jax.core.errors import StoreError
from wholearm_jax.ensembles.scene_check import BatchResult
from wholearm_jax.files.check_store import TYPES, open_store, store_metadata

zarr = pytest.importorskip("zarr")
COUNT, CHUNK, KILLS = 12, 1, 2


@pytest.fixture(scope="module")
def command():
    """The command as a list that lacks only where its store goes."""
    torque = Path(__file__).parents[1] / "data" / "heptagon_torque.csv"
    varied = ["--vary", "vertices=0.0002", "--vary", "friction=10%", "--count", str(COUNT), "--chunk", str(CHUNK)]
    settings = ["--seed", "3", "--arrival", "0.02"]
    run = "from wholearm_jax.cli.app import main; main()"
    return [
        sys.executable,
        "-c",
        run,
        "check",
        str(layered_file("heptagon")),
        "--torque",
        str(torque),
        *varied,
        *settings,
    ]


def start(command, store: Path, *more: str, devices: int = 1) -> subprocess.Popen:
    """Begin the command in a process of its own, which keeps its programs where the tests keep theirs."""
    told = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    folder = Path(jax.config.values["jax_compilation_cache_dir"])
    kept = {"XDG_CACHE_HOME": str(folder.parent if folder.name == "wholearm_jax" else folder)}
    environment = {**told, "MPLBACKEND": "agg", **kept, "JAX_NUM_CPU_DEVICES": str(devices)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "env": environment}
    return subprocess.Popen([*command, "--out", str(store), *more], **pipes)


def finish(process: subprocess.Popen) -> str:
    """Wait for success; what it said."""
    said, _ = process.communicate(timeout=900)
    assert process.returncode == 0, said
    return said


def contents(path: Path) -> dict[str, bytes]:
    """Every array of a store."""
    group = zarr.open_group(str(path), mode="r")
    return {name: np.asarray(group[name][:]).tobytes() for name in [*TYPES, "done"]}


def done(path: Path) -> int:
    """How many chunks of a store are."""
    return int(np.frombuffer(contents(path)["done"], "uint8").sum())


@pytest.fixture(scope="module")
def whole(command, tmp_path_factory):
    """What an uninterrupted process leaves."""
    path = tmp_path_factory.mktemp("whole") / "whole.zarr"
    said = finish(start(command, path))
    assert f"of {COUNT} hold" in said
    assert path.with_suffix(".json").exists()
    return contents(path)


def test_killed_at_any_moment_it_goes_on_to_the_same_store(command, whole, tmp_path):
    """First as soon as something is there to go on with, then at random."""
    path, moments, left = tmp_path / "killed.zarr", random.Random(1), []
    for kill in range(KILLS):
        process = start(command, path)
        until = path / "done" / "zarr.json"
        while process.poll() is None and not (until.exists() and (kill or done(path))):
            time.sleep(0.01)
        time.sleep(moments.uniform(0.0, 4.0) if kill else 0.0)
        process.kill()
        process.communicate()
        left.append(done(path))  # it can always be read
    assert 0 < left[0] < COUNT
    assert left == sorted(left), "what was done stays done"
    finish(start(command, path))
    assert contents(path) == whole


@pytest.mark.slow
def test_two_devices_find_what_one_does(command, whole, tmp_path):
    """Another program, that rounds differently: but for the last digits."""
    path = tmp_path / "two.zarr"
    finish(start(command, path, devices=2))
    for name, values in contents(path).items():
        kind = np.asarray(zarr.open_group(str(path), mode="r")[name][:]).dtype
        both = (np.frombuffer(each, kind) for each in (values, whole[name]))
        np.testing.assert_allclose(*both, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("number", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_several_processes_leave_what_one_does(command, whole, tmp_path, number):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    path = tmp_path / "several.zarr"
    joined = ["--coordinator", address, "--processes", str(number), "--process"]
    running = [start(command, path, *joined, str(k)) for k in range(number)]
    first, *others = [finish(process) for process in running]
    assert f"of {COUNT} hold" in first
    assert all("hold" not in said for said in others)
    assert contents(path) == whole


def test_a_full_disk_is_an_error_and_what_is_there_stays(tmp_path, monkeypatch):
    wanted = store_metadata(4, 2, seed=1)
    store = open_store(tmp_path / "full.zarr", wanted)
    ones = BatchResult(*(np.ones((2, *shape)) for shape in ((), (), (), (), (), (5,))))
    store.write(0, ones._asdict())

    async def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(zarr.storage.LocalStore, "set", full)
        with pytest.raises(StoreError, match="No space left on device") as caught:
            store.write(1, ones._asdict())
    assert "\n" not in str(caught.value)
    again = open_store(tmp_path / "full.zarr", wanted)
    assert again.done().tolist() == [True, False]
    assert np.array_equal(again.read(0).end, ones.end)
    again.write(1, ones._asdict())
    assert again.done().all()
