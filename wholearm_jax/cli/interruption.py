"""Ctrl-C: a command ends within a second with one line and exit status 130, whatever its threads are doing.

Python raises `KeyboardInterrupt` between two of its own instructions only: not while XLA compiles, which takes many
seconds, and a process that then ends while other threads still compile waits for them or crashes. So the signal wakes a
thread of its own, which ends the process at once, without Python's finalisation. Before that it waits, for a moment,
for files that are being written: sets of files are moved into place together, and compiled programs stay whole.

The module is the first that the package imports, before slow ones: the program may be interrupted while they load.
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

INTERRUPTED = 130  # exit status: 128 and the number of SIGINT
WRITING_TIMEOUT = 0.4  # how long to wait for files that are being written [s]
CACHE_QUIET = 0.05  # a program in JAX's cache is whole if nothing has been written to it for so long [s]

_read_end: int | None = None


def exit_on_interrupt() -> Callable[[], None]:
    """Let SIGINT end this process, if this is its main thread; return a function that restores what it did before."""
    global _read_end
    if threading.current_thread() is not threading.main_thread():
        return lambda: None
    if _read_end is None:
        _read_end, write_end = os.pipe()
        os.set_blocking(write_end, False)
        signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
        threading.Thread(target=_exit_on_signal, args=(_read_end,), name="interrupt", daemon=True).start()
    before = signal.signal(signal.SIGINT, _leave_to_thread)

    def restore() -> None:
        signal.signal(signal.SIGINT, before)

    return restore


def _leave_to_thread(number, frame) -> None:
    """Raise nothing: the number of the signal is in the pipe by now."""


def _exit_on_signal(read_end: int) -> None:
    """Wait for SIGINT, and end the process."""
    while os.read(read_end, 1) != bytes([signal.SIGINT]) or signal.getsignal(signal.SIGINT) is not _leave_to_thread:
        pass
    with suppress(Exception):
        _finish_writing()
    with suppress(Exception):
        _end_workers()
    with suppress(OSError):
        restore_cursor = b"\x1b[?25h\r\n" if os.isatty(2) else b""
        os.write(2, restore_cursor + b"wholearm: interrupted\n")
    os._exit(INTERRUPTED)


def _finish_writing() -> None:
    """Wait until no file is being written: neither a set of results, nor a program in JAX's cache."""
    deadline = time.monotonic() + WRITING_TIMEOUT
    if files := sys.modules.get("wholearm_jax.core.atomic_files"):
        files.WRITING.acquire(timeout=WRITING_TIMEOUT)
    if jax := sys.modules.get("jax"):
        cache = jax.config.values.get("jax_compilation_cache_dir")
        while cache and time.monotonic() < deadline and _is_being_written(Path(cache)):
            time.sleep(0.02)


def _is_being_written(folder: Path) -> bool:
    """Return whether a file that was made within the last second has been written to a moment ago."""
    now = time.time()
    if not folder.is_dir() or now - folder.stat().st_mtime > 1.0:
        return False
    with os.scandir(folder) as entries:
        return any(now - entry.stat().st_mtime < CACHE_QUIET for entry in entries)


@contextmanager
def quiet_workers() -> Iterator[None]:
    """Let the processes that are started meanwhile say nothing when a terminal interrupts them with this one.

    They inherit the signals that this thread blocks, from their first instruction on, and are ended by this process,
    whose own thread for signals still wakes. Their tracker of resources, which unblocks them, is started before, and
    told not to report each worker that was ended.
    """
    from multiprocessing import resource_tracker  # not needed by most commands

    others = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, (others, "ignore:resource_tracker")))
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        os.environ["PYTHONWARNINGS"] = others or ""


def _end_workers() -> None:
    """End the processes that this one has started."""
    if processes := sys.modules.get("multiprocessing.process"):
        for child in processes.active_children():
            os.kill(child.pid, signal.SIGKILL)  # joblib's have no `kill`


if sys.argv[:1] == ["-m"] or Path((sys.argv or [""])[0]).stem == "wholearm":
    exit_on_interrupt()  # `python -m wholearm_jax`, while its modules are imported, or the script `wholearm`
