"""Kept programs: read instead of traced, equal to traced ones, never mistaken for others, never in the way."""

import gc
import threading

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from wholearm_jax.core import programs


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
    programs.keep_programs(tmp_path)
    yield tmp_path
    programs.keep_programs(None)


def call(power=2, at=3.0, **others):
    """As a new process would: nothing is in memory."""
    return programs.Program(climb)(Ramp(jnp.asarray(2.0), power), jnp.asarray(at), *others.values())


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
    programs.keep_programs(file)
    assert float(call()[0].slope) == 18.0
    programs.keep_programs(None)


def test_with_no_folder_each_kind_of_arguments_is_traced_once():
    TRACED.clear()
    program = programs.Program(climb)
    for power, at, expected in ((2, 3.0, 18.0), (3, 3.0, 54.0), (2, 4.0, 32.0), (2, [1.0, 2.0], [2.0, 8.0])):
        found, others = program(Ramp(jnp.asarray(2.0), power), np.asarray(at))
        assert found.slope.tolist() == expected
        assert found.power == power
        assert others["at"].tolist() == at
    assert TRACED == [2, 3, 2], "settings and shapes have programs of their own, numbers have not"
    assert program.sizes() == 3
    assert float(program(Ramp(jnp.asarray(2.0), 2), jnp.asarray(3.0), 1)[0].slope) == 19.0
    assert float(program(Ramp(jnp.asarray(2.0), 2), jnp.asarray(3.0), True)[0].slope) == 19.0
    assert program.sizes() == 5, "1 and True are equal, and not the same setting"


def test_transformations_pass_by(folder):
    program = programs.Program(climb)
    slopes = jax.vmap(lambda at: program(Ramp(jnp.asarray(2.0), 2), at)[0].slope)(jnp.arange(3.0))
    assert slopes.tolist() == [0.0, 2.0, 8.0]
    assert float(jax.grad(lambda at: program(Ramp(jnp.asarray(2.0), 2), at)[0].slope)(3.0)) == 12.0
    assert not list(folder.iterdir())


def apply(method, x):
    return method.update(x, method.init(x))[0]


def test_methods_are_named_by_what_they_hold(folder):
    for factor, expected in ((2.0, 6.0), (5.0, 15.0), (2.0, 6.0)):
        assert float(programs.Program(apply)(optax.scale(factor), jnp.asarray(3.0))) == expected
    assert len(list(folder.iterdir())) == 2


def test_what_cannot_be_named_is_not_kept(folder):
    factor = np.asarray(7.0)
    own = optax.GradientTransformation(lambda x: (), lambda x, state, params=None: (7 * x, state))
    for method in (optax.scale(factor), own):
        assert float(programs.Program(apply)(method, jnp.asarray(3.0))) == 21.0
    assert not list(folder.iterdir())


@pytest.fixture
def no_calls_beside(monkeypatch):
    monkeypatch.setattr(programs, "_background_calls", {})


@pytest.mark.usefixtures("no_calls_beside")
def test_what_is_put_beside_is_called_once_for_each_kind_after_the_next_program_is_traced():
    called, all_made = [], threading.Event()

    def note(number, array):
        called.append((number, array.shape, threading.current_thread()))
        if len(called) == 3:
            all_made.set()

    calls = [
        programs.call_in_background(note, number, jnp.zeros(size)) for number, size in ((1, 2), (2, 2), (1, 2), (1, 3))
    ]
    assert calls[0] is calls[2]
    assert not called
    TRACED.clear()
    call(power=7)
    assert all_made.wait(60)
    programs.wait_for(*calls)
    assert [(number, shape) for number, shape, _ in called] == [(1, (2,)), (2, (2,)), (1, (3,))]
    assert all(thread is not threading.current_thread() for *_, thread in called)


@pytest.mark.usefixtures("no_calls_beside")
def test_who_waits_makes_what_has_not_begun():
    first_began, last_made, threads = threading.Event(), threading.Event(), []

    def first():
        first_began.set()
        assert last_made.wait(60)

    def last():
        threads.append(threading.current_thread())
        last_made.set()

    calls = programs.call_in_background(first), programs.call_in_background(last)
    call(power=11)
    assert first_began.wait(60)
    assert not last_made.is_set()
    programs.wait_for(*calls)
    assert threads == [threading.current_thread()]


@pytest.mark.usefixtures("no_calls_beside")
def test_who_waits_is_told_what_was_raised_and_may_try_again():
    tries = []

    def interrupted():
        tries.append(1)
        if len(tries) == 1:
            raise KeyboardInterrupt("by who waits for it")

    with pytest.raises(KeyboardInterrupt, match="who waits"):
        programs.wait_for(programs.call_in_background(interrupted))
    programs.wait_for(programs.call_in_background(interrupted))
    programs.wait_for(programs.call_in_background(interrupted))
    assert len(tries) == 2


@pytest.mark.parametrize("collects", [True, False])
def test_the_collector_rests_while_a_program_is_traced_and_is_then_what_it_was(collects):
    phase_schedule = []

    def traced(x):
        phase_schedule.append(gc.isenabled())
        return x + 1

    was = gc.isenabled()
    try:
        (gc.enable if collects else gc.disable)()
        programs.Program(traced)(np.ones(3))
        assert phase_schedule == [False]
        assert gc.isenabled() is collects
    finally:
        (gc.enable if was else gc.disable)()
