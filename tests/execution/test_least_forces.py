"""The least normal force on the way: of which contacts, from when on, and while what moves."""

import numpy as np
import pytest

from wholearm_jax.execution.least_forces import WINDOW, PlannedContacts, least_force

pytest.importorskip("mujoco")

STEP = WINDOW / 5
NAMES = ("palm:v0", "finger1:v1", "finger2:v2")
PLAN = PlannedContacts((("palm:v0", "finger1:v1"), ("finger1:v1", "finger2:v2")), np.array([0.1, 0.2]))


def held() -> np.ndarray:
    """Forces of 5 N of each phase's contacts."""
    forces = np.full((200, 3), 5.0)
    forces[:100, 2], forces[100:, 0] = 0.0, 0.0
    return forces


def least_of(forces, rates=None) -> float:
    phase = np.repeat([0, 1], 100)
    rates = np.ones((200, 2)) if rates is None else rates
    return least_force(PLAN, NAMES, phase, rates, forces, STEP)


def test_only_contacts_of_the_phase_count():
    forces = held()
    assert least_of(forces) == 5.0


def test_forces_are_averaged_over_the_window():
    forces = held()
    forces[50, 0] = 2.0
    assert least_of(forces) == pytest.approx(5.0 - 3.0 / 5)
    forces[50:55, 0] = 2.0
    assert least_of(forces) == pytest.approx(2.0)


def test_a_contact_counts_once_all_have_pressed():
    """A part that stops some micrometres before its stop closes the last contact on its way."""
    forces = held()
    forces[100:110, 2] = 0.0
    assert least_of(forces) == 5.0
    forces[150:155, 2] = 0.0
    assert least_of(forces) == 0.0


def test_a_phase_ends_where_another_contact_presses():
    """What comes to its stop too fast rebounds from the contacts that it had."""
    forces = held()
    forces[80:100, 2] = 1.0
    forces[90:100, 1] = 0.0
    assert least_of(forces) == 5.0
    forces[70:75, 1] = 0.0
    assert least_of(forces) == 0.0


def test_contacts_that_never_press_at_once_are_lost():
    forces = held()
    forces[100:, 2] = 0.0
    assert least_of(forces) == 0.0


def test_at_rest_friction_takes_any_part_of_the_forces():
    forces, rates = held(), np.ones((200, 2))
    rates[90:100], forces[90:100, :2] = 0.0, 1.0
    assert least_of(forces, rates) == 5.0
    assert least_of(forces, 0 * rates) == np.inf
