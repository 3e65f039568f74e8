import asyncio
import subprocess
import sys
from concurrent.futures import Future

import pytest

from specshield.errors import InsufficientStorage
from specshield.service import app
from specshield.service.heavy.background import Background
from specshield.service.startup import Startup, prepare
from tests.serving import HUNG


def test_calls_are_made_in_turn_and_their_errors_are_told():
    background, before = Background("test"), Future[int]()
    first = background.submit(before.result)
    cancelled, second, wrong = (background.submit(f) for f in (int, lambda: 2, lambda: 1 // 0))
    assert cancelled.cancel()
    assert not second.done()
    before.set_result(1)
    assert (first.result(), second.result()) == (1, 2)
    with pytest.raises(ZeroDivisionError):
        wrong.result()


def test_owners_take_turns():
    background, before, order = Background("test"), Future[int](), []
    background.submit(before.result)
    asked = ("many", 1), ("many", 2), ("many", 3), ("few", 4)
    calls = [background.submit(order.append, number, owner=owner) for owner, number in asked]
    before.set_result(1)
    for each in calls:
        each.result(HUNG)
    assert order == [1, 4, 2, 3]


def test_a_task_of_the_server_that_fails_is_told_in_the_log_and_begun_again(caplog, monkeypatch):
    begun = []

    async def task():
        begun.append(None)
        if len(begun) == 1:
            raise RuntimeError("can't start new thread")

    monkeypatch.setattr(app, "AGAIN", 0.0)
    asyncio.run(app.lasting(task))
    assert len(begun) == 2
    assert "can't start new thread" in caplog.text


def test_a_server_becomes_ready_once_what_kept_it_from_that_has_passed(monkeypatch):
    startup, told = Startup(), []

    def check():
        told.append(startup.problem().message)
        if len(told) == 1:
            raise InsufficientStorage("the server's disk is full")

    monkeypatch.setattr(app, "AGAIN", 0.0)
    asyncio.run(app.lasting(lambda: prepare(startup, check)))
    assert startup.ready
    assert told[1] == "the server cannot become ready now: InsufficientStorage; its log says more"


def test_a_program_that_ends_does_not_wait_for_a_call():
    program = (
        "import time\nfrom specshield.service.heavy.background import Background\n"
        "Background('test').submit(time.sleep, 7200)\n"
    )
    subprocess.run([sys.executable, "-c", program], timeout=HUNG, check=True)
