"""The page at `/`, in a real browser: from a house to why an action is forbidden. Needs Chromium."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import httpx
import pytest

from specshield.stl.formula import BODY_WORDS, KEYWORDS
from specshield.task import POSE_NAMES
from tests.browsing import needs_chromium
from tests.houses import HOUSES, needs_houses
from tests.service.test_switch import CRAWLER, END
from tests.service.world import ROBOT, START, ahead, grid_json, send_policy
from tests.serving import run_specshield, serving, wait_for
from tests.world.test_procthor import SIZES, house

pytestmark = needs_chromium
SHOTS = os.environ.get("SPECSHIELD_SCREENSHOTS")  # a folder for pictures of every screen
# Once what the window's new size changes is there: observers of sizes are told between two frames.
DRAWN = "() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
SCREENS = {"light": (1280, 860), "dark": (1280, 860), "phone": (390, 800)}


def look(page, name):
    """No screen is wider than its window: on a desk, in the dark, on a phone. With SHOTS it is kept."""
    for kind, (width, height) in SCREENS.items():
        page.emulate_media(color_scheme="light" if kind == "light" else "dark")
        page.set_viewport_size({"width": width, "height": height})
        page.evaluate(DRAWN)
        assert page.evaluate("document.documentElement.scrollWidth") <= width, (name, kind)
        if SHOTS:
            page.screenshot(path=Path(SHOTS) / f"{name}-{kind}.png", full_page=True)
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": 1280, "height": 860})


class Floor:
    """Where points of the map are on the screen."""

    def __init__(self, page):
        self.page, self.element = page, page.locator("svg.floor")
        self.element.scroll_into_view_if_needed()

    def at(self, x, y):
        script = """(svg, [x, y]) => {
          const p = new DOMPoint(x, -y).matrixTransform(svg.getScreenCTM());
          return [p.x, p.y];
        }"""
        return self.element.evaluate(script, [x, y])

    def drag(self, start, end):
        self.page.mouse.move(*self.at(*start))
        self.page.mouse.down()
        self.page.mouse.move(*self.at(*end), steps=3)
        self.page.mouse.up()

    def click(self, x, y):
        self.page.mouse.click(*self.at(x, y))


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A server of its own that makes policies."""
    with serving(tmp_path_factory.mktemp("page"), SPECSHIELD_WORKER="true") as running:
        yield running


def draw(page, floor, shape, start, end, name):
    page.get_by_role("button", name=shape).click()
    floor.drag(start, end)
    field = page.get_by_label("Name of the region").last
    field.fill(name)
    field.press("Enter")


def test_from_a_house_to_why_an_action_is_forbidden(own, tmp_path, browse):
    """Upload, draw, write, make, begin, push, drop, see: as somebody does it who has nothing but the page."""
    (tmp_path / "house.json").write_text(json.dumps(house()))
    (tmp_path / "sizes.json").write_text(json.dumps(SIZES))
    with browse() as (page, complaints):
        page.goto(own.url)
        page.get_by_text("No robot is here yet").wait_for()
        look(page, "empty")
        page.get_by_role("link", name="Maps", exact=True).click()
        page.get_by_label("Name").fill("my-house")
        page.locator("#files").set_input_files([tmp_path / "house.json", tmp_path / "sizes.json"])
        page.get_by_role("heading", name="my-house").wait_for()
        page.locator(".walls image").wait_for(state="attached")
        look(page, "map")

        floor = Floor(page)
        draw(page, floor, "Circle", (1.0, 1.0), (1.5, 1.0), "Dock")
        draw(page, floor, "Rectangle", (2.6, 1.4), (3.4, 2.4), "Stairs")
        rule = page.get_by_role("textbox", name="Rule")
        rule.fill("F[0,30] Dok and G[0,40] not touches(Stairs)")
        assert page.locator(".under mark").inner_text() == "Dok"
        page.get_by_text("nothing declares 'Dok'").wait_for()
        look(page, "rule-wrong")
        assert page.get_by_role("button", name="Make it").is_disabled()
        rule.fill("F[0,30] Dock and G[0,40] not touches(Stairs)")
        page.get_by_text("steps 0 to 40").first.wait_for()
        assert page.locator(".timeline li").count() == 2
        look(page, "rule")
        page.get_by_label("Name", exact=True).fill("dock-first")
        page.get_by_role("button", name="Make it").click()

        page.get_by_role("heading", name="dock-first").wait_for()
        page.locator(".badge.ready").wait_for()
        page.get_by_alt_text("can be kept").wait_for()
        look(page, "policy")
        page.get_by_role("link", name="Try it").click()
        page.locator(".walls image").wait_for(state="attached")
        look(page, "begin")
        Floor(page).click(2.45, 1.9)  # it looks at the stairs, closer than one move
        page.get_by_role("heading", name="Step 0").wait_for()
        forbidden = page.locator("tr", has=page.locator(".cannot"), has_text="moves 0.20 m").first
        assert "forbidden" in forbidden.inner_text()
        assert re.search(r"misses (it )?by|too late|does not hold", forbidden.inner_text())
        assert "got 0.0 %" in forbidden.locator(".bars").get_attribute("aria-label")
        reasons = [each for each in page.locator(".cannot").all_inner_texts() if "same reason as" not in each]
        assert len(reasons) == len(set(reasons))  # each is written out once
        assert page.get_by_role("columnheader", name="Then the rule").count() == 1  # the other is folded away
        look(page, "forbidden")

        step = page.get_by_role("button", name="Step", exact=True)
        page.get_by_role("button", name="Push the robot").click()
        page.get_by_text("The robot was pushed").wait_for()
        page.get_by_role("button", name="Drop an obstacle").click()
        Floor(page).click(1.6, 3.4)
        assert page.locator(".obstacle").count() == 1
        step.click()
        page.get_by_role("heading", name="Step 1").wait_for()
        page.get_by_role("button", name="Run", exact=True).click()
        page.get_by_text("The episode is over").wait_for()
        look(page, "over")

        page.get_by_role("link", name="This session's own page").click()
        page.get_by_text("over, the rule is").wait_for()
        page.get_by_label("Step", exact=True).fill("0")
        page.get_by_role("heading", name="Step 0").wait_for()
        assert page.locator(".cannot").count()
        look(page, "session")
        page.get_by_role("link", name="Robots", exact=True).click()
        page.get_by_role("link", name="on one floor").click()
        page.locator(".robot").wait_for(state="attached")
        look(page, "floor")
    unasked = [text for text in complaints if "422" not in text]  # the rule that was wrong
    assert unasked == []
    assert len(complaints) - len(unasked) <= 2


def test_a_map_far_from_its_frames_origin_is_drawn_on_as_any(own, browse):
    """As maps in UTM are. What a browser keeps of a number in an SVG would be half a metre off there."""
    sent = grid_json()
    sent["info"]["origin"]["position"] |= {"x": 448251.25, "y": 5411932.75}
    id = httpx.post(f"{own.url}/v1/maps", json=sent, timeout=None, verify=False).json()["id"]
    with browse() as (page, complaints):
        page.goto(f"{own.url}/#/maps/{id}")
        page.locator(".walls image").wait_for(state="attached")
        box = page.locator("svg.floor").get_attribute("viewBox")
        assert [float(value) for value in box.split()] == pytest.approx([251.25, 64.25, 4.0, 3.0])
        draw(page, Floor(page), "Circle", (253.25, -65.75), (253.75, -65.75), "Dock")
        numbers = [float(field.input_value()) for field in page.locator(".numbers input").all()]
    assert numbers == pytest.approx([448253.25, 5411934.25, 0.5], abs=0.02)
    assert complaints == []


@pytest.fixture
def small(own):
    """The address of the editor of the small map, 4 m by 3 m."""
    id = httpx.post(f"{own.url}/v1/maps", json=grid_json(), timeout=None, verify=False).json()["id"]
    return f"{own.url}/#/maps/{id}"


def test_a_region_takes_any_name_but_a_word_of_the_rules_and_what_is_edited_is_kept_at_once(small, browse):
    """A region called F would, named anew, have taken the operator F of the rule with it."""
    fit = ["constructor", "toString", "__proto__", "true", "Dock_2"]
    unfit = ["Küche", "Region 1", "1abc", "", "a" * 65, *KEYWORDS, *BODY_WORDS, *POSE_NAMES]
    with browse() as (page, complaints):
        page.goto(small)
        page.locator(".walls image").wait_for(state="attached")
        draw(page, Floor(page), "Circle", (1.0, 1.0), (1.5, 1.0), "Dock")
        draw(page, Floor(page), "Rectangle", (2.0, 1.0), (2.5, 1.5), "Stairs")
        place, rule = page.get_by_label("Place"), page.get_by_role("textbox", name="Rule")
        place.select_option("Dock")
        page.get_by_role("button", name="be there once").click()
        place.select_option("Stairs")
        page.get_by_role("button", name="keep the body out").click()
        field = page.get_by_label("Name of the region").first
        wrong = page.locator(".regions .wrong").first
        for name in [*unfit, "Stairs"]:
            field.fill(name)
            field.press("Enter")
            assert wrong.inner_text().startswith(f'"{name}" '), name
            assert wrong.inner_text().endswith("The region is still called Dock.")
            assert rule.input_value() == "F[0,60] Dock and G[0,120] not touches(Stairs)"
        for name in fit:
            field.fill(name)
            field.press("Enter")
            assert wrong.inner_text() == ""
            assert rule.input_value() == f"F[0,60] {name} and G[0,120] not touches(Stairs)"
            page.locator(".timeline code", has_text=f"F[0,60] {name}").wait_for()  # the server takes it
        renamed = """async (given) => (await import("/page/edit/names.js")).renamed(...given)"""
        text = "touches(touches) and abs(x) > 1e1 or e1 U[0,5] touches"
        wanted = "touches(Dock) and abs(x) > 1e1 or e1 U[0,5] Dock"
        assert page.evaluate(renamed, [text, "touches", "Dock"]) == wanted
        assert page.evaluate(renamed, [wanted, "e1", "E"]) == wanted.replace(" e1", " E")

        radius = page.get_by_label("r", exact=True)
        radius.fill("")
        radius.press("Tab")
        assert radius.input_value() == "0.5"
        assert "it is 0.5, as before" in wrong.inner_text()
        rule.fill("F[0,61] Dock_2")
        page.reload()
        page.locator(".timeline code", has_text="F[0,61] Dock_2").wait_for()
        names = [field.input_value() for field in page.get_by_label("Name of the region").all()]
        assert names == ["Dock_2", "Stairs"]
    assert complaints == []


def test_a_rule_over_a_signal_is_written_and_made(small, browse):
    """The editor takes its name and first value, says what is no signal, and keeps what was right."""
    with browse() as (page, complaints):
        page.goto(small)
        page.locator(".walls image").wait_for(state="attached")
        draw(page, Floor(page), "Circle", (1.0, 1.0), (1.5, 1.0), "Dock")
        rule, signals = page.get_by_role("textbox", name="Rule"), page.get_by_label("Signals")
        rule.fill("F[0,20] Dock and G[0,20] battery > 10")
        page.get_by_text("nothing declares 'battery'").wait_for()
        signals.fill("battery = 9e1; call=0")
        page.get_by_text("steps 0 to 20").first.wait_for()  # as it is written, before the field is left
        signals.press("Enter")
        wrong = page.locator(".signals .wrong")
        for text, why in (
            ("battery", '"battery" is not a name, = and a number'),
            ("battery = much", '"battery = much" is not a name, = and a number'),
            ("Dock = 1", '"Dock" is the name of another place or signal'),
            ("a = 1, a = 2", '"a" is the name of another place or signal'),
            ("x = 1", '"x" stands for the robot\'s own pose'),
        ):
            signals.fill(text)
            signals.press("Enter")
            assert wrong.inner_text().startswith(why)
            assert wrong.inner_text().endswith("The rule still has the signals battery = 90, call = 0.")
        name = page.get_by_label("Name of the region")
        name.fill("battery")
        name.press("Enter")
        page.get_by_text('"battery" is the name of another region or signal').wait_for()
        assert rule.input_value() == "F[0,20] Dock and G[0,20] battery > 10"
        page.reload()
        assert signals.input_value() == "battery = 90, call = 0"
        page.get_by_text("steps 0 to 20").first.wait_for()
        look(page, "signals")
        with page.expect_request(
            lambda request: request.method == "POST" and "policies" in request.url
        ) as sent:
            page.get_by_role("button", name="Make it").click()
        assert sent.value.post_data_json["spec"]["signals"] == {"battery": 90, "call": 0}
        page.locator(".badge.ready").wait_for()
    assert [each for each in complaints if "422" not in each] == []  # what the rule was refused with


def test_regions_are_made_with_a_keyboard_alone(small, browse):
    with browse() as (page, complaints):
        page.goto(small)
        page.locator(".walls image").wait_for(state="attached")
        rows = page.locator("ul.regions li")
        circle, rectangle, polygon = (
            page.get_by_role("button", name=name, exact=True) for name in ("Circle", "Rectangle", "Polygon")
        )

        def numbers(row):
            return [field.input_value() for field in rows.nth(row).locator(".numbers input").all()]

        circle.press("Enter")
        page.keyboard.press("Enter")
        assert numbers(0) == ["2", "1.5", "0.38"]
        page.keyboard.type("Dock")  # its name is chosen, to be written over
        page.keyboard.press("Enter")
        assert page.locator("g.region[data-name=Dock]").count() == 1
        rectangle.press("Enter")
        assert rectangle.get_attribute("aria-pressed") == "true"
        page.keyboard.press("Escape")
        assert rectangle.get_attribute("aria-pressed") == "false"
        assert rectangle.evaluate("button => document.activeElement === button")
        rectangle.press("Enter")
        page.keyboard.press("Enter")
        assert numbers(1) == ["1.63", "2.38", "1.13", "1.88"]
        polygon.press("Enter")
        page.keyboard.press("Enter")
        assert numbers(2) == ["1.63, 1.13; 2.38, 1.13; 2, 1.88"]
        corners, wrong = page.get_by_label("Corners"), rows.nth(2).locator(".wrong")
        for text, said in {
            "1, 1; 2, x; 2, 2": 'Corner 2 is "2, x"',
            "1, 1; 2": 'Corner 2 is "2"',
            "1, 1; 2, 2;": "at least 3 corners, and here are 2",
            "": "at least 3 corners, and here are 0",
        }.items():
            corners.fill(text)
            corners.press("Enter")
            assert said in wrong.inner_text()
        corners.fill("0.5, 0.5; 1.5 .5; 1, -1e-1;")
        corners.press("Enter")
        assert wrong.inner_text() == ""
        drawn = page.locator("g.region[data-name=Region2] polygon").get_attribute("points")
        assert drawn == "0.500,-0.500 1.500,-0.500 1.000,0.100"
        look(page, "regions")

        polygon.click()
        floor = Floor(page)
        for x, y in ((3, 1), (3.5, 1)):
            floor.click(x, y)
        page.keyboard.press("Enter")
        assert polygon.get_attribute("aria-pressed") == "false"
        page.get_by_text("the one begun had fewer and is forgotten").wait_for()
        assert rows.count() == 3
        polygon.click()
        for x, y in ((3, 1), (3.5, 1), (3.5, 2)):
            floor.click(x, y)
        page.keyboard.press("Enter")
        assert rows.count() == 4
    assert complaints == []


def test_a_robot_is_tried_with_a_keyboard_alone(server, client, policy, browse):
    """It is set down, moved and obstructed where the middle of what is seen is; the focus is never lost."""
    with browse() as (page, complaints):
        page.goto(f"{server.url}/#/try/{policy['id']}")
        page.locator("svg.floor.drawing .walls image").wait_for(state="attached")
        page.locator("svg.floor").focus()
        page.keyboard.press("Enter")
        page.get_by_role("heading", name="Step 0").wait_for()
        robot = page.locator(".robot circle")
        assert [robot.get_attribute(name) for name in ("cx", "cy")] == ["2", "-1.5"]
        assert page.evaluate("document.activeElement.textContent") == "Run"

        drop = page.get_by_role("button", name="Drop an obstacle")
        drop.press("Enter")
        page.keyboard.press("Enter")
        page.get_by_text("The robot stands there").wait_for()
        assert drop.evaluate("button => document.activeElement === button")
        page.keyboard.press("Enter")
        for key in ("+", "+", *3 * ["ArrowLeft"], "Enter"):
            page.keyboard.press(key)
        page.get_by_text("An obstacle stands there").wait_for()
        assert float(page.locator(".obstacle").get_attribute("cx")) < 1.5

        elsewhere = page.get_by_role("button", name="Put the robot elsewhere")
        elsewhere.press("Enter")
        page.keyboard.press("Escape")
        assert elsewhere.evaluate("button => document.activeElement === button")
        assert elsewhere.get_attribute("aria-pressed") == "false"
        page.keyboard.press("Enter")
        for key in (*8 * ["ArrowRight"], "Enter"):
            page.keyboard.press(key)
        page.get_by_text("The robot was pushed").wait_for()
        assert float(robot.get_attribute("cx")) > 2.5
    assert complaints == []


def test_what_changes_with_each_step_is_not_read_aloud(server, begin, browse):
    """It would be read for as long as the robot drives. That the steps are not there yet is told, once."""
    with browse() as (page, _):
        held = []
        page.route("**/trajectory", lambda route: held.append(route))
        page.goto(f"{server.url}/#/sessions/{begin()['id']}")
        page.get_by_text("the steps are read").wait_for()
        held[0].continue_()
        page.get_by_text("live", exact=True).wait_for()
        aloud = page.locator("main :is(output, [role=status], [role=alert], [aria-live])")
        assert aloud.all_inner_texts() == ["live"]


def test_two_fingers_draw_nothing_and_zoom_one_draws(small, browse):
    with browse(has_touch=True) as (page, complaints):
        page.goto(small)
        page.locator(".walls image").wait_for(state="attached")
        fingers = page.context.new_cdp_session(page)

        def touch(kind, *points):
            at = [dict(zip("xy", floor.at(*point), strict=True), id=i) for i, point in enumerate(points)]
            fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

        page.get_by_role("button", name="Circle").click()
        floor = Floor(page)
        one, other = (1.9, 1.5), (2.1, 1.5)
        touch("touchStart", one)
        touch("touchMove", (1.8, 1.5))
        touch("touchStart", (1.8, 1.5), other)
        assert page.locator(".draft circle").count() == 0
        touch("touchMove", (1.5, 1.5), (2.5, 1.5))
        touch("touchEnd")
        page.wait_for_function("document.querySelector('svg.closer')")
        touch("touchStart", (2.0, 1.5))
        touch("touchMove", (2.2, 1.5))
        touch("touchCancel")
        assert page.locator(".draft circle").count() == 0
        assert page.locator("ul.regions li").count() == 0
        touch("touchStart", (2.0, 1.5))
        touch("touchMove", (2.2, 1.5))
        touch("touchEnd")
        page.locator("ul.regions li").wait_for()
        assert page.locator("ul.regions li").count() == 1
    assert complaints == []


@pytest.mark.parametrize(("width", "height"), [(200, 1), (1, 160)])
def test_a_long_and_narrow_floor_is_drawn_on_once_it_is_near(own, width, height, browse):
    sent = grid_json()
    sent["info"] |= {"resolution": 0.5, "width": width, "height": height}
    sent["data"] = [0] * (width * height)
    id = httpx.post(f"{own.url}/v1/maps", json=sent, timeout=None, verify=False).json()["id"]
    middle = (width / 4, height / 4)
    with browse() as (page, complaints):
        page.goto(f"{own.url}/#/maps/{id}")
        page.locator(".walls image").wait_for(state="attached")
        look(page, "narrow")
        box = page.locator("svg.floor").bounding_box()
        assert 0.32 < box["width"] / box["height"] < 3.1
        floor = Floor(page)
        page.mouse.move(*floor.at(*middle))
        page.mouse.wheel(0, -5000)
        page.wait_for_function("document.querySelector('svg.closer')")
        ground = page.locator(".ground").bounding_box()
        assert min(ground["width"], ground["height"]) > 100  # [px] across, and it was 4
        draw(page, floor, "Circle", middle, (middle[0] + 0.2, middle[1]), "Dock")
        numbers = [float(field.input_value()) for field in page.locator(".numbers input").all()]
        assert numbers == pytest.approx([*middle, 0.2], abs=0.02)
        look(page, "narrow-closer")
    assert complaints == []


def test_a_file_that_holds_no_map_is_named(own, tmp_path, browse):
    with browse() as (page, complaints):
        page.goto(f"{own.url}/#/maps")
        for text, said in {"null": "null", "[1]": "a list", "3": "a number"}.items():
            (tmp_path / "map.json").write_text(text)
            page.locator("#files").set_input_files(tmp_path / "map.json")
            page.get_by_text(f"map.json holds {said}: a map").wait_for()
    assert complaints == []


def test_files_are_chosen_by_one_button_and_no_key_leads_to_a_field_that_is_not_seen(own, browse):
    with browse() as (page, complaints):
        page.goto(f"{own.url}/#/maps")
        choose = page.get_by_role("button", name=re.compile("choose file", re.IGNORECASE))
        with page.expect_file_chooser():
            choose.press("Enter")  # there is one alone
        page.get_by_label("Name").focus()
        page.keyboard.press("Tab")
        assert page.locator("a.tile").first.evaluate("link => document.activeElement === link")
    assert complaints == []


@needs_houses
def test_a_real_house(own, browse):
    """A ProcTHOR house with its rooms and a place that is drawn: it is seen why the robot may not go straight
    on at first; pushed, and with an obstacle, it keeps the rule to its end.
    """
    with browse() as (page, complaints):
        page.goto(f"{own.url}/#/maps")
        page.get_by_label("Name").fill("real-house")
        page.locator("#files").set_input_files([HOUSES / "house_0.json", HOUSES / "asset-sizes.json"])
        page.get_by_role("heading", name="real-house").wait_for()
        page.locator(".walls image").wait_for(state="attached")
        draw(page, Floor(page), "Rectangle", (9.9, 7.0), (10.3, 7.5), "Wet")
        rule = page.get_by_role("textbox", name="Rule")
        rule.fill("F[0,50] LivingRoom and G[0,60] not (Bathroom or touches(Wet))")
        page.get_by_text("steps 0 to 60").first.wait_for()
        page.get_by_label("Name", exact=True).fill("living-room")
        page.get_by_role("button", name="Make it").click()
        page.locator(".badge.ready").wait_for()
        page.get_by_role("link", name="Try it").click()
        page.locator(".walls image").wait_for(state="attached")
        Floor(page).click(9.75, 7.25)  # in the kitchen, where the house has its agent
        page.get_by_role("heading", name="Step 0").wait_for()
        forbidden = page.locator("tr", has=page.locator(".cannot"), has_text="moves 0.20 m").first
        why = "the best way found does not keep 'G[0,60] not (Bathroom or touches(Wet))'"
        assert why in forbidden.inner_text()
        look(page, "real-house-forbidden")
        page.get_by_role("button", name="Push the robot").click()
        page.get_by_text("The robot was pushed").wait_for()
        page.get_by_role("button", name="Drop an obstacle").click()
        Floor(page).click(9.0, 6.0)
        assert page.locator(".obstacle").count() == 1
        page.get_by_role("button", name="Run", exact=True).click()
        page.get_by_text("The episode is over").wait_for()
        look(page, "real-house-over")
        page.get_by_role("link", name="This session's own page").click()
        page.get_by_text("over, the rule is satisfied").wait_for()
    assert complaints == []


def test_a_floor_with_robots_that_are_over(server, client, begin, step, browse):
    """Walls, ways and steps are there; what is seen follows the wheel, the mouse and the keys."""
    sessions = [begin(), begin()]
    for session in sessions:
        for t, pose in enumerate(ahead(3)):
            assert step(session, t, [pose]).status_code == 200
    client.post(f"/v1/sessions/{sessions[0]['id']}/close", json={})
    with browse() as (page, complaints):
        page.goto(f"{server.url}/#/floor?sessions={','.join(session['id'] for session in sessions)}")
        page.locator(".walls image").wait_for(state="attached")
        page.get_by_text("3 / 3").wait_for()
        page.get_by_text("live", exact=True).wait_for()
        modes = page.locator("tbody td:nth-child(3)")
        assert modes.all_inner_texts() == ["over", "shaped"]
        client.post(f"/v1/sessions/{sessions[1]['id']}/close", json={})  # while it is watched
        page.locator(".state").get_by_text("over").wait_for()
        assert modes.all_inner_texts() == ["over", "over"]
        page.get_by_label("Step", exact=True).fill("1")
        page.locator("tbody td").get_by_text("shaped").nth(1).wait_for()
        page.get_by_role("button", name="Newest").click()
        page.locator("tbody td").get_by_text("over").nth(1).wait_for()
        assert page.locator(".robot:not([hidden])").count() == 2
        assert page.locator("tbody td.number").first.inner_text() == "3"
        floor = page.locator("svg.floor")

        def seen():
            return [float(value) for value in floor.get_attribute("viewBox").split()]

        whole, box = seen(), floor.bounding_box()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.mouse.wheel(0, -500)
        page.wait_for_function("document.querySelector('svg.closer')")
        closer = seen()
        assert closer[2] < whole[2] / 2
        page.mouse.down()
        page.mouse.move(box["x"] + 20, box["y"] + box["height"] / 2, steps=3)
        page.mouse.up()
        assert seen()[0] > closer[0]
        floor.focus()
        page.keyboard.press("0")
        assert seen() == whole
        page.get_by_role("button", name="Closer").click()
        assert seen()[2] < whole[2]
    assert complaints == []


def test_robots_are_found_by_what_is_told_of_them_and_a_new_floor_by_its_name(own, browse):
    sent = grid_json() | {"name": "new-floor"}
    sent["info"]["resolution"] = 0.12
    goal = {"type": "circle", "center": [2.0, 1.5], "radius": 0.5}
    with httpx.Client(base_url=own.url, timeout=None, verify=False) as client, browse() as (page, complaints):
        page.goto(own.url)
        page.get_by_role("heading", name="Robots", exact=True).wait_for()
        spec = {"formula": "F[0,20] Goal", "regions": {"Goal": goal}}
        body = {"map_id": client.post("/v1/maps", json=sent).json()["id"], "spec": spec, "robot": ROBOT}
        path = f"/v1/policies/{client.post('/v1/policies', json=body).json()['id']}"
        wait_for(lambda: client.get(path).json()["status"] == "ready")
        begun = {"policy_id": path.split("/")[-1], "initial_pose": START}
        for id in ("day-shift", "night-shift"):
            assert client.post("/v1/sessions", json={**begun, "id": id}).status_code == 201
        page.get_by_role("heading", name="new-floor").wait_for()
        rows, words = page.locator("tbody th"), page.get_by_label("Find robots")
        words.fill("PENDING night new-floor")
        page.wait_for_function("document.querySelectorAll('tbody tr').length === 1")
        assert rows.all_inner_texts() == ["night-shift"]
        look(page, "find")
        words.fill("nothing of the kind")
        page.get_by_text("has these words in its name").wait_for()
        words.fill("")
        rows.get_by_text("day-shift").wait_for()
    assert complaints == []


def test_why_a_start_is_refused_is_told_once_and_in_words(server, client, policy, browse):
    """The small world's own rule, with a goal that is too far for its window."""
    goal = {"type": "circle", "center": [3.6, 1.5], "radius": 0.2}
    spec = {"formula": "F[0,2] Goal and G[0,8] x < 9", "regions": {"Goal": goal}}
    far = send_policy(client, spec=spec)
    with browse() as (page, _):
        page.goto(f"{server.url}/#/try/{far['id']}")
        page.locator(".walls image").wait_for(state="attached")
        Floor(page).click(1.0, 1.5)
        told = page.get_by_text("Set the robot down elsewhere.")
        told.wait_for()
        said = told.inner_text()
    assert said.count("F[0,2] Goal") == 1
    assert "G[0,8]" not in said
    assert "allow_infeasible" not in said
    assert "initial_pose" not in said


def test_a_share_is_called_all_or_none_only_where_it_is(server, browse):
    written = {0.0: "0.0 %", 4e-4: "<0.1 %", 0.034: "3.4 %", 0.5: "50 %", 0.994: "99 %", 0.9961: "99.6 %"}
    written |= {0.9998: ">99.9 %", 1.0 - 1e-15: "100 %", 1.0: "100 %"}
    with browse() as (page, _):
        page.goto(server.url)
        script = """async (shares) => shares.map((await import("/page/lib/dom.js")).percent)"""
        assert page.evaluate(script, list(written)) == list(written.values())


def test_the_time_line_is_red_for_what_is_avoided_alone(small, browse):
    with browse() as (page, complaints):
        page.goto(small)
        page.locator(".walls image").wait_for(state="attached")
        draw(page, Floor(page), "Circle", (1.0, 1.0), (1.3, 1.0), "Region1")
        draw(page, Floor(page), "Circle", (2.0, 1.0), (2.3, 1.0), "Region10")
        rule = page.get_by_role("textbox", name="Rule")
        rule.fill("G[0,9] Region10 and G[0,5] not Region1 and G[0,7] not touches(Region1)")
        page.locator(".timeline li").nth(2).wait_for()
        bars = [bar.get_attribute("class") for bar in page.locator(".timeline .bar").all()]
        assert bars == ["bar G", "bar G avoid", "bar G avoid"]
    assert complaints == []


def test_each_robots_places_are_drawn_also_where_two_rules_call_another_by_one_name(
    server, client, begin, browse
):
    goal = {"type": "rectangle", "min": [1.5, 0.5], "max": [2.5, 2.5]}
    away = {"type": "circle", "center": [3.2, 0.6], "radius": 0.2}
    spec = {"formula": "F[0,8] Goal and G[0,9] not touches(Away)", "regions": {"Goal": goal, "Away": away}}
    one, two = begin(), begin(policy_id=send_policy(client, spec=spec)["id"], id="second")
    three = begin(policy_id=two["policy_ids"][0])
    with browse() as (page, complaints):
        page.goto(f"{server.url}/#/floor?sessions={one['id']},{two['id']},{three['id']}")
        page.locator(".walls image").wait_for(state="attached")
        drawn = page.locator("g.region")
        assert [each.get_attribute("data-name") for each in drawn.all()] == ["Goal", "Goal (second)", "Away"]
        assert [each.get_attribute("class") for each in drawn.all()] == [
            "region visit",
            "region visit",
            "region avoid",
        ]
        assert drawn.nth(0).locator("circle").count() == drawn.nth(1).locator("polygon").count() == 1
    assert complaints == []


def test_a_robot_elsewhere_is_seen_as_it_moves(server, client, begin, step, browse):
    session = begin()
    with browse() as (page, complaints):
        page.goto(f"{server.url}/#/sessions/{session['id']}")
        page.get_by_text("live").wait_for()
        for t, pose in enumerate(ahead(3)):
            assert step(session, t, [pose]).status_code == 200
        page.get_by_role("heading", name="Step 3").wait_for()
        assert page.locator(".actions tbody tr").count() == 5
        client.post(f"/v1/sessions/{session['id']}/close", json={})
        page.get_by_text("over, the rule is pending").wait_for()
    assert complaints == []


def test_what_a_session_learned_of_its_map_is_drawn_over_it(server, begin, step, browse):
    """Live, as it changes, and for an earlier step what there is now, which is said; before it, nothing."""
    session, poses = begin(), ahead(4)
    with browse() as (page, complaints):
        page.goto(f"{server.url}/#/sessions/{session['id']}")
        page.get_by_text("live").wait_for()
        occupied, free = (page.locator(f".learned path.{kind}") for kind in ("occupied", "free"))
        key = page.locator(".key.learned")

        def told():
            assert key.is_visible() == occupied.is_visible()
            return key.inner_text() if key.is_visible() else None

        assert step(session, 0, [poses[0]]).status_code == 200
        page.get_by_role("heading", name="Step 0").wait_for()
        assert told() is None
        seen = {"occupied": [[2.55, 1.05], [2.55, 1.15], [2.65, 1.15]]}
        assert step(session, 1, [poses[1]], **seen).status_code == 200
        key.wait_for()
        assert told() == "found occupied The map says otherwise."
        assert occupied.get_attribute("d") == "M25 10h1v1h-1zM25 11h2v1h-2z"
        box, at = occupied.bounding_box(), Floor(page).at
        low, high = at(2.5, 1.0), at(2.7, 1.2)
        assert [box["x"], box["y"]] == pytest.approx([low[0], high[1]], abs=1.0)
        assert [box["width"], box["height"]] == pytest.approx([high[0] - low[0], low[1] - high[1]], abs=1.0)
        assert step(session, 2, [poses[2]], free=[[3.15, 2.15]]).status_code == 200
        page.get_by_text("found free").wait_for()
        assert free.get_attribute("d") == "M31 21h1v1h-1z"
        look(page, "learned")
        page.get_by_label("Step", exact=True).fill("1")
        page.get_by_text("What is drawn is from step 2.").wait_for()
        page.get_by_label("Step", exact=True).fill("0")
        key.wait_for(state="hidden")
        assert told() is None
    assert complaints == []


def test_what_several_robots_learned_is_drawn_on_their_floor(server, begin, step, browse):
    """Of each what it found itself, before the page was opened and since."""
    (first, second), poses = (begin(id="finds-one"), begin(id="finds-two")), ahead(3)
    for session in (first, second):
        assert step(session, 0, [poses[0]]).status_code == 200
    assert step(first, 1, [poses[1]], occupied=[[2.55, 1.05]]).status_code == 200
    with browse() as (page, complaints):
        page.goto(f"{server.url}/#/floor?sessions=finds-one,finds-two")
        page.get_by_text("finds-one: found occupied").wait_for()
        found = page.locator(".learned g:not([hidden]) path.occupied")
        assert [each.get_attribute("d") for each in found.all()] == ["M25 10h1v1h-1z"]
        page.get_by_text("live").wait_for()
        assert step(second, 1, [poses[1]], occupied=[[2.55, 1.15]]).status_code == 200
        page.get_by_text("finds-two: found occupied").wait_for()
        assert [each.get_attribute("d") for each in found.all()] == ["M25 10h1v1h-1z", "M25 11h1v1h-1z"]
        page.get_by_label("Step", exact=True).fill("0")
        page.locator(".key.learned").first.wait_for(state="hidden")
        assert found.count() == 0
    assert complaints == []


def test_steps_before_a_switch_are_told_under_the_rule_that_held_then(server, client, begin, step, browse):
    """What another robot did elsewhere is not told as motions of the present one, nor drawn on its floor."""
    session, poses = begin(), ahead(3)
    for t in range(3):
        assert step(session, t, [poses[t]]).status_code == 200

    def switch(t, policy_id, pose):
        body = {"t": t, "policy_id": policy_id, "poses": [pose], "clock": "restart"}
        assert client.post(f"/v1/sessions/{session['id']}/switch", json=body).status_code == 200

    crawler = send_policy(client, spec={"formula": "F[0,20] End", "regions": {"End": END}}, robot=CRAWLER)
    switch(3, crawler["id"], poses[3])
    assert step(session, 3, [poses[3]], logits=[0.0, None, 0.0]).status_code == 200
    with browse() as (page, complaints):
        page.goto(f"{server.url}/#/sessions/{session['id']}")
        heading = page.get_by_role("heading", level=2).first
        page.get_by_role("heading", name="Step 3, step 0 of 20 of its rule").wait_for()
        assert page.locator(".robot:not([hidden])").count() == 1
        goal, end = (page.locator(f".region[data-name={name}]") for name in ("Goal", "End"))
        assert (goal.count(), end.count()) == (0, 1)
        page.get_by_label("Step", exact=True).fill("1")
        page.get_by_text("Decided under an earlier rule: F[0,6] Goal and G[0,8] battery > 10").wait_for()
        goal.wait_for()
        assert end.count() == 0
        assert heading.inner_text() == "Step 1 of 8"
        page.get_by_text("Decided for another robot").wait_for()
        assert page.locator(".next").get_attribute("points") == ""
        assert page.locator(".robot:not([hidden])").count() == 1
        page.get_by_role("button", name="Newest").click()
        end.wait_for()
        assert goal.count() == 0
        switch(4, "case1", [4.5, 5.0, 0.0])
        assert step(session, 4, [[4.5, 5.0, 0.0]], logits=[0.0] * 20).status_code == 200
        page.get_by_role("heading", name="Step 4, step 0 of 140 of its rule").wait_for()
        assert page.locator(".way").get_attribute("points") == "4.500,-5.000"
        page.get_by_label("Step", exact=True).fill("3")
        page.get_by_text("Decided under an earlier rule, on another floor: F[0,20] End").wait_for()
        assert page.locator(".robot:not([hidden])").count() == 0
        page.get_by_role("link", name="Robots", exact=True).click()
        row = page.locator("tbody tr", has=page.locator(f"a[title='{session['id']}']"))
        assert "5, step 1 of 140 of its rule" in row.inner_text()
    assert complaints == []


def test_no_action_is_said_to_keep_a_broken_rule_nor_signals_to_be_metres(server, begin, step, browse):
    broken, short = begin(), begin(evaluation="robustness", threshold=0.9)
    assert step(broken, 0, [ahead(0)[0]]).json()["mode"] == "shaped"
    assert step(broken, 1, [ahead(1)[1]], signals={"battery": 5.0}).json()["mode"] == "violated"
    answer = step(short, 0, [ahead(0)[0]]).json()
    assert (answer["mode"], answer["reason"]) == ("fallback", "infeasible")
    assert answer["feasible_mass"] > 0
    with browse() as (page, complaints):
        page.goto(f"{server.url}/#/sessions/{broken['id']}")
        page.get_by_role("heading", name="Step 1").wait_for()
        told = page.locator(".told.can").all_inner_texts()
        assert set(told) == {"is broken; what is left of it can be kept"}
        chart = page.locator(".chart", has_text="Robustness ahead").locator("figcaption span")
        assert re.fullmatch(r"−\d+\.\d\d", chart.inner_text())
        assert page.locator("dl.numbers dt", has_text=re.compile("^Kept$")).count() == 0
        page.get_by_label("Step", exact=True).fill("0")
        page.get_by_role("heading", name="Step 0").wait_for()
        assert re.fullmatch(r"can be kept by \d+\.\d\d", page.locator(".told.can").first.inner_text())
        page.goto(f"{server.url}/#/sessions/{short['id']}")
        page.get_by_text("The threshold that was asked for cannot be had").wait_for()
        assert "no future was found" not in page.locator(".mode").inner_text()
    assert complaints == []


def test_the_key_is_typed_once_and_stays_in_its_tab(tmp_path, browse):
    """Any key that a server may have, also one with a space. What no header can carry is not sent."""
    with serving(tmp_path, SPECSHIELD_API_KEY="a secret~key!") as running, browse() as (page, _):
        page.goto(running.url)
        field = page.get_by_label("API key")
        field.wait_for()
        for _ in range(3):
            page.keyboard.press("Escape")
        field.fill("wrong")
        field.press("Enter")
        page.get_by_text("does not know this key").wait_for()
        for typed in ("cl\u00e9", "a\u200bkey", "  ", " a secret~key! "):
            field.fill(typed)
            assert field.evaluate("field => field.checkValidity()") == ("secret" in typed), typed
        field.press("Enter")
        page.get_by_text("No robot is here yet").wait_for()
        page.get_by_role("link", name="Policies", exact=True).click()
        page.get_by_role("link", name="case1", exact=True).wait_for()
        page.reload()
        page.get_by_role("link", name="case1", exact=True).wait_for()
        kept = page.evaluate("[localStorage.length, document.cookie, location.href]")
        assert kept[:2] == [0, ""]
        assert "secret" not in kept[2]


def test_nothing_is_called_live_once_the_key_is_revoked_until_a_new_one_is_typed(tmp_path, browse):
    def keys(*arguments):
        return run_specshield("keys", *arguments, SPECSHIELD_DATA_DIR=str(tmp_path / "data")).stdout.strip()

    with serving(tmp_path / "data", SPECSHIELD_API_KEY="operator") as running, browse() as (page, _):
        secret, field = keys("create", "alice"), page.get_by_label("API key")
        body = {"id": "watched", "policy_id": "case1", "initial_pose": [4.5, 5.0, 0.0]}
        headers = {"Authorization": f"Bearer {secret}"}
        begun = httpx.post(f"{running.url}/v1/sessions", json=body, headers=headers, timeout=None)
        assert begun.status_code == 201, begun.text
        page.goto(f"{running.url}/#/sessions/watched")
        field.fill(secret)
        field.press("Enter")
        page.get_by_text("live", exact=True).wait_for()
        keys("revoke", "alice")
        page.get_by_text("The server does not know this key.").wait_for()
        page.get_by_text("not live: the connection was lost at").wait_for()
        field.fill(keys("create", "alice"))
        field.press("Enter")
        page.get_by_text("live", exact=True).wait_for()


def test_its_files_are_small_tagged_and_allow_nothing_from_elsewhere(server):
    with httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        page = client.get("/")
        assert page.headers["content-type"].startswith("text/html")
        assert page.headers["content-encoding"] == "gzip"
        assert "default-src 'none'; script-src 'self'" in page.headers["content-security-policy"]
        assert "unsafe" not in page.headers["content-security-policy"]
        again = client.get("/", headers={"If-None-Match": page.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")
        script = client.get("/page/main.js", headers={"Accept-Encoding": "identity"})
        assert script.headers["content-type"].startswith("text/javascript")
        assert "content-encoding" not in script.headers
        for path in ("/page/nothing.js", "/page/../pages/__init__.py", "/page/%2e%2e/__init__.py"):
            assert client.get(path).status_code == 404
