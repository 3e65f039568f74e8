"""The API's description: FastAPI's own, with the problems that all routes may answer, and with examples: for
each answer one that a server gave, and for each problem one of its type.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from fastapi import FastAPI

from specshield.errors import tree
from specshield.service import problems
from specshield.service.middleware import guarded
from specshield.service.schemas.policies import PolicyRequest
from specshield.service.schemas.problems import Problem
from specshield.service.schemas.specs import SpecRequest
from specshield.service.state import problem_documents

TAGS = [
    {"name": "specifications", "description": "Formulas of Signal Temporal Logic."},
    {"name": "maps", "description": "Occupancy grids with named areas."},
    {"name": "robots", "description": "The robots that came with the server."},
    {"name": "policies", "description": "Policies propose the futures that certify actions."},
    {"name": "sessions", "description": "Episodes: one robot, one specification, one decision at each step."},
    {"name": "system", "description": "Liveness, readiness, metrics."},
]

LINKS = {  # of answers that name a thing: the parameter for its id, and the operations on it
    ("/v1/maps", "201"): ("map_id", ("maps_read", "maps_image")),
    ("/v1/policies", "202"): ("policy_id", ("policies_read",)),
    ("/v1/sessions", "201"): (
        "session_id",
        ("sessions_read", "sessions_step", "sessions_switch", "sessions_close", "sessions_trajectory"),
    ),
}  # fmt: skip


def _read(name: str) -> Any:
    return json.loads((Path(__file__).parent / name).read_text())


# For each operation the answers to the requests of `examples`, as tests/service/test_docs.py records them.
ANSWERS = _read("answers.json")
# The problem that stands for a status whose description names none: the last one in the table.
USUAL = {str(status): kind.type for kind, status in problems.STATUS.items()}
WRONG = {  # the problems with bad input that only one operation has
    "specifications_validate": ["invalid-formula"],
    "maps_create": ["invalid-map"],
    "policies_create": ["invalid-formula", "outside-fragment"],
    "sessions_create": ["infeasible-start"],
    "sessions_step": ["invalid-logits"],
    "sessions_switch": ["infeasible-switch"],
}


def described(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI description, made at the first call."""
    if app.openapi_schema is None:
        schema = FastAPI.openapi(app)
        schemas = schema["components"]["schemas"]
        for name in ("HTTPValidationError", "ValidationError"):  # FastAPI's own, which no route answers
            schemas.pop(name, None)
        for model in (Problem, SpecRequest, PolicyRequest):  # the routes refer to these by name
            described = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas.update(described.pop("$defs", {}))
            schemas[model.__name__] = described
        schema["components"]["securitySchemes"] = {
            "key": {"type": "http", "scheme": "bearer", "description": "If the server asks for one."}
        }
        schema["security"] = [{}, {"key": []}]
        for path, methods in schema["paths"].items():  # the answers of the middlewares
            for operation in methods.values():
                said = {"_403": "`cross-site`: a page of another origin sent the request."}
                said["_421"] = "`misdirected-request`: Host does not name this server."
                if guarded(path):
                    said["_401"] = "The server asks for a key, and the request has no valid one."
                    said["_429"] = operation["responses"].get("429", {}).get("description", "")
                    said["_429"] = f"{said['_429']} `rate-limited`: wait for Retry-After.".strip()
                if path.startswith("/v1/"):
                    said["_503"] = operation["responses"].get("503", {}).get("description", "")
                    said["_503"] = f"{said['_503']} `starting`: the server is not ready yet.".strip()
                if "requestBody" in operation:
                    said["_408"] = "The body took too long to arrive."
                    said["_413"] = "The body is over the limit."
                    said["_415"] = "The body's Content-Type is not accepted here."
                added = problem_documents(**said)
                operation["responses"] |= {str(status): told for status, told in added.items()}
        for (path, status), (parameter, operations) in LINKS.items():
            schema["paths"][path]["post"]["responses"][status]["links"] = {
                name: {"operationId": name, "parameters": {parameter: "$response.body#/id"}}
                for name in operations
            }
        schema["components"]["examples"] = {type: {"value": told} for type, told in PROBLEMS.items()}
        schema["paths"] = dict(sorted(schema["paths"].items(), key=lambda path: "delete" in path[1]))
        for path, methods in schema["paths"].items():
            for method, operation in methods.items():
                _show(operation, ANSWERS.get(f"{method} {path}"))
        app.openapi_schema = schema
    return app.openapi_schema


def _show(operation: dict[str, Any], answered: Any) -> None:
    """Puts the examples into the answers of an operation."""
    for status, response in operation["responses"].items():
        content = response.get("content", {})
        if "application/problem+json" in content:
            named = re.findall(r"`([a-z-]+)`", response["description"])
            told = [word for word in named if word in PROBLEMS and PROBLEMS[word]["status"] == int(status)]
            if status == "422":
                told = [*WRONG.get(operation["operationId"], []), "invalid-input", *told]
            shown = {type: {"$ref": f"#/components/examples/{type}"} for type in told or [USUAL[status]]}
            form = content["application/problem+json"]  # one for all statuses, as it comes
            response["content"] = {"application/problem+json": {**form, "examples": shown}}
        elif answered is not None:
            for kind in sorted(content, key="application/json".__ne__):  # /docs uses the first one
                content[kind] = form = content.pop(kind)
                if kind in answered:
                    form["example"] = answered[kind]


def _problem(told: dict[str, Any]) -> dict[str, Any]:
    """The example with the title and the status of its type."""
    made = next(kind for kind in tree() if kind.type == told["type"])("")
    return {"type": told["type"], "title": "", "status": 0, **problems.document(made), **told}


PROBLEMS = {told["type"]: _problem(told) for told in _read("problems.json")}
