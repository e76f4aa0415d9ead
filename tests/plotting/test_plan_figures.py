"""Figures: drawn on the axes given or on new ones, returned, with what the result says; a paper's settings."""

import equinox as eqx
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from support import layered

from wholearm_jax.files.scene_toml import parse, to_dict
from wholearm_jax.model.schedule import torque_schedule
from wholearm_jax.phases.plan_simulation import simulate
from wholearm_jax.plotting.palette import CONTACT_COLOURS, DASHES, contact_styles
from wholearm_jax.plotting.plan_figures import plot_forces, plot_result, plot_torques
from wholearm_jax.plotting.pose_figures import plot_plan_poses, plot_pose, plot_strip
from wholearm_jax.plotting.style import COLUMN, PAPER, format_time_axis

mpl.use("agg")


@pytest.fixture(scope="module")
def pushed():
    """The heptagon pushed to the left under constant torques."""
    data = to_dict(layered("heptagon"))
    data["phase"] = [data["phase"][0] | {"arrive": "caught", "duration": 0.3}]
    return simulate(parse(data), torque_schedule([0.0, 0.3], [[0.55, -0.24]] * 2))


@pytest.fixture(autouse=True)
def closed():
    """Each test begins without a figure, whatever the ones before it have left open, and leaves none."""
    plt.close("all")
    yield
    plt.close("all")


@pytest.mark.parametrize("draw", [plot_torques, plot_forces])
def test_draws_on_the_axes_given(draw, pushed):
    _, (used, other) = plt.subplots(1, 2)
    assert draw(pushed, used) is used
    assert used.lines
    assert not other.lines
    assert draw(pushed) is plt.gca()


def test_results_compose(pushed):
    figure, grid = plt.subplots(2, 2)
    assert list(plot_result(pushed, grid[:, 0])) == list(grid[:, 0])
    assert list(plot_strip(pushed, axes=grid[:, 1:].T)[0]) == list(grid[:, 1])
    assert len(grid[1, 1].patches) == 1  # the object
    assert figure.axes == list(grid.flat)  # none was added


def test_forces_show_the_margin_and_every_contact(pushed):
    ax = plot_forces(pushed)
    legend = ax.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == list(pushed.phases[0].contacts)
    (dot,) = (line for line in ax.lines if line.get_marker() == "o")
    np.testing.assert_allclose(dot.get_xydata()[0], (pushed.phases[0].margin_time, pushed.margin))
    assert any(f"margin {pushed.margin:.3g} N" in text.get_text() for text in ax.texts)


def test_pose_numbers_its_vertices(pushed):
    ax = plot_pose(pushed.scene, pushed.phases[0].traced.begin, numbers=True)
    assert [text.get_text() for text in ax.texts] == [str(k) for k in range(7)]


def test_phases_are_numbered_where_their_names_do_not_fit(pushed):
    names = [phase.name for phase in pushed.phases]
    for width, labels in ((10.0, names), (0.4, ["1"])):
        ax = plt.figure(figsize=(width, 2.0)).add_subplot()
        format_time_axis(ax, pushed)
        assert [text.get_text() for text in ax.texts] == labels
        plt.close()


def test_poses_of_a_long_plan_stand_in_rows(pushed):
    z = np.asarray(pushed.scene.start)
    long = eqx.tree_at(lambda scene: scene.phases, pushed.scene, pushed.scene.phases[:1] * 6)
    axes = plot_plan_poses(long, [z] * 6, [z] * 6)
    assert axes.shape == (2, 5)
    assert [bool(ax.title.get_text()) for ax in axes.flat] == [True] * 7 + [False] * 3
    width, height = axes[0, 0].figure.get_size_inches()
    assert width > height
    plt.close()


def test_settings_of_a_paper(pushed):
    with plt.rc_context(PAPER):
        figure = plot_result(pushed)[0].figure
        assert mpl.rcParams["font.size"] == 8
        assert mpl.rcParams["pdf.fonttype"] == 42
    assert figure.get_size_inches()[0] == COLUMN


def test_contacts_are_told_apart():
    several = [[f"palm:v{k}" for k in range(4)], [f"finger1:v{k}" for k in range(8)]]
    styles = contact_styles(several)
    assert len(set(styles.values())) == len(styles) == 12
    assert all(colour < len(CONTACT_COLOURS) and dash < len(DASHES) for colour, dash in styles.values())
