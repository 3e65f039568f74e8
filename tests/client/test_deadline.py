"""No call outlasts its time, whatever the server does, and no answer is taken for another's."""

import asyncio
import json
import time

import httpx
import pytest
from client_script import SESSION

from benchmarks.hostile import FAULTS, hostile_servers
from specshield import errors
from specshield.client import AsyncSession, AsyncShieldClient, Session, SessionInfo, ShieldClient
from specshield.client.models import build

POSE, LOGITS = (0.0, 0.0, 0.0), [0.0, 0.0]
INFO = build(SessionInfo, SESSION)
GENEROUS = 20.0  # [s] on a busy machine; without a bound these calls last from minutes to for ever


@pytest.fixture(scope="module")
def ports():
    with hostile_servers() as ports:
        yield ports


def asked(url, call, asynchronous, **options):
    """What `call(session)` raises, and after how long."""

    async def awaited():
        async with AsyncShieldClient(url, **options) as client:
            await call(AsyncSession(client._run, INFO, POSE))

    def blocking():
        with ShieldClient(url, **options) as client:
            call(Session(client._run, INFO, POSE))

    began = time.monotonic()
    with pytest.raises(errors.TransportError) as caught:
        asyncio.run(awaited()) if asynchronous else blocking()
    return caught.value, time.monotonic() - began


@pytest.mark.parametrize("asynchronous", [False, True])
@pytest.mark.parametrize("fault", [*FAULTS, "never_accepts"])
def test_a_step_ends_by_its_deadline(ports, fault, asynchronous):
    url = f"http://127.0.0.1:{ports[fault]}"
    _, seconds = asked(url, lambda s: s.step(POSE, LOGITS, deadline=0.2), asynchronous, timeout=600.0)
    assert seconds < GENEROUS


@pytest.mark.parametrize("asynchronous", [False, True])
@pytest.mark.parametrize("fault", ["drip_head", "drip_body", "endless_chunks", "silent"])
def test_without_a_deadline_the_timeout_bounds_a_try_and_not_each_read(ports, fault, asynchronous):
    url = f"http://127.0.0.1:{ports[fault]}"
    _, seconds = asked(url, lambda s: s.step(POSE, LOGITS), asynchronous, timeout=0.2)
    assert seconds < GENEROUS
    _, seconds = asked(url, lambda s: s.close(POSE), asynchronous, timeout=0.2)
    assert seconds < GENEROUS


@pytest.mark.parametrize("asynchronous", [False, True])
def test_a_handshake_that_never_ends_is_left(ports, asynchronous):
    url = f"https://127.0.0.1:{ports['silent']}"
    error, seconds = asked(url, lambda s: s.step(POSE, LOGITS, deadline=0.2), asynchronous, timeout=600.0)
    assert type(error) is errors.TransportTimeout
    assert seconds < GENEROUS


@pytest.mark.parametrize("deadline", [0.0, -1.0, float("nan"), float("inf"), "soon"])
def test_a_deadline_is_a_positive_time(deadline):
    with ShieldClient("http://127.0.0.1:9") as client, pytest.raises(errors.InputError) as caught:
        Session(client._run, INFO, POSE).step(POSE, LOGITS, deadline=deadline)
    assert caught.value.path == "deadline"


def decided(t):
    return {
        "t": t,
        "mode": "shaped",
        "distribution": [1.0, 0.0],
        "j_values": [1.0, 0.0],
        "robustness": [0.1, None],
        "action": 0,
        "action_name": "m",
        "completion_action": 0,
        "spec_status": "pending",
        "feasible_mass": 1.0,
        "kl": 0.0,
        "reason": None,
        "finished": False,
        "in_collision": False,
        "next_poses": [[0, 0, 0], [0, 0, 0]],
        "residual": None,
        "witness": [0],
    }


class Confused:
    """A server, or something in front of it, whose first answer to each step is to another request."""

    def __init__(self, wrong):
        self.wrong, self.ids = wrong, set()

    def __call__(self, request):
        id, t = request.headers["x-request-id"], json.loads(request.content)["t"]
        assert id not in self.ids, "each try has an id of its own"
        self.ids.add(id)
        first = len(self.ids) % 2
        if first and self.wrong == "t":
            return httpx.Response(200, json=decided(t - 1), headers={"x-request-id": id})
        return httpx.Response(200, json=decided(t), headers={"x-request-id": "another" if first else id})


@pytest.mark.parametrize("wrong", ["t", "id"])
@pytest.mark.parametrize("asynchronous", [False, True])
def test_an_answer_to_another_request_is_no_answer(wrong, asynchronous):
    server = Confused(wrong)

    async def awaited():
        async with AsyncShieldClient("http://robot.test", transport=httpx.MockTransport(server)) as client:
            session = AsyncSession(client._run, INFO, POSE)
            return [(await session.step(POSE, LOGITS)).t for _ in range(3)]

    def blocking():
        with ShieldClient("http://robot.test", transport=httpx.MockTransport(server)) as client:
            session = Session(client._run, INFO, POSE)
            return [session.step(POSE, LOGITS).t for _ in range(3)]

    assert (asyncio.run(awaited()) if asynchronous else blocking()) == [0, 1, 2]
    assert len(server.ids) == 6
