"""/v1/policies: the policies pi_phi that certify actions."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response
from pydantic import TypeAdapter

from specshield.errors import FragmentError, InUse, TrainingUnavailable
from specshield.service import examples
from specshield.service.library.policies import Description, Record, describe
from specshield.service.routes import uploads
from specshield.service.schemas import Card, Id, PolicyList, PolicyRequest, PolicyResponse
from specshield.service.state import Cursor, Limit, Server, ServerState, problems
from specshield.service.training import methods
from specshield.service.training.jobs import Training

router = APIRouter(prefix="/v1/policies", tags=["policies"])
MODELS = (PolicyRequest,)  # documented by hand
REQUEST = TypeAdapter(PolicyRequest)
CARD = TypeAdapter(Card)
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
        _429="The server keeps no more policies.",
        _503="`training-unavailable`: no worker is there to train; or the store is away.",
    ),
    openapi_extra=uploads.request_body(
        "What to train, as JSON; or a policy trained elsewhere, as two files.",
        REQUEST,
        examples.POLICY,
        {"weights": "policy.safetensors", "card": "card.json"},
    ),
)
async def create(request: Request, server: ServerState) -> Any:
    """Training takes minutes: read the policy to see how far it is.

    Policies are immutable and known by the hash of task, method, options and seed: the same request again
    answers the policy there is, and queues it once more if it failed. `reachability` computes, in seconds,
    and `dqn` learns, in minutes, for conjunctions of `F[a,b]`, `G[a,b]` and `F[a,c] G[d,b]` over boolean
    combinations of predicates; `planner` is made in seconds for any formula, and plans at every decision.
    """
    if uploads.is_multipart(request):
        weights, card = await uploads.parts(request, "weights", "card")
        return _show(server, await asyncio.to_thread(_add, server, weights, card))
    return await asyncio.to_thread(_ask, server, await request.body())


def _add(server: Server, weights: bytes, content: bytes) -> Record:
    card = uploads.parse(CARD, content, "card").model_dump(exclude_unset=True)
    return server.policies.add_card(describe(card), card, weights)


def _ask(server: Server, content: bytes) -> dict[str, Any]:
    body = uploads.parse(REQUEST, content).model_dump(exclude_unset=True)
    asked = PolicyRequest(**body)
    options = methods.complete(asked.method, asked.options)
    robot = body.get("robot", "stretch")
    about = Description(asked.map_id, robot, body["spec"], asked.method, asked.seed, options)
    about = server.policies.resolve(about)
    task = server.policies.task(about)
    try:
        methods.check(asked.method, task, options)
    except FragmentError as error:
        raise (error if error.path == "robot" else error.at("spec.formula")) from None
    record = server.policies.find(about, task)
    if record is not None and _training(server, record).status != "failed":
        return _show(server, record)
    here = server.worker is not None and asked.method in methods.available()
    if not (here or server.jobs.worker_there(asked.method)):
        raise TrainingUnavailable(
            f"no worker is there that makes policies by {asked.method}; start one with `specshield worker`"
        )
    record = record or server.policies.add(about, task)
    server.jobs.start(record.id, asked.method)
    return _show(server, record)


def _training(server: Server, record: Record) -> Training:
    return Training("ready", 1.0) if record.card is not None else server.jobs.get(record.id)


def _show(server: Server, record: Record) -> dict[str, Any]:
    training, about = _training(server, record), record.about
    return {
        "id": record.id,
        "name": record.name,
        "status": training.status,
        "progress": training.progress,
        "eta_s": training.eta_s,
        "error": training.error,
        "metrics": (record.card or {}).get("metrics", {}),
        "map_id": about.map_id,
        "robot": about.robot,
        "spec": about.spec,
        "horizon": record.horizon,
        "method": about.method,
        "seed": about.seed,
        "options": about.options,
        "created_at": record.created_at,
    }


@router.get(
    "", response_model=PolicyList, summary="List the policies", responses=problems(_503="The store is away.")
)
async def list_all(server: ServerState, cursor: Cursor = None, limit: Limit = 100) -> Any:
    """In order of name and id."""

    def show() -> dict[str, Any]:
        found, following = server.policies.page(cursor, limit)
        return {"items": [_show(server, record) for record in found], "next": following}

    return await asyncio.to_thread(show)


@router.get(
    "/{policy_id}",
    response_model=PolicyResponse,
    summary="Read a policy",
    responses=problems(_404="No such policy.", _503="The store is away."),
)
async def read(policy_id: PolicyId, server: ServerState) -> Any:
    """How far it is, and what was measured."""
    return await asyncio.to_thread(lambda: _show(server, server.policies.record(policy_id)))


@router.delete(
    "/{policy_id}",
    status_code=204,
    summary="Cancel or remove a policy",
    responses=problems(
        _404="No such policy.",
        _409="`in-use`: a session still asks it, or it came with the server.",
        _503="The store is away.",
    ),
)
async def delete(policy_id: PolicyId, server: ServerState) -> Response:
    """A training is cancelled, and the policy stays as failed; any other policy is removed."""
    record = await asyncio.to_thread(server.policies.record, policy_id)
    if record.name is not None:
        raise InUse(
            f"policy {record.name!r} came with the server",
            path="policy_id",
            got=policy_id,
            expected="one that was sent",
        )
    training = await asyncio.to_thread(_training, server, record)
    if training.status in ("queued", "training"):
        await asyncio.to_thread(server.jobs.cancel, record.id)
        return Response(status_code=204)
    session = await server.sessions.using(record.id)
    if session is not None:
        message = f"session {session!r} still asks this policy"
        raise InUse(
            message, path="policy_id", got=policy_id, expected="a policy without sessions", session_id=session
        )
    await asyncio.to_thread(server.policies.delete, record)
    await asyncio.to_thread(server.jobs.forget, record.id)
    return Response(status_code=204)
