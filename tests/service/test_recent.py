"""What this process keeps of sessions: no more than its room, and nothing of those that are over."""

import asyncio
import gc
from operator import attrgetter

import httpx
import msgspec
import numpy as np
import pytest

from specshield.caution.taught import Taught
from specshield.service.app import create_app
from specshield.service.library.files import Recent
from specshield.service.sessions.rules import line
from specshield.service.sessions.session import Session
from specshield.service.sessions.state import State
from specshield.service.settings import Settings
from specshield.service.storage.store import Record
from specshield.shield.decision import Carry
from specshield.task import Task
from specshield.world.learned import LearnedMap
from tests.service.world import LOGITS, START, grid_json, policy_files, rule

ROUNDS = 8


def session(formula="F[0,6] Goal", motions=4, horizon=8):
    carry = Carry(0, np.zeros((motions, 3)), (bytes(horizon),) * motions)
    state = State(1, 1, True, "pending", 0.0, b"", carry=carry)
    told = rule(spec={"formula": formula, "regions": {}, "signals": {}})
    return Session.of(Record(line(told), state.packed(), b"1", bytes(24), None))


def test_the_sessions_used_last_are_kept():
    recent = Recent(30_000, attrgetter("size"))
    for i in range(10):
        recent.put(i, session())
        assert recent.peek(0) is not None
    kept = [i for i in range(10) if recent.peek(i) is not None]
    assert 2 < len(kept) < 10
    assert kept == [0, *range(11 - len(kept), 10)]


@pytest.mark.parametrize("large", [{"formula": "F[0,6] Goal" * 300}, {"motions": 64, "horizon": 1000}])
def test_a_session_of_a_large_rule_takes_the_place_of_many(large):
    recent = Recent(30_000, attrgetter("size"))
    recent.put("small", session())
    recent.put("small", session())
    recent.put("large", session(**large))
    assert recent.peek("small") is None
    recent.drop("large")
    recent.put("small", session())
    assert recent.peek("small") is not None


def test_the_state_that_an_older_server_stored_is_read():
    """Its carry had fewer fields, those of one that was kept field by field."""
    poses = np.arange(6.0).reshape(2, 3)
    carry = [4, poses.tobytes(), [b"\1\2", None], None]
    stored = msgspec.msgpack.encode([5, 5, True, "pending", 0.0, b"head", False, False, False, carry])
    state = State.of(stored)
    assert (state.carry.t, state.carry.witnesses, state.carry.learned) == (4, (b"\1\2", None), None)
    assert state.carry.next_poses.tolist() == poses.tolist()
    assert State.of(state.packed()).carry.next_poses.tolist() == poses.tolist()


def test_whether_a_session_has_learned_is_known_without_unpacking_what():
    """It is asked at each step, on the event loop; what was learned may take milliseconds to unpack."""
    carry = Carry(0, np.zeros((4, 3)), (None,) * 4)
    known = [Taught().to_bytes(), Taught(LearnedMap(revision=1)).to_bytes()]
    carries = [None, carry, *(carry._replace(learned=each) for each in known)]
    states = [State(1, 1, True, "pending", 0.0, b"", carry=each) for each in carries]
    assert [state.has_learned for state in states] == [False, False, False, True]
    assert [state.learned.revision for state in states] == [0, 0, 0, 1]


async def _held(many):
    """The ids of the sessions in memory. A thread lets go of a session a moment after it has answered, so
    this waits until no more than so many are left; it gives up after 10 s.
    """
    for _ in range(200):
        gc.collect()
        held = [each.id for each in gc.get_objects() if isinstance(each, Session)]
        if len(held) <= many:
            break
        await asyncio.sleep(0.05)
    return held


async def _episodes(folder):
    """ROUNDS episodes each that end by a last step, by being closed and by being erased; one that goes on."""
    app = create_app(Settings(data_dir=folder, worker=False))
    transport = httpx.ASGITransport(app)
    async with (
        app.routes.router.lifespan_context(app.routes),
        httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8000", timeout=None) as client,
    ):
        while (await client.get("/readyz")).status_code != 200:
            await asyncio.sleep(0.05)

        async def begin(**options):
            begun = {"policy_id": policy["id"], "initial_pose": START, **options}
            made = await client.post("/v1/sessions", json=begun)
            assert made.status_code == 201, made.text
            path = f"/v1/sessions/{made.json()['id']}"
            asked = {"t": 0, "poses": [START], "logits": LOGITS}
            answer = await client.post(f"{path}/steps", json=asked)
            assert answer.status_code == 200, answer.text
            return path

        assert (await client.post("/v1/maps", json=grid_json())).status_code == 201
        sent = {name: (name, content) for name, content in policy_files().items()}
        policy = (await client.post("/v1/policies", files=sent)).json()
        tasks = set()
        for _ in range(ROUNDS):
            for ended in (client.delete, lambda path: client.post(f"{path}/close", json={})):
                assert (await ended(await begin())).is_success
            path = await begin(max_steps=9)
            for t in range(1, 10):
                asked = {"t": t, "poses": [START], "logits": LOGITS}
                answer = await client.post(f"{path}/steps", json=asked)
                assert answer.status_code == 200, answer.text
            assert answer.json()["finished"]
            assert await _held(0) == []
            tasks.add(sum(isinstance(each, Task) for each in gc.get_objects()))
        running = (await begin()).rpartition("/")[2]
        return running, await _held(1), tasks


def test_nothing_stays_in_memory_of_a_session_that_is_over(tmp_path):
    running, held, tasks = asyncio.run(_episodes(tmp_path / "data"))
    assert held == [running]
    assert len(tasks) == 1  # as many after each round as after the first
