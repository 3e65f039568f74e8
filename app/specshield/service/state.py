"""The state that all routes of one server process share, and what their descriptions have in common."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import Depends, Query, Request

from specshield.service.access.keys import Key, Keys
from specshield.service.heavy.heavy import Heavy
from specshield.service.leaving import Streams
from specshield.service.library.files import Recent
from specshield.service.library.maps import Maps
from specshield.service.library.policies import Policies
from specshield.service.sessions.sessions import Sessions
from specshield.service.settings import Settings
from specshield.service.startup import Startup
from specshield.service.storage.store import Store
from specshield.service.training.children import TrainingWorker
from specshield.service.training.jobs import Jobs
from specshield.service.watch.events import Watchers
from specshield.service.watch.gauges import Gauges

PICTURES = 32  # kept in memory; each has 5 to 500 kB
TOO_MUCH = {"_503": "`busy`: the server has too many requests now; ask again after `Retry-After`."}
FULL = {"_507": "`insufficient-storage`: the disk is full, or the space that you may use."}
RETRY_AFTER = {
    "description": "Seconds after which to ask again: with every 503, and with `rate-limited`.",
    "schema": {"type": "integer", "minimum": 1},
}
RETRY = {"headers": {"Retry-After": RETRY_AFTER}}


@dataclass
class Server:
    """startup: the progress of this server's start. worker: the training worker that it runs, if any."""

    settings: Settings
    store: Store
    maps: Maps
    policies: Policies
    sessions: Sessions
    jobs: Jobs
    gauges: Gauges
    watchers: Watchers
    worker: TrainingWorker | None
    startup: Startup
    heavy: Heavy
    keys: Keys
    pictures: Recent[bytes] = field(default_factory=lambda: Recent[bytes](PICTURES))  # of policies, by id
    streams: Streams = field(default_factory=Streams)
    reading: asyncio.Lock = field(default_factory=asyncio.Lock)  # held for each line of a trajectory


async def _server(request: Request) -> Server:
    server: Server = request.app.state.server
    return server


async def _caller(request: Request) -> Key:
    key: Key = request.scope["state"]["key"]
    return key


Caller = Annotated[Key, Depends(_caller)]


async def _owner(caller: Caller) -> str:
    return caller.name


Owner = Annotated[str, Depends(_owner)]
ServerState = Annotated[Server, Depends(_server)]
Cursor = Annotated[
    str | None,
    Query(max_length=64, description="`next` of the page before; leave it out for the first page."),
]
Limit = Annotated[int, Query(ge=1, le=1000, description="The most items that the page may have.")]


def json_body(model: str, example: Any) -> dict[str, Any]:
    """OpenAPI's `content` for a JSON body that the route itself reads and checks."""
    schema = {"$ref": f"#/components/schemas/{model}"}
    return {"application/json": {"schema": schema, "example": example}}


def problems(**said: str) -> dict[int | str, dict[str, Any]]:
    """The problem documents that a route may answer, by status: problems(_409="history-gap, ...")."""
    return problem_documents(_422="Bad input: the field, what it held, what is valid.", **said)


def problem_documents(**said: str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's `responses` for these statuses. said: the description of each, as `_409="..."`."""
    content = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    found = {int(status[1:]): {"description": text, "content": content} for status, text in said.items()}
    return {status: told | RETRY if status in (429, 503) else told for status, told in found.items()}
