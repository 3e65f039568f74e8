"""Steps in MessagePack and over a WebSocket, asked of a real server by a real client."""

import asyncio
import json
import signal
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from itertools import pairwise

import httpx
import msgpack
import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from websockets.asyncio.client import connect as aconnect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import connect

from specshield.client import ShieldClient
from specshield.errors import BodyTooLarge, InputError
from specshield.local import LocalShield
from specshield.service.routes.messages import read_step
from specshield.service.schemas.steps import StepRequest
from tests.service.test_bad_input import problem
from tests.service.world import LOGITS, ROBOT, START, ahead, grid_json, send_policy
from tests.serving import HUNG, command_line, serving, wait_for

PACKED = {"Content-Type": "application/msgpack", "Accept": "application/msgpack"}


def body(t, /, **fields):
    return {"t": t, "poses": ahead(t)[-1:], "logits": LOGITS, **fields}


def stream_of(server, session):
    return f"ws{server.url.removeprefix('http')}/v1/sessions/{session['id']}/stream"


def test_a_step_in_messagepack_has_the_same_values(client, begin, step):
    session = begin()
    path = f"/v1/sessions/{session['id']}/steps"
    answer = client.post(path, content=msgpack.packb(body(0)), headers=PACKED)
    assert (answer.status_code, answer.headers["content-type"]) == (200, "application/msgpack")
    assert set(answer.headers) >= {"server-timing", "x-request-id"}
    again = step(session, 0, [START])
    assert again.headers["content-type"] == "application/json"
    assert list(msgpack.unpackb(answer.content).items()) == list(again.json().items())
    for declared in ("application/msgpack", "Application/MsgPack; v=1"):
        headers = {**PACKED, "Content-Type": declared}
        assert client.post(path, content=msgpack.packb(body(0)), headers=headers).content == answer.content


def test_what_a_caller_does_not_take_is_not_what_is_answered(client, begin):
    path = f"/v1/sessions/{begin()['id']}/steps"
    for accept, kind in (
        ("application/msgpack;q=0", "application/json"),
        ("application/msgpackfoo", "application/json"),
        ("application/msgpack; q=0.0, application/json", "application/json"),
        ("*/*", "application/json"),
        ("application/msgpack;q=0.5", "application/msgpack"),
        ("Application/MsgPack", "application/msgpack"),
        ("application/json;q=0.1, application/msgpack", "application/msgpack"),
    ):
        answer = client.post(path, json=body(0), headers={"Accept": accept})
        assert (answer.status_code, answer.headers["content-type"]) == (200, kind), accept
    path = path.replace("steps", "trajectory")
    for accept, kind in (("application/x-ndjson;q=0", "json"), ("application/x-ndjson", "x-ndjson")):
        assert client.get(path, headers={"Accept": accept}).headers["content-type"] == f"application/{kind}"


@pytest.mark.parametrize(
    ("content", "type", "path"),
    [
        (msgpack.packb(body(0, logits=[float("nan"), 0.0, 0.0, 0.0, 0.0])), "invalid-logits", "logits[0]"),
        (msgpack.packb(body(0, logits=[float("inf"), 0.0, 0.0, 0.0, 0.0])), "invalid-logits", "logits[0]"),
        (msgpack.packb(body(0, speed=1)), "invalid-input", "speed"),
        (msgpack.packb(body(0, t=0.0)), "invalid-input", "t"),
        (msgpack.packb([1, 2]), "invalid-input", ...),
        (msgpack.packb({f"f{i}": i for i in range(60_000)}), "invalid-input", ...),
        (b"\xc1", "invalid-input", ...),
        (b"", "invalid-input", ...),
        (b"\x81\xa1\xff\x01", "invalid-input", ...),
        (b"\x91" * 2000 + b"\x01", "invalid-input", ...),
        (msgpack.packb(msgpack.Timestamp(5)), "invalid-input", ""),
        (msgpack.packb(body(0, logits=[msgpack.ExtType(5, b"abc")])), "invalid-logits", "logits[0]"),
    ],
)
def test_messagepack_that_is_no_step(client, begin, content, type, path):
    session = begin()
    found = client.post(f"/v1/sessions/{session['id']}/steps", content=content, headers=PACKED)
    assert (found.status_code, found.json()["type"]) == (422, type), found.text
    assert found.headers["content-type"] == "application/problem+json"
    assert path is ... or found.json()["path"] == path
    assert len(found.content) < 20_000
    assert not any(word in found.text for word in ("Error", "object at", "datetime")), found.text


def test_the_fault_of_a_large_body_is_told_in_short():
    """To name every wrong field of these took up to a second of the event loop, and a robot's step waited."""
    pose, point, many = [0.0, 0.0, 0.0], [0.1, 0.2], 1 << 17
    longest = {**body(0), "poses": [pose] * 10_001, "occupied": [point] * 2000, "free": [point] * 2000}
    assert len(read_step(json.dumps(longest), False).poses) == 10_001
    for sent, path in (
        ({**longest, "poses": [pose] * 10_000 + [[0.0, 0.0, "a"]]}, "poses[10000][2]"),
        ({**body(0), "t": [[]] * many}, "t"),
        ({**body(0), **{f"f{i}": 0 for i in range(many)}}, "body"),
        ({**body(0), "poses": [pose] * many}, "poses"),
    ):
        for content in (json.dumps(sent), msgpack.packb(sent)):
            with pytest.raises(InputError) as wrong:
                read_step(content, isinstance(content, bytes))
            assert "errors" not in wrong.value.details
            assert wrong.value.path in (path, "body")
    with pytest.raises(InputError, match="too many items"):
        read_step(json.dumps({"t": [[]] * 60_000}), False)


def test_a_stream_answers_in_order_in_the_form_it_was_asked(server, client, begin, step):
    session, twin = begin(seed=1), begin(seed=1)
    with connect(stream_of(server, session)) as stream:
        for t in range(4):  # all sent before any answer is read
            stream.send(json.dumps(body(t)) if t % 2 else msgpack.packb(body(t)))
        for t in range(4):
            message = stream.recv()
            answer = json.loads(message) if t % 2 else msgpack.unpackb(message)
            assert answer == step(twin, t, ahead(t)[-1:]).json()
        stream.send(msgpack.packb(body(9)))
        gap = msgpack.unpackb(stream.recv())
        assert (gap["status"], gap["type"], gap["expected_t"]) == (409, "history-gap", 4)
        stream.send("{")
        assert json.loads(stream.recv())["type"] == "invalid-input"
        stream.send(json.dumps(body(4)))  # goes on after errors
        assert json.loads(stream.recv())["t"] == 4
        client.delete(f"/v1/sessions/{session['id']}")
        stream.send(json.dumps(body(5)))
        assert json.loads(stream.recv())["status"] == 404


def test_a_handshake_is_refused_over_http(server):
    for url, status in (
        (stream_of(server, {"id": "nothing"}), 404),
        (stream_of(server, {"id": "no:id"}), 404),
        (f"{stream_of(server, {'id': 'any'})}s", 404),
    ):
        with pytest.raises(InvalidStatus) as refused:
            connect(url)
        assert refused.value.response.status_code == status
        assert json.loads(refused.value.response.body)["type"] == "not-found"
    assert "handshake" not in server.log.read_text()  # a caller's mistake is no error of the server's


def test_a_proxy_that_passes_on_no_upgrade_is_told_of(client, begin):
    problem(client.get(f"/v1/sessions/{begin()['id']}/stream"), 422, "invalid-input", "Upgrade")


def test_text_that_is_no_text_ends_the_stream_and_writes_no_traceback(server, begin):
    with connect(stream_of(server, begin())) as stream:
        stream.send(b"\xff", text=True)
        with pytest.raises(ConnectionClosed) as closed:
            stream.recv()
    assert closed.value.rcvd.code == 1007
    assert "Traceback" not in server.log.read_text()


def test_the_query_of_a_stream_is_not_logged(server, begin):
    """A key that somebody puts there by mistake does not belong into a log."""
    session = begin()
    with connect(f"{stream_of(server, session)}?api_key=ss_secret"):
        pass
    wait_for(lambda: f"{session['id']}/stream" in server.log.read_text())
    assert "ss_secret" not in server.log.read_text()


def test_a_message_over_the_limit_ends_the_stream_and_no_other(server, begin):
    session, other = begin(), begin()
    with connect(stream_of(server, session)) as large, connect(stream_of(server, other)) as stream:
        # What the server no longer reads of the message may reset the connection, before its word arrives or
        # while the message is still being sent.
        with suppress(ConnectionClosed):
            large.send(b" " * (2 << 20))
        with pytest.raises(ConnectionClosed) as closed:
            large.recv()
        assert closed.value.rcvd is None or closed.value.rcvd.code == 1009
        stream.send(json.dumps(body(0)))
        assert json.loads(stream.recv())["t"] == 0


def test_a_caller_who_does_not_read_holds_up_nobody(server, begin):
    session, other = begin(), begin()

    async def scene():
        async with (
            aconnect(stream_of(server, session), max_queue=1) as deaf,
            aconnect(stream_of(server, other)) as stream,
        ):
            deaf.transport.pause_reading()

            async def flood():
                while True:
                    await deaf.send(json.dumps(body(0, witnesses=True)))

            flooding = asyncio.create_task(flood())
            for t in range(30):
                await stream.send(json.dumps(body(t)))
                assert json.loads(await stream.recv())["t"] == t
            flooding.cancel()
            deaf.transport.abort()

    asyncio.run(scene())


def test_messages_that_never_end_take_no_more_than_all_bodies_may(tmp_path):
    """What is over the limit on all of them together is let go, and steps are decided as before."""
    with (
        serving(tmp_path, SPECSHIELD_MAX_BODIES_BYTES=str(2 << 20)) as server,
        ShieldClient(server.url, timeout=HUNG) as client,
        ExitStack() as opened,
    ):
        with pytest.raises(BodyTooLarge, match="at most 2097152 bytes"):  # nor may an upload ever have more
            client.maps.upload("resolution: 0.05", b" " * (3 << 20))
        session = client.sessions.create(policy_id="case1", initial_pose=(5.0, 5.0, 0.0))
        address = stream_of(server, {"id": session.id})
        streams = [opened.enter_context(connect(address, ping_interval=None)) for _ in range(4)]
        for stream in streams:
            stream.socket.sendall(b"\x01\xff" + (900_000).to_bytes(8, "big") + bytes(4) + b" " * 800_000)

        def let_go(stream):
            with suppress(TimeoutError, ConnectionClosed):
                stream.recv(timeout=0)
            return stream.close_code == 1013

        wait_for(lambda: sum(map(let_go, streams)) == 2)
        session.step((5.0, 5.0, 0.0), [0.0] * 20)


def test_a_message_in_fragments_is_one_message(server, begin):
    sent = json.dumps(body(0))
    with connect(stream_of(server, begin())) as stream, connect(stream_of(server, begin())) as other:
        stream.send(iter(sent))  # each character is a fragment
        other.send(sent)
        assert json.loads(stream.recv()) == json.loads(other.recv())


PING, EMPTY, STEP = b"\x89\x80" + bytes(4), b"\x00\x80" + bytes(4), b"\x81\x82" + bytes(4) + b"{}"


@pytest.mark.parametrize("frame", [PING, EMPTY, STEP], ids=["pings", "empty fragments", "steps"])
def test_a_flood_of_small_frames_holds_up_nobody(server, client, begin, frame):
    """The server takes little of the flood before it answers others, where uvicorn takes 256 KB at once."""
    with connect(stream_of(server, begin()), ping_interval=None) as stream:
        flood, over, sent = stream.socket, threading.Event(), 0
        flood.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 16)

        def send():
            nonlocal sent
            with suppress(OSError):
                flood.sendall(b"\x01\x80" + bytes(4) if frame == EMPTY else b"")  # begins a message
                while not over.is_set():
                    flood.sendall(frame * 1000)
                    sent += len(frame) * 1000

        sending = threading.Thread(target=send)
        sending.start()
        marks = []
        for _ in range(30):
            assert client.get("/livez").status_code == 200
            marks.append(sent)
        # By the tenth, what lies between the two is full. While another process has the client's processor,
        # the server goes on with the flood: so it is the quickest quarter of the requests that counts.
        taken = sorted(after - before for before, after in pairwise(marks[9:]))[5]
        over.set()
        flood.shutdown(socket.SHUT_RDWR)
        sending.join()
    assert taken < 1 << 17, "bytes for each request"


def test_streams_that_are_idle_make_room_and_one_that_is_used_stays(tmp_path):
    few = {"SPECSHIELD_MAX_CONNECTIONS": "8", "SPECSHIELD_KEEP_ALIVE_TIMEOUT": "2"}
    with serving(tmp_path, **few) as server, ExitStack() as held:
        with httpx.Client(base_url=server.url, timeout=None, verify=False) as client:
            client.post("/v1/maps", json=grid_json())
            asked = {"policy_id": send_policy(client)["id"], "initial_pose": START}
            path = stream_of(server, client.post("/v1/sessions", json=asked).json())
        robot = held.enter_context(ShieldClient(server.url, stream=True, timeout=60)).sessions.create(**asked)
        assert robot.step(START, LOGITS).t == 0  # holds a stream and a connection
        used, *idle = (held.enter_context(connect(path)) for _ in range(6))
        until = time.monotonic() + 4
        while time.monotonic() < until:
            used.send("{")
            assert json.loads(used.recv())["status"] == 422
            time.sleep(0.1)
        for _ in range(6):
            assert httpx.get(f"{server.url}/livez", timeout=None, verify=False).status_code == 200
            held.enter_context(connect(path))
        used.send(json.dumps(body(0)))
        assert json.loads(used.recv())["t"] == 0
        assert robot.step(ahead(1)[-1], LOGITS).t == 1  # its stream made room too: it opens another
        for stream in idle:
            with pytest.raises(ConnectionClosed):
                stream.recv()


def test_a_server_that_stops_says_so_to_its_streams(tmp_path):
    with serving(tmp_path) as server, httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        client.post("/v1/maps", json=grid_json())
        asked = {"policy_id": send_policy(client)["id"], "initial_pose": START}
        session = client.post("/v1/sessions", json=asked).json()
        with connect(stream_of(server, session)) as stream:
            stream.send(json.dumps(body(0)))
            assert json.loads(stream.recv())["t"] == 0
            server.process.send_signal(signal.SIGTERM)
            with pytest.raises(ConnectionClosed) as closed:
                stream.recv()
            assert closed.value.rcvd.code == 1001


def test_a_server_that_stops_ends_a_stream_after_the_step_that_it_is_deciding(tmp_path):
    """A planner decides, and its process stands still until the server has closed its port. The server gives
    it 10 s from then on, of which nothing here takes one.
    """
    made = LocalShield.make(grid_json(), "F[0,20] x > 1.5", robot=ROBOT, method="planner", check=False)
    files = {"weights": ("w", made.weights), "card": ("c", json.dumps(dict(made.card)).encode())}
    with serving(tmp_path) as server, httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        client.post("/v1/maps", json=grid_json())
        asked = {"policy_id": client.post("/v1/policies", files=files).json()["id"], "initial_pose": START}
        session = client.post("/v1/sessions", json=asked).json()
        with connect(stream_of(server, session)) as stream:
            stream.send(json.dumps(body(0)))
            assert json.loads(stream.recv())["t"] == 0
            below = psutil.Process(server.process.pid).children(recursive=True)
            planners = [each for each in below if "tests.template" in command_line(each.pid)]  # forks of it
            assert planners
            for each in planners:
                each.suspend()
            stream.send(json.dumps(body(1)))
            for _ in range(3):
                client.get("/livez")  # the server has read what was sent before
            server.process.send_signal(signal.SIGTERM)
            try:
                wait_for(lambda: is_free(client.base_url.port))
            finally:
                for each in planners:
                    each.resume()
            assert json.loads(stream.recv())["t"] == 1
            with pytest.raises(ConnectionClosed) as closed:
                stream.recv()
            assert closed.value.rcvd.code == 1001


def test_a_stream_that_is_being_opened_when_the_server_stops_ends_too(tmp_path):
    """The store stands still while the session is looked for. On a busy machine it may come so late
    that it is refused."""
    with serving(tmp_path) as server, httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        client.post("/v1/maps", json=grid_json())
        asked = {"policy_id": send_policy(client)["id"], "initial_pose": START}
        session = client.post("/v1/sessions", json=asked).json()
        below = psutil.Process(server.process.pid).children(recursive=True)
        (store,) = (each for each in below if "valkey-server" in each.name())
        store.suspend()
        with ThreadPoolExecutor(1) as beside:
            opened = beside.submit(connect, stream_of(server, session), open_timeout=HUNG)
            for _ in range(3):
                client.get("/livez")
            server.process.send_signal(signal.SIGTERM)
            store.resume()
            with suppress(InvalidHandshake, OSError), opened.result() as stream:
                with pytest.raises(ConnectionClosed) as closed:
                    stream.recv()
                assert closed.value.rcvd.code == 1001


def is_free(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0


SCALARS = (
    st.none() | st.booleans() | st.integers(-5, 10) | st.floats() | st.sampled_from([1e8, 1.1e8, "1", 2**70])
)
VALUES = (
    st.lists(SCALARS, max_size=4) | st.lists(st.lists(SCALARS, min_size=2, max_size=4), max_size=3) | SCALARS
)
FIELDS = ("t", "poses", "logits", "main_task_done", "signals", "witnesses", "speed")
VALID = {"t": 1, "poses": [[1, 1.5, 0.0]], "logits": [0.5, None, 2], "signals": {"battery": 5}}


@settings(max_examples=500)
@given(
    st.dictionaries(
        st.sampled_from(FIELDS), VALUES | st.dictionaries(st.sampled_from("ab"), SCALARS), max_size=2
    )
)
def test_what_is_read_fast_is_what_the_schema_takes(fields):
    sent = {**VALID, **fields}
    try:
        expected = StepRequest.model_validate(sent).model_dump()
    except ValidationError:
        expected = None
    packed = msgpack_of(sent)
    for content in (json.dumps(sent).encode(), packed):
        if content is None:
            continue
        try:
            found = read_step(content, content is packed)
        except InputError:
            assert expected is None
        else:
            assert {name: getattr(found, name) for name in expected} == expected


def msgpack_of(value):
    try:
        return msgpack.packb(value)
    except OverflowError:
        return None
