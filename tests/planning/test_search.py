"""Plans from a start and a goal: traced anew, they arrive; where there is none, the reason is right."""

import importlib
import itertools
import json
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import tomli_w
from shapely import LineString, Polygon
from support import layered

import wholearm_jax as wa
from wholearm_jax.files import load_goal, load_start
from wholearm_jax.files.scene_toml import SceneError, to_dict
from wholearm_jax.model import COORDINATES, resting_configuration
from wholearm_jax.optimisation import certified_bounds
from wholearm_jax.planning.goal import make_goal
from wholearm_jax.planning.improvement import is_secure
from wholearm_jax.planning.move_stops import move_stops
from wholearm_jax.planning.moves import moves_from
from wholearm_jax.planning.plans import Step, make_plan
from wholearm_jax.planning.search import SHORT_PLAN
from wholearm_jax.planning.successors import successor_formations


def part_data(name="heptagon"):
    data = to_dict(layered(name))
    data["hand"]["fingers"] = "coplanar"
    for finger in ("finger1", "finger2"):
        data["hand"][finger]["length"] = 0.13
    return data


@pytest.fixture(scope="module")
def part():
    """The heptagon at rest on an edge, on a hand whose fingers share a plane; no phases."""
    scene = wa.parse(part_data())
    z = resting_configuration(scene.object, scene.hand, 5, 0.02)
    return eqx.tree_at(lambda s: (s.start, s.phases), scene, (jnp.asarray(z), ()))


@pytest.fixture(scope="module")
def turned(part):
    return wa.plan(part, by={"phi": -0.35}, count=2)


def test_plans_arrive_when_traced_anew(part, turned):
    assert turned.found
    assert turned.reason == ""
    assert turned.plans[0].bound == max(one.bound for one in turned.plans)
    for one in turned.plans:
        traced = wa.trace(one.scene)
        assert all(int(phase.dynamics.status) == wa.Status.OK for phase in traced)
        assert float(traced[-1].end[2] - part.start[2]) == pytest.approx(-0.35, abs=np.radians(1))
        np.testing.assert_allclose(one.bounds, certificates(one.scene), rtol=1e-7)
        assert one.bound > 0


def certificates(scene):
    """What `optimise` compares its margins with."""
    return [float(bound.value) for bound in certified_bounds(scene)]


def test_a_trapezoid_slides_in_the_hand_that_is_chosen_for_it(tmp_path):
    """What `wholearm scene` says to go on with: fingers that end at its corners could not slide it."""
    (tmp_path / "part.csv").write_text("x [mm],y [mm]\n0,0\n56,0\n42,21\n14,21\n")
    scene = wa.scene_from_outline(wa.read_outline(tmp_path / "part.csv"))
    found = wa.plan(scene, by={"x": -0.006}, count=1, max_nodes=20)
    assert found.found, found.reason


@pytest.mark.parametrize(("shift", "off", "nodes"), [(2e-3, 1e-3, 1), (2e-3, 1e-3, 20), (3e-3, 1e-6, 20)])
def test_a_plan_ends_where_its_path_meets_the_goal_and_not_at_a_tip(tmp_path, shift, off, nodes):
    """Paths end at 1.3 mm, where a vertex leaves a finger at its tip, and at 3.6 mm."""
    (tmp_path / "part.csv").write_text("x [mm],y [mm]\n0,0\n12,0\n9,4.5\n3,4.5\n")
    friction = {"palm": 0.3, "finger1": 0.1, "finger2": 0.1}
    scene = wa.scene_from_outline(wa.read_outline(tmp_path / "part.csv"), friction=friction)
    found = wa.plan(scene, by={"x": -shift}, count=1, max_nodes=nodes)
    (best,) = found.plans
    assert best.ends[-1][0] - found.start[0] == pytest.approx(-shift, abs=off)
    assert "leaves its feature" not in best.reasons[-1]


def test_no_plan_goes_on_with_a_contact_at_the_very_end_of_its_feature():
    """A vertex slides to finger 2's tip; there the object was to be tipped about it."""
    finger = {"length": 0.1457, "inertia": 1.26e-3, "viscous": 0.005, "dry": 0.01, "torque_limit": 5.0}
    joints = 0.1153, -0.1153
    hand = {f"finger{k + 1}": finger | {"joint": [x, 0.0]} for k, x in enumerate(joints)}
    outline = [[-44.6, -0.7], [11.0, -32.4], [34.3, -14.2], [64.3, 23.3], [16.8, 28.0], [3.7, 24.8]]
    shape = {"vertices": [[x / 1e3, y / 1e3] for x, y in outline], "mass": 1.0, "friction": 0.1}
    start = {"on": "e1", "x": 0.0}
    hand["fingers"] = "layered"
    part = wa.parse_start({"title": "", "gravity": 9.81, "hand": hand, "object": shape, "start": start})
    corners = np.array(shape["vertices"]) - Polygon(shape["vertices"]).centroid.coords[0]
    found = wa.plan(part, by={"phi": 0.3}, count=1, max_nodes=100)
    (best,) = found.plans
    clearances = []
    for before, after, z in zip(best.steps[:-1], best.steps[1:], best.ends[:-1], strict=True):
        kept = {name.split()[0] for name in before.contacts} & {name.split()[0] for name in after.contacts}
        for name in kept:
            link, feature = name.split(":")
            if link != "palm" and feature[0] == "v":
                x, y = corners[int(feature[1:])]
                across = z[0] + x * np.cos(z[2]) - y * np.sin(z[2]) - joints[int(link[-1]) - 1]
                above = z[1] + x * np.sin(z[2]) + y * np.cos(z[2])
                clearances.append(0.1457 - np.hypot(across, above))
    assert len(clearances) >= 3
    assert min(clearances) > 1e-3


@pytest.fixture(scope="module")
def shifted_and_turned(part):
    return wa.plan(part, by={"x": -0.02, "phi": -0.3}, count=1, max_nodes=40)


def test_the_certificate_is_largest_at_the_places_where_phases_change(part, shifted_and_turned):
    """Thirds of paths, where the search leaves them, allow 0.0004 N."""
    (best,) = shifted_and_turned.plans
    places = [k for k, step in enumerate(best.steps[:-1]) if step.until is not None]
    assert len(places) >= 2
    for k, share in itertools.product(places, (-0.02, 0.02)):
        name, value = best.steps[k].until
        displacement = (best.ends[k] - best.begins[k])[COORDINATES.index(name)]
        data = to_dict(best.scene)
        data["phase"][k]["until"] = {name: value + share * float(displacement)}
        moved = wa.parse(data)
        if shifted_and_turned.goal.is_reached(np.asarray(wa.trace(moved)[-1].end)):
            assert min(certificates(moved)) < 1.005 * best.bound


def test_a_turn_that_nothing_holds_half_way_is_no_plan():
    """Tipped from further left, a T lies over a fingertip that cannot carry it: at each place alone torques might."""
    finger = {"length": 0.0634, "inertia": 5e-4, "viscous": 0.03, "torque_limit": 1.0}
    bar, stem = (0.0, 0.07527), (0.02709, 0.04817)
    low, high = 0.01816, 0.04088
    left, right = [[stem[1], 0], [stem[1], low], [bar[1], low]], [[bar[0], low], [stem[0], low]]
    data = {
        "title": "T",
        "gravity": [2.4, -9.5],
        "hand": {
            "finger1": {"joint": [0.0708, 0.0], **finger},
            "finger2": {"joint": [-0.0708, 0.0], **finger | {"torque_limit": 2.0}},
        },
        "object": {
            "vertices": [[stem[0], 0], *left, [bar[1], high], [bar[0], high], *right],
            "mass": 0.5,
            "friction": 0.1,
        },
        "start": {"on": "e5", "x": -0.0061},
        "phase": [
            {
                "name": "slide",
                "contacts": ["palm:v5", "palm:v6", "finger1:e0", "finger2:e4"],
                "toward": "theta1-",
                "until": {"theta2": 0.501},
                "duration": 1.0,
            },
            {
                "name": "tip",
                "contacts": ["finger2:e4 rolling", "palm:v5", "finger1:e0"],
                "toward": "phi+",
                "until": {"phi": 1.92},
                "duration": 1.0,
            },
        ],
    }
    scene = wa.parse(data)
    assert min(float(bound.value) for bound in wa.bounds(scene)) > 1.5
    assert wa.convex_bounds(scene)[1].margin < 0
    start, goal = np.asarray(scene.start), make_goal(np.asarray(scene.start), by={"phi": np.radians(20)})
    steps = [
        Step(phase.formation.names, row["toward"], next(iter(row["until"].items())), np.asarray(one.end), 1.0)
        for phase, row, one in zip(scene.phases, data["phase"], wa.trace(scene), strict=True)
    ]
    assert make_plan(scene, start, tuple(steps), 1.0, goal, 0.0) is None

    def begun_at(theta2, goal):
        return make_plan(scene, start, (replace(steps[0], until=("theta2", theta2)), steps[1]), 1.0, goal, 0.0)

    assert begun_at(0.47, None).bound > 1.2  # a swing, which cannot stop on its way
    assert begun_at(0.47, goal) is None
    held = begun_at(0.422, goal)
    assert held is not None
    np.testing.assert_allclose(held.bounds, certificates(held.scene), rtol=1e-7)
    assert held.bound < 0.6 * min(float(bound.value) for bound in wa.bounds(held.scene))


def test_a_place_moved_beyond_its_path_is_no_plan(part, shifted_and_turned):
    (best,) = shifted_and_turned.plans
    assert is_secure(best, regrasps=False)
    k = next(k for k, step in enumerate(best.steps) if step.until is not None)
    name, _ = best.steps[k].until
    row = COORDINATES.index(name)
    beyond = 20 * (best.ends[k] - best.begins[k])[row]
    step = replace(best.steps[k], until=(name, float(best.ends[k][row] + beyond)))
    beyond = make_plan(
        part, shifted_and_turned.start, (*best.steps[:k], step, *best.steps[k + 1 :])[: k + 2], 1.0, None
    )
    assert beyond is None or not is_secure(beyond, regrasps=False)


def test_a_way_back_leads_on_where_the_first_was_too_short_to_be_one():
    """0.3 mm to the left of the start finger 2's tip meets a vertex: too short a slide for a hand."""
    data = part_data()
    outline = [[40.1, 2.1], [31.2, 21.7], [-14.2, 38.1], [-41.3, 17.7], [-32.7, -25.1], [-8.7, -42.1], [28.7, -24.2]]
    data["object"] = {"vertices": (np.array(outline) / 1e3).tolist(), "mass": 0.25, "friction": 0.09}
    for finger in ("finger1", "finger2"):
        data["hand"][finger]["length"] = 0.11
    scene = wa.parse(data)
    start = jnp.asarray(resting_configuration(scene.object, scene.hand, 1, 0.01))
    scene = eqx.tree_at(lambda s: (s.start, s.phases), scene, (start, ()))
    found = wa.plan(scene, by={"x": -0.005}, count=1, max_nodes=15)
    assert found.found, found.reason
    assert [step.toward for step in found.plans[0].steps] == ["x+", "x-", "x-"]
    assert found.plans[0].ends[-1][0] - found.start[0] == pytest.approx(-0.005, abs=1e-6)


@pytest.mark.slow
def test_the_best_plan_can_be_optimised_as_it_is(turned):
    optimum = wa.optimise(turned.plans[0].scene, knots=21)
    assert optimum.result.status is wa.Status.OK
    assert optimum.result.margin <= turned.plans[0].bound * (1 + 1e-9)


def test_the_same_search_finds_the_same_plans(part, turned):
    again = wa.plan(part, by={"phi": -0.35}, count=2)
    assert [[step.contacts for step in one.steps] for one in again.plans] == [
        [step.contacts for step in one.steps] for one in turned.plans
    ]


def test_moves_are_the_formations_that_can_follow(part):
    """Both enumerations list the same paths, with the same ends."""
    listed = {
        (one.contacts, one.toward): np.asarray(one.end)
        for one in successor_formations(part, part.start, rolling=True)
        if one.status is wa.Status.OK
    }
    moves = {(one.contacts, one.toward): one.places[-1] for one in moves_from(part, part.start)}
    assert moves.keys() == listed.keys()
    for key, end in moves.items():
        np.testing.assert_allclose(end, listed[key], atol=1e-8)


def test_a_finger_moves_alone_only_where_regrasps_are_allowed():
    """Finger 1 is to stand away while all else stays where it is: no path of four sliding contacts leads there."""
    scene = wa.load("heptagon")
    begin = wa.trace(scene)[0].begin
    scene = eqx.tree_at(lambda s: (s.start, s.phases), scene, (begin, ()))
    wanted = {"goal": {"theta1": 0.9}, "by": {"x": 0.0, "phi": 0.0, "theta2": 0.0}}
    assert not wa.plan(scene, **wanted, max_phases=2, rolling=False).found
    found = wa.plan(scene, **wanted, max_phases=2, regrasp_cost=0.5, count=1)
    assert [step.regrasp for step in found.plans[0].steps] == ["finger1:away"]
    assert found.plans[0].scene.phases[0].name == "1: finger1:away"
    assert found.plans[0].bound > 0
    assert wa.optimise(found.plans[0].scene, knots=11).result.status is wa.Status.OK


@pytest.mark.parametrize(
    ("name", "degrees", "regrasp_cost", "nodes"),
    [
        ("heptagon", -90, 1.0, 250),
        pytest.param("heptagon", 90, 1.0, 1500, marks=pytest.mark.slow),
        pytest.param("hexagon", -90, None, 1500, marks=pytest.mark.slow),
    ],
)
def test_an_object_is_tumbled(name, degrees, regrasp_cost, nodes):
    """By a turn that takes more phases than the search for short plans allows."""
    scene = wa.load(name)
    found = wa.plan(scene, by={"phi": np.radians(degrees)}, regrasp_cost=regrasp_cost, count=1, max_nodes=nodes)
    plan = found.plans[0]
    assert len(plan.steps) > SHORT_PLAN
    optimum = wa.optimise(plan.scene, knots=21)
    assert optimum.result.status is wa.Status.OK
    traced = wa.trace(optimum.scene)
    assert float(traced[-1].end[2] - found.start[2]) == pytest.approx(np.radians(degrees), abs=np.radians(1))


def test_a_part_that_can_be_tipped_from_a_small_part_of_a_slide_only_is():
    """One of the exhaustive search's parts (`exhaustive_planning.py`): thirds of paths alone found nothing."""
    data = part_data()
    data["phase"] = [data["phase"][0] | {"contacts": ["palm:v0", "palm:v1", "finger1:v1", "finger2:v2"]}]
    vertices = [[0.036, -0.0159], [0.0235, 0.0313], [-0.0322, 0.0167], [-0.0261, -0.0247], [0.0147, -0.0332]]
    data["object"] = {"vertices": vertices, "mass": 0.19, "friction": 0.07}
    for finger, joint in (("finger1", 0.055), ("finger2", -0.055)):
        data["hand"][finger] |= {"joint": [joint, 0.0], "length": 0.09}
    part = wa.parse(data)
    z = resting_configuration(part.object, part.hand, 1, 0.01)
    part = eqx.tree_at(lambda s: (s.start, s.phases), part, (jnp.asarray(z), ()))
    found = wa.plan(part, by={"phi": np.radians(-15)}, count=1, max_nodes=120)
    assert found.plans[0].bound > 0.08
    assert any(step.delay > 0 for step in found.plans[0].steps)
    traced = wa.trace(found.plans[0].scene)
    assert float(traced[-1].end[2] - z[2]) == pytest.approx(np.radians(-15), abs=np.radians(1))


def test_what_has_been_found_when_the_search_ends_is_judged(part, monkeypatch):
    """The first configuration's moves reach the goal, but other places are to be looked at before it has its turn."""
    module = importlib.import_module("wholearm_jax.planning.search")

    def late(move, goal, unit):
        for step, is_end in move_stops(move, goal, unit):
            yield replace(step, delay=9.0 if goal.is_reached(step.end) else step.delay), is_end

    monkeypatch.setattr(module, "move_stops", late)
    found = wa.plan(part, by={"x": 0.01}, count=1, max_nodes=1)
    assert found.nodes == 1
    assert found.found
    assert found.plans[0].ends[-1][0] == pytest.approx(float(part.start[0]) + 0.01, abs=1e-3)


def test_an_unreachable_goal_names_the_nearest_pose(part):
    found = wa.plan(part, by={"x": 0.5}, max_phases=1)
    assert not found.found
    assert found.reason.startswith("no plan: all moves were tried; nearest: x is off by ")
    assert found.nearest is not None
    assert found.nearest.ends[-1][0] > float(part.start[0])


@pytest.mark.parametrize(
    ("by", "message"),
    [
        ({"x": -30.0}, "no plan: x = -29.98 m is far out of reach: lengths are in metres"),
        ({"phi": -90.0}, "no plan: phi = -90.26 rad is 14.4 turns: angles are in radians"),
    ],
)
def test_a_goal_in_another_unit_is_not_searched_for(part, by, message):
    found = wa.plan(part, by=by)
    assert found.reason.startswith(message)
    assert found.nodes == 0


def test_a_goal_at_which_the_start_is_already_is_not_searched_for(part):
    """Within the tolerances there is nothing to do; with smaller ones the same goal has a plan."""
    there = wa.plan(part, by={"x": 0.0005})
    assert not there.found
    assert there.nodes == 0
    assert there.reason.startswith("no plan: the start is within the goal's tolerances already")
    nearer = wa.plan(part, by={"x": 0.0005}, tolerance={"x": 1e-4}, count=1)
    assert nearer.plans[0].ends[-1][0] == pytest.approx(float(part.start[0]) + 0.0005, abs=1e-4)


def test_a_start_at_which_links_overlap_says_which(part):
    """Of fingers so long that they cross above the object, by shapely."""
    hand = eqx.tree_at(lambda h: h.length, part.hand, jnp.full(2, 0.17))
    z = resting_configuration(part.object, hand, 5, 0.02)
    found = wa.plan(eqx.tree_at(lambda s: (s.hand, s.start), part, (hand, jnp.asarray(z))), by={"x": -0.01})
    tips = [np.asarray(hand.joint[k]) + 0.17 * np.array([np.cos(z[3 + k]), np.sin(z[3 + k])]) for k in range(2)]
    fingers = [LineString([np.asarray(hand.joint[k]), tips[k]]) for k in range(2)]
    assert fingers[0].crosses(fingers[1])
    assert not found.found
    assert found.nodes == 0
    assert found.reason.startswith("no plan: at the start finger1 and finger2 cross, ")
    assert found.reason.endswith("layered)")
    distances = 0.6 * abs(np.asarray(hand.joint)[:, 0]).min(), 1.6 * abs(np.asarray(hand.joint)[:, 0]).max()
    ranges = "length=0.102:0.272,joint={:.3g}:{:.3g}".format(*distances)
    assert f"--hand-from {ranges}, or" in found.reason, "as the command line takes it"
    layered = eqx.tree_at(lambda h: h.layered, hand, jnp.array(True))  # what it advises helps: no finger is in the way
    other = wa.plan(eqx.tree_at(lambda s: (s.hand, s.start), part, (layered, jnp.asarray(z))), by={"x": -0.01})
    assert other.nodes > 0


def test_a_start_at_which_fingers_are_nearer_than_their_clearance_says_how_near(part):
    near = eqx.tree_at(lambda s: s.hand.clearance, part, jnp.asarray(0.2))
    found = wa.plan(near, by={"x": -0.01})
    assert found.nodes == 0
    assert " mm apart, of a clearance of 200 mm: search for a hand that fits" in found.reason
    assert "give them less clearance" in found.reason


def test_a_floor_for_the_margin_holds(part):
    assert not wa.plan(part, by={"phi": -0.35}, margin=5.0, max_phases=2).found


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "at least one coordinate"),
        ({"goal": {"z": 1.0}}, "'z' is not a coordinate"),
        ({"goal": {"x": 0.0}, "by": {"x": 0.1}}, "x is given twice"),
        ({"goal": {"x": float("nan")}}, "must be finite"),
        ({"goal": {"x": 0.0}, "tolerance": {"x": 0.0}}, "tolerances positive"),
    ],
)
def test_goals_that_cannot_be_understood_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_goal(np.zeros(5), **arguments)


@pytest.mark.parametrize("name", ["heptagon", "hexagon"])
@pytest.mark.parametrize("offset", [0.0, 0.004])
def test_fingers_close_until_they_touch(name, offset):
    """Against shapely: the contact edges touch the outline, and nothing lies inside."""
    data = part_data(name)
    for finger in ("finger1", "finger2"):
        data["hand"][finger]["offset"] = offset
    scene = wa.parse(data)
    z = resting_configuration(scene.object, scene.hand, 5, 0.01)
    corners = np.asarray(data["object"]["vertices"])
    centre = np.asarray(Polygon(corners).centroid.coords[0])
    turn = np.array([[np.cos(z[2]), -np.sin(z[2])], [np.sin(z[2]), np.cos(z[2])]])
    outline = Polygon((corners - centre) @ turn.T + z[:2])
    assert outline.bounds[1] == pytest.approx(0.0, abs=1e-12)
    for finger, side in enumerate((1, -1)):
        along = np.array([np.cos(z[3 + finger]), np.sin(z[3 + finger])])
        base = np.asarray(scene.hand.joint[finger]) + side * offset * np.array([-along[1], along[0]])
        edge = LineString([base, base + 0.13 * along])
        assert edge.distance(outline) < 1e-12
        assert edge.intersection(outline.buffer(-1e-9)).length == 0


def write_scene(folder, **changes):
    data = part_data()
    data.pop("phase")
    data["start"] = {"on": "e5", "x": 0.02}
    path = folder / "part.toml"
    path.write_text(tomli_w.dumps(data | changes))
    return path


def test_the_file_says_start_and_goal(tmp_path):
    path = write_scene(tmp_path, goal={"by": {"x": -0.03, "phi": "-20 deg"}, "tolerance": {"x": 0.002}})
    found = load_goal(path)
    assert found == {"goal": {}, "by": {"x": -0.03, "phi": -np.radians(20)}, "tolerance": {"x": 0.002}}
    start = load_start(path).start
    np.testing.assert_allclose(start[:3], [0.02, 0.0373555, -0.2587709], atol=1e-6)
    assert load_goal(write_scene(tmp_path)) is None
    with pytest.raises(SceneError, match=r"start.on: e9: the object has edges 0 to 6"):
        load_start(write_scene(tmp_path, start={"on": "e9"}))
    with pytest.raises(SceneError, match=r"goal.z: unknown key"):
        load_goal(write_scene(tmp_path, goal={"z": 1.0}))


def test_the_command_writes_a_scene_that_optimise_takes(wholearm, tmp_path):
    path = write_scene(tmp_path)
    code, out, err = wholearm("plan", path, "--by", "x=-0.03", "--count", "1", "--out", tmp_path / "out")
    assert code == 0, err
    assert "bound" in out
    planned = wa.load(tmp_path / "out" / "plan.toml")
    assert len(planned.phases) == 1
    assert (tmp_path / "out" / "plan.png").exists()
    assert (tmp_path / "out" / "search.png").exists()
    refused, _, err = wholearm("plan", path, "--by", "q=1")
    assert refused == 2
    assert "write coordinates and values" in err


def test_the_command_says_what_may_help_that_has_not_been_tried(wholearm, tmp_path):
    path = write_scene(tmp_path)
    command = ("plan", path, "--phases", "1", "--by")
    code, _, err = wholearm(*command, "x=0.5")
    assert code == 1
    assert "what may help: --regrasp-cost 1, so that fingers may go elsewhere; --hand-from length=0.078:0.208" in err
    assert "--time" not in err, "all moves were tried"
    assert "edge" not in err, "it is not to turn"
    code, _, err = wholearm(*command, "phi=-3", "--regrasp-cost", "1", "--time", "0")
    assert code == 1
    assert "what may help: --time 60, for a longer search; --hand-from" in err
    assert "--regrasp-cost" not in err
    assert "a start on another edge and more friction at the palm" in err
    shape = part_data()["object"] | {"friction": {"palm": 0.5, "finger1": 0.1, "finger2": 0.1}}
    path = write_scene(tmp_path, object=shape)
    _, _, err = wholearm("plan", path, "--phases", "1", "--by", "phi=-3", "--time", "0")
    assert "a start on another edge: what lies flat" in err


def test_where_no_hand_has_a_plan_the_command_goes_on_with_the_nearest(wholearm, tmp_path):
    """Not with the scene's own, whose fingers cross."""
    data = part_data()
    for finger in ("finger1", "finger2"):
        data["hand"][finger]["length"] = 0.17
    path = write_scene(tmp_path, hand=data["hand"])
    ranges = {"length": (0.11, 0.13), "joint": (0.07, 0.08)}
    text = ",".join(f"{name}={low}:{high}" for name, (low, high) in ranges.items())
    out = tmp_path / "out"
    code, _, err = wholearm(
        "plan", path, "--by", "x=-0.5", "--phases", "1", "--hand-from", text, "--out", out, "--count", "1"
    )
    assert code == 1
    nearest = wa.plan_with_hand(load_start(path), by={"x": -0.5}, max_phases=1, count=1, **ranges).nearest.hand
    joint, length = float(nearest.joint[0, 0]), float(nearest.length[0])
    said = f"0 have a plan; the nearest, searched for longer: joints at -+{joint:.4g} m, fingers {length:.4g} m long"
    assert said in err
    assert "no plan: all moves were tried; nearest: x is off by" in err
    assert "cross" not in err
    np.testing.assert_array_equal(wa.load(out / "nearest.toml").hand.length, nearest.length)


def test_a_start_beyond_a_joints_range_says_which(part):
    """Both fingers of a part at rest stand steeper than 45 degrees; with the range that is advised, a search begins."""
    narrow = eqx.tree_at(lambda s: s.hand.range, part, jnp.asarray([[0.1, np.pi / 4], [0.1, 3.0]]))
    found = wa.plan(narrow, by={"x": -0.01})
    beyond = np.degrees(float(part.start[3])) - 45
    advice = "give the joint more range, or correct its pose and angles"
    assert found.reason == f"no plan: at the start finger1 is {beyond:.3g} deg beyond its range: {advice}"
    wide = eqx.tree_at(lambda s: s.hand.range, part, jnp.asarray([[0.1, 3.0], [0.1, 3.0]]))
    assert wa.plan(wide, by={"x": -0.01}, max_nodes=1).nodes == 1


def test_the_command_says_what_a_finger_does_that_moves_alone(wholearm):
    command = ("plan", "heptagon", "--goal", "theta1=0.9", "--regrasp-cost", "0", "--count", "1", "--phases", "1")
    code, out, _ = wholearm(*command)
    assert code == 0
    assert "regrasp" in out
    assert "finger1:away" in out
    code, out, _ = wholearm(*command, "--json")
    assert code == 0
    assert [phase["regrasp"] for phase in json.loads(out)["plans"][0]["phases"]] == ["finger1:away"]
