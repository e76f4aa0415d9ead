"""Ctrl-C at any moment: one line, exit status 130, soon, and what was compiled and written before stays."""

import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.interruption import interrupt
from wholearm_jax.cli.interruption import _is_being_written, exit_on_interrupt

SOON = 1.0  # s, of a machine that does nothing else
MOMENTS = [0.5, *(random.Random(7).uniform(1.0, 9.0) for _ in range(3))]


def busy() -> float:
    """How many times as long as alone a process takes on this machine now, about."""
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


@pytest.mark.parametrize("moment", MOMENTS)
def test_ctrl_c_while_it_imports_traces_and_compiles(moment, tmp_path):
    command = ["optimise", "heptagon", "--out", str(tmp_path / "out")]
    code, err, seconds = interrupt(command, moment, tmp_path / "cache")
    assert code == 130, err
    assert err.splitlines()[-1] == "wholearm: interrupted"
    assert not re.search("Traceback|Fatal|Error|abort", err)
    assert seconds < SOON * busy()
    assert not list(Path(tmp_path).glob("out/*"))
    assert not [path for path in Path(tmp_path).rglob(".*") if path.is_file()], "nothing is left half written"


def test_a_process_of_ones_own_keeps_its_handler():
    """`main` called from Python, as by these tests, hands SIGINT back."""
    own = signal.signal(signal.SIGINT, signal.default_int_handler)  # which a process in the background may ignore
    try:
        restore = exit_on_interrupt()
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        restore()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.1)  # the thread that waits for signals has seen it, and has not ended the process
    finally:
        signal.signal(signal.SIGINT, own)


def test_ctrl_c_waits_for_files_that_are_being_written(tmp_path):
    """A set of files that is being moved into place: the process ends once it is whole."""
    script = """
import os, sys, time
from pathlib import Path
from wholearm_jax.cli.interruption import exit_on_interrupt
from wholearm_jax.core import atomic_files
exit_on_interrupt()
replace = os.replace
def slow(*names):
    print("moving", flush=True)
    time.sleep(0.1)
    replace(*names)
os.replace = slow
atomic_files.write_together(Path(sys.argv[1]), {"a": "new", "b": "new", "summary.json": "new"}, "summary.json")
time.sleep(60)
"""
    with subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "moving\n"
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "wholearm: interrupted\n")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(
        ("a", "b", "summary.json"), "new"
    )


@pytest.mark.parametrize("moment", [0.0, 0.02, 0.05, 0.1])
def test_ctrl_c_ends_workers(moment):
    """Of perturbed executions, which a terminal interrupts with the command: none is left, none says a word.

    One of the two may still be starting when the first result is there.
    """
    pytest.importorskip("joblib")
    script = """
import time
from wholearm_jax.cli.interruption import exit_on_interrupt, quiet_workers
exit_on_interrupt()
from joblib import Parallel, delayed
with quiet_workers():
    for _ in Parallel(n_jobs=2, return_as="generator")(delayed(time.sleep)(0.2 * i) for i in range(1000)):
        print("one", flush=True)
"""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", script], start_new_session=True, **pipes) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "one\n"
        time.sleep(moment)
        os.killpg(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=60)  # which waits for all that hold the pipes
    assert (process.returncode, err) == (130, "wholearm: interrupted\n")


def test_a_program_that_is_being_written_is_noticed(tmp_path):
    assert not _is_being_written(tmp_path / "none")
    (tmp_path / "program").write_bytes(b"1")
    assert _is_being_written(tmp_path)
    os.utime(tmp_path / "program", (0, 0))
    assert not _is_being_written(tmp_path)
