"""The API's description: committed, complete, its examples true, its page there without the internet."""

import json
import os
import re
from pathlib import Path

import httpx
import pytest

from specshield.errors import SpecshieldError, TransportError, tree
from specshield.service import description
from specshield.service.app import create_app
from specshield.service.examples import POLICY
from specshield.service.problems import status_of
from specshield.service.settings import Settings

COMMITTED = Path(__file__).parents[2] / "openapi.json"


@pytest.fixture(scope="module")
def told():
    return create_app(Settings()).routes.openapi()


def operations(told):
    for path, methods in told["paths"].items():
        for method, operation in methods.items():
            yield path, method, operation


def test_the_committed_description_is_this_one(told):
    assert json.loads(COMMITTED.read_text()) == told, "run `make openapi`"


def test_the_docs_say_what_to_do_about_every_type_of_problem():
    """Those of status 422 that are not listed have a row in common."""
    text = (COMMITTED.parent / "docs" / "http.md").read_text()
    rows = re.findall(r"^\| (\d{3} `.*?) \| .* \|$", text, re.MULTILINE)
    listed = {found for row in rows for found in re.findall(r"`([\w-]+)`", row)}
    kinds = [each for each in tree() if not issubclass(each, TransportError) and each is not SpecshieldError]
    assert {each.type for each in kinds if status_of(each("")) != 422} <= listed


def test_every_operation_and_every_field_is_described(told):
    for path, method, operation in operations(told):
        assert operation["summary"], (path, method)
        assert operation["description"], (path, method)
        for parameter in operation.get("parameters", []):
            assert parameter["description"], (path, method, parameter["name"])
        for response in operation["responses"].values():
            assert response["description"], (path, method)
    for name, schema in told["components"]["schemas"].items():
        for field, told in schema.get("properties", {}).items():
            told_by_type = "const" in told or "$ref" in told or "$ref" in told.get("items", {})
            assert told_by_type or told.get("description"), f"{name}.{field} is not described"


def test_the_problems_that_any_operation_may_answer_are_told(told):
    """The key, the size of bodies and whether the server is ready are asked of all alike."""
    for path, method, operation in operations(told):
        told = set(operation["responses"])
        assert ("401" in told) == (path.startswith("/v1/") or path == "/metrics"), (path, method)
        assert ("413" in told) == ("requestBody" in operation), (path, method)
        assert ("503" in told) == (path.startswith("/v1/") or path == "/readyz"), (path, method)


def test_when_to_ask_again_is_told_where_it_is_sent(told):
    for path, method, operation in operations(told):
        waits = {
            status
            for status, answer in operation["responses"].items()
            if "Retry-After" in answer.get("headers", {})
        }
        assert waits == {"429", "503"} & set(operation["responses"]), (path, method)
    assert "retry_after" in told["components"]["schemas"]["Problem"]["properties"]


def test_all_that_keeps_something_may_lack_the_room(told):
    for path in ("/v1/maps", "/v1/policies", "/v1/sessions"):
        content = told["paths"][path]["post"]["responses"]["507"]["content"]["application/problem+json"]
        assert list(content["examples"]) == ["insufficient-storage"], path


def test_references_lead_somewhere(told):
    for name in re.findall(r'"#/components/schemas/(\w+)"', json.dumps(told)):
        assert name in told["components"]["schemas"]


RECORD = os.environ.get("SPECSHIELD_RECORD_ANSWERS")  # 1: the answers of the examples are written anew
ANSWERS = Path(description.__file__).parent / "answers.json"
ORDER = [  # as the page shows them: from the top down each example works as it stands
    ("post", "/v1/specs/validate", 200),
    ("post", "/v1/maps", 201),
    ("get", "/v1/maps", 200),
    ("get", "/v1/maps/{map_id}/image.png", 200),
    ("get", "/v1/maps/{map_id}", 200),
    ("delete", "/v1/maps/{map_id}", 409),  # it came with the server
    ("get", "/v1/robots", 200),
    ("get", "/v1/robots/{name}", 200),
    ("post", "/v1/policies", 503),  # no worker here; with one it is 202
    ("get", "/v1/policies", 200),
    ("get", "/v1/policies/{policy_id}/image.svg", 200),
    ("get", "/v1/policies/{policy_id}", 200),
    ("delete", "/v1/policies/{policy_id}", 409),  # it came with the server
    ("post", "/v1/sessions", 201),
    ("get", "/v1/sessions", 200),
    ("post", "/v1/sessions/{session_id}/steps", 200),
    ("post", "/v1/sessions/{session_id}/switch", 200),
    ("post", "/v1/sessions/{session_id}/close", 200),
    ("get", "/v1/sessions/{session_id}/trajectory", 200),
    ("get", "/v1/sessions/{session_id}/learned", 200),
    ("get", "/v1/sessions/{session_id}/image.svg", 200),
    ("get", "/v1/sessions/{session_id}/events", 204),  # it is over: nothing follows
    ("get", "/v1/sessions/{session_id}/record", 200),
    ("get", "/v1/events", 200),
    ("get", "/v1/sessions/{session_id}", 200),
    ("delete", "/v1/sessions/{session_id}", 204),
    ("get", "/livez", 200),
    ("get", "/readyz", 200),
    ("get", "/metrics", 200),
]


def test_the_page_shows_the_operations_in_an_order_that_works(told):
    tags = [tag["name"] for tag in told["tags"]]
    shown = sorted(operations(told), key=lambda each: tags.index(each[2]["tags"][0]))
    assert [(method, path) for path, method, _ in shown] == [(method, path) for method, path, _ in ORDER]


def test_the_examples_work_as_they_stand_and_are_answered_as_the_page_says(server, told):
    answers = {}
    with httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        for method, path, status in ORDER:
            operation = told["paths"][path][method]
            filled = path.format(**examples_of(operation))
            asked = examples_of(operation, "query")
            response = client.request(method, filled, params=asked, json=body_of(operation, told))
            assert response.status_code == status, (method, path, response.text)
            kind = response.headers.get("content-type", "").partition(";")[0]
            if status in (200, 201):
                answers[f"{method} {path}"] = recorded(response, kind)
            if status in (200, 201) and kind == "application/json":
                content = operation["responses"][str(status)]["content"]["application/json"]
                documented = content["schema"]["$ref"]
                fields = told["components"]["schemas"][documented.rsplit("/", 1)[1]]["properties"]
                assert set(response.json()) <= set(fields)
                said = f"{method} {path}: SPECSHIELD_RECORD_ANSWERS=1 pytest {__file__} writes it anew"
                assert RECORD or shape(response.json()) == shape(content["example"]), said
    if RECORD:
        made = answers["get /v1/policies/{policy_id}"]["application/json"]
        queued = {"name": None, "status": "queued", "progress": 0.0, "metrics": {}, "horizon": 60}
        answers["post /v1/policies"] = {"application/json": {**made, **queued, **POLICY}}
        lines = [f"{json.dumps(name)}: {json.dumps(answer)}" for name, answer in answers.items()]
        ANSWERS.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def recorded(response, kind):
    """By media type; of a long list its first two, of numbers six digits."""
    if kind == "application/json":
        return {kind: rounded(response.json())}
    if kind in ("text/event-stream", "text/plain"):
        return {kind: "\n".join(line for line in response.text.splitlines()[:12] if len(line) < 2000)}
    return {}


def rounded(value):
    if isinstance(value, dict):
        return {name: rounded(each) for name, each in value.items()}
    if isinstance(value, list):
        short = value[:2] if value and isinstance(value[0], dict) and "name" not in value[0] else value
        return [rounded(each) for each in short]
    return round(value, 6) if isinstance(value, float) else value


def shape(value):
    """What stays the same from one answer to the next: the names of the members."""
    return sorted(value) if isinstance(value, dict) else type(value)


def test_every_answer_has_an_example_of_its_own_kind(told):
    schemas = told["components"]["schemas"]
    for path, method, operation in operations(told):
        for status, response in operation["responses"].items():
            for kind, form in response.get("content", {}).items():
                if kind == "application/problem+json":
                    for type, example in form["examples"].items():
                        assert example["$ref"] == f"#/components/examples/{type}"
                        value = told["components"]["examples"][type]["value"]
                        assert (value["type"], str(value["status"])) == (type, status), (path, method)
                elif kind == "application/json":
                    wanted = schemas[form["schema"]["$ref"].rsplit("/", 1)[1]].get("required", [])
                    assert set(wanted) <= set(form["example"]), (path, method, status)


def test_the_page_asks_for_answers_in_json(told):
    """It asks for the type that is listed first; MessagePack is nothing that a reader could read."""
    for path, method, operation in operations(told):
        for response in operation["responses"].values():
            kinds = list(response.get("content", {}))
            assert "application/json" not in kinds[1:], (path, method, kinds)


def examples_of(operation, place="path"):
    """Of the parameters in the path, or of those of a query that have some."""
    return {
        parameter["name"]: next(iter(parameter["examples"].values()))["value"]
        for parameter in operation.get("parameters", [])
        if parameter["in"] == place and (place == "path" or "examples" in parameter)
    }


def body_of(operation, told):
    if "requestBody" not in operation:
        return None
    content = operation["requestBody"]["content"]["application/json"]
    if "example" in content:
        return content["example"]
    if "examples" in content:
        return content["examples"]["occupancy_grid"]["value"]
    return told["components"]["schemas"][content["schema"]["$ref"].rsplit("/", 1)[1]]["examples"][0]


def test_the_page_asks_nobody_else(server):
    page = httpx.get(f"{server.url}/docs", timeout=None, verify=False).text
    for link in re.findall(r'(?:src|href)="([^"]+)"', page):
        assert link.startswith("./"), link
        assert httpx.get(f"{server.url}/{link}", timeout=None, verify=False).status_code == 200
