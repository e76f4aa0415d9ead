"""Interrupt a command at random moments: `python benchmarks/interruption.py --command "optimise heptagon"`.

Each run starts as a user's first one, without kept programs, gets SIGINT after a random time, and must end with one
line and exit status 130. Prints each run's moment and how long it took to end, and the longest.
"""

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LINE = "wholearm: interrupted"


def interrupt(command: list[str], moment: float, cache: Path) -> tuple[int, str, float]:
    """Run a command with a cache folder, interrupt it after `moment` seconds: exit status, standard error, seconds."""
    environment = {"PATH": "/usr/bin:/bin", "XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(Path(__file__).parents[1])}
    program = [sys.executable, "-m", "wholearm_jax", *command]
    with subprocess.Popen(
        program, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        time.sleep(moment)
        process.send_signal(signal.SIGINT)
        begun = time.perf_counter()
        _, err = process.communicate(timeout=120)
        return process.returncode, err, time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--latest", type=float, default=20.0, help="last moment [s]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--command", default="optimise heptagon")
    given = parser.parse_args()
    draw, longest, failures = random.Random(given.seed), 0.0, 0
    for _ in range(given.runs):
        moment = draw.uniform(0.1, given.latest)
        with tempfile.TemporaryDirectory() as cache:
            code, err, seconds = interrupt(given.command.split(), moment, Path(cache))
            programs = sum(path.is_file() for path in Path(cache).rglob("*"))
        ok = code == 130 and err.splitlines()[-1:] == [LINE] and "Traceback" not in err
        longest, failures = max(longest, seconds), failures + (not ok)
        print(f"after {moment:5.2f} s: status {code}, {seconds:.3f} s, {programs} files kept")
        if not ok:
            print(err)
    print(f"{given.runs} runs, {failures} failures, longest {longest:.3f} s")
    sys.exit(failures > 0)


if __name__ == "__main__":
    main()
