"""Every test computes in 64 bits, compiles as the command line does, and leaves room for those that follow."""

import ctypes
import gc
import os
import sys
from pathlib import Path

import jax
import pytest

from wholearm_jax.cli import app as command
from wholearm_jax.core.config import configure
from wholearm_jax.core.executable_cache import MIN_CACHED_COMPILE_TIME

MAPPED = 30_000  # half of the memory areas that Linux grants a process by default
RESIDENT = 5 << 30  # memory of a worker [bytes], above which two of them leave little of 16 GiB to what tests start

configure()
gc.set_threshold(100_000, 20, 20)


def pytest_configure(config):
    """Tests and what they start list fonts anew: a user's list may lack those of a matplotlib that has gone."""
    cache = getattr(config, "cache", None)  # None where pytest keeps none
    if cache is not None:
        os.environ.setdefault("MPLCONFIGDIR", str(cache.mkdir("matplotlib")))


def pytest_collection_modifyitems(items):
    """Tests of derivatives, which compile longest, one after the other: each worker takes a run of tests, and what it
    has compiled it has. Notebooks late, when others have compiled their programs; the many short ones at the end."""

    def place(item):
        late = ("test_notebooks", "test_scene_toml")
        derived = any(word in item.nodeid for word in ("gradient", "derivatives", "test_readme"))
        return -1 if derived else next((k for k, name in enumerate(late, 1) if name in item.nodeid), 0)

    items.sort(key=place)


@pytest.fixture(autouse=True, scope="session")
def _programs_are_kept(request):
    """Workers share compiled programs, also with what they start as users do, and the next run finds them."""
    cache = getattr(request.config, "cache", None)  # None where pytest keeps none
    if cache is not None and jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(cache.mkdir("programs") / "wholearm_jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_CACHED_COMPILE_TIME)


@pytest.fixture(autouse=True)
def _room_for_programs():
    """Each compiled program maps a thousand small areas of memory, and a process that runs out of them crashes."""
    yield
    if Path("/proc/self").exists() and (_areas() > MAPPED or _resident() > RESIDENT):
        jax.clear_caches()
        getattr(ctypes.CDLL(None), "malloc_trim", lambda _: 0)(0)  # the C library would keep what is free


def _areas() -> int:
    return len(Path("/proc/self/maps").read_bytes().splitlines())


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture
def wholearm(monkeypatch, capsys):
    """Run the program in this process: arguments -> (exit status, standard output, standard error)."""
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "true")  # leave the user's cache folder alone

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["wholearm", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            command.main()
        printed = capsys.readouterr()
        return caught.value.code or 0, printed.out, printed.err

    return run
