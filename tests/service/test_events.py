"""Watching a session: every decision once, in order, whoever makes it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import threading
import time
from typing import Any

import httpx
import pytest
import redis

from specshield.errors import LimitReached, SessionDamaged
from specshield.service.routes.sessions import _each
from specshield.service.sessions import record
from specshield.service.sessions.session import Session
from specshield.service.sessions.state import State
from specshield.service.storage.archive import Archive
from specshield.service.storage.archiving import ArchivingStore
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.objects import open_objects
from specshield.service.storage.store import scoped
from specshield.service.watch.events import EVERY, Watchers
from specshield.service.watch.feed import KEPT
from tests.service.world import ahead
from tests.serving import HUNG, serving, wait_for

END = "end"


def read(
    url: str,
    session: str,
    after: int | None = None,
    most: int = 10_000,
    last: int | None = None,
    found: list[Any] | None = None,
    **more: Any,
) -> list[Any]:
    """(id, data as text) of each event until the stream ends; `END` as the id of the last one.

    found: a list that is filled as they come.
    """
    found = [] if found is None else found
    with contextlib.suppress(httpx.RemoteProtocolError):  # a server that was stopped
        _read(found, f"{url}/v1/sessions/{session}/events", after, most, last, **more)
    return found


def _read(
    found: list[Any], path: str, after: int | None, most: int, last: int | None, headers: Any = None
) -> None:
    headers = {**(headers or {}), **({} if last is None else {"Last-Event-ID": str(last)})}
    params = {} if after is None else {"after": after}
    with httpx.stream("GET", path, params=params, headers=headers, timeout=None, verify=False) as response:
        if response.status_code == 204:
            found.append(204)
            return
        assert response.status_code == 200, response.read()
        assert response.headers["content-type"].startswith("text/event-stream")
        event: dict[str, str] = {}
        for line in response.iter_lines():
            if line == "" and "data" in event:
                found.append((int(event["id"]) if "id" in event else event["event"], event["data"]))
                if len(found) == most:
                    break
            if line == "":
                event = {}
            elif not line.startswith(":"):
                name, _, value = line.partition(": ")
                event[name] = value


class Reader(threading.Thread):
    """Reads in a thread of its own, until the stream ends."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(daemon=True)
        self._args, self._options, self.found = args, options, list[Any]()
        self.start()

    def run(self) -> None:
        read(*self._args, **self._options, found=self.found)


def test_every_decision_is_told_once_and_as_it_was_answered(server, client, begin, step):
    session = begin()
    early = Reader(server.url, session["id"], after=-1)
    answers = {t: step(session, t, [pose]).text for t, pose in enumerate(ahead(3))}
    answers[6] = step(session, 6, ahead(6)).text  # 4 and 5 were passed over
    late = Reader(server.url, session["id"], after=-1)
    resumed = Reader(server.url, session["id"], last=2)
    answers[7] = step(session, 7, [ahead(7)[-1]]).text
    assert client.post(f"/v1/sessions/{session['id']}/close", json={}).status_code == 200
    expected = list(answers.items())
    for reader, events in ((early, expected), (late, expected), (resumed, expected[3:])):
        reader.join()
        assert reader.found[:-1] == events
        kind, told = reader.found[-1]
        assert kind == END
        assert json.loads(told)["next_t"] == 8
    assert read(server.url, session["id"], last=6)[0] == expected[-1]
    assert read(server.url, session["id"], last=7) == [204], "a browser that came back is told to stay away"
    assert read(server.url, session["id"], after=-1)[:-1] == expected, "and it can be read again"


def test_more_steps_than_are_kept_in_memory(server, client, begin, step):
    session = begin(max_steps=200)
    reader = Reader(server.url, session["id"], after=-1)
    pose = ahead(1)[0]
    for t in range(150):
        assert step(session, t, [pose]).status_code == 200
    client.post(f"/v1/sessions/{session['id']}/close", json={})
    reader.join()
    assert [t for t, _ in reader.found] == [*range(150), END]
    assert [t for t, _ in read(server.url, session["id"], after=9)] == [*range(10, 150), END]


def test_a_stream_ends_though_a_switch_passed_the_last_steps_over(server, client, begin, step):
    session = begin()
    reader = Reader(server.url, session["id"], after=-1)
    assert step(session, 0, ahead(0)).status_code == 200
    wait_for(lambda: reader.found)
    asked = {"t": 4, "policy_id": session["policy_ids"][0], "clock": "restart", "poses": ahead(0) * 4}
    assert client.post(f"/v1/sessions/{session['id']}/switch", json=asked).status_code == 200
    assert client.post(f"/v1/sessions/{session['id']}/close", json={}).status_code == 200
    reader.join(HUNG)
    assert [t for t, _ in reader.found] == [0, END]
    assert json.loads(reader.found[-1][1])["next_t"] == 4


def test_a_switch_is_told_however_long_before_the_next_step_it_is_made(server, client, begin, step):
    session = begin()
    reader = Reader(server.url, session["id"], after=-1)
    assert step(session, 0, ahead(0)).status_code == 200
    wait_for(lambda: reader.found)
    asked = {"t": 1, "policy_id": session["policy_ids"][0], "clock": "restart"}
    assert client.post(f"/v1/sessions/{session['id']}/switch", json=asked).status_code == 200
    time.sleep(2.0)  # the stream knows of the switch by now; it has to be told if not, too
    assert step(session, 3, ahead(3)[1:]).status_code == 200
    client.post(f"/v1/sessions/{session['id']}/close", json={})
    reader.join(HUNG)
    assert [t for t, _ in reader.found] == [0, "switch", 3, END]


def test_two_switches_with_no_step_between_are_both_told(server, client, begin, step):
    session = begin()
    reader = Reader(server.url, session["id"], after=-1)
    assert step(session, 0, ahead(0)).status_code == 200
    wait_for(lambda: reader.found)
    for t in (2, 4):
        asked = {"t": t, "policy_id": session["policy_ids"][0], "clock": "restart", "poses": ahead(0) * 2}
        assert client.post(f"/v1/sessions/{session['id']}/switch", json=asked).status_code == 200
        time.sleep(2.0)  # the stream knows of it by now
    assert step(session, 5, ahead(0) * 2).status_code == 200
    client.post(f"/v1/sessions/{session['id']}/close", json={})
    reader.join(HUNG)
    assert [t for t, _ in reader.found] == [0, "switch", "switch", 5, END]


def test_what_another_server_decides_is_told_here_and_a_server_that_stops_lets_its_readers_go(tmp_path):
    with serving(tmp_path) as one, httpx.Client(base_url=one.url, verify=False, timeout=None) as client:
        body = {"policy_id": "case1", "initial_pose": [4.5, 5.0, 0.0]}
        session = client.post("/v1/sessions", json=body).json()["id"]
        with serving(tmp_path) as other:
            reader = Reader(other.url, session, after=-1)
            local = Reader(one.url, session, after=-1, most=3)
            for t in range(3):
                asked = {"t": t, "poses": [[4.5, 5.0, 0.0]], "logits": [0.0] * 20}
                assert client.post(f"/v1/sessions/{session}/steps", json=asked).status_code == 200
            local.join()
            assert [t for t, _ in local.found] == [0, 1, 2]
            assert [t for t, _ in read(other.url, session, after=0, most=2)] == [1, 2]
            wait_for(lambda: len(reader.found) == 3)  # a server that stops tells nothing more
        reader.join(HUNG)
        assert not reader.is_alive()
        assert [t for t, _ in reader.found] == [0, 1, 2]


def test_a_server_that_is_stopped_by_ctrl_c_lets_its_readers_go(tmp_path):
    with serving(tmp_path) as server, httpx.Client(base_url=server.url, timeout=None) as client:
        body = {"policy_id": "case1", "initial_pose": [4.5, 5.0, 0.0]}
        reader = Reader(server.url, client.post("/v1/sessions", json=body).json()["id"])
        wait_for(lambda: watched(client))
        server.process.send_signal(signal.SIGINT)
        assert server.process.wait(HUNG) == 0
        reader.join(HUNG)
        assert not reader.is_alive()
        assert "timeout graceful shutdown exceeded" not in server.log.read_text()


@contextlib.asynccontextmanager
async def another_server(server):
    """What another server has of the store and the archive, and its watchers, who look from now on."""
    held = Archive(open_objects(f"{server.data_dir}/archive"))
    store = ArchivingStore(EmbeddedStore(server.data_dir).url, 30.0, 60, held)
    watchers = Watchers(store, 10, lambda: False, lambda: 0)
    looking = asyncio.create_task(watchers.run())
    yield store, watchers
    looking.cancel()
    await store.aclose()


async def put_away(store, id):
    return await store.put_away(id, time.time() + 60, await store.dump(id))


async def ids_told(stream, last):
    told = b""
    while b"id: %d\n" % last not in told and b"event: end" not in told:
        told += await anext(stream)
    await stream.aclose()
    return [int(line[4:]) for line in told.splitlines() if line.startswith(b"id: ")]


def test_a_stream_goes_on_though_its_session_leaves_the_store_while_it_is_looked_at(server, begin, step):
    session = begin()
    id, moved = scoped("", session["id"]), []

    async def watch():
        async with another_server(server) as (store, watchers):
            ask = store.news

            async def news(asked):  # after the look at its version
                if not moved:
                    moved.append(await put_away(store, id))
                return await ask(asked)

            store.news = news
            stream = await watchers.open(id, None)
            assert step(session, 0, ahead(0)).status_code == 200
            assert await ids_told(stream, 0) == [0]
        assert moved == [True]

    asyncio.run(watch())


def test_a_key_has_at_most_half_of_the_streams(server, begin, step):
    session = begin()
    assert step(session, 0, ahead(0)).status_code == 200

    async def watch():
        async with another_server(server) as (_, watchers):
            id, streams = scoped("", session["id"]), []

            async def begin_as(owner):
                streams.append(await watchers.open(id, -1, owner))
                await anext(streams[-1])

            for _ in range(5):
                await begin_as("one")
            with pytest.raises(LimitReached, match="this key has 5 open streams"):
                await begin_as("one")
            for _ in range(5):
                await begin_as("another")
            with pytest.raises(LimitReached, match="this server has 10 open streams"):
                await begin_as("third")
            for stream in streams:
                await stream.aclose()
            await begin_as("one")
            await streams[-1].aclose()

    asyncio.run(watch())


def test_of_many_streams_that_are_behind_one_at_a_time_reads(server, begin, step):
    session, pose = begin(), ahead(1)[0]
    for t in range(3):
        assert step(session, t, [pose]).status_code == 200
    id, reading, most = scoped("", session["id"]), [], []

    async def watch():
        async with another_server(server) as (store, watchers):
            ask = store.news

            async def news(asked):
                if asked[0][1] == 3:  # what is new
                    return await ask(asked)
                reading.append(asked)
                most.append(len(reading))
                await asyncio.sleep(0)
                found = await ask(asked)
                reading.remove(asked)
                return found

            store.news = news
            streams = [await watchers.open(id, -1) for _ in range(9)]
            assert await asyncio.gather(*(ids_told(stream, 2) for stream in streams)) == [[0, 1, 2]] * 9
        assert most == [1] * 9

    asyncio.run(watch())


def test_older_steps_are_read_and_written_once_for_all_streams(server, begin, step):
    session, pose, last = begin(), ahead(1)[0], KEPT
    for t in range(last + 1):
        assert step(session, t, [pose]).status_code == 200
    id, read = scoped("", session["id"]), []

    async def watch():
        async with another_server(server) as (store, watchers):
            ask = store.news

            async def news(asked):
                read.append(asked[0][1])
                return await ask(asked)

            store.news = news
            streams = [await watchers.open(id, -1) for _ in range(9)]
            told = await asyncio.gather(*(ids_told(stream, last) for stream in streams))
            assert told == [[*range(last + 1)]] * 9
        assert read.count(0) == 1

    asyncio.run(watch())


def test_an_archived_session_is_read_once_for_a_stream(server, begin, step, monkeypatch):
    session, pose, last = begin(), ahead(1)[0], 2 * KEPT
    for t in range(last + 1):
        assert step(session, t, [pose]).status_code == 200
    id, read = scoped("", session["id"]), []

    async def watch():
        async with another_server(server) as (store, watchers):
            assert await put_away(store, id)
            dump = store.dump

            async def noted(id):
                read.append(id)
                return await dump(id)

            store.dump = noted
            alone = Watchers(store, 10, lambda: False, lambda: 0)  # which does not look for news
            assert await ids_told(await alone.open(id, -1), last) == [*range(last + 1)]
            assert read == [id]
            monkeypatch.setattr("specshield.service.watch.events.AWAY", 0.0)  # looks at every turn
            stream = await watchers.open(id, None)
            assert await anext(stream)
            await asyncio.sleep(5 * EVERY)
            assert read == [id, id]
            await stream.aclose()

    asyncio.run(watch())


def test_a_session_whose_file_is_damaged_ends_its_streams_and_keeps_no_other_from_its_news(
    server, begin, step
):
    """None has told less than it says: one that lacks decisions breaks off, and its caller asks again."""
    lost, other = begin(), begin()
    id = scoped("", lost["id"])
    assert step(lost, 0, ahead(0)).status_code == 200

    async def watch():
        async with another_server(server) as (store, _):
            watchers = Watchers(store, 10, lambda: False, lambda: 0)
            streams = [await watchers.open(scoped("", each["id"]), None) for each in (lost, other)]
            for stream in streams:
                assert await anext(stream)
            assert await put_away(store, id)
            behind = await watchers.open(id, -1)
            assert await anext(behind)
            store.archive._objects.write((await store.file(id)).path, b"damaged")
            with pytest.raises(SessionDamaged):
                await anext(behind)
            looking = asyncio.create_task(watchers.run())
            assert b"event: end" in await anext(streams[0])
            assert step(other, 0, ahead(0)).status_code == 200
            assert await ids_told(streams[1], 0) == [0]
            looking.cancel()

    asyncio.run(watch())


def test_of_many_who_read_a_trajectory_one_is_given_a_line_in_a_round_of_the_event_loop():
    async def read():
        turns, written, most = asyncio.Lock(), 0, 0

        async def reader():
            nonlocal written
            async for _ in _each(iter([b"{}"] * 20), turns):
                written += 1

        readers = asyncio.gather(*(reader() for _ in range(50)))
        while not readers.done():
            before = written
            await asyncio.sleep(0)
            most = max(most, written - before)
        assert (written, most) == (1000, 1)

    asyncio.run(read())


def test_a_step_is_told_once_though_it_is_decided_while_the_archive_is_read(server, begin, step):
    session = begin()
    assert step(session, 0, ahead(0)).status_code == 200
    id, read = scoped("", session["id"]), []

    async def watch():
        async with another_server(server) as (store, watchers):
            assert await put_away(store, id)
            before, dump = await store.load(id), store.dump

            async def slow(id):
                found = await dump(id)
                if not read:  # as if the step were decided by the server that reads
                    read.append(step(session, 1, ahead(1)[1:]))
                    now = await store.load(id, 1)
                    made, row = record.decode(now.step), Session.of(now).rows[-1]
                    told = record.answer(made, row, session["actions"])
                    watchers.decided(id, before.version, now.version, State.of(now.state), row, made, told)
                return found

            store.dump = slow
            first = await watchers.open(id, -1)
            assert await anext(first)
            await asyncio.sleep(1.0)  # time for several looks
            assert step(session, 2, ahead(2)[2:]).status_code == 200
            await asyncio.sleep(1.0)
            assert await ids_told(await watchers.open(id, 0), 2) == [1, 2]
            await first.aclose()
        assert [answer.status_code for answer in read] == [200]

    asyncio.run(watch())


def test_an_erased_session_ends_its_streams_and_an_unknown_one_has_none(server, client, begin, step):
    session = begin()
    reader = Reader(server.url, session["id"], after=-1)
    step(session, 0, ahead(0))
    while not watched(client):
        time.sleep(0.05)
    client.delete(f"/v1/sessions/{session['id']}")
    reader.join()
    assert client.get(f"/v1/sessions/{session['id']}/events").json()["type"] == "not-found"
    for wrong in ("-2", "x", str(10**9)):
        response = client.get(f"/v1/sessions/{session['id']}/events", headers={"Last-Event-ID": wrong})
        assert response.json()["type"] == "invalid-input"


def test_a_stream_that_needs_a_store_which_is_away_ends_and_the_log_tells_of_no_failure(tmp_path):
    with (
        serving(tmp_path, SPECSHIELD_STORE_TIMEOUT="0.5") as server,
        httpx.Client(base_url=server.url, timeout=None, verify=False) as client,
        contextlib.closing(redis.Redis(unix_socket_path=str(tmp_path / "store" / "socket"))) as store,
    ):
        body = {"policy_id": "case1", "initial_pose": [4.5, 5.0, 0.0]}
        session = client.post("/v1/sessions", json=body).json()["id"]
        body = {"t": 0, "poses": [[4.5, 5.0, 0.0]], "logits": [0.0] * 20}
        assert client.post(f"/v1/sessions/{session}/steps", json=body).status_code == 200
        Reader(server.url, session)  # so that the server knows of the session
        while not watched(client):
            time.sleep(0.05)
        pid = store.info()["process_id"]
        os.kill(pid, signal.SIGSTOP)
        try:
            for path in (f"/v1/sessions/{session}/events?after=-1", f"/v1/events?session={session}:-1"):
                assert client.get(path).text == "retry: 1000\n\n"
        finally:
            os.kill(pid, signal.SIGCONT)
        assert "Traceback" not in server.log.read_text()


def watched(client: httpx.Client) -> bool:
    lines = client.get("/metrics", timeout=None).text.splitlines()
    return "specshield_watchers 0.0" not in lines


def test_the_number_of_readers_is_bounded_and_those_who_leave_make_room(tmp_path):
    def connect() -> socket.socket:
        connection = socket.create_connection(("127.0.0.1", port))
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
        assert connection.recv(4096).startswith(b"HTTP/1.1 200")
        return connection

    with (
        serving(tmp_path, SPECSHIELD_MAX_WATCHERS="2") as server,
        httpx.Client(base_url=server.url, verify=False, timeout=None) as client,
    ):
        port = httpx.URL(server.url).port
        body = {"policy_id": "case1", "initial_pose": [4.5, 5.0, 0.0]}
        session = client.post("/v1/sessions", json=body).json()["id"]
        path = f"/v1/sessions/{session}/events"
        connections = [connect(), connect()]
        response = client.get(path)
        assert (response.status_code, response.json()["type"]) == (429, "limit-reached")
        for connection in connections:
            connection.close()
        while watched(client):
            time.sleep(0.05)
        connect().close()
