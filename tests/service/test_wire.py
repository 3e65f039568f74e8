import asyncio
import time
from contextlib import aclosing
from types import SimpleNamespace

import hiredis
import pytest
import redis

from specshield.errors import StoreError
from specshield.service.storage.connect import USER, reaching
from specshield.service.storage.store import Change, Store
from specshield.service.storage.wire import PART, Script, Wire, _Link
from tests.serving import free_port, wait_for
from tests.stores import VALKEY, answers, needs_redis, running


def test_an_answer_that_comes_too_late_is_nobody_elses():
    """Though the one who asked has gone meanwhile."""

    async def scene():
        release = asyncio.Event()

        async def echo(reader, writer):
            commands = hiredis.Reader()
            while data := await reader.read(65536):
                commands.feed(data)
                await release.wait()
                while (command := commands.gets()) is not False:
                    writer.write(b"$%d\r\n%s\r\n" % (len(command[1]), command[1]))
            writer.close()

        server = await asyncio.start_server(echo, "127.0.0.1", 0)
        _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        link, loop = _Link(SimpleNamespace(_writer=writer)), asyncio.get_running_loop()
        gone = asyncio.create_task(link.send(("GET", "one"), loop.time() + 0.05))
        await asyncio.sleep(0.0)
        gone.cancel()
        loop.call_later(0.2, release.set)
        with pytest.raises(redis.ConnectionError):
            await link.send(("GET", "another"), loop.time() + 60.0)
        release.set()
        server.close()

    asyncio.run(scene())


def test_a_server_that_can_wait_for_no_replica_any_more_is_left():
    """As one that has become a replica itself: its answers are not told, and another connection is opened."""

    async def scene():
        async def demoted(reader, writer):
            await reader.readuntil(b"GET")
            writer.write(b"+there\r\n-ERR WAIT cannot be used with replica instances\r\n")

        server = await asyncio.start_server(demoted, "127.0.0.1", 0)
        _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        link, loop = _Link(SimpleNamespace(_writer=writer), 1), asyncio.get_running_loop()
        with pytest.raises(redis.ConnectionError):
            await link.send(("GET", "one"), loop.time() + 60.0)
        assert link.closed
        server.close()

    asyncio.run(scene())


def test_a_refusal_is_told_at_once_with_its_reason():
    """Though replicas are waited for: nothing was written that they could lack."""

    async def scene():
        async def read_only(reader, writer):
            while await reader.read(65536):
                writer.write(b"-READONLY You can't write against a read only replica.\r\n")

        server = await asyncio.start_server(read_only, "127.0.0.1", 0)

        class Connection:
            async def connect(self):
                _, self._writer = await asyncio.open_connection(*server.sockets[0].getsockname())

        wire = Wire(Connection, 60.0, 1)
        with pytest.raises(StoreError, match="the store refuses: READONLY"), reaching():
            await wire.run(Script("return 1"), [], [])
        server.close()

    began = time.monotonic()
    asyncio.run(scene())
    assert time.monotonic() - began < 0.5 * PART * 60.0


@pytest.mark.parametrize("program", [pytest.param("redis-server", marks=needs_redis), VALKEY])
def test_a_right_that_the_stores_user_lacks_is_told_alike_however_it_was_asked(tmp_path, program):
    """And no caller is told the user's name, which only the log has."""
    port, told = free_port(), set()

    async def scene():
        url = f"redis://alice:secret@127.0.0.1:{port}"
        async with aclosing(Store(url, 60.0, 60)) as store:
            for right, call in (
                ("-@scripting", lambda store: store.load("@it")),
                ("-hset", lambda store: store._write("@it", b"", Change(b"x", config=b"y"))),
                ("-zlexcount", lambda store: store.count(None)),
                ("resetkeys", lambda store: store.load("@it")),
            ):
                default.acl_setuser(
                    "alice", reset=True, enabled=True, passwords=["+secret"], categories=["+@all"]
                )
                default.execute_command("ACL", "SETUSER", "alice", "~*", right)
                with pytest.raises(StoreError) as caught:
                    await call(store)
                told.add((caught.value.message, caught.value.expected))

    with (
        running(tmp_path, "--port", str(port), "--save", "", program=program),
        redis.Redis(port=port) as default,
    ):
        wait_for(lambda: answers(default))
        asyncio.run(scene())
    assert told == {("the store refuses: its user lacks a right", USER)}


def test_a_server_that_goes_while_a_connection_is_made_cannot_be_reached():
    """uvloop has no OSError for a write to what the other side has closed by then."""

    async def gone():
        raise RuntimeError("unable to perform operation on <TCPTransport closed=True>; the handler is closed")

    wire = Wire(lambda: SimpleNamespace(connect=gone), 60.0)
    with pytest.raises(redis.ConnectionError, match="closed"):
        asyncio.run(wire.run(Script("return 1"), [], []))


def test_a_connection_that_is_not_made_in_time_is_given_up():
    """Though redis-py misses that the time is over, as it does now and then where it sends in Python 3.11."""

    async def deaf():
        try:
            await asyncio.sleep(60.0)
        except asyncio.CancelledError:
            await asyncio.sleep(60.0)

    wire = Wire(lambda: SimpleNamespace(connect=deaf), 0.05)
    began = time.monotonic()
    with pytest.raises(TimeoutError):
        asyncio.run(wire.run(Script("return 1"), [], []))
    assert time.monotonic() - began < 30.0
