"""POST /v1/sessions/{id}/steps as plain ASGI, since FastAPI's own handling takes longer than a decision.

`routes/sessions.py` describes the route for OpenAPI. The middlewares apply to it as to all other routes.
"""

from __future__ import annotations

import re
from types import SimpleNamespace

from starlette.types import ASGIApp, Receive, Scope, Send

from specshield.errors import SpecshieldError
from specshield.service import problems
from specshield.service.access.owners import scoped
from specshield.service.routes.messages import MSGPACK, accepts, read_step
from specshield.service.schemas.answers import to_json, to_msgpack
from specshield.service.schemas.base import ID
from specshield.service.state import Server

PATH = re.compile(rf"/v1/sessions/({ID})/steps")
ROUTE = SimpleNamespace(path="/v1/sessions/{session_id}/steps")  # what the metrics call it
PACKED, JSON = MSGPACK.encode(), b"application/json"


class StepRoute:
    """Answers the steps, and passes all other requests on to `app`."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        asked = scope["type"] == "http" and scope["method"] == "POST"
        found = PATH.fullmatch(scope["path"]) if asked else None
        if found is None:
            await self.app(scope, receive, send)
            return
        scope["route"], scope["path_params"] = ROUTE, {"session_id": found[1]}
        headers = dict(scope["headers"])
        body = (await receive())["body"]  # the whole body: bounds/bodies.py has waited for it
        try:
            packed = headers.get(b"content-type", b"").lower().startswith(PACKED)
            request = read_step(body, packed)
            server: Server = scope["app"].state.server
            key = scoped(scope["state"]["owner"], found[1])
            answer = await server.sessions.steps.decide(key, request, scope["state"]["timing"])
        except SpecshieldError as error:
            await problems.tell(scope, error)(scope, receive, send)
            return
        packed = accepts(headers.get(b"accept", b"").decode("latin-1"), MSGPACK)
        content = to_msgpack(answer) if packed else to_json(answer)
        told = [(b"content-length", b"%d" % len(content)), (b"content-type", PACKED if packed else JSON)]
        await send({"type": "http.response.start", "status": 200, "headers": told})
        await send({"type": "http.response.body", "body": content})
