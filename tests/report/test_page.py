"""Reports: what the page says is what the files say, and in a browser it plays, scrubs and fits."""

import json
import re
import shutil

import numpy as np
import pytest
from support import layered

from wholearm_jax.core.errors import SceneError
from wholearm_jax.feedback import Controller, PhaseLaw
from wholearm_jax.files.controller_json import write_controller
from wholearm_jax.files.results import summary, write_summary, write_torque, write_trajectory
from wholearm_jax.files.scene_toml import parse, to_dict
from wholearm_jax.model.schedule import torque_schedule
from wholearm_jax.phases.plan_simulation import simulate
from wholearm_jax.report.page import render, report
from wholearm_jax.report.result_folder import critical_phase, load_result_folder

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
CHROMIUM = next((path for path in map(shutil.which, NAMES) if path), None)
TITLE = "a <b>heptagon</b> </script><script>throw 1</script>"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The heptagon pushed to the left in two phases under constant torques, written as the command line does."""
    data = to_dict(layered("heptagon"))
    slide = data["phase"][0] | {"arrive": "caught", "duration": 0.3}
    data["phase"] = [slide | {"name": "near", "until": {"x": 0.0}}, slide | {"name": "far"}]
    data["title"] = TITLE
    result = simulate(parse(data), torque_schedule([0.0, 0.3, 0.3, 0.6], [[0.55, -0.24]] * 2 + [[0.5, -0.1]] * 2))
    assert result.status.label == "ok"
    place = tmp_path_factory.mktemp("result")
    write_torque(result.torque, place / "torque.csv")
    write_trajectory(result, place / "trajectory.csv", 101)
    content = summary(result, bounds=(2 * result.phases[0].margin, float("-inf")), command="simulate")
    write_summary(content, place / "summary.json")
    (place / "report.html").write_text(report(place))
    return place


@pytest.fixture
def copied(folder, tmp_path):
    """A copy of the folder to spoil."""
    return shutil.copytree(folder, tmp_path / "result")


def drawn(page: str):
    """The numbers that the page draws."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found.group(1))


def test_forces_drawn_balance_the_weight(folder):
    """While it slides on the palm without turning or falling, the arrows' vertical parts add up to the weight."""
    phase = drawn((folder / "report.html").read_text())["phases"][0]
    cn, ct, places = (np.array(phase[name], float) for name in ("cn", "ct", "places"))
    normal = places[..., 2:]
    tangent = np.stack([normal[..., 1], -normal[..., 0]], axis=-1)
    total = (cn[..., None] * normal + ct[..., None] * tangent).sum(1)
    moving = np.isfinite(total[:, 1])
    assert moving.sum() > 20
    np.testing.assert_allclose(total[moving, 1], 0.2 * 9.81, rtol=1e-5)
    vertices, z = np.array(drawn((folder / "report.html").read_text())["vertices"]), np.array(phase["z"])[-1]
    c, s = np.cos(z[2]), np.sin(z[2])
    np.testing.assert_allclose(places[-1, 0, :2], z[:2] + [[c, -s], [s, c]] @ vertices[5], atol=1e-6)  # palm:v5


def test_page_holds_everything_it_needs(folder):
    page = (folder / "report.html").read_text()
    assert not re.search(r"<link|<img|@import|url\(|src=", page)
    assert set(re.findall(r"https?://[^\s\"']+", page)) == {"http://www.w3.org/2000/svg"}  # a name, not an address
    assert "throw 1</script>" not in page
    assert "50.0 %" in page
    content = json.loads((folder / "summary.json").read_text())
    assert f'id="margin">{content["margin"]:.4g}<' in page
    for phase in content["phases"]:
        assert phase["margin_contact"] in page


def test_where_each_phase_begins_and_ends(folder):
    """In millimetres and degrees, as the rows of the trajectory say."""
    page = (folder / "report.html").read_text()
    table = re.search(r'<table id="poses">.*?</table>', page, re.DOTALL)
    assert table is not None
    shown = [re.findall(r"<t[dh][^>]*>([^<]*)</t[dh]>", row) for row in re.findall(r"<tr><th scope.*?</tr>", table[0])]
    rows = [row.split(",") for row in (folder / "trajectory.csv").read_text().splitlines()[1:]]
    assert [cells[0] for cells in shown] == ["near", "far"]
    for name, begin, begin_angle, end, end_angle, displacement, turn in shown:
        own = np.array([[float(v) for v in row[2:5]] for row in rows if row[1] == name])
        first, last = own[0], own[-1]
        for text, position in ((begin, first), (end, last), (displacement, last - first)):
            np.testing.assert_allclose([float(v) for v in text.split(",")], 1e3 * position[:2], atol=0.051)
        for text, angle in ((begin_angle, first[2]), (end_angle, last[2]), (turn, last[2] - first[2])):
            assert float(text) == pytest.approx(np.degrees(angle), abs=0.051)


def law(*names):
    """A law of phases along one straight path, the last of them pressed against a contact."""
    common = {"contacts": ("palm:v4",), "flows": False, "margin": 0.25, "approach": 0.15}
    path = {"s": [0.0, 0.5], "theta": [[1.0, 1.0], [1.4, 1.3]], "tangent": [[0.8, 0.6]] * 2}
    motion = {"time": [0.0, 0.3], "s_ref": [0.0, 0.5], "v_ref": [0.0, 0.0]}
    torques = {"torque": [[0.1, 0.2]] * 2, "gain": [[2e-3, -1e-3]] * 2}
    tables = {name: np.array(values) for name, values in (path | motion | torques).items()}
    phases = [
        PhaseLaw(name=name, reach=press / 200, press=press, **common, **tables)
        for name, press in zip(names, (0.0, 20.0), strict=True)
    ]
    return Controller("", tuple(phases), 60.0, 10.0, 200.0, 0.3, (0.05, 0.03), 1.0, np.ones(2))


def test_a_law_has_a_table_of_what_it_holds_and_how_its_phases_end(copied):
    assert 'id="law"' not in report(copied)
    write_controller(law("near", "far"), copied / "controller.json")
    page = report(copied)
    rows = re.findall(r"<tr><th scope.*?</tr>", re.search(r'<table id="law">.*?</table>', page, re.DOTALL)[0])
    cells = [re.findall(r"<t[dh][^>]*>([^<]*)</t[dh]>", row) for row in rows]
    assert cells == [
        ["near", "0.25", "0.3", "0.5", "by the clock, at rest"],
        ["far", "0.25", "0.3", "0.5", "pressed against the new contact, by up to 0.04 and 0.02 N m"],
    ]


def test_a_law_of_another_plan_is_refused(copied):
    write_controller(law("near", "farther"), copied / "controller.json")
    with pytest.raises(SceneError, match=r"controller\.json: phases are not those of summary\.json"):
        report(copied)
    (copied / "controller.json").write_text("{}")
    with pytest.raises(SceneError, match=r"controller\.json: version"):
        report(copied)


def test_a_plan_without_motion(folder):
    written = load_result_folder(folder)
    failed = written.summary | {"status": "singular", "margin": None, "message": "near: singular"}
    blank = {"status": "singular", "margin": None, "margin_time": None, "bound": None}
    failed["phases"] = [row | blank for row in failed["phases"]]
    page = render(written._replace(summary=failed, trajectories={}))
    assert "There is no motion to show" in page
    assert drawn(page)["phases"] == []


BAD = {
    "no summary": ("summary.json", None, "no such file"),
    "not JSON": ("summary.json", "{", "cannot be read"),
    "another JSON": ("summary.json", "[1]", "must be a table; it is not a summary"),
    "deep JSON": ("summary.json", "[" * 100_000, "cannot be read"),
    "no trajectory": ("trajectory.csv", None, "no such file"),
    "empty trajectory": ("trajectory.csv", "", "line 1: the header must be t,phase,x"),
    "another table": ("trajectory.csv", "t,x\n1,2\n", "line 1: the header must be t,phase,x"),
    "no torque": ("torque.csv", None, "no such file"),
}


@pytest.mark.parametrize(("name", "text", "cause"), BAD.values(), ids=BAD.keys())
def test_bad_folders_are_named(name, text, cause, copied):
    (copied / name).unlink()
    if text is not None:
        (copied / name).write_text(text)
    with pytest.raises(SceneError) as caught:
        report(copied)
    message = str(caught.value)
    assert message.startswith(f"{copied / name}: {cause}")
    assert "\n" not in message


@pytest.mark.parametrize("row", ["0.1,near,much", "0.1,elsewhere" + ",0" * 20, "0.1,near,1"])
def test_bad_rows_are_named_by_line(row, copied):
    path = copied / "trajectory.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:5], row, *lines[5:]]) + "\n")
    with pytest.raises(SceneError, match=r"trajectory\.csv: line 6: not a row"):
        report(copied)


def test_summary_of_another_scene(copied):
    content = json.loads((copied / "summary.json").read_text())
    content["phases"][0]["name"] = "elsewhere"
    (copied / "summary.json").write_text(json.dumps(content))
    with pytest.raises(SceneError, match="phases are not those of its scene"):
        report(copied)


SPOILT = {
    "status": (3, "status: must be text, not 3"),
    "margin": ("5", "margin: must be a number, not '5'"),
    "message": (None, "message: must be text"),
    "phases": (None, "phases: must be a list"),
    "scene": ([], "scene: must be a table"),
}


@pytest.mark.parametrize(("key", "value", "cause"), [(key, *rest) for key, rest in SPOILT.items()], ids=SPOILT.keys())
def test_a_summary_with_something_else_in_it(key, value, cause, copied):
    content = json.loads((copied / "summary.json").read_text())
    (copied / "summary.json").write_text(json.dumps(content | {key: value}))
    with pytest.raises(SceneError) as caught:
        report(copied)
    assert str(caught.value).startswith(f"{copied / 'summary.json'}: {cause}")


PHASE_SPOILT = {
    "status": ("fine", "phases[1].status: 'fine' is unknown"),
    "contacts": (["palm:v5", 4], "phases[1].contacts[1]: must be text, not 4"),
    "duration": (0.0, "phases[1].duration: must be greater than 0, not 0.0"),
    "margin": (float("nan"), "phases[1].margin: must be finite"),
    "margin_time": ([], "phases[1].margin_time: must be a number"),
}


@pytest.mark.parametrize(
    ("key", "value", "cause"), [(key, *rest) for key, rest in PHASE_SPOILT.items()], ids=PHASE_SPOILT.keys()
)
def test_a_phase_with_something_else_in_it(key, value, cause, copied):
    content = json.loads((copied / "summary.json").read_text())
    content["phases"][1][key] = value
    (copied / "summary.json").write_text(json.dumps(content))
    with pytest.raises(SceneError) as caught:
        report(copied)
    assert str(caught.value).startswith(f"{copied / 'summary.json'}: {cause}")


# --- in a browser ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine: install the system's package chromium to run this test")
    driver = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install '.[test]'")
    with driver.sync_playwright() as session:
        running = session.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield running
        running.close()


@pytest.fixture
def opened(browser, folder):
    """Open the report without a network: width, colour scheme -> page. It must raise no complaint until the end."""
    complaints, contexts = [], []

    def open_at(width: int, scheme: str = "light"):
        context = browser.new_context(viewport={"width": width, "height": 800}, color_scheme=scheme, offline=True)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto((folder / "report.html").as_uri())
        return page

    yield open_at
    for context in contexts:
        context.close()
    assert complaints == []


def object_at(page) -> str:
    """The object's outline as it is drawn."""
    return page.locator("#scene path").nth(1).get_attribute("d")


def scrub(page, share: float) -> None:
    move = "(s, share) => { s.value = share * s.max; s.dispatchEvent(new Event('input')); }"
    page.locator("#time").evaluate(move, share)


def test_plays_pauses_and_ends(opened):
    page = opened(1280)
    before = object_at(page)
    assert page.locator("#clock").inner_text() == "0.000 s"
    page.select_option("#rate", "1")
    page.click("#play")
    assert page.locator("#play").get_attribute("aria-label") == "Pause"
    page.locator("#play[aria-label=Play]").wait_for()
    assert page.locator("#clock").inner_text() == "0.600 s"
    assert object_at(page) != before
    page.select_option("#rate", "0.1")  # slow: it is still under way when it is told to pause
    page.click("#play")
    page.locator("#clock", has_text=re.compile("0.0[1-9]")).wait_for()
    page.click("#play")
    held = page.locator("#clock").inner_text()
    assert 0 < float(held.split()[0]) < 0.6
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    assert page.locator("#clock").inner_text() == held


def test_scrubs_everything_together(opened, folder):
    page = opened(1280)
    rows = [row.split(",") for row in (folder / "trajectory.csv").read_text().splitlines()[1:]]
    scrub(page, 0.1)
    first = object_at(page), page.locator("#forces .now").get_attribute("d")
    row = next(row for row in rows if abs(float(row[0]) - 0.06) < 1e-9)
    shown = page.locator("#force-legend b").all_inner_texts()
    np.testing.assert_allclose([float(v) for v in shown], [float(v) for v in row[14:18]], atol=5.1e-3)
    torques = page.locator("#torque-legend b").all_inner_texts()
    assert [float(v.replace("\u2212", "-")) for v in torques] == [0.55, -0.24]
    assert page.locator("#scene .force").count() == 4
    scrub(page, 0.75)
    assert page.locator("#clock").inner_text() == "0.450 s"
    assert object_at(page) != first[0]
    assert page.locator("#forces .now").get_attribute("d") != first[1]
    box = page.locator("#torques").bounding_box()
    page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])  # a plot is a slider too
    assert 0.25 < float(page.locator("#clock").inner_text().split()[0]) < 0.35
    page.locator("#strip button").nth(7).click()
    assert page.locator("#clock").inner_text() == "0.600 s"
    page.focus("#time")
    page.keyboard.press("Home")
    assert page.locator("#clock").inner_text() == "0.000 s"


@pytest.mark.parametrize("width", [375, 1280])
def test_fits_its_window(width, opened):
    page = opened(width)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for name in ("#scene", "#torques", "#forces", "#play", "#time", "#strip"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width + 0.5, name
    beside = page.locator("#forces").bounding_box()["x"] > page.locator("#scene").bounding_box()["x"] + 100
    assert beside == (width > 900)
    assert page.locator("h1").inner_text().lower() == TITLE.lower()
    size = page.locator("#play").bounding_box()
    assert min(size["width"], size["height"]) >= 44  # a finger's breadth


def test_a_phone_shows_animation_plots_and_speed_together(opened):
    page = opened(390)
    bottom = {}
    for name in ("#scene", "#play", "#time", "#rate", "#torques", "#forces"):
        box = page.locator(name).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
        bottom[name] = box["y"] + box["height"]
    assert bottom["#rate"] < 480, "the speed is above the fold, in one line with the other controls"
    assert max(bottom.values()) <= 800, "animation and plots are on one screen"
    page.evaluate("window.scrollTo(0, 250)")
    scene, forces = (page.locator(name).bounding_box() for name in ("#scene", "#forces"))
    assert scene["y"] >= 0, "the animation stays in sight"
    assert scene["y"] + scene["height"] < forces["y"] + forces["height"] < 800


def test_wide_tables_scroll_within_themselves(opened):
    page = opened(390)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for name in ("#phases", "#poses"):
        widths = page.locator(name).evaluate("(t) => [t.parentElement.clientWidth, t.parentElement.scrollWidth]")
        assert widths[0] < widths[1], name
        page.locator(name).evaluate("(t) => { t.parentElement.scrollLeft = 200; }")
        head = page.locator(f"{name} tbody th").first.bounding_box()
        assert 0 <= head["x"] < 40, "the phase's name stays in sight"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_colours_follow_the_scheme(scheme, opened):
    page = opened(1280, scheme)
    colour = "(n, name) => getComputedStyle(n)[name].match(/[\\d.]+/g).slice(0, 3).map(Number)"
    paper = page.locator("body").evaluate(colour, "backgroundColor")
    assert (sum(paper) > 600) == (scheme == "light")
    for name, prop in (("body", "color"), (".verdict strong", "color"), ("#torques text >> nth=0", "fill")):
        ink = page.locator(name).evaluate(colour, prop)
        assert contrast(ink, paper) >= 4.5, name
    lines = page.locator("#forces path[stroke-width='1.75']")
    for k in range(lines.count()):
        assert contrast(lines.nth(k).evaluate(colour, "stroke"), paper) >= 2


def contrast(one, other) -> float:
    """The contrast ratio of the web's accessibility guidelines."""

    def luminance(rgb):
        share = np.array(rgb) / 255
        linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
        return linear @ [0.2126, 0.7152, 0.0722]

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_the_margin_is_that_of_a_phase_that_moves():
    """As a plan's is: not that of a hold, and none where a phase has none."""
    moves, holds = {"name": "slide", "margin": 0.8}, {"name": "hold", "margin": 0.1}
    plan = {"phase": [{"name": "slide"}, {"name": "hold", "hold": True}]}
    assert critical_phase({"phases": [moves, holds], "scene": plan}) is moves
    assert critical_phase({"phases": [moves | {"margin": None}, holds], "scene": plan}) is None
    assert critical_phase({"phases": [holds], "scene": {"phase": plan["phase"][1:]}}) is holds
