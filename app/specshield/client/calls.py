"""The calls of the service, each a generator (core.py) that the shells sync.py and aio.py perform."""

from __future__ import annotations

import logging
import math
import os
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal

from specshield.client import wire
from specshield.client.away import OnFailure, on_failure_value
from specshield.client.core import Flow, Wait, call, deliver, erase, fetch
from specshield.client.models import Map, Page, Policy, SessionInfo, Spec, build
from specshield.client.wire import Content, Failure, Numbers, Request
from specshield.errors import InputError, SessionExists, SpecshieldError, TransportError, TransportTimeout

log = logging.getLogger("specshield")
READY_EVERY = 0.25  # [s] between two requests whether the server is ready


def wait_until_ready(timeout: float = 300.0) -> Flow[None]:
    """Return when the server is ready to decide: its first start takes about a minute.

    This also waits for a server that cannot be reached yet. A logged warning says for what. Raises
    TransportTimeout after `timeout` [s], with the progress of the server's start; Unauthorized if the server
    refuses the API key; and the error of its answer if another server than specshield answers.
    """
    if timeout not in (0.0, math.inf):  # to ask once, or for ever
        wire.seconds_value(timeout, "timeout")
    # Many servers answer /readyz, but not the list of maps; and another process may answer that.
    asked = Request("GET", "/readyz"), wire.get("maps", params={"limit": "1"})
    seconds, told = 0.0, SpecshieldError
    while True:
        for request in asked:
            outcome = yield request
            seconds += outcome.seconds
            if isinstance(outcome, Failure) or outcome.status in wire.AWAY:
                break
            answered = wire.json_object(outcome)
        else:
            build(Page, answered)
            return
        error = outcome.error if isinstance(outcome, Failure) else wire.error_of(outcome)
        if seconds >= timeout:
            raise TransportTimeout(f"not ready after {seconds:.1f} s: {error}") from error
        if told is not type(error):  # else a program whose server was not started would wait without a word
            told = type(error)
            log.warning("waiting: %s", error)
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
    """Parse a formula. Raises FormulaError, which says where the formula is wrong.

    If regions, signals or a map are given, every name must be one of theirs; a map's rooms are names too.
    """
    optional = {"regions": regions, "signals": signals, "map_id": map_id}
    body = {"formula": formula, **{name: value for name, value in optional.items() if value is not None}}
    return build(Spec, (yield from call(wire.post("specs", "validate", body=body))))


def create_map(format: str, **members: Any) -> Flow[Map]:
    """Send a map in any format of the server; its /docs lists the formats and their members.

    The member `name` is your name for the map, which you can use wherever its id is asked for.

    If a member is bytes or the path object of a file, all are sent as files, as `map_server` needs it.
    """
    if not any(isinstance(member, bytes | os.PathLike) for member in members.values()):
        return build(Map, (yield from call(wire.post("maps", body={"format": format, **members}, slow=True))))
    parts = {name: wire.content(member, name) for name, member in {"format": format, **members}.items()}
    files = {name: (name, part, "application/octet-stream") for name, part in parts.items()}
    return build(Map, (yield from call(Request("POST", wire.path("maps"), files=files, slow=True))))


def upload_map(metadata: Content, image: Content, *, name: str | None = None) -> Flow[Map]:
    """Send a ROS map_server map: YAML, and PGM or PNG, each as content or as the path object of a file."""
    files = {"metadata": wire.content(metadata, "metadata"), "image": wire.content(image, "image")}
    return (yield from create_map("map_server", **files, **_named(name)))


def procthor_map(
    house: Mapping[str, Any],
    asset_sizes: Mapping[str, Any],
    resolution: float = 0.05,
    *,
    name: str | None = None,
) -> Flow[Map]:
    """Send a ProcTHOR house, drawn with cells of `resolution` [m]; map (x, y) is house (x, z)."""
    members = {"house": house, "asset_sizes": asset_sizes, "resolution": resolution}
    return (yield from create_map("procthor", **members, **_named(name)))


def occupancy_grid_map(info: Mapping[str, Any], data: Sequence[int], *, name: str | None = None) -> Flow[Map]:
    """Send a nav_msgs/OccupancyGrid: its `info`, and `data` row by row from the lowest y."""
    return (yield from create_map("occupancy_grid", info=info, data=data, **_named(name)))


def _named(name: str | None) -> dict[str, str]:
    return {} if name is None else {"name": name}


def get_map(id: str) -> Flow[Map]:
    """Read a map by its id or its name."""
    return build(Map, (yield from call(wire.get("maps", id))))


def delete_map(id: str) -> Flow[None]:
    """Remove a map. Raises InUse while a policy is for it."""
    return (yield from erase(Request("DELETE", wire.path("maps", id))))


def map_image(id: str) -> Flow[bytes]:
    """The map as PNG: white cells are free, black ones occupied."""
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
    """Have a policy made. Returns at once (see `wait`). The same request again returns the same policy.

    `name` is your name for the policy, which you can use wherever its id is asked for.

    `signals` has the other signals of the formula, each with its value before the first sample. The server's
    /docs lists the methods and their options.
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
    """Send a policy made elsewhere: safetensors and its card, each as content or as a path object."""
    told = wire.encode(card) if isinstance(card, Mapping) else wire.content(card, "card")
    files = {
        "weights": ("policy.safetensors", wire.content(weights, "weights"), "application/octet-stream"),
        "card": ("card.json", told, "application/json"),
    }
    return build(Policy, (yield from call(Request("POST", wire.path("policies"), files=files, slow=True))))


def policy_image(id: str) -> Flow[bytes]:
    """An SVG of the floor, with the starts from which the policy can keep the rule."""
    return (yield from fetch(wire.get("policies", id, "image.svg", slow=True))).content


def get_policy(id: str) -> Flow[Policy]:
    """Read a policy by its id or its name: the progress of its making, and what was measured of it."""
    return build(Policy, (yield from call(wire.get("policies", id))))


def delete_policy(id: str) -> Flow[None]:
    """Cancel the making of a policy, or remove it. Raises InUse while sessions use it.

    The request is sent only once: the first DELETE cancels the making, and a second one removes the policy.
    """
    return (yield from erase(Request("DELETE", wire.path("policies", id), tries=1)))


def wait_policy(
    id: str,
    *,
    timeout: float = 3600.0,
    interval: float = 1.0,
    progress: Callable[[Policy], object] | None = None,
) -> Flow[Policy]:
    """Read the policy every `interval` [s] until it is `ready` or `failed`; each answer goes to `progress`.

    After its first answer the server may be away for a while. Raises TransportTimeout after `timeout` [s];
    the making of the policy goes on.
    """
    seconds, policy = 0.0, None
    while True:
        try:
            delivery = yield from deliver(wire.get("policies", id))
            seconds += delivery.seconds
            policy = build(Policy, wire.json_object(delivery.reply))
        except SpecshieldError as error:
            away = isinstance(error, TransportError) or error.details.get("status") in wire.AWAY
            if policy is None or not away:
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
    """Begin a session at `initial_pose`, with which the first step's pose has to agree to 1e-6.

    `threshold` is the least probability of the actions that can keep the rule. The guarantee holds for 1 with
    evaluation "feasibility", the defaults. With evaluation "robustness" it is the mean robustness [m] to
    reach, for which 1 is often too much. `margin` and `slack` are the robustness [m] and the steps to keep in
    reserve. `shaping` is "projection" or one of the preferences that the server's /docs lists. Raises
    InfeasibleStart if no way to keep the rule was found, unless `allow_infeasible`.

    `uncertainty`: with "learned", margin and slack follow from how the robot moves; {"translation": m,
    "rotation": rad, "slip": probability} is what is known of it before the first step; with "none", it is
    taken to move exactly as described. `learn_map`: a motion that stops short marks what it ran into.
    `map_memory`: the steps after which a point sent as `occupied` is forgotten; None: its age does not
    matter. `threshold_over`: whether `threshold` holds at each "step" or over the whole "episode".

    `on_failure` says what `step` does when the service cannot answer in time. "raise": it raises the error.
    "witness": it returns a `LocalDecision` that follows the latest certified continuation, or says to stop if
    there is none, it has ended, or the robot has left it. "stop": it returns one that says to stop.
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
    except SessionExists:  # if an earlier try created this session and its answer was lost, it is read back
        if delivery.tries == 1:
            raise
        told = yield from call(wire.get("sessions", key))
        if id is not None and not (yield from _begins(body, told)):  # the id belongs to another session
            raise
        return build(SessionInfo, told)


def _begins(body: Mapping[str, Any], told: Mapping[str, Any]) -> Flow[bool]:
    """Whether the session `told` can be the one that `body` asked for: it has no decided step yet, and its
    policies and settings, as far as it shows them, are those of the request.
    """
    if told.get("next_t") != 0:
        return False
    for name in (body.keys() & told.keys()) - {"policy_ids"}:
        asked, has = body[name], told[name]
        if isinstance(asked, dict) and isinstance(has, dict):
            asked = {**has, **asked}  # members that were left out have their defaults
        if asked != has:
            return False
    ids: list[str] = []
    for named in body.get("policy_ids") or [body["policy_id"]]:
        ids += [(yield from get_policy(named)).id]  # the request may name the policy by its name
    return ids == told.get("policy_ids")


def policies_asked(policy_id: str | None, policy_ids: Sequence[str] | None) -> dict[str, Any]:
    """The member of a request that names the policies. Raises InputError unless one of the two is given."""
    if (policy_id is None) == (policy_ids is None):
        raise InputError("give policy_id or policy_ids", path="policy_id", expected="exactly one of the two")
    if isinstance(policy_ids, str) or not isinstance(policy_ids, Iterable | None):  # letters are no ids
        told, expected = "policy_ids is not a list", "a list of ids or names"
        raise InputError(told, path="policy_ids", got=policy_ids, expected=expected)
    return {"policy_id": policy_id} if policy_ids is None else {"policy_ids": list(policy_ids)}


def get_session(id: str, *, on_failure: OnFailure = "raise") -> Flow[SessionInfo]:
    """Take up a session that was begun earlier, at its next step.

    If the last executed action was a terminal one, say `main_task_done=True` at the next step: only the
    caller knows. `on_failure` is as in `create`; with "witness" the latest certified continuation is read
    back too. Poses that were recorded but not sent (`session.unsent`) are lost with the old process: `record`
    them again, or the rule's clock falls behind.
    """
    on_failure_value(on_failure)
    return build(SessionInfo, (yield from call(wire.get("sessions", id))))


def delete_session(id: str) -> Flow[None]:
    """Erase a session and its trajectory."""
    return (yield from erase(Request("DELETE", wire.path("sessions", id))))
