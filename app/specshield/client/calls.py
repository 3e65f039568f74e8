"""What can be asked of the service, one generator a call (core.py). The shells perform them: sync.py as they
are here, aio.py with `await`.
"""

from __future__ import annotations

import logging
import os
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

from specshield.client import wire
from specshield.client.away import OnFailure, on_failure_value
from specshield.client.core import Flow, Wait, call, deliver, erase, fetch
from specshield.client.models import Map, Policy, SessionInfo, Spec, build
from specshield.client.wire import Content, Failure, Numbers, Reply, Request
from specshield.errors import InputError, SessionExists, StoreError, TransportError, TransportTimeout

log = logging.getLogger("specshield")
READY_EVERY = 0.25  # s between two questions whether the server is ready


def wait_until_ready(timeout: float = 300.0) -> Flow[None]:
    """Return when the server is ready to decide: its first start takes about a minute.

    A server that cannot be reached yet is waited for too. Raises TransportTimeout after `timeout` [s],
    which says how far the server was.
    """
    seconds = 0.0
    while True:
        outcome = yield Request("GET", "/readyz")
        seconds += outcome.seconds
        if isinstance(outcome, Reply) and outcome.status not in (502, 503, 504):
            return wire.check(outcome)
        error = outcome.error if isinstance(outcome, Failure) else wire.error_of(outcome)
        if seconds >= timeout:
            raise TransportTimeout(f"not ready after {seconds:.1f} s: {error}") from error
        pause = min(READY_EVERY, timeout - seconds)
        yield Wait(pause)
        seconds += pause


def validate(
    formula: str,
    regions: Mapping[str, Any] | None = None,
    *,
    signals: Mapping[str, float] | None = None,
    map_id: str | None = None,
) -> Flow[Spec]:
    """Parse a formula; FormulaError says where it is wrong.

    Once regions, signals or a map (whose rooms are names) are given, every name must be one of theirs.
    """
    optional = {"regions": regions, "signals": signals, "map_id": map_id}
    body = {"formula": formula, **{name: value for name, value in optional.items() if value is not None}}
    return build(Spec, (yield from call(wire.post("specs", "validate", body=body))))


def create_map(format: str, **members: Any) -> Flow[Map]:
    """Send a map in any format that the server has (its /docs lists them), by the format's own members.

    A member `name` is what you call the map; the name is taken wherever its id is.

    A member that is bytes or the path object of a file makes all of them go as files, as `map_server` wants.
    """
    if not any(isinstance(member, bytes | os.PathLike) for member in members.values()):
        return build(Map, (yield from call(wire.post("maps", body={"format": format, **members}, slow=True))))
    parts = {name: wire.content(member, name) for name, member in {"format": format, **members}.items()}
    files = {name: (name, part, "application/octet-stream") for name, part in parts.items()}
    return build(Map, (yield from call(Request("POST", wire.path("maps"), files=files, slow=True))))


def upload_map(metadata: Content, image: Content, *, name: str | None = None) -> Flow[Map]:
    """A ROS map_server map: YAML and PGM or PNG, each its content or the path object of a file."""
    files = {"metadata": wire.content(metadata, "metadata"), "image": wire.content(image, "image")}
    return (yield from create_map("map_server", **files, **_named(name)))


def procthor_map(
    house: Mapping[str, Any],
    asset_sizes: Mapping[str, Any],
    resolution: float = 0.05,
    *,
    name: str | None = None,
) -> Flow[Map]:
    """A ProcTHOR house, drawn at `resolution` [m]; map (x, y) is house (x, z)."""
    members = {"house": house, "asset_sizes": asset_sizes, "resolution": resolution}
    return (yield from create_map("procthor", **members, **_named(name)))


def occupancy_grid_map(info: Mapping[str, Any], data: Sequence[int], *, name: str | None = None) -> Flow[Map]:
    """A nav_msgs/OccupancyGrid: its `info`, and `data` row by row from the lowest y."""
    return (yield from create_map("occupancy_grid", info=info, data=data, **_named(name)))


def _named(name: str | None) -> dict[str, str]:
    return {} if name is None else {"name": name}


def get_map(id: str) -> Flow[Map]:
    """A map by its id or its name."""
    return build(Map, (yield from call(wire.get("maps", id))))


def delete_map(id: str) -> Flow[None]:
    """Remove a map. InUse while a policy is for it."""
    return (yield from erase(Request("DELETE", wire.path("maps", id))))


def map_image(id: str) -> Flow[bytes]:
    """The map as PNG: white is free, black occupied."""
    return (yield from fetch(wire.get("maps", id, "image.png", slow=True))).content


def create_policy(
    map_id: str,
    formula: str,
    regions: Mapping[str, Any] | None = None,
    *,
    signals: Mapping[str, float] | None = None,
    robot: str | Mapping[str, Any] = "stretch",
    method: str = "reachability",
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    name: str | None = None,
) -> Flow[Policy]:
    """Have a policy made; returns at once (see `wait`). The same request again is the same policy.

    `name` is what you call it; the name is taken wherever its id is.

    `signals` names the other signals of the formula, with the value each holds before its first sample. The
    server's /docs lists the methods that it has and the options of each.
    """
    body = {
        "map_id": map_id,
        "robot": robot,
        "spec": {"formula": formula, "regions": regions or {}, "signals": signals or {}},
        "method": method,
        "seed": seed,
        "options": options or {},
        **_named(name),
    }
    return build(Policy, (yield from call(wire.post("policies", body=body, slow=True))))


def upload_policy(weights: Content, card: Content | Mapping[str, Any]) -> Flow[Policy]:
    """A policy made elsewhere: safetensors and its card, each the content or a path object."""
    told = wire.encode(card) if isinstance(card, Mapping) else wire.content(card, "card")
    files = {
        "weights": ("policy.safetensors", wire.content(weights, "weights"), "application/octet-stream"),
        "card": ("card.json", told, "application/json"),
    }
    return build(Policy, (yield from call(Request("POST", wire.path("policies"), files=files, slow=True))))


def policy_image(id: str) -> Flow[bytes]:
    """The floor as SVG, and from where the policy can keep the rule."""
    return (yield from fetch(wire.get("policies", id, "image.svg", slow=True))).content


def get_policy(id: str) -> Flow[Policy]:
    """A policy by its id or its name: how far it is, and what was measured."""
    return build(Policy, (yield from call(wire.get("policies", id))))


def delete_policy(id: str) -> Flow[None]:
    """Cancel its training, or remove it. InUse while sessions use it.

    Sent once: the first DELETE cancels a training, a second one would remove what is left of it.
    """
    return (yield from erase(Request("DELETE", wire.path("policies", id), tries=1)))


def wait_policy(
    id: str,
    *,
    timeout: float = 3600.0,
    interval: float = 1.0,
    progress: Callable[[Policy], object] | None = None,
) -> Flow[Policy]:
    """Ask every `interval` [s] until it is `ready` or `failed`; `progress` sees every answer.

    A server that goes away for a while is waited for, once it has answered. Raises TransportTimeout after
    `timeout` [s]; the training goes on.
    """
    seconds, policy = 0.0, None
    while True:
        try:
            delivery = yield from deliver(wire.get("policies", id))
            seconds += delivery.seconds
            policy = build(Policy, wire.json_object(delivery.reply))
        except (TransportError, StoreError) as error:
            if policy is None:
                raise
            seconds += error.details.get("seconds", 0.0)
        else:
            if progress is not None:
                progress(policy)
            if policy.status in ("ready", "failed"):
                for warning in policy.warnings:
                    log.warning("policy %s: %s", id, warning)
                return policy
        if seconds >= timeout:
            told = f"policy {id} is {policy.status} ({policy.progress:.0%}) after {seconds:.1f} s"
            raise TransportTimeout(told, policy=policy)
        pause = min(interval, timeout - seconds)
        yield Wait(pause)
        seconds += pause


def create_session(
    *,
    initial_pose: Numbers,
    policy_id: str | None = None,
    policy_ids: Sequence[str] | None = None,
    id: str | None = None,
    seed: int = 0,
    threshold: float = 1.0,
    margin: float = 0.0,
    slack: int = 0,
    evaluation: Literal["feasibility", "robustness"] = "feasibility",
    shaping: str = "projection",
    max_steps: int | None = None,
    allow_infeasible: bool = False,
    uncertainty: Literal["learned", "none"] | Mapping[str, float] = "learned",
    learn_map: bool = True,
    map_memory: int | None = None,
    threshold_over: Literal["step", "episode"] = "step",
    on_failure: OnFailure = "raise",
) -> Flow[SessionInfo]:
    """Begin at `initial_pose`, which is x_0: the first step's pose has to agree with it to 1e-6.

    `threshold` is delta; the guarantee is for 1 with evaluation "feasibility", the defaults. With
    "robustness" it is the mean robustness [m] asked for, of which 1 is often too much. `margin` and
    `slack` are the robustness [m] and the steps to keep in hand. `shaping` is "projection" or one of the
    preferences that the server's /docs lists.
    Raises InfeasibleStart where no action has a satisfying future, unless `allow_infeasible`.

    `uncertainty`: "learned" has margin and slack follow from how the robot moves; {"translation": m,
    "rotation": rad, "slip": probability} says what is known of it before the first step; "none" takes the
    world for exact. `learn_map`: a motion that stops short marks what it ran into. `map_memory`: the steps
    after which a point sent as `occupied` is forgotten, None: not for its age.
    `threshold_over`: whether `threshold` holds at each "step" or over the whole "episode".

    `on_failure` says what a step is when the service cannot answer it in time. "raise": its error. "witness":
    a `LocalDecision` that follows the certified continuation received last; it says to stop where there is
    none, where it has ended, and where the robot is not where it leads. "stop": one that says to stop.
    """
    on_failure_value(on_failure)
    asked = policies_asked(policy_id, policy_ids)
    key = str(uuid.uuid4()) if id is None else id
    body: dict[str, Any] = {
        "id": key,
        "initial_pose": wire.pose_values(initial_pose, "initial_pose"),
        "seed": seed,
        "threshold": threshold,
        "margin": margin,
        "slack": slack,
        "evaluation": evaluation,
        "shaping": shaping,
        "allow_infeasible": allow_infeasible,
        "uncertainty": dict(uncertainty) if isinstance(uncertainty, Mapping) else uncertainty,
        "learn_map": learn_map,
        "map_memory": map_memory,
        "threshold_over": threshold_over,
        **asked,
    }
    body.update({} if max_steps is None else {"max_steps": max_steps})
    delivery = yield from deliver(wire.post("sessions", body=body, slow=True))
    try:
        return build(SessionInfo, wire.json_object(delivery.reply))
    except SessionExists:  # after a lost answer of our own it is this very session, which is read back
        if delivery.tries == 1:
            raise
        told = yield from call(wire.get("sessions", key))
        if id is not None and not (yield from _begins(body, told)):  # the caller's id was in use before
            raise
        return build(SessionInfo, told)


def _begins(body: Mapping[str, Any], told: Mapping[str, Any]) -> Flow[bool]:
    """Whether the session `told` of can be the one that `body` asked for: no step is taken yet, and policies
    and settings are those asked for, as far as it tells of them.
    """
    if told.get("next_t") != 0:
        return False
    for name in (body.keys() & told.keys()) - {"policy_ids"}:
        asked, has = body[name], told[name]
        if isinstance(asked, dict) and isinstance(has, dict):
            asked = {**has, **asked}  # what was left out has its default
        if asked != has:
            return False
    ids: list[str] = []
    for named in body.get("policy_ids") or [body["policy_id"]]:
        ids += [(yield from get_policy(named)).id]  # it may have been asked for by its name
    return ids == told.get("policy_ids")


def policies_asked(policy_id: str | None, policy_ids: Sequence[str] | None) -> dict[str, Any]:
    """The member of a body that names the policies. InputError unless exactly one of the two is given."""
    if (policy_id is None) == (policy_ids is None):
        raise InputError("give policy_id or policy_ids", path="policy_id", expected="exactly one of the two")
    if isinstance(policy_ids, str) or not isinstance(policy_ids, Iterable | None):  # letters are no ids
        raise InputError("this is no list", path="policy_ids", got=policy_ids, expected="ids or names")
    return {"policy_id": policy_id} if policy_ids is None else {"policy_ids": list(policy_ids)}


def get_session(id: str, *, on_failure: OnFailure = "raise") -> Flow[SessionInfo]:
    """A session begun earlier, ready for its next step.

    If the last action run was a terminal one, say `main_task_done=True` there: only the caller knows.
    `on_failure` is as in `create`. With "witness" the certified continuation received last is read back too.
    The poses of steps that the service has not heard of are not: `record` them again (`session.unsent`), or
    the rule's clock falls behind.
    """
    on_failure_value(on_failure)
    return build(SessionInfo, (yield from call(wire.get("sessions", id))))


def delete_session(id: str) -> Flow[None]:
    """Erase it with its trajectory."""
    return (yield from erase(Request("DELETE", wire.path("sessions", id))))
