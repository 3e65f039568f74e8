"""The page while the server is away, after answers that were lost, and of what is gone. Needs Chromium."""

from __future__ import annotations

import json
from contextlib import ExitStack

import httpx

from tests.browsing import needs_chromium
from tests.service.world import START, policy_files
from tests.serving import free_port, serving, wait_for

pytestmark = needs_chromium
AWAY = "The server does not answer; trying again."
LOST = "not live: the connection was lost at"
STANDING = [4.5, 5.0, 0.0]


def stand(url, id, t=0):
    """A robot of case 1 that stands still: its session begun, or one more step."""
    if t == 0:
        body = {"id": id, "policy_id": "case1", "initial_pose": STANDING}
        response = httpx.post(f"{url}/v1/sessions", json=body, timeout=None, verify=False)
        assert response.status_code == 201, response.text
    body = {"t": t, "poses": [STANDING], "logits": [0.0] * 20}
    response = httpx.post(f"{url}/v1/sessions/{id}/steps", json=body, timeout=None, verify=False)
    assert response.status_code == 200, response.text


def test_what_watches_a_fleet_lasts_through_a_restart(tmp_path, browse):
    """The lists, a session, a floor, and a view that was asked for meanwhile, say that the server is away,
    and go on when it is back, where the keyboard was. Then the session is erased.
    """
    port, fleet = free_port(), [f"robot-of-the-warehouse-north-{n:04}" for n in range(1, 4)]
    with ExitStack() as stack:
        (robots, complaints), *shown = (stack.enter_context(browse()) for _ in range(4))
        policies, session, floor = (page for page, _ in shown)
        with serving(tmp_path, port=port) as first:
            for id in fleet[:2]:
                stand(first.url, id)
            policies.goto(f"{first.url}/#/policies")
            session.goto(f"{first.url}/#/sessions/{fleet[0]}")
            floor.goto(f"{first.url}/#/floor?sessions={','.join(fleet[:2])},nosuch")
            robots.goto(first.url)
            link = robots.get_by_role("link", name="-north-0001")
            link.focus()
            assert robots.title() == "Robots · specshield"
            policies.get_by_role("link", name="case1", exact=True).wait_for()
            floor.get_by_text("nosuch is gone.").wait_for()
            for page in (session, floor):
                page.get_by_text("live", exact=True).wait_for()
        for page in (robots, policies):
            page.get_by_text(AWAY).wait_for()
        for page in (session, floor):
            page.get_by_text(LOST).wait_for()
        policies.get_by_role("link", name="Maps", exact=True).click()
        policies.get_by_text(AWAY).wait_for()
        with serving(tmp_path, port=port) as second:
            stand(second.url, fleet[2])
            stand(second.url, fleet[0], 1)
            robots.get_by_role("link", name="-north-0003").wait_for()
            assert link.evaluate("element => element === document.activeElement")
            policies.get_by_role("heading", name="Maps", exact=True).wait_for()
            for page in (robots, policies):
                assert page.get_by_text(AWAY).count() == 0
            for page in (session, floor):
                page.get_by_text("live", exact=True).wait_for()
            session.get_by_role("heading", name="Step 1").wait_for()
            httpx.delete(
                f"{second.url}/v1/sessions/{fleet[0]}", timeout=None, verify=False
            ).raise_for_status()
            session.get_by_text("erased: the server no longer has this session").wait_for()
            floor.get_by_role("row", name="-north-0001").get_by_text("erased").wait_for()
    assert [text for text in complaints if "ERR_" not in text and "503" not in text] == []


def test_who_comes_back_to_a_page_sees_the_session_that_has_the_id_now(server, browse):
    """A robot that begins each episode under the same id: the page was hidden, and heard of nothing."""
    id, url = "north-again", server.url
    hide = """hidden => {
      Object.defineProperty(document, "hidden", { value: hidden, configurable: true });
      document.dispatchEvent(new Event("visibilitychange"));
    }"""
    for t in range(2):
        stand(url, id, t)
    with browse() as (session, complaints), browse() as (floor, _):
        session.goto(f"{url}/#/sessions/{id}")
        floor.goto(f"{url}/#/floor?sessions={id}")
        for page in (session, floor):
            page.get_by_text("live", exact=True).wait_for()
            page.evaluate(hide, True)
        httpx.delete(f"{url}/v1/sessions/{id}", timeout=None, verify=False).raise_for_status()
        stand(url, id)
        for page in (session, floor):
            page.evaluate(hide, False)
        session.get_by_role("heading", name="Step 0").wait_for()
        session.get_by_text("live", exact=True).wait_for()
        floor.get_by_role("row", name=id).get_by_text("erased").wait_for()
        assert complaints == []
    httpx.delete(f"{url}/v1/sessions/{id}", timeout=None, verify=False).raise_for_status()


def test_a_view_that_cannot_be_read_is_told_and_the_page_does_not_begin_anew_for_ever(server, browse):
    with browse() as (page, _):
        page.route("**/views/maps.js", lambda route: route.abort())
        page.goto(f"{server.url}/#/maps")
        page.get_by_role("heading", name="This cannot be shown").wait_for()
        page.unroute("**/views/maps.js")
        page.reload()
        page.get_by_role("heading", name="Maps").wait_for()


def test_a_trial_lasts_through_lost_answers_and_is_closed_when_it_is_left(server, client, policy, browse):
    """A double click before the map is there begins one session. A step whose answer is lost is sent again as
    it was, with the obstacle that it tells of.
    """

    def under_way():
        return [each["id"] for each in client.get("/v1/sessions").json()["items"] if not each["finished"]]

    before = set(under_way())
    with browse() as (page, complaints):
        held, free = [], []
        page.route("**/image.png", lambda route: route.continue_() if free else held.append(route))
        page.goto(f"{server.url}/#/try/{policy['id']}")
        page.get_by_role("button", name="Set it down anywhere").dblclick()
        page.get_by_text("The robot is set down").wait_for()
        free.append(True)
        for route in held:
            route.continue_()
        page.get_by_role("heading", name="Step 0").wait_for()
        page.get_by_role("link", name="Policies", exact=True).click()
        page.get_by_role("heading", name="Policies").wait_for()
        wait_for(lambda: set(under_way()) <= before)

        page.goto(f"{server.url}/#/try/{policy['id']}")
        page.locator("svg.floor.drawing .walls image").wait_for(state="attached")
        script = """(svg, [x, y]) => {
          const p = new DOMPoint(x, -y).matrixTransform(svg.getScreenCTM());
          return [p.x, p.y];
        }"""
        page.mouse.click(*page.locator("svg.floor").evaluate(script, START[:2]))
        page.get_by_role("heading", name="Step 0").wait_for()
        assert len(set(under_way()) - before) == 1
        page.get_by_role("button", name="Obstacle before it").click()
        step, hint = page.get_by_role("button", name="Step", exact=True), page.locator(".controls .hint")
        sent = []

        def lose(route):
            sent.append(route.request.post_data)
            if len(sent) == 2:
                route.fetch()  # it is decided, and the answer is lost
            if len(sent) <= 2:
                route.abort()
            else:
                route.continue_()

        page.route("**/steps", lose)
        for _ in range(2):
            with page.expect_event("requestfailed"):
                step.click()
            page.get_by_text("the server does not answer. Step or Run sends this step again.").wait_for()
        assert len(sent) == 2
        step.click()
        page.get_by_role("heading", name="Step 1").wait_for()
        page.wait_for_function("document.querySelector('.controls .hint').textContent === ''")
        assert sent[0] == sent[1] == sent[2]
        assert json.loads(sent[0])["occupied"]
        step.click()
        page.get_by_role("heading", name="Step 2").wait_for()
        assert "occupied" not in json.loads(sent[3])
        assert hint.inner_text() == ""
        page.goto("about:blank")  # as a tab that is closed, but the browser lives to send what is left to say
        wait_for(lambda: set(under_way()) <= before)
    refused = (
        "422"  # of a place that was drawn, from where the rule cannot be kept: another one is drawn then
    )
    assert [text for text in complaints if "ERR_" not in text and refused not in text] == []


def test_what_cannot_be_shown_is_said_under_a_heading_and_a_title_of_its_own(server, client, policy, browse):
    files = policy_files(seed=7)
    warning = "no start that was drawn can keep the rule"
    files["card"] = json.dumps({**json.loads(files["card"]), "warnings": [warning]}).encode()
    sent = client.post("/v1/policies", files={name: (name, content) for name, content in files.items()})
    with browse() as (page, complaints):
        page.goto(f"{server.url}/#/policies/{sent.json()['id']}")
        page.get_by_label("State").get_by_text(warning).wait_for()
        for path, heading in [
            ("maps/%E0%A4%A", "There is no such page"),
            ("sessions/nosuch", "This cannot be shown"),
            ("policies", "Policies"),
        ]:
            page.goto(f"{server.url}/#/{path}")
            page.get_by_role("heading", name=heading).wait_for()
            assert page.title() == f"{heading} · specshield"
            assert page.evaluate("document.activeElement.id") == "main"
    assert [text for text in complaints if "404" not in text] == []
