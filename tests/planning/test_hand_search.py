"""The hand that is found: its plan arrives, no hand that was tried has a larger certificate, and it is found again."""

import importlib
from unittest.mock import Mock

import equinox as eqx
import numpy as np
import pytest

import wholearm_jax as wa
from wholearm_jax.files import read_outline
from wholearm_jax.model import edge_on_palm, resting_configuration
from wholearm_jax.planning import PlanningResult


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A box 60 x 40 mm at rest, on the hand that was chosen for it."""
    path = tmp_path_factory.mktemp("drawing") / "box.csv"
    path.write_text("x [mm],y [mm]\n0,0\n60,0\n60,40\n0,40\n")
    return wa.scene_from_outline(read_outline(path), mass=0.1)


SEARCH = {"length": (0.1, 0.12), "joint": (0.036, 0.09), "grid": 2, "refinements": 0, "max_nodes": 1, "max_phases": 1}


@pytest.fixture(scope="module")
def found(box):
    return wa.plan_with_hand(box, by={"x": -0.004}, **SEARCH)


def _with_hand(box, trial):
    """Put a scene together in which the box lies in the hand of a trial."""
    hand = {"joint": [[trial.joint, 0.0], [-trial.joint, 0.0]], "length": [trial.length] * 2}
    inertia = np.asarray(box.hand.inertia) * (trial.length / np.asarray(box.hand.length)) ** 2
    new = tuple(np.asarray(value) for value in (*hand.values(), inertia))
    scene = eqx.tree_at(lambda s: (s.hand.joint, s.hand.length, s.hand.inertia), box, new)
    z = resting_configuration(scene.object, scene.hand, 0, 0.0)
    return eqx.tree_at(lambda s: s.start, scene, np.asarray(z))


def test_the_best_of_the_hands_has_the_largest_certificate(box, found):
    """Each hand that was tried is planned for by itself, from a scene that is put together here."""
    assert len(found.trials) == 4
    assert found.best.bound == max(one.bound for one in found.trials if not np.isnan(one.bound))
    for one in found.trials:
        if np.isnan(one.bound):
            continue
        scene = _with_hand(box, one)
        planned = wa.plan(scene, by={"x": -0.004}, max_phases=1, max_nodes=1)
        assert planned.found == np.isfinite(one.bound)
        if planned.found:
            assert planned.plans[0].bound == pytest.approx(one.bound, rel=1e-9)


def test_the_plan_on_the_best_hand_arrives(box, found):
    best = found.planning.plans[0]
    traced = wa.trace(best.scene)
    assert float(traced[-1].end[0] - box.start[0]) == pytest.approx(-0.004, abs=1e-3)
    assert np.asarray(best.scene.hand.length).tolist() == [found.best.length] * 2
    assert np.asarray(found.scene.hand.joint)[:, 0].tolist() == [found.best.joint, -found.best.joint]


def test_the_last_hand_is_better_than_its_neighbours(box):
    """Proportions between those of the grid, to which the best plan's certificate leads."""
    found = wa.plan_with_hand(box, by={"x": -0.004}, **SEARCH | {"refinements": 1})
    rounds, climbed = found.trials[:-1], found.trials[-1]
    assert found.best == climbed
    assert climbed.bound > max(one.bound for one in rounds if not np.isnan(one.bound)) * 1.02
    for step in (-1e-3, 1e-3):
        beside = {"length": (climbed.length,) * 2, "joint": (climbed.joint + step,) * 2}
        neighbour = wa.plan_with_hand(box, by={"x": -0.004}, **SEARCH | beside)
        assert not neighbour.trials[0].bound > climbed.bound


def test_the_search_widens_until_some_hand_has_a_plan(box, monkeypatch):
    """Hands without a plan are searched again with more effort; those on which the part does not fit are not."""
    module, efforts = importlib.import_module("wholearm_jax.planning.hand_search"), []

    def plan(scene, goal, *, max_nodes, **options):
        efforts.append(max_nodes)
        enough = max_nodes == 3 and float(scene.hand.length[0]) == 0.12
        return Mock(spec=PlanningResult, found=enough, plans=(Mock(bound=1.0),))

    monkeypatch.setattr(module, "plan", plan)
    monkeypatch.setattr(module, "EFFORTS", (1, 3, 9))
    found = wa.plan_with_hand(box, by={"x": -0.004}, **SEARCH | {"max_nodes": None})
    closing = sum(not np.isnan(trial.bound) for trial in found.trials)
    assert efforts == [1] * closing + [3] * closing
    assert found.best.length == 0.12


def test_where_no_hand_has_a_plan_the_scene_stays(box):
    found = wa.plan_with_hand(box, by={"x": -0.5}, **SEARCH)
    assert found.best is None
    assert found.planning is None
    assert found.scene is box


def test_where_no_hand_has_a_plan_the_nearest_is_known(box):
    goal = {"by": {"x": -0.06}, "max_nodes": 2, "max_phases": 3}
    found = wa.plan_with_hand(box, **SEARCH | goal)
    assert found.best is None
    assert found.scene is box
    closing = [trial for trial in found.trials if not np.isnan(trial.bound)]
    alone = [wa.plan(_with_hand(box, trial), **goal).distance for trial in closing]
    assert len(set(alone)) > 1
    best = closing[int(np.argmin(alone))]
    assert np.asarray(found.nearest.hand.length).tolist() == [best.length] * 2
    assert float(found.nearest.hand.joint[0, 0]) == best.joint
    out_of_reach = wa.plan_with_hand(box, **SEARCH | {"by": {"x": -50.0}})
    assert out_of_reach.nearest is None  # no search begins


def test_ranges_and_starts_that_cannot_be_are_refused(box):
    with pytest.raises(ValueError, match="joint: the range must be"):
        wa.plan_with_hand(box, by={"x": -0.01}, length=(0.1, 0.2), joint=(0.05, 0.04))
    raised = eqx.tree_at(lambda s: s.start, box, np.add(box.start, [0, 1e-3, 0, 0, 0]))
    with pytest.raises(ValueError, match="does not lie on an edge"):
        wa.plan_with_hand(raised, by={"x": -0.01}, length=(0.1, 0.2), joint=(0.04, 0.05))
    assert edge_on_palm(box.object, np.asarray(box.start)) == 0
