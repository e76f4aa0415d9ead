"""Kept programs: read instead of traced, equal to traced ones, never mistaken for others, never in the way."""

import gc
import importlib
import inspect
import json
import pickle
import shutil
import sys
import threading
import time
import types
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import wholearm_jax as wa
from wholearm_jax.core import program_cache


class Ramp(eqx.Module):
    """A pytree with a static field."""

    slope: jax.Array
    power: int = eqx.field(static=True)


TRACED = []


def climb(ramp: Ramp, at, shift=0.0):
    """Says that it is traced."""
    TRACED.append(ramp.power)
    return Ramp(ramp.slope * at**ramp.power + shift, ramp.power), {"at": at}


@pytest.fixture
def folder(tmp_path):
    TRACED.clear()
    program_cache.enable_program_cache(tmp_path)
    yield tmp_path
    program_cache.enable_program_cache(None)


def call(power=2, at=3.0, **others):
    """As a new process would: nothing is in memory."""
    return program_cache.CachedJit(climb)(Ramp(jnp.asarray(2.0), power), jnp.asarray(at), *others.values())


def test_a_later_process_reads_what_an_earlier_one_traced(folder):
    first, second = call(), call(at=4.0)
    assert TRACED == [2]
    assert len(list(folder.iterdir())) == 1
    assert float(first[0].slope) == 18.0
    assert float(second[0].slope) == 32.0
    assert second[0].power == 2
    assert float(second[1]["at"]) == 4.0


def test_static_arguments_shapes_and_settings_name_programs_of_their_own(folder):
    assert float(call(power=3)[0].slope) == 54.0
    assert float(call(power=2)[0].slope) == 18.0
    assert call(at=[1.0, 2.0])[0].slope.tolist() == [2.0, 8.0]
    assert float(call(shift=1.0)[0].slope) == 19.0
    assert float(call(shift=2.0)[0].slope) == 20.0
    assert TRACED == [3, 2, 2, 2, 2]
    assert len(list(folder.iterdir())) == 5


@pytest.mark.parametrize("content", [b"", b"nonsense", b"\x80\x04N."])
def test_a_file_that_cannot_be_read_is_written_anew(folder, content):
    call()
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    path.write_bytes(content)
    assert float(call()[0].slope) == 18.0
    assert TRACED == [2, 2]
    assert len(path.read_bytes()) == len(whole)


def test_a_folder_that_cannot_be_written_to_does_no_harm(tmp_path):
    file = tmp_path / "file"
    file.touch()
    program_cache.enable_program_cache(file)
    assert float(call()[0].slope) == 18.0
    program_cache.enable_program_cache(None)


def test_with_no_folder_each_kind_of_arguments_is_traced_once():
    TRACED.clear()
    program = program_cache.CachedJit(climb)
    for power, at, expected in ((2, 3.0, 18.0), (3, 3.0, 54.0), (2, 4.0, 32.0), (2, [1.0, 2.0], [2.0, 8.0])):
        found, others = program(Ramp(jnp.asarray(2.0), power), np.asarray(at))
        assert found.slope.tolist() == expected
        assert found.power == power
        assert others["at"].tolist() == at
    assert TRACED == [2, 3, 2], "settings and shapes have programs of their own, numbers have not"
    assert program.compiled_count() == 3
    assert float(program(Ramp(jnp.asarray(2.0), 2), jnp.asarray(3.0), 1)[0].slope) == 19.0
    assert float(program(Ramp(jnp.asarray(2.0), 2), jnp.asarray(3.0), True)[0].slope) == 19.0
    assert program.compiled_count() == 5, "1 and True are equal, and not the same setting"


def test_transformations_pass_by(folder):
    program = program_cache.CachedJit(climb)
    slopes = jax.vmap(lambda at: program(Ramp(jnp.asarray(2.0), 2), at)[0].slope)(jnp.arange(3.0))
    assert slopes.tolist() == [0.0, 2.0, 8.0]
    assert float(jax.grad(lambda at: program(Ramp(jnp.asarray(2.0), 2), at)[0].slope)(3.0)) == 12.0
    assert not list(folder.iterdir())


@pytest.mark.parametrize("kept", [True, False])
def test_a_part_of_another_program_is_read_from_its_file(folder, kept):
    """As where each of several devices calls it: the part is traced once for all processes, and equal."""
    if not kept:
        program_cache.enable_program_cache(None)
    ramp, shape = Ramp(jnp.asarray(2.0), 2), jax.ShapeDtypeStruct((), jnp.float64)
    for _ in range(2):  # two processes
        part = program_cache.CachedJit(climb).embedded(ramp, shape)
        found, others = jax.jit(lambda at, part=part: part(ramp, 2 * at))(jnp.asarray(1.5))
        assert (float(found.slope), found.power, float(others["at"])) == (18.0, 2, 3.0)
    assert ([2] if kept else [2, 2]) == TRACED
    assert len(list(folder.iterdir())) == kept


def apply(method, x):
    return method.update(x, method.init(x))[0]


def test_methods_are_named_by_what_they_hold(folder):
    for factor, expected in ((2.0, 6.0), (5.0, 15.0), (2.0, 6.0)):
        assert float(program_cache.CachedJit(apply)(optax.scale(factor), jnp.asarray(3.0))) == expected
    assert len(list(folder.iterdir())) == 2


def test_what_cannot_be_named_is_not_kept(folder):
    factor = np.asarray(7.0)
    own = optax.GradientTransformation(lambda x: (), lambda x, state, params=None: (7 * x, state))
    for method in (optax.scale(factor), own):
        assert float(program_cache.CachedJit(apply)(method, jnp.asarray(3.0))) == 21.0
    assert not list(folder.iterdir())


@pytest.mark.parametrize("collects", [True, False])
def test_the_collector_rests_while_a_program_is_traced_and_is_then_what_it_was(collects):
    phase_schedule = []

    def traced(x):
        phase_schedule.append(gc.isenabled())
        return x + 1

    was = gc.isenabled()
    try:
        (gc.enable if collects else gc.disable)()
        program_cache.CachedJit(traced)(np.ones(3))
        assert phase_schedule == [False]
        assert gc.isenabled() is collects
    finally:
        (gc.enable if was else gc.disable)()


def test_a_change_in_any_folder_changes_the_key(tmp_path):
    """Kept programs are stale once any file of the package has changed, in whatever folder."""
    assert Path(wa.__file__).parent == program_cache.PACKAGE_ROOT
    copy = tmp_path / "package"
    shutil.copytree(program_cache.PACKAGE_ROOT, copy, ignore=shutil.ignore_patterns("__pycache__"))
    digest = program_cache._source_digest(copy)
    assert digest == program_cache._source_digest(program_cache.PACKAGE_ROOT)
    assert digest in program_cache._environment_key()
    folders = sorted({path.parent for path in copy.rglob("*.py")})
    assert len(folders) > 10
    for folder in folders:
        path = sorted(folder.glob("*.py"))[0]
        source = path.read_bytes()
        path.write_bytes(source + b"\n")
        assert program_cache._source_digest(copy) != digest, path
        path.write_bytes(source)
    path.rename(path.with_name("renamed.py"))
    assert program_cache._source_digest(copy) != digest


def test_functions_of_every_folder_have_names():
    """A function that a program is built with, passed as a setting, is known whatever its folder."""
    folders, functions = set(), 0
    for path in program_cache.PACKAGE_ROOT.rglob("*.py"):
        parts = path.relative_to(program_cache.PACKAGE_ROOT.parent).with_suffix("").parts
        if path.name.startswith("__") or parts[1] in ("plotting", "execution"):
            continue
        module = importlib.import_module(".".join(parts))
        for value in map(inspect.unwrap, vars(module).values()):  # without the tests' type checks
            if isinstance(value, types.FunctionType) and value.__module__ == module.__name__:
                if any(not isinstance(d, program_cache.PLAIN_TYPES) for d in value.__defaults__ or ()):
                    continue
                functions += not value.__closure__
                folders.add(parts[1])
                assert value.__closure__ or program_cache._setting_key(value) is not None, value
    assert functions > 300
    assert len(folders) >= 10


def test_every_program_of_the_package_is_at_the_top_of_a_module():
    """Its file's name says which function it is, the same in every process."""
    count = 0
    for name, module in sorted(sys.modules.items()):
        if name.startswith("wholearm_jax."):
            for attribute, value in vars(module).items():
                if isinstance(value, program_cache.CachedJit) and value.__module__ == name:
                    count += 1
                    assert "<" not in value.__qualname__, (name, attribute)
    assert count >= 10


class RunsCode:
    """An object that, unpickled, would write a file."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return Path.touch, (self.target,)


def renamed(whole, folder):
    """The file of another program."""
    call(power=5)
    return next(p for p in folder.iterdir() if p.read_bytes() != whole).read_bytes()


DAMAGED = {
    "empty": lambda whole, folder: b"",
    "cut": lambda whole, folder: whole[: len(whole) // 2],
    "longer": lambda whole, folder: whole + b"more",
    "a bit flipped": lambda whole, folder: whole[:-100] + bytes([whole[-100] ^ 4]) + whole[-99:],
    "a structure of its own": lambda whole, folder: whole.replace(b'"module"', b'"tuple"'),
    "zeros": lambda whole, folder: bytes(len(whole)),
    "text": lambda whole, folder: "schräg\n\n\n\n".encode("latin-1"),
    "a pickle": lambda whole, folder: pickle.dumps(RunsCode(folder / "written")),
    "a pickle of what was once kept": lambda whole, folder: pickle.dumps(({"a": 0}, b"program")),
    "another program": renamed,
}


@pytest.mark.parametrize("damage", DAMAGED.values(), ids=DAMAGED.keys())
def test_a_damaged_or_foreign_file_is_ignored_and_made_anew(folder, damage):
    call()
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    path.write_bytes(damage(whole, folder))
    TRACED.clear()
    assert float(call()[0].slope) == 18.0
    assert TRACED == [2]
    assert path.read_bytes().splitlines()[:2] == whole.splitlines()[:2]
    assert not (folder / "written").exists()
    TRACED.clear()
    assert float(call()[0].slope) == 18.0
    assert TRACED == [], "the file made anew is read"


def test_kept_files_hold_data_alone(folder):
    call()
    (path,) = folder.iterdir()
    _, name, _, description, program = path.read_bytes().split(b"\n", 4)
    assert name.decode() == path.name
    assert json.loads(description)[0] == "tuple"
    with pytest.raises(pickle.UnpicklingError):
        pickle.loads(path.read_bytes())
    assert float(jax.export.deserialize(bytearray(program)).call(jnp.asarray(2.0), jnp.asarray(3.0))[0]) == 18.0


def test_the_package_unpickles_nothing():
    for path in program_cache.PACKAGE_ROOT.rglob("*.py"):
        source = path.read_text()
        assert "import pickle" not in source, path
        assert "allow_pickle=True" not in source, path


def test_threads_that_ask_for_one_program_build_it_once():
    traced, begin = [], threading.Barrier(2)

    def slow(x):
        traced.append(threading.current_thread())
        time.sleep(0.2)
        return x + 1

    program = program_cache.CachedJit(slow)

    def ask(_):
        begin.wait(60)
        return float(program(np.ones(())))

    with ThreadPoolExecutor(2) as threads:
        assert list(threads.map(ask, range(2))) == [2.0, 2.0]
    assert len(traced) == 1
