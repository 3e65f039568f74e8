"""/v1/policies: the policies pi_phi, which propose the futures that certify actions."""

from __future__ import annotations

import asyncio
import secrets
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response

from specshield.errors import InUse, TrainingUnavailable
from specshield.policy.methods import METHODS
from specshield.service import examples
from specshield.service.access.keys import Key
from specshield.service.bounds.bodies import received
from specshield.service.heavy.uploads import PARTS, is_multipart
from specshield.service.library.maps import undeletable
from specshield.service.library.policies import Record
from specshield.service.schemas.base import Id
from specshield.service.schemas.policies import PolicyList, PolicyResponse
from specshield.service.state import (
    FULL,
    TOO_MUCH,
    Caller,
    Cursor,
    Limit,
    Owner,
    Server,
    ServerState,
    json_body,
    problems,
)
from specshield.service.training.jobs import Training

router = APIRouter(prefix="/v1/policies", tags=["policies"])
PolicyId = Annotated[
    Id, Path(description="Id or name of a policy.", openapi_examples={"case1": {"value": "case1"}})
]


@router.post(
    "",
    status_code=202,
    response_model=PolicyResponse,
    summary="Ask for a policy, or send one",
    responses=problems(
        _404="No such map.",
        _409="`name-taken`: something else of yours has the name.",
        _429="`limit-reached`: the server keeps no more policies; delete one.",
        _503=f"`training-unavailable`: no worker is there to train; the store is away; or {TOO_MUCH['_503']}",
        **FULL,
    ),
    openapi_extra={
        "requestBody": {
            "required": True,
            "description": "JSON that says what to make, or a policy that was made elsewhere, as two files.",
            "content": {
                **json_body("PolicyRequest", examples.POLICY),
                "multipart/form-data": {
                    "schema": {
                        "type": "object",
                        "required": list(PARTS),
                        "properties": {
                            name: {"type": "string", "format": "binary", "description": file}
                            for name, file in PARTS.items()
                        },
                    }
                },
            },
        }
    },
)
async def create(request: Request, server: ServerState, caller: Caller) -> Any:
    """The answer comes at once. Making the policy takes seconds to minutes: read it to see the progress.

    Policies are immutable. The id of a policy that is made here is the hash of its map, task, method, options
    and seed: the same request again is answered with the existing policy, which is queued once more if it
    failed. The id of a policy that was sent is a hash over its weights and card too, so it is never the id of
    a policy that is made here.
    """
    body = received(request)
    if is_multipart(body.content_type):
        kept = await server.heavy.run(request, "add_policy", body.content_type, body.content, caller)
        shown = await asyncio.to_thread(_show, server, kept, caller.name)
    else:
        asked, name = await server.heavy.run(request, "check_policy", body.content, caller.name)
        shown = await asyncio.to_thread(_ask, server, caller, asked, name)
    await server.store.follow()
    return shown


def _ask(server: Server, caller: Key, asked: Record, called: str | None) -> dict[str, Any]:
    made, name = server.policies.made_here(asked.id), asked.about.method
    status = "failed" if made is None else _training(server, made).status
    queued = status == "failed"
    own = [] if server.worker is None else server.worker.methods
    if queued and name not in own and not server.jobs.worker_there(name):
        needs = METHODS.get(name).needs
        installed = f" where {' and '.join(needs)} is installed" if needs else ""
        told = f"no running worker makes policies by {name}"
        expected = f"a worker: start one with `specshield worker`{installed}, then ask again"
        raise TrainingUnavailable(told, path="method", got=name, expected=expected)
    record = server.policies.add(asked, caller)
    if queued:
        server.jobs.start(record.id, name, caller.name)
    elif status == "queued":
        server.jobs.ask_too(record.id, name, caller.name)
    if called is not None:
        server.policies.name(record, caller.name, called)
    return _show(server, record, caller.name)


def _training(server: Server, record: Record) -> Training:
    return Training("ready", 1.0) if record.card is not None else server.jobs.get(record.id)


def _show(server: Server, record: Record, owner: str) -> dict[str, Any]:
    return _shown(server, record, server.policies.name_of(record, owner))


def _shown(server: Server, record: Record, name: str | None) -> dict[str, Any]:
    card = record.card or {}  # the card may come from a stranger
    warnings = card.get("warnings", [])
    return {
        **vars(_training(server, record)),
        **vars(record.about),
        "id": record.id,
        "name": name,
        "metrics": card.get("metrics", {}),
        "warnings": [str(each)[:500] for each in warnings[:16]] if isinstance(warnings, list) else [],
        "horizon": record.horizon,
        "created_at": record.created_at,
    }


@router.get(
    "", response_model=PolicyList, summary="List the policies", responses=problems(_503="The store is away.")
)
async def list_all(server: ServerState, owner: Owner, cursor: Cursor = None, limit: Limit = 100) -> Any:
    """The policies that came with the server and your own, in order of name and id. `spec` has no `regions`
    here.
    """

    def show() -> dict[str, Any]:
        found, following = server.policies.page(owner, cursor, limit)
        names = server.policies.claims.names("policies", owner)
        items = [_shown(server, record, record.name or names.get(record.id)) for record in found]
        for item in items:
            item["spec"] = {name: held for name, held in item["spec"].items() if name != "regions"}
        return {"items": items, "next": following}

    return await asyncio.to_thread(show)


@router.get(
    "/{policy_id}",
    response_model=PolicyResponse,
    summary="Read a policy",
    responses=problems(_404="No such policy.", _503="The store is away."),
)
async def read(policy_id: PolicyId, server: ServerState, owner: Owner) -> Any:
    """The policy's task, the progress of its making, and what was measured of it."""
    return await asyncio.to_thread(lambda: _show(server, server.policies.find(policy_id, owner), owner))


@router.delete(
    "/{policy_id}",
    status_code=204,
    summary="Cancel or remove a policy",
    responses=problems(
        _404="No such policy.",
        _409="`in-use`: a session still uses it, or it came with the server.",
        _503="The store is away.",
    ),
)
async def delete(policy_id: PolicyId, server: ServerState, owner: Owner) -> Response:
    """A policy that is being made is cancelled, and stays with the status `failed`. Any other policy is
    removed for the key that asks; another key that asked for the same policy keeps it.
    """
    record = await asyncio.to_thread(server.policies.find, policy_id, owner)
    if record.name is not None:
        raise undeletable("policy", record.name, policy_id)
    claims, token = server.policies.claims, secrets.token_hex(8)
    making = (await asyncio.to_thread(_training, server, record)).status in ("queued", "training")
    if making and await asyncio.to_thread(claims.owners, "policies", record.id) < 2:
        await asyncio.to_thread(server.jobs.cancel, record.id)
        await server.store.follow()
        return Response(status_code=204)
    await asyncio.to_thread(claims.mark, "policies", record.id, owner, token)
    try:
        session = await server.sessions.using(owner, record.id)
        if session is not None:
            told = f"session {session!r} still uses this policy"
            expected = "a policy that no session uses: close the session first"
            raise InUse(told, path="policy_id", got=policy_id, expected=expected, session_id=session)
        if await asyncio.to_thread(server.policies.delete, record, owner, token):
            await asyncio.to_thread(server.jobs.forget, record.id)
    finally:
        await asyncio.to_thread(claims.unmark, "policies", record.id, token)
    await server.store.follow()
    return Response(status_code=204)
