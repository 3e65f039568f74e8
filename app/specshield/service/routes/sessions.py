"""/v1/sessions: episodes, decided step by step."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Header, Path, Query, Response
from fastapi.responses import StreamingResponse

from specshield.service import examples
from specshield.service.routes.messages import MSGPACK, accepts
from specshield.service.schemas.base import Id
from specshield.service.schemas.sessions import SessionList, SessionRequest, SessionResponse, SwitchRequest
from specshield.service.schemas.steps import (
    CloseRequest,
    CloseResponse,
    Learned,
    StepRequest,
    StepResponse,
    Trajectory,
)
from specshield.service.state import Caller, Cursor, Limit, Owner, ServerState, problems
from specshield.service.storage.store import scoped
from specshield.service.watch import logs

router = APIRouter(prefix="/v1/sessions", tags=["sessions"])
PathId = Annotated[
    Id, Path(description="Id of a session.", openapi_examples={"example": {"value": examples.SESSION["id"]}})
]


async def _key(session_id: PathId, owner: Owner) -> str:
    return scoped(owner, session_id)


SessionKey = Annotated[str, Depends(_key)]
NDJSON = "application/x-ndjson"
GONE = {"_404": "No such session; it may have expired.", "_503": "The store is away: try again."}
DAMAGED = {"_410": "`session-damaged`: the session's file in the archive can no longer be read."}
UNREADABLE = GONE | DAMAGED


@router.post(
    "",
    status_code=201,
    response_model=SessionResponse,
    summary="Begin a session",
    responses=problems(
        _404="No such policy.",
        _409="`session-exists`: you have a session of this id.",
        _429="`limit-reached`: the server keeps no more sessions.",
        _503="The store is away: try again.",
        _507="`insufficient-storage`: the disk is full.",
    ),
)
async def create(request: SessionRequest, server: ServerState, caller: Caller) -> Any:
    """A session is one episode of one robot. It holds the trajectory and every answer that was given.

    The request is refused with `invalid-pose` where x_0 is outside the map or in collision, and with
    `infeasible-start` where no action from x_0 has a future that satisfies the specification (unless
    `allow_infeasible`). A session is erased some time after its last change: `expires_at` says when.
    """
    begun = await server.sessions.create(request, caller)
    logs.tell("session begun", session_id=begun["id"], policy_ids=begun["policy_ids"])
    return begun


@router.get(
    "", response_model=SessionList, summary="List the sessions", responses=problems(_503="The store is away.")
)
async def list_all(server: ServerState, owner: Owner, cursor: Cursor = None, limit: Limit = 100) -> Any:
    """Your sessions in order of id; ids that the server makes are in order of time.

    `spec` has no `regions` here, and `robot` is left out. A page may have fewer items than `limit`.
    """
    found, following = await server.sessions.page(owner, cursor, limit)
    return {"items": found, "next": following}


@router.get(
    "/{session_id}",
    response_model=SessionResponse,
    summary="Read a session",
    responses=problems(**UNREADABLE),
)
async def read(key: SessionKey, server: ServerState) -> Any:
    """The session's settings and its state; `next_t` is the next step to ask for."""
    return await server.sessions.read(key)


@router.delete("/{session_id}", status_code=204, summary="Erase a session", responses=problems(**GONE))
async def delete(key: SessionKey, server: ServerState) -> Response:
    """Erases the session, its trajectory and its answers."""
    await server.sessions.delete(key)
    logs.tell("session erased")
    return Response(status_code=204)


@router.post(
    "/{session_id}/steps",
    response_class=Response,
    summary="Decide one step",
    responses={
        200: {
            "model": StepResponse,
            "content": {MSGPACK: {"schema": {"$ref": "#/components/schemas/StepResponse"}}},
            "description": "The decision. `Server-Timing` has total, rollout and store in ms.",
        },
        **problems(
            **UNREADABLE,
            _409="`history-gap` (with `expected_t`), `history-conflict`, `step-conflict`, `session-finished`",
        ),
    },
    openapi_extra={
        "requestBody": {"content": {MSGPACK: {"schema": {"$ref": "#/components/schemas/StepRequest"}}}}
    },
)
async def step(key: SessionKey, body: StepRequest) -> Response:
    """Send where the robot is and what its model proposes; get the closest distribution that keeps the rule.

    `poses` ends with x_t, and begins with a pose that the server has, or the first that it lacks. A decided
    step that is sent again with equal x_t, logits, signals and main_task_done gets the stored answer byte for
    byte, so a lost answer can be asked for again. After an error nothing is stored.

    Body and answer may be MessagePack too, by `Content-Type` and `Accept: application/msgpack`. The WebSocket
    `/v1/sessions/{session_id}/stream` takes the same bodies as messages and answers them in order: text
    frames are JSON, binary frames MessagePack. A problem document is known by its `type` and `status`.
    """
    raise AssertionError("routes/steps.py answers this route")


@router.post(
    "/{session_id}/switch",
    response_model=SessionResponse,
    summary="Go on under another rule",
    responses=problems(
        _404="No such session or policy.",
        _409="`history-gap` (with `expected_t`), `history-conflict`, `step-conflict`, `session-finished`",
        **DAMAGED,
        _429="`limit-reached`: the session has had too many rules.",
        _503="The store is away: try again.",
    ),
)
async def switch(key: SessionKey, body: SwitchRequest, server: ServerState, caller: Caller) -> Any:
    """Brings another rule, map or robot from step t on; the other settings of the session stay.

    The request is refused with `infeasible-switch` where no action from x_t has a future that satisfies the
    new rule, and with `invalid-pose` where x_t is outside the new map or the new footprint touches something
    there. A refused switch changes nothing, and a switch that is sent again is made once. `max_steps` grows
    where the new rule needs it.
    """
    made = await server.sessions.switches.make(key, body, caller.name)
    logs.tell("session switched", policy_ids=made["policy_ids"], t=body.t)
    return made


@router.post(
    "/{session_id}/close",
    response_model=CloseResponse,
    summary="End a session",
    responses=problems(
        **UNREADABLE,
        _409="`history-gap`, `history-conflict`, or `session-finished` for states after a close.",
    ),
)
async def close(key: SessionKey, body: CloseRequest, server: ServerState) -> Any:
    """Send the last states, for which no decision is needed, and get the verdict. The trajectory is kept."""
    closed = await server.sessions.close(key, body)
    logs.tell("session closed", spec_status=closed["spec_status"], next_t=closed["next_t"])
    return closed


@router.get(
    "/{session_id}/trajectory",
    response_class=Response,
    summary="Read a trajectory back",
    responses={
        200: {
            "model": Trajectory,
            "content": {NDJSON: {"schema": {"type": "string", "description": "One item in each line."}}},
            "description": "Every state, with the answer that was given there.",
        },
        **problems(**UNREADABLE),
    },
)
async def trajectory(
    key: SessionKey,
    server: ServerState,
    accept: Annotated[str, Header(include_in_schema=False)] = "",
    format: Annotated[
        Literal["json", "ndjson"] | None,
        Query(description="`Accept: application/x-ndjson` asks for NDJSON too."),
    ] = None,
    after: Annotated[int, Query(ge=-1, le=1_000_000, description="Leave out the steps up to this one.")] = -1,
) -> Response:
    """The states x_0 to x_t with the answers, as one JSON object or as one JSON object in each line. With
    `after`, only those of later steps.
    """
    lines, rules = await server.sessions.trajectory(key, after)
    if format == "ndjson" or (format is None and accepts(accept, NDJSON)):
        return StreamingResponse(_each(lines, server.reading), media_type=NDJSON)
    return StreamingResponse(_listed(lines, rules, server.reading), media_type="application/json")


@router.get(
    "/{session_id}/learned",
    response_class=Response,
    summary="Read what the session learned of the map",
    responses={200: {"model": Learned}, **problems(**UNREADABLE)},
)
async def learned(key: SessionKey, server: ServerState) -> Response:
    """The cells that differ from the map, as `occupied` and `free` points and contacts have shown. Cells have
    the indices of an OccupancyGrid's `data`: row by row from the map's origin, `row * width + column`.
    """
    return Response(await server.sessions.learned(key), media_type="application/json")


async def _each(lines: Iterator[bytes], turns: asyncio.Lock) -> AsyncIterator[bytes]:
    """The lines. However many callers read, one is written in a round of the event loop: 10,000 lines take
    more than a second.
    """
    while True:
        async with turns:
            line = next(lines, None)
            await asyncio.sleep(0)
        if line is None:
            return
        yield line + b"\n"


async def _listed(lines: Iterator[bytes], rules: bytes, turns: asyncio.Lock) -> AsyncIterator[bytes]:
    yield b'{"items":['
    before = b""
    async for line in _each(lines, turns):
        yield before + line
        before = b","
    yield b'],"next":null,"rules":' + rules + b"}"
