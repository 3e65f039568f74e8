"""What a caller can get wrong: a problem that names field, value and what is valid, and no change."""

import codecs
import io
import json
import math

import httpx
import numpy as np
import pytest
from PIL import Image

from specshield import shipped
from specshield.policy.methods import Run
from specshield.policy.planner import policy as planner
from specshield.robot import robot_from_json
from specshield.service.schemas.problems import Problem
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.service.world import LOGITS, RESOLUTION, ROBOT, SPEC, START, ahead, cells, grid_json, policy_files

YAML = b"resolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.25\n"
FLOOR, PARTS = shipped.MAPS / "case2", {"metadata": ".yaml", "image": ".pgm"}
PGM = b"P5\n4 3\n255\n" + bytes([254] * 12)


def problem(response, status, type, path=...):
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    body = response.json()
    assert (body["status"], body["type"]) == (status, type), body
    assert body["detail"]
    assert "Traceback" not in response.text
    if path is not ...:
        assert body["path"] == path, body
        assert body["expected"]
        assert "got" in body
    return body


@pytest.fixture
def unchanged(client, policy):
    """Whatever the test sends, the server keeps what it had."""

    def kept():
        return [
            client.get(f"/v1/{what}", params={"limit": 1000}).json()
            for what in ("maps", "policies", "sessions")
        ]

    before = kept()
    yield
    assert kept() == before


@pytest.mark.parametrize(
    ("body", "type", "position"),
    [
        ({"formula": "F[0,5] (a"}, "invalid-formula", 9),
        ({"formula": "F[5,0] a"}, "invalid-formula", ...),
        ({"formula": "1 < x < 2"}, "invalid-formula", ...),
        ({"formula": "F a"}, "invalid-formula", 2),
        ({"formula": "G[0,9] Sofa", "regions": {}}, "invalid-formula", 7),
        ({"formula": "G[0,9] Sofa", "map_id": "case1"}, "invalid-formula", 7),
        ({"formula": "G[0,2000] x > 1"}, "horizon-too-long", ...),
        ({"formula": "(" * 4000}, "invalid-formula", ...),
    ],
)
def test_formulas(client, unchanged, body, type, position):
    answer = problem(client.post("/v1/specs/validate", json=body), 422, type, "formula")
    assert position is ... or answer["position"] == position


@pytest.mark.parametrize(
    ("body", "path"),
    [
        ({}, "formula"),
        ({"formula": 7}, "formula"),
        ({"formula": "x > 1", "colour": "red"}, "colour"),
        (
            {"formula": "A", "regions": {"A": {"type": "circle", "center": [0, 0], "radius": -1}}},
            "regions.A.radius",
        ),
        ({"formula": "A", "regions": {"A": {"type": "disc"}}}, "regions.A.type"),
        (
            {"formula": "A", "regions": {"A": {"type": "circle", "center": [0], "radius": 1}}},
            "regions.A.center",
        ),
        ({"formula": "A", "regions": {"G": {"type": "circle", "center": [0, 0], "radius": 1}}}, "regions.G"),
    ],
)
def test_fields_of_a_specification(client, unchanged, body, path):
    response = client.post("/v1/specs/validate", json=body)
    answer = problem(response, 422, response.json()["type"], path)
    assert answer["type"].startswith("invalid-")


@pytest.mark.parametrize(
    ("region", "missing"),
    [({"center": [0, 0], "radius": 1}, "type"), ({"type": "circle", "center": [0, 0]}, "radius")],
)
def test_what_a_region_lacks_is_said_to_be_missing(client, region, missing):
    told = client.post("/v1/specs/validate", json={"formula": "F[0,3] A", "regions": {"A": region}})
    path = f"regions.A.{missing}"
    assert problem(told, 422, "invalid-input", path)["detail"] == f"{path} is missing"


def test_a_body_that_is_no_json_is_told_with_the_place_of_the_fault(client):
    said = {"Content-Type": "application/json"}
    told = client.post("/v1/sessions", content=b"{'policy_id': 'case1'}", headers=said)
    assert problem(told, 422, "invalid-input")["detail"].endswith("at character 1")


def test_an_address_with_the_version_twice_is_told(client):
    told = problem(client.post("/v1/v1/sessions", json={}), 404, "not-found")
    assert told["expected"] == "a path listed at /docs; the base_url of the SDK ends before /v1"


@pytest.mark.parametrize(
    "content", [b"{", b"[1, 2]", b'"text"', b"", b"\xff\xfe", b"[" * 100_000, b'{"formula": 1e999}']
)
def test_bodies_that_are_no_json_object(client, unchanged, content):
    response = client.post(
        "/v1/specs/validate", content=content, headers={"Content-Type": "application/json"}
    )
    assert response.status_code == 422, response.text
    problem(response, 422, response.json()["type"])


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b'{"policy_id": "\xff"}', "its text is not UTF-8"),
        (b"[" * 20_000, "it is nested too deeply"),
        (b'{"seed": ' + b"9" * 5000 + b"}", "a number has too many digits"),
    ],
)
@pytest.mark.parametrize("path", ["", "/nosuch/close", "/nosuch/switch", "/nosuch/steps"])
def test_bodies_about_sessions_that_cannot_be_read_say_why(client, path, content, why):
    told = client.post(f"/v1/sessions{path}", content=content, headers={"Content-Type": "application/json"})
    assert problem(told, 422, "invalid-input")["detail"] == f"the body is not JSON: {why}"


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("maps", grid_json(), 201),
        ("specs/validate", {"formula": "F[0,3] x > 1"}, 200),
        ("policies", {"map_id": "nosuch", "spec": {"formula": "F[0,3] x > 1"}}, 404),
        ("sessions", {"policy_id": "nosuch", "initial_pose": START}, 404),
        ("sessions/nosuch/steps", {"t": 0, "poses": [START]}, 404),
    ],
)
def test_a_byte_order_mark_is_passed_over(client, path, body, status):
    """PowerShell writes one, and Windows' editors do."""
    content = codecs.BOM_UTF8 + json.dumps(body).encode()
    told = client.post(f"/v1/{path}", content=content, headers={"Content-Type": "application/json"})
    assert told.status_code == status, told.text


def test_json_that_is_not_said_to_be(client, unchanged):
    response = client.post("/v1/specs/validate", content=json.dumps({"formula": "x > 0"}))
    told = problem(response, 415, "unsupported-media-type", "Content-Type")
    assert "application/json" in told["expected"]


def png(width, height):
    buffer = io.BytesIO()
    Image.new("1", (width, height)).save(buffer, "PNG")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("metadata", "image", "path"),
    [
        (YAML, b"P9\n4 3\n255\n" + bytes(12), "image"),
        (YAML, PGM[:-3], "image"),
        (YAML, png(4001, 1), ...),
        (YAML, b"", "image"),
        (YAML.replace(b"0.05", b"-1"), PGM, "resolution"),
        (YAML.replace(b"0.05", b".nan"), PGM, "resolution"),
        (YAML.replace(b"origin", b"corner"), PGM, "origin"),
        (b"{", PGM, ...),
        (b"\xff\xfe\x00", PGM, "metadata"),
        (b"!!python/object/apply:os.system ['true']", PGM, ...),
    ],
)
def test_maps_as_files(client, unchanged, metadata, image, path):
    files = {"metadata": ("map.yaml", metadata), "image": ("map.pgm", image)}
    problem(client.post("/v1/maps", files=files), 422, "invalid-map", path)


@pytest.mark.parametrize("side", [4001, 20_000])  # the second is over the image library's own limit
def test_a_map_over_the_limit_in_cells(client, unchanged, side):
    files = {"metadata": ("map.yaml", YAML), "image": ("map.png", png(side, side))}
    answer = problem(client.post("/v1/maps", files=files), 422, "invalid-map")
    assert "4000" in answer["expected"]


def test_parts_that_are_missing_or_too_many(client, unchanged):
    files = {"metadata": ("map.yaml", YAML)}
    problem(client.post("/v1/maps", files=files), 422, "invalid-map", "image")
    files["image"] = ("i", PGM)
    more = problem(client.post("/v1/maps", files={**files, "more": ("m", b"x")}), 422, "invalid-map", "more")
    assert more["got"] == "more"
    twice = [("metadata", ("m", YAML)), ("metadata", ("m", YAML))]
    problem(client.post("/v1/maps", files=twice), 422, "invalid-input", "body")
    problem(client.post("/v1/maps", files=files, data={"format": "procthor"}), 422, "invalid-input", "format")
    answer = problem(client.post("/v1/policies", files=files), 422, "invalid-input", "body")
    assert answer["got"] == ["image", "metadata"]
    broken = client.post("/v1/maps", content=b"--x\r\n\r\n", headers={"Content-Type": "multipart/form-data"})
    problem(broken, 422, "invalid-input")


def changed(body, **fields):
    return {**body, **fields}


@pytest.mark.parametrize(
    ("body", "path"),
    [
        ({"format": "picture"}, "format"),
        ({"house": {}}, "format"),
        ({"format": "map_server", "metadata": "", "image": ""}, "format"),
        (changed(grid_json(), colour="red"), "colour"),
        ({"format": "occupancy_grid", "info": {}}, "data"),
        (changed(grid_json(), data=[0, 0, 101]), ...),
        (changed(grid_json(), data="0"), "data"),
        ({"format": "procthor", "house": [], "asset_sizes": {}, "resolution": 0.05}, "house"),
        (changed(grid_json(), info={**grid_json()["info"], "width": 5000}), "info.width"),
        (changed(grid_json(), info={**grid_json()["info"], "resolution": 0}), "info.resolution"),
        ({"format": "procthor", "house": {}, "asset_sizes": {}}, ...),
    ],
)
def test_maps_as_json(client, unchanged, body, path):
    response = client.post("/v1/maps", json=body)
    answer = problem(response, 422, response.json()["type"], path)
    assert answer["type"] in ("invalid-map", "invalid-input")


HOUSE = {
    "rooms": [
        {
            "id": "room|1",
            "roomType": "Bedroom",
            "floorPolygon": [{"x": x, "y": 0, "z": z} for x, z in ((0, 0), (0, 3), (3, 3), (3, 0))],
            "children": [],
        }
    ],
    "walls": [],
    "doors": [],
    "windows": [],
    "objects": [
        {
            "id": "Sofa|1",
            "assetId": "Sofa_1",
            "position": {"x": 1, "y": 0.4, "z": 1},
            "rotation": {"x": 0, "y": 0, "z": 0},
            "kinematic": True,
        }
    ],
    "proceduralParameters": {},
    "metadata": {},
}


def test_a_house_with_an_unknown_asset(client, unchanged):
    body = {"format": "procthor", "house": HOUSE, "asset_sizes": {}}
    assert "Sofa_1" in json.dumps(problem(client.post("/v1/maps", json=body), 422, "invalid-map"))


def test_a_fault_as_large_as_an_upload_is_told_in_short(client, unchanged):
    thing = {**HOUSE["objects"][0], "assetId": "é" * 1_000_000}
    house = {"format": "procthor", "house": {**HOUSE, "objects": [thing]}, "asset_sizes": {}}
    answer = client.post("/v1/maps", json=house)
    assert problem(answer, 422, "invalid-map")["path"] == "house.objects[0].assetId"
    assert len(answer.content) < 32_768
    wrong = client.post("/v1/maps", json=changed(grid_json(), colour=[0] * 1_000_000))
    assert problem(wrong, 422, "invalid-map", "colour")["got"] == "colour"


@pytest.mark.parametrize(
    ("types", "path"),
    [
        (["Hall", "F"], "rooms.F"),
        (["x"], "rooms.x"),
        (["A" * 64] * 2, f"rooms.{'A' * 64}_1"),
        (["Bedroom"] * 256, "rooms"),
    ],
)
def test_a_house_with_rooms_that_no_formula_could_name(client, unchanged, types, path):
    rooms = [{**HOUSE["rooms"][0], "roomType": type} for type in types]
    body = {"format": "procthor", "house": {**HOUSE, "rooms": rooms, "objects": []}, "asset_sizes": {}}
    problem(client.post("/v1/maps", json=body), 422, "invalid-map", path)


def test_a_floor_that_came_with_the_server_keeps_its_name(client, unchanged):
    """Sent without its named areas, which the server knows."""
    files = {part: (FLOOR.with_suffix(end)).read_bytes() for part, end in PARTS.items()}
    problem(client.post("/v1/maps", files=files, data={"name": "flat"}), 422, "invalid-input", "name")
    assert client.post("/v1/maps", files=files, data={"name": "case2"}).json()["name"] == "case2"


def test_regions_as_large_as_the_schema_says_are_taken_and_no_larger_ones(client):
    shapes = client.get("/openapi.json").json()["components"]["schemas"]
    corners, circles = (
        shapes[kind]["properties"][field]["maxItems"]
        for kind, field in (("Polygon", "vertices"), ("Union", "members"))
    )
    for more, status in ((0, 200), (1, 422)):
        turn = np.linspace(0.0, 2 * math.pi, corners + more, endpoint=False)
        round = {"type": "polygon", "vertices": np.stack([np.cos(turn), np.sin(turn)], axis=1).tolist()}
        dots = [{"type": "circle", "center": [i, 0], "radius": 1} for i in range(circles + more)]
        for region in (round, {"type": "union", "members": dots}):
            body = {"formula": "F[0,9] R", "regions": {"R": region}}
            assert client.post("/v1/specs/validate", json=body).status_code == status


def test_maps_and_policies_that_are_not_there(client, unchanged):
    for path in (
        "/v1/maps/none",
        "/v1/maps/none/image.png",
        "/v1/policies/none",
        "/v1/sessions/none",
        "/v1/maps/",
    ):
        problem(client.get(path), 404, "not-found")
    problem(client.get("/v1/maps/..%2f..%2fetc%2fpasswd"), 404, "not-found")
    problem(client.get("/v1/maps/" + "a" * 65), 422, "invalid-input", "map_id")
    problem(client.get("/v1/maps", params={"limit": 0}), 422, "invalid-input", "limit")
    for path, methods in (
        ("/v1/maps", "GET, POST"),
        ("/v1/sessions/x", "DELETE, GET"),
        ("/livez", "GET, HEAD"),
    ):
        response = client.put(path)
        assert problem(response, 405, "method-not-allowed")["expected"] == methods
        assert response.headers["allow"] == methods
    for path in ("/livez", "/readyz"):
        assert client.head(path).status_code == 200
    problem(client.post("/v1/specs/validate", json={"formula": "x > 1", "map_id": "none"}), 404, "not-found")


def ask(**fields):
    return {"map_id": "case1", "spec": {"formula": "F[0,9] Office"}, **fields}


@pytest.mark.parametrize(
    ("body", "type", "path"),
    [
        (ask(map_id="none"), "not-found", "map_id"),
        (ask(robot="spot"), "invalid-robot", "robot"),
        (ask(robot={**ROBOT, "actions": []}), "invalid-robot", "robot.actions"),
        (ask(robot={**ROBOT, "footprint": {"radius": -1}}), "invalid-robot", "robot.footprint.radius"),
        (
            ask(robot={**ROBOT, "actions": [{"name": "a"}, {"name": "a"}]}),
            "invalid-robot",
            "robot.actions[1].name",
        ),
        (ask(spec={"formula": "F[0,9] Sofa"}), "invalid-formula", "spec.formula"),
        (ask(spec={"formula": "F[0,1001] Office"}), "horizon-too-long", "spec.formula"),
        (ask(spec={"formula": "(F[0,9] Office) or (F[0,9] Hall)"}), "outside-fragment", "spec.formula"),
        (ask(spec={"formula": " and ".join(["F[0,9] Office"] * 9)}), "outside-fragment", "spec.formula"),
        (ask(robot={**ROBOT, "actions": [{"name": "go", "translate": 0.1}]}), "training-unavailable", ...),
        (ask(method="ppo"), "invalid-input", "method"),
        (ask(method="reachability", options={"pitch": 9}), "invalid-policy", "options.pitch"),
        (ask(method="reachability", options={"beam": {"a": 1}}), "invalid-input", "options.beam"),
        (ask(method="reachability"), "training-unavailable", ...),
        (ask(options={"units": 1024}), "invalid-policy", "options.units"),
        (ask(options={"depth": 3}), "invalid-policy", "options.depth"),
        (ask(seed=-1), "invalid-input", "seed"),
        (ask(), "training-unavailable", ...),
    ],
)
def test_policies_that_are_asked_for(client, unchanged, body, type, path):
    status = {"not-found": 404, "training-unavailable": 503}.get(type, 422)
    problem(client.post("/v1/policies", json=body), status, type, path)


def sent(weights=None, **card):
    files = policy_files(seed=99)
    files["card"] = json.dumps({**json.loads(files["card"]), **card}).encode()
    return {"weights": ("w", files["weights"] if weights is None else weights), "card": ("c", files["card"])}


def sent_case1(**card):
    """The files of a policy that came with the server, which has tables."""
    made = json.loads((shipped.MODELS / "case1" / "card.json").read_bytes())
    weights = (shipped.MODELS / "case1" / "policy.safetensors").read_bytes()
    return {"weights": ("w", weights), "card": ("c", json.dumps({**made, **card}).encode())}


@pytest.mark.parametrize(
    ("files", "path"),
    [
        (sent(task_hash="0" * 64), "card.task_hash"),
        (sent(map_id="0" * 64), ...),
        (sent(spec={**SPEC, "formula": "F[0,7] Goal"}), "card.task_hash"),
        (sent(seed="zero"), "card.seed"),
        (sent(robot="spot"), "card.robot"),
        (sent(options={"units": "many"}), "card.options.units"),
        (sent_case1(options={"pitch": 2.0}), "card.options.pitch"),
        ({**sent(), "card": ("c", b"{")}, "card"),
        (sent(weights=b"\x80\x04\x95pickle"), "weights"),
        (sent(weights=policy_files()["weights"][:-8]), "weights"),
        (sent(weights=b"\xff" * 8 + b"{}"), "weights"),
    ],
)
def test_policies_trained_elsewhere(client, unchanged, files, path):
    response = client.post("/v1/policies", files=files)
    answer = problem(response, 422, response.json()["type"], path)
    assert answer["type"].startswith("invalid-")


@pytest.mark.parametrize(
    ("fields", "type", "path"),
    [
        ({"initial_pose": [40.0, 1.5, 0.0]}, "invalid-pose", "initial_pose"),
        ({"initial_pose": [0.05, 1.5, 0.0]}, "invalid-pose", "initial_pose"),
        ({"initial_pose": [1.0, 1.5]}, "invalid-pose", "initial_pose"),
        ({"initial_pose": [1.0, "1.5", 0.0]}, "invalid-pose", "initial_pose[1]"),
        ({"initial_pose": [3.5, 0.5, 0.0]}, "infeasible-start", "initial_pose"),
        ({"policy_id": None}, "invalid-input", ...),
        ({"policy_ids": ["case1"]}, "invalid-input", ...),
        ({"threshold": 0.0}, "invalid-input", "threshold"),
        ({"threshold": 1.5}, "invalid-input", "threshold"),
        ({"margin": -1.0}, "invalid-input", "margin"),
        ({"slack": -1}, "invalid-input", "slack"),
        ({"evaluation": "guess"}, "invalid-input", "evaluation"),
        ({"shaping": "lookahead", "threshold": 0.9}, "invalid-input", "shaping"),
        ({"max_steps": 10**9}, "invalid-input", "max_steps"),
        ({"id": "../x"}, "invalid-input", "id"),
        ({"id": "{x}"}, "invalid-input", "id"),
        ({"seed": 1.5}, "invalid-input", "seed"),
        ({"uncertainty": "nne"}, "invalid-input", "uncertainty"),
        ({"uncertainty": {"slip": 0.1}}, "invalid-input", "uncertainty.translation"),
    ],
)
def test_sessions(client, policy, unchanged, fields, type, path):
    body = {"policy_id": policy["id"], "initial_pose": START, **fields}
    told = problem(client.post("/v1/sessions", json=body), 422, type, path)
    if path == "id":  # in words, as of the other names
        assert told["expected"].startswith("1 to 64 letters from A to Z or a to z, digits")


def test_look_ahead_where_it_cannot_be_had(client, policy):
    spec = {**SPEC, "formula": "G[0,6] F[0,4] Goal"}
    grid, robot = OccupancyGrid(cells(), RESOLUTION), robot_from_json(ROBOT)
    task = make_task(grid, robot, spec["formula"], spec["regions"], None, spec["signals"])
    made = planner.synthesise(task, run=Run(spec=spec))
    files = {"weights": ("w", made.weights()), "card": ("c", json.dumps(made.card).encode())}
    id = client.post("/v1/policies", files=files).json()["id"]
    body = {"policy_id": id, "initial_pose": [1.8, 1.5, 0.0], "allow_infeasible": True}
    refused = client.post("/v1/sessions", json={**body, "shaping": "lookahead"})
    assert "'projection'" in problem(refused, 422, "outside-fragment", "shaping")["expected"]
    assert client.post("/v1/sessions", json=body).status_code == 201


def test_policies_for_different_tasks_do_not_share_a_session(client, policy, unchanged):
    body = {"policy_ids": [policy["id"], "case1"], "initial_pose": START}
    problem(client.post("/v1/sessions", json=body), 422, "invalid-policy", "policy_ids[1]")
    body = {"policy_id": "none", "initial_pose": START}
    problem(client.post("/v1/sessions", json=body), 404, "not-found", "policy_id")


def test_an_infeasible_start_can_be_insisted_on(begin):
    session = begin(initial_pose=[3.5, 0.5, 0.0], allow_infeasible=True)
    assert not session["feasible"]


RAW = {
    "NaN": b'{"t": 0, "poses": [[1, 1.5, 0]], "logits": [NaN, 0, 0, 0, 0]}',
    "Infinity": b'{"t": 0, "poses": [[1, 1.5, 0]], "logits": [Infinity, 0, 0, 0, 0]}',
    "1e999": b'{"t": 0, "poses": [[1, 1.5, 0]], "logits": [1e999, 0, 0, 0, 0]}',
    "-Infinity": b'{"t": 0, "poses": [[1, 1.5, 0]], "logits": [-Infinity, 0, 0, 0, 0]}',
}


@pytest.mark.parametrize("content", RAW.values(), ids=RAW)
def test_numbers_that_are_none(client, begin, content):
    path = f"/v1/sessions/{begin()['id']}/steps"
    response = client.post(path, content=content, headers={"Content-Type": "application/json"})
    answer = problem(response, 422, "invalid-logits", "logits[0]")
    assert answer["expected"] == "a finite number, or null for minus infinity"


@pytest.mark.parametrize(
    ("fields", "type", "path"),
    [
        ({"logits": [0.0] * 4}, "invalid-logits", "logits"),
        ({"logits": [0.0] * 300}, "invalid-logits", "logits"),
        ({"logits": [None] * 5}, "invalid-logits", "logits"),
        ({"logits": None}, "invalid-logits", "logits"),
        ({"logits": [0.0, True, 0.0, 0.0, 0.0]}, "invalid-logits", "logits[1]"),
        ({"t": -1}, "invalid-input", "t"),
        ({"t": 0.5}, "invalid-input", "t"),
        ({"poses": []}, "invalid-pose", "poses"),
        ({"poses": [[1.0, 1.5, math.pi, 0.0]]}, "invalid-pose", "poses[0]"),
        ({"poses": ahead(1)}, "invalid-pose", "poses"),
        ({"signals": {"fuel": 1.0}}, "invalid-samples", "signals.fuel"),
        ({"main_task_done": 1}, "invalid-input", "main_task_done"),
        ({"speed": 1}, "invalid-input", "speed"),
    ],
)
def test_steps(client, begin, step, fields, type, path):
    session = begin()
    problem(step(session, **{"t": 0, "poses": [START], "logits": LOGITS, **fields}), 422, type, path)
    assert client.get(f"/v1/sessions/{session['id']}").json() == session


@pytest.mark.parametrize("poses", [START, [START[:2]], [{"x": 1.0, "y": 1.5, "theta": 0.0}]])
def test_what_is_no_pose_is_told_with_what_a_pose_is(begin, step, poses):
    answer = problem(step(begin(), t=0, poses=poses, logits=LOGITS), 422, "invalid-pose", "poses[0]")
    assert answer["expected"] == "three numbers [x, y, theta], in metres and radians"


def test_a_misspelt_field_is_told_before_a_missing_one_with_the_names_there_are(client, begin, step):
    told = step(begin(), t=0, poses=[START], logit=LOGITS)
    answer = problem(told, 422, "invalid-input", "logit")
    assert answer["detail"] == "logit is not a field of this request"
    assert {"t", "poses", "logits"} <= {*answer["expected"].removeprefix("one of ").split(", ")}
    assert [error["path"] for error in answer["errors"]] == ["logit"]
    nested = ask(robot={"footprint": {"radius": 0.2, "raduis": 1}, "actions": [{"nam": "wait"}]})
    answer = problem(client.post("/v1/policies", json=nested), 422, "invalid-robot", "robot.footprint.raduis")
    assert "radius" in answer["expected"]
    assert "map_id" not in answer["expected"]


def test_signals_that_are_no_object_are_told_so_in_the_words_of_json(begin, step):
    told = step(begin(), t=0, poses=[START], logits=LOGITS, signals=[1.0])
    assert problem(told, 422, "invalid-samples", "signals")["expected"] == "an object"


def test_a_long_list_of_errors_stays_a_list(client, begin):
    """20 logits that are none and a long name: every entry whole, each of bounded size."""
    logits = ",".join(["NaN"] * 20)
    content = f'{{"{"x" * 5000}": 1, "t": 0, "poses": [[1, 1.5, 0]], "logits": [{logits}]}}'
    path = f"/v1/sessions/{begin()['id']}/steps"
    response = client.post(path, content=content, headers={"Content-Type": "application/json"})
    found = Problem.model_validate(problem(response, 422, "invalid-logits", "logits[0]")).errors
    assert [error.path for error in found] == [f"logits[{i}]" for i in range(20)]
    assert all(error.got == "nan" and error.expected for error in found)
    response = client.post("/v1/policies", files=policy_files() | {"card": b"{}"})
    listed = Problem.model_validate(problem(response, 422, "invalid-input", "card.map_id")).errors
    assert len(listed) == 8
    assert all(error.path.startswith("card.") for error in listed)
    assert len(client.post("/v1/specs/validate", json={"formula": "x > 1", "y" * 5000: 1}).text) < 2000
    answer = client.post("/v1/policies", json=ask(method="q" * 5000))
    assert problem(answer, 422, "invalid-input", "method")["got"] == "q" * 400 + "…"


@pytest.mark.parametrize("chunked", [False, True])
def test_bodies_over_the_limit(client, unchanged, chunked):
    size = 2 << 20
    content = (b" " * 65536 for _ in range(size // 65536)) if chunked else b" " * size
    try:
        response = client.post(
            "/v1/specs/validate", content=content, headers={"Content-Type": "application/json"}
        )
    except httpx.WriteError:
        pytest.fail("the server hung up before it said why")
    assert problem(response, 413, "body-too-large")["limit"] == 1 << 20


def test_a_card_over_the_limit(client, unchanged):
    response = client.post("/v1/policies", files=policy_files() | {"card": b" " * (2 << 20)})
    assert problem(response, 413, "body-too-large", "card")["limit"] == 1 << 20


def test_a_map_of_the_largest_size_is_taken(client):
    size = 4000
    image = b"P5\n%d %d\n255\n" % (size, size) + np.full(size * size, 254, np.uint8).tobytes()
    files = {"metadata": ("map.yaml", YAML), "image": ("map.pgm", image)}
    response = client.post("/v1/maps", files=files)
    assert response.status_code == 201, response.text
    assert (response.json()["width"], response.json()["height"]) == (size, size)
