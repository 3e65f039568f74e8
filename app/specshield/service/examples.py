"""Requests and problems for the docs page. The requests work as they stand, from the top of the page down."""

from __future__ import annotations

from typing import Any

SPEC_REQUEST: dict[str, Any] = {
    "formula": "F[0,60] (Charger1 or Charger2) and G[0,150] not Forbidden",
    "regions": {
        "Charger1": {"type": "circle", "center": [1.0, 2.0], "radius": 0.6},
        "Charger2": {"type": "rectangle", "min": [4.0, 1.0], "max": [5.0, 2.0]},
        "Forbidden": {"type": "polygon", "vertices": [[2.0, 2.0], [3.0, 2.0], [2.5, 3.0]]},
    },
}

POLICY: dict[str, Any] = {
    "map_id": "case1",
    "robot": "stretch",
    "spec": {
        "formula": "F[0,60] Goal",
        "regions": {"Goal": {"type": "circle", "center": [2.0, 2.0], "radius": 0.6}},
    },
    "method": "reachability",
    "seed": 0,
}

SESSION: dict[str, Any] = {"id": "example", "policy_id": "case1", "initial_pose": [5.0, 5.0, 0.0], "seed": 7}

STEP: dict[str, Any] = {
    "t": 0,
    "poses": [[5.0, 5.0, 0.0]],
    "logits": [2.0, 0.5, 0.5, -1.0, -4.0, None, 0.0, 0.0, *[None] * 12],
    "main_task_done": False,
}

SWITCH: dict[str, Any] = {"t": 1, "policy_id": "case1", "clock": "restart", "poses": [[5.2, 5.0, 0.0]]}

CLOSE: dict[str, Any] = {"t": 1, "poses": [[5.2, 5.0, 0.0]]}

# Each a problem document of one type, but for its title and status, which follow from the type.
PROBLEMS: list[dict[str, Any]] = [
    {
        "type": "history-gap",
        "detail": "the poses begin at step 9; the server has those before step 7",
        "path": "poses",
        "got": 9,
        "expected": "poses from step 7 or earlier up to step 9",
        "expected_t": 7,
    },
    {
        "type": "history-conflict",
        "detail": "the pose of step 6 is not the one that is stored",
        "path": "poses[0]",
        "got": [5.4, 5.0, 0.0],
        "expected": "[5.2, 5.0, 0.0], within 1e-6",
    },
    {
        "type": "step-conflict",
        "detail": "step 6 was decided for other logits",
        "path": "logits",
        "expected": "the logits that were sent before, or step 7",
    },
    {
        "type": "session-finished",
        "detail": "the session is over: no further step is decided",
        "path": "t",
        "got": 141,
        "expected": "a new session",
    },
    {
        "type": "session-exists",
        "detail": "there is a session with this id",
        "path": "id",
        "got": "example",
        "expected": "another id, or none",
    },
    {
        "type": "name-taken",
        "detail": "another map has this name",
        "path": "name",
        "got": "case1",
        "expected": "a name that is free",
    },
    {
        "type": "in-use",
        "detail": "it came with the server, and stays",
        "path": "id",
        "got": "case1",
        "expected": "one that was made or uploaded here",
    },
    {
        "type": "invalid-input",
        "detail": "seed is not valid",
        "path": "seed",
        "got": "7",
        "expected": "a valid integer",
    },
    {
        "type": "invalid-formula",
        "detail": "nothing declares 'Dok'",
        "path": "formula",
        "got": "Dok",
        "position": 8,
        "expected": "a region or room (Dock, Hall, Kitchen), x, y, theta, or a signal",
    },
    {
        "type": "invalid-logits",
        "detail": "one logit for each action",
        "path": "logits",
        "got": 3,
        "expected": "20 logits",
    },
    {
        "type": "invalid-map",
        "detail": "the grid has too few cells",
        "path": "data",
        "got": 9999,
        "expected": "100 x 100 = 10000 values",
    },
    {
        "type": "outside-fragment",
        "detail": "reachability takes conjunctions of F[a,b], G[a,b] and F[a,c] G[d,b]",
        "path": "spec.formula",
        "got": "Hall U[0,20] Kitchen",
        "expected": "such a rule, or the method planner",
    },
    {
        "type": "infeasible-start",
        "detail": "no future exists that keeps the rule from here: F[0,5] Kitchen could not be kept",
        "path": "initial_pose",
        "got": [5.0, 5.0, 0.0],
        "expected": "a start from which the rule can be kept",
        "proved": True,
        "conjuncts": [
            {"formula": "F[0,5] Kitchen", "feasible_alone": False, "robustness": -1.84, "late_by": 11},
            {"formula": "G[0,80] not Bathroom", "feasible_alone": True, "robustness": 1.2, "late_by": None},
        ],
    },
    {
        "type": "infeasible-switch",
        "detail": "no future was found that keeps the new rule from here",
        "path": "policy_id",
        "got": "case1",
        "expected": "a rule that can still be kept",
        "proved": False,
        "conjuncts": [
            {"formula": "F[0,60] Charger1", "feasible_alone": False, "robustness": -0.41, "late_by": 7}
        ],
    },
    {
        "type": "not-found",
        "detail": "there is nothing with this id",
        "path": "id",
        "got": "robot-7",
        "expected": "an id or a name that the list shows",
    },
    {
        "type": "unauthorized",
        "detail": "an API key is needed",
        "path": "Authorization",
        "got": None,
        "expected": "Bearer <key>",
    },
    {
        "type": "cross-site",
        "detail": "a page of another origin may not use this server",
        "path": "Origin",
        "got": "https://elsewhere.example",
        "expected": "a program, or a page that comes from this server",
    },
    {
        "type": "misdirected-request",
        "detail": "this server does not answer for the host that was asked for",
        "path": "Host",
        "got": "robots.example",
        "expected": "the address that the server listens on, or a name in SPECSHIELD_ALLOWED_HOSTS",
    },
    {
        "type": "request-timeout",
        "detail": "the body took too long to arrive",
        "expected": "a body sent at once",
    },
    {
        "type": "body-too-large",
        "detail": "the body is too large",
        "got": 90_000_000,
        "expected": "at most 67108864 bytes",
    },
    {
        "type": "unsupported-media-type",
        "detail": "the body is not declared as JSON",
        "path": "Content-Type",
        "got": "text/plain",
        "expected": "the header Content-Type: application/json",
    },
    {
        "type": "rate-limited",
        "detail": "the key 'fleet' may make 50 requests a second",
        "expected": "to be asked again after Retry-After",
        "retry_after": 1,
    },
    {
        "type": "limit-reached",
        "detail": "the server keeps at most 100000 of them",
        "expected": "room for one more: erase what is not needed",
    },
    {
        "type": "training-unavailable",
        "detail": "no worker is there to make a policy",
        "expected": "one: start it with `specshield worker`",
    },
    {
        "type": "store-unavailable",
        "detail": "the store cannot be reached: ConnectionError",
        "expected": "the request again, in a while",
    },
    {
        "type": "starting",
        "detail": "the server is starting: it has compiled 98 of about 194 kernels",
        "expected": "the request again, in a while",
    },
    {
        "type": "stopping",
        "detail": "the server was told to stop",
        "expected": "another server, or this one later",
    },
    {"type": "insufficient-storage", "detail": "the server's disk is full", "expected": "a disk with room"},
]
