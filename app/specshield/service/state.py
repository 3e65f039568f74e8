"""What every route of one server process shares."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import Depends, Query, Request

from specshield.service.access.keys import Keys
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

PICTURES = 32  # kept in memory, of 5 to 500 kB each
TOO_MUCH = {"_503": "`busy`: too much is asked of the server just now; ask again after `Retry-After`."}
RETRY_AFTER = {
    "description": "Seconds after which to ask again: with every 503, and with `rate-limited`.",
    "schema": {"type": "integer", "minimum": 1},
}
RETRY = {"headers": {"Retry-After": RETRY_AFTER}}


@dataclass
class Server:
    """startup: how far this server has come. worker: this server's own, if it has one."""

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


def _server(request: Request) -> Server:
    server: Server = request.app.state.server
    return server


ServerState = Annotated[Server, Depends(_server)]
Cursor = Annotated[
    str | None,
    Query(max_length=64, description="`next` of the page before; leave it out for the first page."),
]
Limit = Annotated[int, Query(ge=1, le=1000, description="Items a page.")]


def json_content(model: str, example: Any) -> dict[str, Any]:
    """A body in JSON that a route reads by itself."""
    schema = {"$ref": f"#/components/schemas/{model}"}
    return {"application/json": {"schema": schema, "example": example}}


def problems(**said: str) -> dict[int | str, dict[str, Any]]:
    """The problem documents a route may answer: problems(_409="history-gap, ...")."""
    return problem_documents(_422="Bad input: the field, what it held, what is valid.", **said)


def problem_documents(**said: str) -> dict[int | str, dict[str, Any]]:
    """The problem documents of the statuses that are named, with what is said of each."""
    content = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    found = {int(status[1:]): {"description": text, "content": content} for status, text in said.items()}
    return {status: told | RETRY if status in (429, 503) else told for status, told in found.items()}
