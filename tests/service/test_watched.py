"""What a page needs of the service: names, robots in full, pictures, one stream of several sessions."""

from __future__ import annotations

import base64
import io
import json
import threading
from pathlib import Path
from xml.etree import ElementTree

import httpx
import numpy as np
from PIL import Image

from tests.service.world import START, ahead, grid_json, policy_files
from tests.serving import HUNG


def test_a_map_that_came_with_the_server_keeps_its_name_and_that_is_said(client):
    maps = Path(__file__).parents[2] / "maps"
    files = {"metadata": (maps / "case2.yaml").read_bytes(), "image": (maps / "case2.pgm").read_bytes()}
    for name, status in (("mine", 422), ("case2", 201)):
        sent = client.post("/v1/maps", files=files, data={"name": name})
        assert sent.status_code == status, sent.text
        if status == 422:
            told = sent.json()
            assert told["detail"] == "what came with the server keeps its name"
            assert told["expected"] == "'case2', or no name"


def test_maps_and_policies_have_names_that_are_accepted_wherever_their_ids_are(client):
    grid = grid_json()
    grid["info"]["resolution"] = 0.05
    map_id = client.post("/v1/maps", json={**grid, "name": "ward-3"}).json()["id"]
    shown = client.get("/v1/maps/ward-3").json()
    assert (shown["id"], shown["name"]) == (map_id, "ward-3")
    assert "ward-3" in [
        item["name"] for item in client.get("/v1/maps", params={"limit": 1000}).json()["items"]
    ]
    for name, problem in (("case1", "name-taken"), ("0" * 64, "invalid-input"), ("no name", "invalid-input")):
        refused = client.post("/v1/maps", json={**grid, "name": name})
        assert (refused.status_code, refused.json()["path"]) == (
            409 if problem == "name-taken" else 422,
            "name",
        )
        assert refused.json()["type"] == problem
    other = client.post("/v1/maps", json=grid_json()).json()["id"]
    assert (
        client.post("/v1/maps", json={**grid_json(), "name": "ward-3"}).json()["id"] == map_id
    )  # who has it

    assert client.post("/v1/maps", json={**grid, "name": "ward-4"}).json()["name"] == "ward-4"
    assert client.get("/v1/maps/ward-3").status_code == 404, "a name that was changed is free again"
    assert client.post("/v1/maps", json={**grid_json(), "name": "ward-3"}).json()["id"] == other

    files = {**{k: (k, v) for k, v in policy_files(seed=5).items()}, "name": (None, "to-the-goal")}
    sent = client.post("/v1/policies", files=files).json()
    assert sent["name"] == client.get("/v1/policies/to-the-goal").json()["name"] == "to-the-goal"
    body = {"policy_id": "to-the-goal", "initial_pose": START}
    begun = client.post("/v1/sessions", json=body).json()
    assert begun["policy_ids"] == [sent["id"]]
    assert begun["robot"]["actions"][0] == {
        "name": "forward",
        "translate": 0.2,
        "rotate": 0.0,
        "terminal": False,
    }
    client.delete(f"/v1/sessions/{begun['id']}")
    assert client.delete("/v1/policies/to-the-goal").status_code == 204
    assert client.get("/v1/policies/to-the-goal").status_code == 404
    assert client.delete("/v1/maps/ward-4").status_code == 204
    assert client.get("/v1/maps/ward-4").status_code == 404


def test_pictures_stand_alone_and_say_what_is_drawn(client, begin, step):
    robots = client.get("/v1/robots").json()["items"]
    assert [action["name"] for action in robots[0]["actions"]][:5] == ["m", "r", "l", "b", "end"]
    session = begin()
    assert step(session, 0, [START]).status_code == 200
    for path in (
        f"/v1/sessions/{session['id']}/image.svg",
        f"/v1/policies/{session['policy_ids'][0]}/image.svg",
    ):
        drawn = client.get(path)
        assert drawn.headers["content-type"] == "image/svg+xml"
        root = ElementTree.fromstring(drawn.content)
        assert "Goal" in [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]
        links = [image.get("href") for image in root.iter("{http://www.w3.org/2000/svg}image")]
        assert all(link.startswith("data:image/png;base64,") for link in links)
        again = client.get(path, headers={"If-None-Match": drawn.headers["etag"]})
        assert again.status_code == 304


def test_what_a_session_learned_of_its_map_is_told_and_drawn(client, begin, step):
    """A told point, and one in what the map has occupied; of a session that learned nothing, nothing."""
    session, cells = begin(id="learns"), {"occupied": [425, 466], "free": [871]}
    where = {"occupied": [[2.55, 1.05], [2.65, 1.15], [0.05, 0.05]], "free": [[3.15, 2.15], [1.05, 2.05]]}

    def learned():
        return client.get("/v1/sessions/learns/learned").json()

    def drawn():
        svg = client.get("/v1/sessions/learns/image.svg").content
        image = next(ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}image")).get("href")
        pixels = Image.open(io.BytesIO(base64.b64decode(image.partition(",")[2]))).convert("RGBA")
        return b"violet cells were found occupied" in svg, np.asarray(pixels)[::-1].reshape(-1, 4)

    nothing = {"map_id": session["map_id"], "map_revision": 0, "occupied": [], "free": []}
    assert learned() == {"t": -1, **nothing}
    assert step(session, 0, [START]).status_code == 200
    assert learned() == {"t": 0, **nothing}
    said, pixels = drawn()
    assert not said
    walls = pixels[0]
    assert {tuple(pixel) for pixel in pixels} == {(0, 0, 0, 0), tuple(walls)}
    assert step(session, 1, ahead(1)[1:], **where).status_code == 200
    assert learned() == {"t": 1, **nothing, "map_revision": 1, **cells}
    said, pixels = drawn()
    assert said
    free = np.zeros(len(pixels), bool)
    free[cells["free"]] = True
    assert (pixels[cells["occupied"]] == pixels[425]).all()
    assert not (pixels[425] == walls).all()
    assert ((pixels[:, 3] > 0) & (pixels[:, 3] < 255)).tolist() == free.tolist()  # paler
    client.post("/v1/sessions/learns/close", json={})
    assert learned()["occupied"] == cells["occupied"]


def test_what_a_robot_ran_into_is_told(client):
    body = {"policy_id": "case1", "initial_pose": [5.0, 5.0, 0.0], "id": "runs-into"}
    session, pose = client.post("/v1/sessions", json=body).json(), body["initial_pose"]
    logits = [0.0 if name == "m" else -9.0 for name in session["actions"]]
    for t in range(7):
        asked = {"t": t, "poses": [pose], "logits": logits}
        told = client.post("/v1/sessions/runs-into/steps", json=asked).json()
        foreseen = told["next_poses"][told["action"]]
        pose = [a + (0.3 if t == 4 else 1.0) * (b - a) for a, b in zip(pose, foreseen, strict=True)]
    learned = client.get("/v1/sessions/runs-into/learned").json()
    assert (learned["t"], learned["map_revision"], learned["free"]) == (6, 1, [])
    x, y = 5.0 + 4 * 0.2 + 0.3 * 0.2, 5.0  # where it was stopped
    shown = client.get(f"/v1/maps/{session['map_id']}").json()
    assert shown["origin"][2] == 0.0
    at = np.array(learned["occupied"])
    xs = shown["origin"][0] + (at % shown["width"] + 0.5) * shown["resolution"]
    ys = shown["origin"][1] + (at // shown["width"] + 0.5) * shown["resolution"]
    assert len(at) > 3
    assert ((xs > x - 0.2) & (xs < x + 0.7) & (abs(ys - y) < 0.5)).all()


def test_several_sessions_are_told_in_one_stream(server, client, begin, step):
    sessions = [begin(), begin()]
    assert step(sessions[0], 0, [START]).status_code == 200
    asked = [f"{sessions[0]['id']}:-1", sessions[1]["id"], "nobody"]
    found = []

    def read():
        with httpx.stream(
            "GET", f"{server.url}/v1/events", params={"session": asked}, timeout=None
        ) as response:
            data = (line for line in response.iter_lines() if line.startswith("data: "))
            found.extend(json.loads(line.removeprefix("data: ")) for line in data)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    while not found:  # the stream is there once it tells what was before
        reader.join(0.05)
    answer = step(sessions[1], 0, [START]).json()
    assert step(sessions[0], 1, ahead(1)).status_code == 200
    for session in sessions:
        client.post(f"/v1/sessions/{session['id']}/close", json={})
    reader.join(HUNG)
    assert not reader.is_alive(), "it ends when all of them are over"
    told = [(item["session"], item.get("t", "over")) for item in found]
    assert sorted(told, key=str) == sorted(
        [(sessions[0]["id"], 0), (sessions[0]["id"], 1), (sessions[0]["id"], "over"), (sessions[1]["id"], 0),
         (sessions[1]["id"], "over")], key=str,
    )  # fmt: skip
    item = next(item for item in found if item["session"] == sessions[1]["id"] and "t" in item)
    assert item["decision"] == answer
    assert item["pose"] == START
    trajectory = client.get(f"/v1/sessions/{sessions[1]['id']}/trajectory").json()["items"]
    assert item["logits"] == trajectory[0]["logits"]


def test_a_rule_says_when_its_windows_are_and_what_it_avoids(client):
    text = "F[0,60] G[0,5] a > 1 and G[0,9] not b > 0 and (c > 0 U[2,8] a > 1)"
    told = client.post("/v1/specs/validate", json={"formula": text}).json()
    windows = [(w["operator"], w["begin"], w["end"], w["depth"]) for w in told["windows"]]
    assert windows == [("F", 0, 60, 0), ("G", 0, 65, 1), ("G", 0, 9, 0), ("U", 2, 8, 0)]
    assert told["avoided"] == ["b"]
    assert told["methods"] == ["planner"]
    told = client.post("/v1/specs/validate", json={"formula": "F[0,60] a > 1"}).json()
    assert told["methods"] == ["dqn", "planner", "reachability"]
