"""Calls in child processes: bounded, cancelled, shared among owners, and gone when nobody needs them."""

from __future__ import annotations

import asyncio
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import Future
from contextvars import copy_context
from pathlib import Path
from typing import Any

import pytest
from starlette.requests import Request

from specshield.cores import cores
from specshield.errors import Busy, MapError, ServerError, StoreError, TooExpensive
from specshield.service.heavy.child import LENGTH
from specshield.service.heavy.heavy import TASKS, Heavy
from specshield.service.heavy.pool import Pool, Template, Turns
from specshield.service.heavy.threads import Threads
from specshield.service.sessions.shields import Shields
from specshield.service.settings import Settings
from specshield.service.watch import logs
from tests.serving import HUNG, children, wait_for


def run(
    scenario: Callable[[Pool], Awaitable[Any]],
    template: Template,
    size: int = 1,
    idle: float = 60.0,
    unused: Callable[[float], object] = lambda since: None,
) -> Any:
    async def whole() -> Any:
        pool = Pool(template, size=size, memory=1 << 30, nice=1, waiting=4, idle=idle, unused=unused)
        try:
            return await scenario(pool)
        finally:
            pool.close()

    return asyncio.run(whole())


@pytest.fixture(scope="module")
def template() -> Iterator[Template]:
    """One for all pools: to start it takes a second of a processor."""
    template = Template()
    yield template
    template.stop()


def test_children_answer_fail_run_out_and_are_replaced(template: Template) -> None:
    async def scenario(pool: Pool) -> None:
        assert await pool.run("math:sqrt", 9.0, seconds=60.0) == 3.0
        first = await pool.run("os:getpid", seconds=60.0)
        assert await pool.run("os:getpid", seconds=60.0) == first != os.getpid()

        with pytest.raises(MapError) as wrong:  # our errors come back as they are
            await pool.run("specshield.world.checks:integer", 1.5, "data[0]", 0, 9, seconds=60.0)
        assert (wrong.value.path, wrong.value.got) == ("data[0]", 1.5)
        with pytest.raises(MapError, match="aaa…") as wrong:  # but in short
            await pool.run("specshield.world.checks:member", {}, "a" * 1_000_000, "", seconds=60.0)
        assert len(pickle.dumps(wrong.value)) < 10_000
        with pytest.raises(StoreError, match="files cannot be used: No such file") as away:
            await pool.run("os:listdir", "/no/such/folder", seconds=60.0)
        assert "/no" not in str(away.value)
        with pytest.raises(ServerError, match="ZeroDivisionError"):  # and others without what they say
            await pool.run("operator:truediv", 1, 0, seconds=60.0)
        assert await pool.run("os:getpid", seconds=60.0) == first

        with pytest.raises(TooExpensive, match=r"0\.2 s"):
            await pool.run("time:sleep", 600.0, seconds=0.2)
        second = await pool.run("os:getpid", seconds=60.0)
        assert second != first
        with pytest.raises(TooExpensive, match="MiB"):
            await pool.run("builtins:bytearray", 4 << 30, seconds=60.0)
        with pytest.raises(TooExpensive, match="ended"):
            await pool.run("os:abort", seconds=60.0)
        assert await pool.run("math:sqrt", 4.0, seconds=60.0) == 2.0

    run(scenario, template)


def test_a_call_that_is_cancelled_is_killed_and_so_are_all_children_at_the_end(template: Template) -> None:
    async def scenario(pool: Pool) -> int:
        pid: int = await pool.run("os:getpid", seconds=60.0)
        sleeping = asyncio.create_task(pool.run("time:sleep", 600.0, seconds=600.0))
        await asyncio.sleep(0)  # it has the child now
        sleeping.cancel()
        with pytest.raises(asyncio.CancelledError):
            await sleeping
        other: int = await pool.run("os:getpid", seconds=60.0)
        assert other != pid
        await _ends(pid)
        return other

    left = run(scenario, template)
    asyncio.run(_ends(left))


def test_a_child_that_was_stopped_ends_when_its_time_is_over(template: Template) -> None:
    async def scenario(pool: Pool) -> None:
        pid: int = await pool.run("os:getpid", seconds=60.0)
        os.kill(pid, signal.SIGSTOP)
        with pytest.raises(TooExpensive):
            await pool.run("math:sqrt", 9.0, seconds=0.2)
        await _ends(pid)

    run(scenario, template)


def test_a_child_that_was_killed_while_it_had_nothing_to_do_is_replaced(template: Template) -> None:
    async def scenario(pool: Pool) -> None:
        pid: int = await pool.run("os:getpid", seconds=60.0)
        os.kill(pid, signal.SIGKILL)
        await _ends(pid)
        await asyncio.sleep(0.1)  # the event loop hears of it
        assert await pool.run("math:sqrt", 9.0, seconds=60.0) == 3.0  # and it is not called too expensive
        assert pool.children == 1

    run(scenario, template)


# A template that can fork at its first and third try.
FULL_AT_TIMES = """
import os, socket
from specshield.service.heavy import child
fork, tries = os.fork, []
def fork_or_not():
    tries.append(None)
    if len(tries) == 2:
        raise BlockingIOError(11, "Resource temporarily unavailable")
    return fork()
os.fork = fork_or_not
child.template(socket.socket(fileno=os.dup(0)))
"""


def test_where_no_child_can_be_begun_the_caller_is_told_so_and_other_calls_go_on() -> None:
    template = Template()

    async def scenario(pool: Pool) -> None:
        template._control, theirs = socket.socketpair()
        with theirs:
            template._process = subprocess.Popen([sys.executable, "-c", FULL_AT_TIMES], stdin=theirs)
        long = asyncio.create_task(pool.run("time:sleep", 600.0, seconds=600.0))
        await asyncio.to_thread(wait_for, lambda: pool.children and children(template._process.pid))
        with pytest.raises(Busy):
            await pool.run("math:sqrt", 9.0, seconds=60.0)
        assert await pool.run("math:sqrt", 9.0, seconds=60.0) == 3.0
        assert not long.done()
        assert pool.children == 2

        template._process.kill()
        assert await pool.run("math:sqrt", 9.0, seconds=60.0) == 3.0
        assert not long.done()  # it was not too expensive, and is made once more
        long.cancel()
        await asyncio.gather(long, return_exceptions=True)

    try:
        run(scenario, template, size=2)
    finally:
        template.stop()


def test_a_call_whose_child_was_killed_is_made_once_more(template: Template, tmp_path: Path) -> None:
    once = f"mkdir {tmp_path / 'first'} 2> /dev/null && kill -9 $PPID; exit 3"

    async def scenario(pool: Pool) -> None:
        assert await pool.run("subprocess:call", ["sh", "-c", once], seconds=60.0) == 3
        assert pool.children == 1

    run(scenario, template)


def test_a_child_whose_caller_is_gone_says_nothing_of_it(capfd: pytest.CaptureFixture[str]) -> None:
    template = Template()
    try:
        template.fork(1 << 30, 1).close()
        with template.fork(1 << 30, 1) as calls:  # by its first word the one before has been forked
            calls.setblocking(True)
            assert calls.recv(1 << 16)  # all of it: else the child would see a reset, not an end
            process = template._process
            assert process is not None
            wait_for(lambda: len(children(process.pid)) == 1)
            calls.sendall(LENGTH.pack(9) + b"cut")  # and one whose caller is killed in the middle of a call
        wait_for(lambda: not children(process.pid))
    finally:
        template.stop()
    assert capfd.readouterr().err == ""


def test_a_child_that_keeps_much_memory_or_has_nothing_to_do_ends(template: Template) -> None:
    unused = list[float]()  # since when, each time that no child was left

    async def scenario(pool: Pool) -> None:
        pid = await pool.run("os:getpid", seconds=60.0)
        begun = time.monotonic()
        await pool.run("numpy:ones", 100, seconds=60.0)
        ended = time.monotonic()
        await _ends(pid)  # idle
        assert pool.children == 0
        assert begun < unused[0] < ended  # and not when the child ended
        pid = await pool.run("os:getpid", seconds=60.0)
        assert len(await pool.run("operator:mul", b"a", 100 << 20, seconds=60.0)) == 100 << 20
        await _ends(pid)

    run(scenario, template, idle=0.05, unused=unused.append)


def test_owners_take_turns() -> None:
    async def scenario() -> list[str]:
        turns, order = Turns(1, 4), list[str]()
        await turns.take("first")

        async def call(owner: str) -> None:
            await turns.take(owner)
            order.append(owner)
            turns.give()

        calls = [asyncio.create_task(call(owner)) for owner in ("many", "many", "many", "few", "other")]
        await asyncio.sleep(0)
        calls[1].cancel()
        turns.give()
        await asyncio.gather(*calls, return_exceptions=True)
        return order

    assert asyncio.run(scenario()) == ["many", "few", "other", "many"]


def test_an_owner_has_so_many_waiting_and_no_more() -> None:
    async def scenario() -> None:
        turns = Turns(1, 2)
        await turns.take("a")
        waiting = [asyncio.create_task(turns.take("a")) for _ in range(2)]
        await asyncio.sleep(0)
        with pytest.raises(Busy):
            await turns.take("a")
        another = asyncio.create_task(turns.take("b"))
        for _ in range(3):
            turns.give()
        await asyncio.gather(*waiting, another)

    asyncio.run(scenario())


def test_an_owner_whose_slow_decisions_fill_its_processes_keeps_nobody_else_waiting(tmp_path: Path) -> None:
    gate, open_gate = tmp_path / "gate", tmp_path

    async def scenario() -> None:
        heavy = Heavy(Settings(data_dir=tmp_path))

        async def decide(owner: str, session: int, wanted: Path) -> int:
            logs.request.set({"state": {"owner": owner}})
            return await heavy.decide(_once_there, str(wanted), session=f"{session}", key=())

        try:
            many = [asyncio.create_task(decide("many", i, gate)) for i in range(3 * max(cores(), 2))]
            await asyncio.sleep(0)
            other = await asyncio.wait_for(asyncio.create_task(decide("few", 0, open_gate)), HUNG)
            gate.touch()
            assert other not in await asyncio.gather(*many)
        finally:
            heavy.close()

    asyncio.run(scenario())


def _once_there(shields: Shields, path: str) -> int:
    """The process that this is called in, once there is a file at this path."""
    while not os.path.exists(path):
        time.sleep(0.01)
    return os.getpid()


def test_an_owner_whose_uploads_fill_its_processes_keeps_nobody_else_waiting(tmp_path: Path) -> None:
    os.mkfifo(endless := tmp_path / "endless")  # who reads it waits for a writer

    async def scenario() -> None:
        heavy = Heavy(Settings(data_dir=tmp_path, heavy_timeout=3600.0))

        async def run(owner: str, *asked: Any) -> Any:
            request = Request({"type": "http", "state": {"owner": owner}}, asyncio.Event().wait)  # type: ignore[arg-type]
            return await heavy.run(request, *asked, owner)

        try:
            many = [asyncio.create_task(run("many", "check_policy", endless)) for _ in range(3 * TASKS)]
            await asyncio.sleep(0)
            checked = await asyncio.wait_for(run("few", "check_spec", b'{"formula": "x > 0"}'), HUNG)
            assert checked["names"] == ["x"]
            for each in many:
                each.cancel()
            await asyncio.gather(*many, return_exceptions=True)
        finally:
            heavy.close()

    asyncio.run(scenario())


def test_an_owner_whose_calls_fill_its_threads_keeps_nobody_else_waiting() -> None:
    threads, gate = Threads(), threading.Event()

    def submit(owner: str, function: Callable[[], Any]) -> Future[Any]:
        context = copy_context()
        context.run(logs.request.set, {"state": {"owner": owner}})
        return context.run(threads.submit, function)

    many = [submit("many", gate.wait) for _ in range(3 * cores())]
    assert all(submit(owner, lambda: "done").result(HUNG) == "done" for owner in ("few", ""))
    assert threads.submit(lambda: "done").result(HUNG) == "done"  # outside of requests
    gate.set()
    assert all(each.result(HUNG) for each in many)


async def _ends(pid: int) -> None:
    while os.path.exists(f"/proc/{pid}"):
        await asyncio.sleep(0.01)
