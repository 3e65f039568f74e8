"""Every call of the SDK as a generator that does no I/O: it yields what to send and how long to wait.

A shell (sync.py, aio.py) performs a `Request` and sends its `Reply` or `Failure` in; it sleeps for a
`Wait`; the generator's return value is the call's. So requests, parsing and retries exist once.

Retries: a lost answer, 502, 503 or 504 is followed by the same bytes again, at most `tries` times,
after 0.05 s, 0.1 s, 0.2 s, ..., and no try starts later than four timeouts after the first. All that
is repeated is safe to repeat: steps are locked by t and content, maps and policies are addressed by
content, and a session is created under an id the client chose.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from specshield.client.models import Map, Page, Policy, SessionInfo, Spec, build
from specshield.client.wire import (
    Content,
    Failure,
    Numbers,
    Reply,
    Request,
    check,
    content,
    encode,
    error_of,
    get,
    json_object,
    path,
    pose_values,
    post,
)
from specshield.errors import (
    InputError,
    NotFound,
    SessionExists,
    StoreError,
    TrainingUnavailable,
    TransportError,
    TransportTimeout,
)

T = TypeVar("T")
BACKOFF = 0.05  # s before the second try, doubled for each that follows
PATIENCE = 4  # timeouts after which no further try starts


@dataclass(frozen=True)
class Wait:
    seconds: float


Flow = Generator[Request | Wait, Reply | Failure, T]


@dataclass(frozen=True)
class Delivery:
    """A reply, the number of tries and the time [s] it took."""

    reply: Reply
    tries: int
    seconds: float


def deliver(request: Request) -> Flow[Delivery]:
    """Send until there is an answer worth having; TransportError where there is none."""
    tries, seconds = 0, 0.0
    while True:
        outcome = yield request
        tries, seconds = tries + 1, seconds + outcome.seconds
        wait = BACKOFF * 2 ** (tries - 1)
        if not _passing(outcome) or tries == request.tries or seconds + wait > PATIENCE * outcome.timeout:
            if isinstance(outcome, Failure):
                outcome.error.details.update(tries=tries, seconds=round(seconds, 3))
                raise outcome.error
            return Delivery(outcome, tries, seconds)
        yield Wait(wait)
        seconds += wait


def _passing(outcome: Reply | Failure) -> bool:
    """Whether the same request may fare better in a moment."""
    if isinstance(outcome, Failure):
        return True
    return outcome.status in (502, 503, 504) and not isinstance(error_of(outcome), TrainingUnavailable)


def call(request: Request) -> Flow[dict[str, Any]]:
    delivery = yield from deliver(request)
    return json_object(delivery.reply)


def erase(request: Request) -> Flow[None]:
    """DELETE; gone already, after a try of our own whose answer was lost, is gone."""
    delivery = yield from deliver(request)
    try:
        check(delivery.reply)
    except NotFound:
        if delivery.tries == 1:
            raise


def page(cls: type[T], resource: str, cursor: str | None) -> Flow[Page[T]]:
    raw: Page[Any] = build(
        Page, (yield from call(get(resource, params={} if cursor is None else {"cursor": cursor})))
    )
    return Page(tuple(build(cls, item) for item in raw.items), raw.next)


def validate(
    formula: str,
    regions: Mapping[str, Any] | None,
    signals: Mapping[str, float] | None,
    map_id: str | None,
) -> Flow[Spec]:
    optional = {"regions": regions, "signals": signals, "map_id": map_id}
    body = {"formula": formula, **{name: value for name, value in optional.items() if value is not None}}
    return build(Spec, (yield from call(post("specs", "validate", body=body))))


def upload_map(metadata: Content, image: Content) -> Flow[Map]:
    files = {
        "metadata": ("map.yaml", content(metadata, "metadata"), "application/yaml"),
        "image": ("map", content(image, "image"), "application/octet-stream"),
    }
    return build(Map, (yield from call(Request("POST", path("maps"), files=files, slow=True))))


def post_map(**body: Any) -> Flow[Map]:
    return build(Map, (yield from call(post("maps", body=body, slow=True))))


def get_map(id: str) -> Flow[Map]:
    return build(Map, (yield from call(get("maps", id))))


def map_image(id: str) -> Flow[bytes]:
    delivery = yield from deliver(get("maps", id, "image.png", slow=True))
    check(delivery.reply)
    return delivery.reply.content


def create_policy(
    map_id: str,
    formula: str,
    regions: Mapping[str, Any] | None,
    signals: Mapping[str, float] | None,
    robot: str | Mapping[str, Any],
    method: str,
    seed: int,
    options: Mapping[str, Any] | None,
) -> Flow[Policy]:
    body = {
        "map_id": map_id,
        "robot": robot,
        "spec": {"formula": formula, "regions": regions or {}, "signals": signals or {}},
        "method": method,
        "seed": seed,
        "options": options or {},
    }
    return build(Policy, (yield from call(post("policies", body=body, slow=True))))


def upload_policy(weights: Content, card: Content | Mapping[str, Any]) -> Flow[Policy]:
    files = {
        "weights": ("policy.safetensors", content(weights, "weights"), "application/octet-stream"),
        "card": (
            "card.json",
            encode(card) if isinstance(card, Mapping) else content(card, "card"),
            "application/json",
        ),
    }
    return build(Policy, (yield from call(Request("POST", path("policies"), files=files, slow=True))))


def get_policy(id: str) -> Flow[Policy]:
    return build(Policy, (yield from call(get("policies", id))))


def delete_policy(id: str) -> Flow[None]:
    """Sent once: the first DELETE cancels a training, a second one would remove what is left of it."""
    return (yield from erase(Request("DELETE", path("policies", id), tries=1)))


def wait_policy(
    id: str, timeout: float, interval: float, progress: Callable[[Policy], object] | None
) -> Flow[Policy]:
    """Ask until ready or failed. A server away for a while is waited for, if it has answered once."""
    seconds, policy = 0.0, None
    while True:
        try:
            delivery = yield from deliver(get("policies", id))
            seconds += delivery.seconds
            policy = build(Policy, json_object(delivery.reply))
        except (TransportError, StoreError) as error:
            if policy is None:
                raise
            seconds += error.details.get("seconds", 0.0)
        else:
            if progress is not None:
                progress(policy)
            if policy.status in ("ready", "failed"):
                return policy
        if seconds + interval > timeout:
            raise TransportTimeout(
                f"policy {id} is {policy.status} ({policy.progress:.0%}) after {seconds:.0f} s", policy=policy
            )
        yield Wait(interval)
        seconds += interval


def create_session(
    policy_id: str | None,
    policy_ids: Sequence[str] | None,
    initial_pose: Numbers,
    *,
    id: str | None,
    seed: int,
    threshold: float,
    margin: float,
    slack: int,
    evaluation: Literal["feasibility", "robustness"],
    shaping: Literal["projection", "lookahead"],
    max_steps: int | None,
    allow_infeasible: bool,
) -> Flow[SessionInfo]:
    """`session-exists` after a lost answer of our own is this very session: it is read back."""
    if (policy_id is None) == (policy_ids is None):
        raise InputError("give policy_id or policy_ids", path="policy_id", expected="exactly one of the two")
    key = str(uuid.uuid4()) if id is None else id
    body: dict[str, Any] = {
        "id": key,
        "initial_pose": pose_values(initial_pose, "initial_pose"),
        "seed": seed,
        "threshold": threshold,
        "margin": margin,
        "slack": slack,
        "evaluation": evaluation,
        "shaping": shaping,
        "allow_infeasible": allow_infeasible,
    }
    body.update({"policy_id": policy_id} if policy_ids is None else {"policy_ids": list(policy_ids)})
    body.update({} if max_steps is None else {"max_steps": max_steps})
    delivery = yield from deliver(post("sessions", body=body, slow=True))
    try:
        return build(SessionInfo, json_object(delivery.reply))
    except SessionExists:
        if delivery.tries == 1:
            raise
        info = yield from get_session(key)
        if id is not None and info.next_t > 0:  # the caller's id was in use before
            raise
        return info


def get_session(id: str) -> Flow[SessionInfo]:
    return build(SessionInfo, (yield from call(get("sessions", id))))


def delete_session(id: str) -> Flow[None]:
    return (yield from erase(Request("DELETE", path("sessions", id))))
