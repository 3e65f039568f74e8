"""Steps over a WebSocket in MessagePack, against a server that misbehaves when it is told to."""

import asyncio
import contextlib
import json
import multiprocessing
import sys
import threading
import time
from http import HTTPStatus

import msgpack
import numpy as np
import pytest
from client_script import SESSION
from test_deadline import decided
from test_shells import NO_NAME
from websockets.sync.server import serve

from specshield import errors
from specshield.client import AsyncSession, AsyncShieldClient, Session, SessionInfo, ShieldClient
from specshield.client.models import build
from specshield.client.network import stream, transport
from specshield.client.network.stream import leave
from tests.serving import wait_for

POSE, LOGITS = (0.0, 0.0, 0.0), [0.0, None]
INFO = build(SessionInfo, SESSION)


class Server:
    """`faults[n]` is what the n-th message meets: "drop", "stale", "late", "mute", "text", a problem, or an
    event that the answer waits for. An answer says in `next_poses` which pose it is about.
    """

    def __init__(self, *faults, refuse=None):
        self.faults, self.refuse = list(faults), refuse
        self.messages, self.paths, self.keys = [], [], []

    def __call__(self, connection):
        with contextlib.suppress(Exception):
            for message in connection:
                body = msgpack.unpackb(message)
                self.messages.append(body)
                fault = self.faults.pop(0) if self.faults else None
                answer = {**decided(body["t"]), "next_poses": body["poses"][-1:] * 2}
                if fault == "drop":
                    return
                if fault == "mute":
                    continue
                if isinstance(fault, threading.Event):
                    fault.wait(60.0)
                if fault == "late":  # once the client has given up, and asks again
                    before = len(self.messages)
                    wait_for(lambda before=before: len(self.messages) > before)
                if fault == "stale":
                    answer = decided(body["t"] - 1)
                if isinstance(fault, dict):
                    answer = fault
                connection.send("not MessagePack" if fault == "text" else msgpack.packb(answer))

    def look(self, connection, request):
        self.paths.append(request.path)
        self.keys.append(request.headers.get("Authorization"))
        if self.refuse is None:
            return None
        response = connection.respond(HTTPStatus(self.refuse["status"]), json.dumps(self.refuse))
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = "application/problem+json"
        return response


@contextlib.contextmanager
def served(handler):
    """Where it listens."""
    with serve(handler, "127.0.0.1", 0, process_request=handler.look, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.socket.getsockname()[1]}/prefix"
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture(params=["sync", "async"])
def stepping(request):
    """stepping(server or its address, n, **options): the answers to n steps of a session over one client."""

    def run(handler, n=1, timeout=10.0, **options):
        async def awaited(url):
            async with AsyncShieldClient(url, api_key="key", timeout=timeout, stream=True) as client:
                session = AsyncSession(client._run, INFO, POSE)
                return [await session.step(POSE, LOGITS, **options) for _ in range(n)]

        def blocking(url):
            with ShieldClient(url, api_key="key", timeout=timeout, stream=True) as client:
                session = Session(client._run, INFO, POSE)
                return [session.step(POSE, LOGITS, **options) for _ in range(n)]

        with contextlib.nullcontext(handler) if isinstance(handler, str) else served(handler) as url:
            return blocking(url) if request.param == "sync" else asyncio.run(awaited(url))

    return run


def test_steps_go_over_one_connection_in_messagepack(stepping, monkeypatch):
    """To a server on this machine, for which a proxy would take itself."""
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    server = Server()
    decisions = stepping(server, 5)
    assert [decision.t for decision in decisions] == [0, 1, 2, 3, 4]
    assert decisions[0].distribution == (1.0, 0.0)
    assert server.paths == ["/prefix/v1/sessions/s/stream"]
    assert server.keys == ["Bearer key"]
    assert server.messages[1] == {
        "t": 1,
        "poses": [[0, 0, 0]],
        "logits": [0.0, None],
        "main_task_done": False,
        "witnesses": False,
    }


def test_a_flag_may_be_one_of_numpy(stepping):
    server = Server()
    stepping(server, 1, main_task_done=np.bool_(True), witnesses=1, explain=np.bool_(True))
    sent = {name: server.messages[0][name] for name in ("main_task_done", "witnesses", "explain")}
    assert sent == {"main_task_done": True, "witnesses": True, "explain": True}


def test_the_connection_of_a_session_that_is_finished_is_left(stepping):
    """Under another rule it may go on, over a new one."""
    server = Server({**decided(0), "finished": True})
    stepping(server, 3)
    assert len(server.paths) == 2


def test_a_loop_that_is_closed_keeps_no_connection():
    """Each `asyncio.run` has a loop of its own."""
    with served(Server()) as url:
        client = AsyncShieldClient(url, timeout=60.0, stream=True)
        session = AsyncSession(client._run, INFO, POSE)
        assert [asyncio.run(session.step(POSE, LOGITS)).t for _ in range(4)] == [0, 1, 2, 3]
        assert len(client._streams._open) == 1


@pytest.mark.parametrize("fault", ["drop", "stale", "text"])
def test_a_lost_connection_and_a_wrong_answer_are_asked_again_on_a_new_one(stepping, fault):
    server = Server(None, fault, fault)
    assert [decision.t for decision in stepping(server, 3)] == [0, 1, 2]
    assert len(server.paths) == 3
    assert [message["t"] for message in server.messages] == [0, 1, 1, 1, 2]


def test_an_answer_that_comes_late_is_never_read(stepping):
    server = Server(None, "late")
    assert [decision.t for decision in stepping(server, 3, timeout=2.0)] == [0, 1, 2]


def test_the_answer_to_a_step_that_is_cancelled_is_never_read():
    answering, elsewhere = threading.Event(), (0.0, 0.3, 0.0)
    server = Server(None, answering)

    async def cancelled(url):
        async with AsyncShieldClient(url, timeout=60.0, stream=True) as client:
            session = AsyncSession(client._run, INFO, POSE)
            await session.step(POSE, LOGITS)
            step = asyncio.create_task(session.step(POSE, LOGITS))
            while len(server.messages) < 2:
                await asyncio.sleep(0.01)
            step.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await step
            answering.set()
            return await session.step(elsewhere, LOGITS)

    with served(server) as url:
        decision = asyncio.run(cancelled(url))
    assert (decision.t, decision.next_poses[0], len(server.paths)) == (1, elsewhere, 2)


def test_a_host_that_no_name_can_be_is_a_transport_error(stepping):
    with pytest.raises(errors.TransportError):
        stepping(NO_NAME)


def test_a_server_that_says_nothing_is_left_at_the_deadline(stepping):
    began = time.monotonic()
    with pytest.raises(errors.TransportTimeout):
        stepping(Server("mute"), timeout=600.0, deadline=0.2)
    assert time.monotonic() - began < 20.0


def test_an_answer_that_could_not_be_read_in_time_is_none(stepping, monkeypatch):
    monkeypatch.setattr(transport, "UNDERSTANDING", 60.0)  # [s] to parse a byte
    server = Server()
    with pytest.raises(errors.TransportTimeout) as caught:
        stepping(server, timeout=20.0)
    assert len(server.paths) == len(server.messages) == caught.value.details["tries"] > 1


def test_problems_arrive_as_their_errors(stepping):
    gap = {"type": "history-conflict", "status": 409, "detail": "no", "path": "poses[0]"}
    server = Server(gap)
    with pytest.raises(errors.HistoryConflict, match="no") as caught:
        stepping(server)
    assert (caught.value.path, len(server.messages)) == ("poses[0]", 1)
    starting = {"type": "starting", "status": 503, "detail": "soon"}
    assert stepping(Server(starting, starting))[0].t == 0


def test_a_handshake_that_is_refused_is_the_error_that_the_server_names(stepping):
    refusal = {"type": "not-found", "status": 404, "detail": "there is no session 's'"}
    server = Server(refuse=refusal)
    with pytest.raises(errors.NotFound, match="there is no session"):
        stepping(server)
    assert len(server.paths) == 1


@pytest.mark.parametrize("client", [ShieldClient, AsyncShieldClient])
@pytest.mark.parametrize("missing", ["msgpack", "websockets"])
def test_without_the_packages_it_says_what_to_install(client, missing, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(errors.InputError, match=missing) as caught:
        client("http://127.0.0.1:9", stream=True)
    assert "specshield[stream]" in caught.value.expected


def test_a_forked_process_asks_over_connections_of_its_own():
    """Else the parent would read what the child was answered, whose pose may be another."""
    server, fork, elsewhere = Server(), multiprocessing.get_context("fork"), (0.0, 0.3, 0.0)
    with served(server) as url, ShieldClient(url, timeout=10.0, stream=True) as client:
        session = Session(client._run, INFO, POSE)
        session.step(POSE, LOGITS)

        def asks():
            session.step(elsewhere, LOGITS)
            client.close()

        child = fork.Process(target=asks)
        child.start()
        child.join()
        assert session.step(POSE, LOGITS).next_poses[0] == POSE
    assert (child.exitcode, len(server.paths)) == (0, 2)


def test_of_two_connections_for_one_session_one_is_kept_and_none_of_a_closed_client(monkeypatch):
    left, answering = [], threading.Event()
    leaving = staticmethod(lambda connection: left.append(connection) or leave(connection))
    monkeypatch.setattr(stream.SyncStreams, "_leave", leaving)
    server = Server(answering, answering, None, closing := threading.Event())
    with served(server) as url, ShieldClient(url, timeout=60.0, stream=True) as client:
        asking = [
            threading.Thread(target=Session(client._run, INFO, POSE).step, args=(POSE, LOGITS)) for _ in "ab"
        ]
        [thread.start() for thread in asking]
        wait_for(lambda: len(server.messages) == 2)
        answering.set()
        [thread.join() for thread in asking]
        assert (len(left), len(client._streams._open)) == (1, 1)
        Session(client._run, INFO, POSE).step(POSE, LOGITS)
        last = threading.Thread(target=Session(client._run, INFO, POSE).step, args=(POSE, LOGITS))
        last.start()
        wait_for(lambda: len(server.messages) == 4)
        client.close()
        closing.set()
        last.join()
        assert (len(left), len(client._streams._open), len(server.paths)) == (2, 0, 2)


def test_a_client_that_is_closed_while_a_step_is_asked_keeps_no_connection():
    server = Server(answering := threading.Event())

    async def closed(url):
        client = AsyncShieldClient(url, timeout=60.0, stream=True)
        step = asyncio.create_task(AsyncSession(client._run, INFO, POSE).step(POSE, LOGITS))
        while not server.messages:
            await asyncio.sleep(0.01)
        await client.close()
        answering.set()
        return (await step).t, client._streams._open

    with served(server) as url:
        assert asyncio.run(closed(url)) == (0, {})


def test_another_event_loop_asks_over_connections_of_its_own():
    server = Server()
    with served(server) as url:
        client = AsyncShieldClient(url, timeout=10.0, stream=True)
        session = AsyncSession(client._run, INFO, POSE)
        assert [asyncio.run(session.step(POSE, LOGITS)).t for _ in range(2)] == [0, 1]
        asyncio.run(client.close())
    assert (len(server.messages), len(server.paths)) == (2, 2)
