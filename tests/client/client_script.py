"""Drive a call of the SDK by hand: answers in the words of the HTTP contract, no network."""

import json

from specshield import errors
from specshield.client.core import Wait, Within
from specshield.client.wire import Failure, Reply


def answer(body, status=200, seconds=0.01):
    return Reply(status, {"content-type": "application/json"}, json.dumps(body).encode(), seconds, 0.5)


def problem(status, kind, **members):
    body = json.dumps({"type": kind, "detail": kind, "status": status, **members}).encode()
    return Reply(status, {"content-type": "application/problem+json"}, body, 0.01, 0.5)


def lost(seconds=0.5):
    return Failure(errors.TransportTimeout("no answer"), seconds, 0.5)


def drive(flow, *outcomes):
    """Feed `outcomes` to the requests of `flow`: (result or error, requests sent, waits)."""
    sent, waits, script = [], [], list(outcomes)
    try:
        command = next(flow)
        while True:
            if isinstance(command, Within):
                command = next(flow)
            elif isinstance(command, Wait):
                waits.append(command.seconds)
                command = next(flow)
            else:
                sent.append(command)
                command = flow.send(script.pop(0))
    except StopIteration as stop:
        result = stop.value
    except errors.SpecshieldError as error:
        result = error
    assert not script, "not every outcome was asked for"
    return result, sent, waits


SESSION = {
    "id": "s",
    "policy_ids": ["p"],
    "map_id": "m",
    "spec": {"formula": "F[0,3] a", "regions": {}},
    "horizon": 3,
    "actions": ["m", "end"],
    "terminal_actions": [1],
    "next_t": 0,
    "feasible": True,
    "spec_status": "pending",
    "main_task_done": False,
    "finished": False,
    "expires_at": "2030-01-01T00:00:00Z",
}
