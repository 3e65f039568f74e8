"""Server processes under uvicorn's supervisor."""

from __future__ import annotations

import select
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context

from uvicorn import Config
from uvicorn.supervisors.multiprocess import Process

from specshield.service.leaving import notice_killed
from tests.serving import HUNG


def test_a_worker_that_is_killed_while_it_is_asked_is_noticed_at_once(monkeypatch):
    monkeypatch.setattr(Process, "start", Process.start)  # so that what follows is undone
    notice_killed()
    worker = Process(Config("none:app"), [])
    hung = ([], [], [worker.child_conn])  # waits for ever, and holds the pipe as a worker does
    worker.process = get_context("spawn").Process(target=select.select, args=hung)
    worker.start()
    with ThreadPoolExecutor(1) as supervisor:
        asked = supervisor.submit(worker.is_ready, 10 * HUNG)
        worker.process.kill()
        assert asked.result(HUNG) is False
    worker.join()
