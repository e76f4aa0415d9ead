r"""This version against an earlier one: a path with its table, and checks, in turn.

    python benchmarks/cost_against.py [COMMIT] [--turns 31]

The heptagon's plan on a hand whose fingers cannot pass each other and on one whose fingers can, in two processes, one
for each version, that wait for each other: `wa.trace` (paths and tables of both phases) and `wa.check` of 2048 scenes
(vertices within 0.2 mm, friction within 10 %), on one device. A turn is the shortest of 60 traces and one check of
all scenes; kept are the median of the turns' ratios and its quartiles. The commit that is taken if none is named is the
last one for which links were no bodies; an earlier version reads the same scenes without the keys that it does not
know, and its paths and margins must be the same ones.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import measure
import numpy as np
from layered_scenes import layered_file

import wholearm_jax as wa

HERE = Path(__file__).parent
LINKS_WERE_NO_BODIES = "6826e6b"
LAYERED = '[hand]\nfingers = "layered"\n'
WORKER = """
import json, sys, time
from pathlib import Path
import jax
import numpy as np
import wholearm_jax as wa
try:
    from wholearm_jax.ensembles import make_ensemble
except ImportError:
    from wholearm_jax.variation import vary as make_ensemble

PATHS, SCENES = 60, 2048
wa.configure()
scene, torque = wa.load(Path(sys.argv[1])), wa.read_torque(sys.argv[2])
ensemble = make_ensemble(scene, {"vertices": 0.0002, "friction": "10%"}, seed=1)

def trace():
    return jax.block_until_ready(wa.trace(scene))

def check():
    return wa.check(ensemble, torque, count=SCENES, arrival=0.02)

def seconds(call):
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun

lengths = [float((one.dynamics if hasattr(one, "dynamics") else one.table).length) for one in trace()]
checked = check()
print(json.dumps({"lengths": lengths, "margins": np.nan_to_num(checked.margin).tolist()}), flush=True)
for _ in sys.stdin:
    path = min(seconds(trace) for _ in range(PATHS))
    print(json.dumps({"path": path, "check": SCENES / seconds(check)}), flush=True)
"""


class Version:
    """A process of one version of the package that times paths and checks when it is asked to."""

    def __init__(self, root: Path, scene: Path, torque: Path):
        command = [sys.executable, "-c", WORKER, str(scene), str(torque)]
        environment = {**os.environ, "PYTHONPATH": str(root)}
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=scene.parent
        )
        self.found = self._read()

    def _read(self) -> dict:
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("a version's process has ended; its errors are above")
        return json.loads(line)

    def time(self) -> dict[str, float]:
        """Seconds of a plan's paths and tables, and checks a second."""
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return self._read()

    def close(self) -> None:
        """End the process."""
        self.process.stdin.close()
        self.process.wait()


def in_turn(earlier: Version, now: Version, turns: int) -> dict:
    """Ratios of this version's times and rates to the earlier one's, each of one turn."""
    rows = [(earlier.time(), now.time()) for _ in range(turns)]
    found = {}
    for quantity in ("path", "check"):
        ratios = [after[quantity] / before[quantity] for before, after in rows]
        low, median, high = np.quantile(ratios, (0.25, 0.5, 0.75))
        found[quantity] = {
            "earlier": float(np.median([before[quantity] for before, _ in rows])),
            "now": float(np.median([after[quantity] for _, after in rows])),
            "ratio": float(median),
            "quartiles": [float(low), float(high)],
        }
        print(f"  {quantity}: ratio {median:.3f}, quartiles {low:.3f} to {high:.3f}", flush=True)
    return found


def compare(folder: Path, root: Path, scene_file: Path, turns: int) -> dict:
    """Optimise a scene, and time both versions on it and its torques."""
    wa.write_torque(wa.optimise(wa.load(scene_file)).torque, folder / "torque.csv")
    text = scene_file.read_text()
    (folder / "now.toml").write_text(text)
    knows_layers = any("layered" in path.read_text() for path in (root / "wholearm_jax").rglob("*.py"))
    (folder / "earlier.toml").write_text(text if knows_layers else text.replace(LAYERED, ""))
    earlier = Version(root, folder / "earlier.toml", folder / "torque.csv")
    now = Version(HERE.parent, folder / "now.toml", folder / "torque.csv")
    np.testing.assert_allclose(now.found["lengths"], earlier.found["lengths"], rtol=1e-9)
    np.testing.assert_allclose(now.found["margins"], earlier.found["margins"], atol=1e-6)
    found = in_turn(earlier, now, turns)
    for version in (earlier, now):
        version.close()
    return found


def main() -> None:
    """Compare and keep the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", nargs="?", default=LINKS_WERE_NO_BODIES)
    parser.add_argument("--turns", type=int, default=31)
    asked = parser.parse_args()
    wa.configure()
    scenes = {
        "coplanar": HERE.parent / "wholearm_jax" / "scenes" / "heptagon.toml",
        "layered": layered_file("heptagon"),
    }
    result: dict = {"commit": asked.commit, "turns": asked.turns}
    with tempfile.TemporaryDirectory() as name:
        folder, root = Path(name), Path(name) / "earlier"
        subprocess.run(["git", "clone", "--quiet", str(HERE.parent), str(root)], check=True)
        subprocess.run(["git", "-C", str(root), "checkout", "--quiet", asked.commit], check=True)
        for hand, scene_file in scenes.items():
            print(f"heptagon, {hand} fingers:", flush=True)
            result[hand] = compare(folder, root, scene_file, asked.turns)
    print(measure.save("cost_against", result))


if __name__ == "__main__":
    main()
