"""Bundled plans are such as a hand in one plane can do: their trajectories and executions, looked at from outside.

What overlaps is judged from the scene file and trajectory.csv alone, with Shapely, by none of the package's geometry.
"""

import csv
import tomllib
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.affinity import rotate, translate
from support import layered, optimised

import wholearm_jax as wa
from wholearm_jax.execution.executions import execute
from wholearm_jax.files import bundled, write_trajectory

SCENES = Path(wa.__file__).parent / "scenes"
TIMES = 2000
ROUNDING = 1e-8  # [m]
TIMESTEPS = {"box": 1e-4}  # [s]; a fingertip takes over from a vertex, where nothing stops the object
END_OF_RANGE = {"box": {"finger1 reaches its range"}}  # where the plan itself ends: the finger lies on the palm


@pytest.fixture(scope="module", params=bundled())
def optimum(request):
    return request.param, optimised(request.param)


def test_a_margin_near_the_bound(optimum):
    _, found = optimum
    assert found.result.status is wa.Status.OK
    assert min(found.bound_fraction) > 0.9


def test_links_and_object_do_not_overlap(optimum, tmp_path):
    name, found = optimum
    scene = tomllib.loads((SCENES / f"{name}.toml").read_text())
    write_trajectory(found.result, tmp_path / "trajectory.csv", TIMES // len(scene["phase"]) + 1)
    rows = list(csv.DictReader((tmp_path / "trajectory.csv").read_text().splitlines()))
    assert len(rows) >= TIMES
    outline = shapely.Polygon(scene["object"]["vertices"])
    outline = translate(outline, -outline.centroid.x, -outline.centroid.y)
    assert scene["hand"].get("fingers", "coplanar") == "coplanar"
    for row in rows:
        fingers = []
        for k in (1, 2):
            finger = scene["hand"][f"finger{k}"]
            joint, theta = np.array(finger["joint"]), float(row[f"theta{k}"])
            tip = joint + finger["length"] * np.array([np.cos(theta), np.sin(theta)])
            assert tip[1] > -ROUNDING, f"finger {k} below the palm at {row['t']} s"
            fingers.append(shapely.LineString([joint, tip]))
        placed = translate(
            rotate(outline, float(row["phi"]), origin=(0, 0), use_radians=True), float(row["x"]), float(row["y"])
        )
        assert not fingers[0].intersects(fingers[1]), f"fingers cross at {row['t']} s"
        assert placed.bounds[1] > -ROUNDING, f"object below the palm at {row['t']} s"
        inside = placed.buffer(-ROUNDING, join_style="mitre")
        assert not inside.intersects(fingers[0]), f"finger 1 in the object at {row['t']} s"
        assert not inside.intersects(fingers[1]), f"finger 2 in the object at {row['t']} s"


def test_executions_end_where_predicted(optimum):
    name, found = optimum
    done = execute(found.result, timestep=TIMESTEPS.get(name, 2e-4))
    assert set(done.link_contacts) == END_OF_RANGE.get(name, set())
    assert done.ending.value == "ok"
    assert done.position_error < 5e-5
    assert abs(done.angle_error) < 1e-3


@pytest.mark.parametrize("name", ["flight", "passage"])
def test_layered_flights_end_where_predicted(name):
    found = wa.optimise(layered(name))
    assert found.result.status is wa.Status.OK
    done = execute(found.result, timestep=2e-4)
    assert done.position_error < 5e-5
    assert abs(done.angle_error) < 1e-3
