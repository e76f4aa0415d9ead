"""Hand-overs: where a vertex reaches a fingertip at rest, torques must do under either of the two contacts."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from reference.unreduced import Model

import wholearm_jax as wa
from wholearm_jax.cli.output import note_hand_overs
from wholearm_jax.core import Status
from wholearm_jax.phases import STARTING, STOPPING, find_hand_overs, one_sided_torques, possible_hand_overs

FINGER = {"length": 0.11, "inertia": 2e-3, "viscous": 0.02, "dry": 0.01, "torque_limit": 1.0}
HAND = {f"finger{k}": FINGER | {"joint": [x, 0.0]} for k, x in ((1, 0.08), (2, -0.08))}
BOX = [[0.0, 0.0], [0.0518, 0.0], [0.0518, 0.0498], [0.0, 0.0498]]
VERTICES = ["palm:v0", "palm:v1", "finger1:v2", "finger2:v3"]


def box_scene(*phases):
    """A box that slides to the right until finger 2's tip reaches its vertex 3, and goes on from there."""
    first = {"name": "1", "contacts": VERTICES, "toward": "x+", "duration": 1.0}
    start = {"x": 0.01, "y": 0.0249, "phi": 0.0, "theta1": 2.295, "theta2": 0.661}
    return {
        "title": "box",
        "gravity": 9.81,
        "hand": HAND,
        "object": {"vertices": BOX, "mass": 0.2, "friction": 0.1},
        "start": start,
        "phase": [first, *phases],
    }


SLIDE = {
    "name": "2",
    "contacts": ["palm:v0", "palm:v1", "finger1:v2", "finger2:e3"],
    "toward": "x+",
    "until": {"x": 0.051},
    "duration": 1.0,
}
ROLL = {
    "name": "2",
    "contacts": ["finger2:e3 rolling", "palm:v1", "finger1:v2"],
    "toward": "x-",
    "until": {"x": 0.03},
    "duration": 1.0,
}


def hand_over_of(data):
    scene = wa.parse(copy.deepcopy(data))
    traced = wa.trace(scene)
    return scene, traced, find_hand_overs(scene, traced)[1]


@pytest.fixture(scope="module")
def sliding():
    return hand_over_of(box_scene(SLIDE))


def test_a_vertex_that_reaches_a_tip_hands_over_to_it(sliding):
    scene, traced, over = sliding
    assert (over.before.name, over.after.name) == ("finger2:v3", "finger2:e3")
    assert find_hand_overs(scene, traced)[0] is None
    np.testing.assert_allclose(traced[0].end, traced[1].begin, atol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["start", "arrival"])
def test_forces_of_both_contacts_are_those_of_the_unreduced_equations(sliding, sign):
    """The least force by either contact, and that it moves or brakes the object, from Newton's and Euler's laws."""
    _, traced, over = sliding
    best, z, least = over.best_motion(sign), np.array(traced[0].end), []
    for contacts in (VERTICES, SLIDE["contacts"]):
        model = Model(box_scene(), contacts)
        tangent = model.direction(z, "x+")
        acceleration, forces = model.solve(z, np.zeros(5), best.torque, np.sign(model.reversing(z, tangent)))
        assert sign * acceleration @ tangent > 0
        least.append(forces.min())
    np.testing.assert_allclose(best.margin, min(least), rtol=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["start", "arrival"])
def test_no_torque_of_a_grid_does_better(sliding, sign):
    _, traced, over = sliding
    best, z = over.best_motion(sign), np.array(traced[0].end)
    models = [Model(box_scene(), contacts) for contacts in (VERTICES, SLIDE["contacts"])]
    tangents = [model.direction(z, "x+") for model in models]
    grid, margins = np.linspace(-1.0, 1.0, 41), []
    for torque in np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2):
        pairs = list(zip(models, tangents, strict=True))
        found = [m.solve(z, np.zeros(5), torque, np.sign(m.reversing(z, t))) for m, t in pairs]
        if all(sign * a @ t > 0 for (a, _), t in zip(found, tangents, strict=True)):
            margins.append(min(forces.min() for _, forces in found))
    assert best.margin - 0.5 < max(margins) < best.margin + 0.5  # as coarse as the grid is; it asks for no surplus


def linear_in_torque(z, contacts):
    """Acceleration along the path and forces of the un-reduced equations at rest, linear in `(1, tau1, tau2)`."""
    model = Model(box_scene(), contacts)
    tangent = model.direction(z, "x+")
    sign = np.sign(model.reversing(z, tangent))
    solved = [model.solve(z, np.zeros(5), torque, sign) for torque in ([0.0, 0.0], [1.0, 0.0], [0.0, 1.0])]
    rows = np.array([np.append(acceleration @ tangent, forces) for acceleration, forces in solved]).T
    rows[:, 1:] -= rows[:, :1]
    return rows[0], rows[1:]


@pytest.mark.parametrize("sign", [STARTING, STOPPING], ids=["start", "arrival"])
def test_the_best_by_the_planned_contact_that_serves_by_the_other(sliding, sign):
    """Torques of a grid serve where the un-reduced equations say so, and none of them does better."""
    _, traced, over = sliding
    both = [linear_in_torque(np.array(traced[0].end), contacts) for contacts in (VERTICES, SLIDE["contacts"])]
    (_, planned), (ahead, other) = both if sign == STOPPING else both[::-1]
    grid = np.linspace(-1.0, 1.0, 201)
    torques = np.stack([np.ones(grid.size**2), *(a.ravel() for a in np.meshgrid(grid, grid))])

    serves = (other @ torques).min(0) >= 0.5 * over.best_motion(sign).margin
    if sign == STOPPING:
        serves &= -(ahead @ torques) / np.linalg.norm(ahead[1:]) >= 0.03
    np.testing.assert_array_equal((over.unplanned_rows(sign) @ torques).min(0) >= 0, serves)
    assert 0.01 < serves.mean() < 0.9

    best, of_grid = over.planned_margin(sign), (planned @ torques).min(0)[serves].max()
    assert over.best_motion(sign).margin <= best
    assert best - 0.1 < of_grid < best + 1e-9  # as coarse as the grid is


def test_a_torque_that_holds_by_one_contact_alone_holds_no_object(sliding):
    """While the object waits at the hand-over, the margin is that of the contact that holds it less well."""
    scene, traced, over = sliding
    before, after = over
    alone = after.statics.most_central_torque(after.accelerations)
    assert alone.margin > 0
    assert before.statics.margin_under(alone.torque).margin < 0
    both = over.best_hold()
    assert both.margin > 0
    for one in over:
        assert one.statics.margin_under(both.torque).margin >= 0.98 * both.margin
    for hold, status in ((alone.torque, Status.CONTACT_LOST), (both.torque, None)):
        torque = wa.torque_schedule([0.0, 1.0, 1.0, 2.0], [both.torque, both.torque, hold, hold])
        second = wa.simulate(scene, torque, traced=traced).phases[1]
        if status is not None:
            assert (second.status, second.time) == (status, pytest.approx(1.0))
        assert (second.holds[0].loss_time is None) == (status is None)


@pytest.fixture(scope="module")
def optimum(sliding):
    scene, traced, _ = sliding
    return wa.optimise(scene, traced=traced)


def with_torques_at_the_hand_over(result, stops, starts):
    """A plan as it was simulated, beside a schedule with other torques before and after its hand-over."""
    times, values = np.array(result.torque.times), np.array(result.torque.values)
    rows = np.flatnonzero(abs(times - result.phases[1].start) < 1e-9)
    waits = [held.end for held in result.phases[1].holds]
    departs = np.flatnonzero(abs(times - max([result.phases[1].start, *waits])) < 1e-9)
    values[rows[0]], values[departs[-1]] = stops, starts
    return replace(result, torque=wa.torque_schedule(times, values))


def test_torques_that_do_by_one_contact_alone_are_those_of_the_unreduced_equations(sliding, optimum):
    """Who comes early is stopped by the contact that takes over, who comes late is started by the one that ends."""
    _, traced, over = sliding
    z, rng = np.array(traced[0].end), np.random.default_rng(4)
    models = [Model(box_scene(), contacts) for contacts in (VERTICES, SLIDE["contacts"])]
    tangents = [model.direction(z, "x+") for model in models]
    counts = {True: [0, 0], False: [0, 0]}
    for torque in rng.uniform(-1.0, 1.0, (60, 2)):
        moved = [
            m.solve(z, np.zeros(5), torque, np.sign(m.reversing(z, t))) for m, t in zip(models, tangents, strict=True)
        ]
        (_, late), (acceleration, early) = moved
        goes_on = acceleration @ tangents[1] >= 0
        lost = {True: bool(early.min() < 0 or goes_on), False: bool(late.min() < 0)}
        found = one_sided_torques(with_torques_at_the_hand_over(optimum.result, torque, torque))
        for stops, expected in lost.items():
            match = [one for one in found if one.stops is stops]
            assert len(match) == expected
            counts[stops][expected] += 1
            if match:
                names = (over.before.name, over.after.name) if stops else (over.after.name, over.before.name)
                assert (match[0].planned, match[0].other) == names
                assert match[0].force == pytest.approx((early if stops else late).min(), rel=1e-6)
    assert min(*counts[True], *counts[False]) > 3


def test_torques_that_do_by_one_contact_alone_are_noted(sliding, optimum, capsys):
    _, _, over = sliding
    note_hand_overs(with_torques_at_the_hand_over(optimum.result, [-1.0, -1.0], over.best_motion(1.0).torque))
    assert "the torques that stop the object at 1 s do so by finger2:v3 alone" in (err := capsys.readouterr().err)
    assert "if it comes there a moment early, finger2:e3 holds it, and contacts are lost" in err
    best = [over.best_motion(sign).torque for sign in (-1.0, 1.0)]
    note_hand_overs(with_torques_at_the_hand_over(optimum.result, *best))
    assert capsys.readouterr().err == ""


def test_what_is_optimised_serves_by_either_contact(sliding, optimum):
    """An object that comes up to a hundredth of the motion early or late meets torques that move it as planned."""
    z = np.array(sliding[1][0].end)
    first, second = optimum.result.phases
    early, late = (Model(box_scene(), contacts) for contacts in (SLIDE["contacts"], VERTICES))
    times, values = np.array(optimum.torque.times), np.array(optimum.torque.values)
    begin, departs = (max([phase.start, *(held.end for held in phase.holds)]) for phase in (first, second))
    end = second.start + second.duration

    def moved(model, moments):
        tangent = model.direction(z, "x+")
        for moment in moments:
            torque = [np.interp(moment, times, column) for column in values.T]
            acceleration, forces = model.solve(z, np.zeros(5), torque, np.sign(model.reversing(z, tangent)))
            yield acceleration @ tangent, forces.min()

    for along, least in moved(early, second.start - (second.start - begin) * np.linspace(1e-9, 0.01, 7)):
        assert along < 0 < least
    for _, least in moved(late, departs + (end - departs) * np.linspace(1e-9, 0.01, 7)):
        assert least > 0
    assert one_sided_torques(optimum.result) == ()


def test_what_is_optimised_waits_by_either_contact(optimum):
    assert optimum.result.status is Status.OK, optimum.result.message
    assert all(held.margin > 0 for held in optimum.result.phases[1].holds)


def test_a_hand_over_that_no_torque_survives_is_named():
    """Finger 2 is rough: what presses the vertex against it moves the tip along the edge."""
    data = box_scene(SLIDE)
    data["object"]["friction"] = {"palm": 0.1, "finger1": 0.1, "finger2": 0.9}
    scene, _, over = hand_over_of(data)
    assert over.margin < 0
    optimum = wa.optimise(scene)
    assert optimum.result.status is not Status.OK
    assert "finger2:v3 hands over to finger2:e3 there, and no torque" in optimum.result.message
    assert "hand over elsewhere" in optimum.result.message


def test_a_tip_does_not_roll_at_the_vertex_that_it_takes_over_at():
    """It would be a corner on a corner all the way."""
    optimum = wa.optimise(wa.parse(box_scene(ROLL)))
    assert optimum.result.phases[1].status is Status.LEFT_FORMATION
    assert "finger2:e3 rolling at the end of its feature, where it slips off" in optimum.result.message


@pytest.mark.parametrize(
    ("before", "after", "may"),
    [
        (("finger2:v3",), ("finger2:e3",), True),
        (("finger2:v3",), ("finger2:e2",), True),
        (("finger2:e0",), ("finger2:e3 rolling",), True),
        (("finger2:v3",), ("finger1:e3",), False),
        (("finger2:v3",), ("finger2:v0",), False),
        (("finger2:v3",), ("finger2:e0",), False),
        (("finger2:away",), ("finger2:e0",), False),
    ],
)
def test_which_contacts_may_hand_over(before, after, may):
    assert any(possible_hand_overs(before, after, 4)) is may
