"""Server processes under uvicorn's supervisor."""

from __future__ import annotations

import select
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context

from uvicorn import Config
from uvicorn.supervisors.multiprocess import Process

from specshield.service.leaving import notice_killed
from tests.serving import HUNG


def test_a_worker_that_is_killed_while_it_is_asked_is_noticed_at_once(monkeypatch, tmp_path):
    """And what it had open is forgotten, of it alone."""
    monkeypatch.setattr(Process, "start", Process.start)  # so that what follows is undone
    monkeypatch.setattr(Process, "join", Process.join)
    monkeypatch.setenv("PROMETHEUS_MULTIPROC_DIR", str(tmp_path))
    notice_killed()
    worker = Process(Config("none:app"), [])
    hung = ([], [], [worker.child_conn])  # waits for ever, and holds the pipe as a worker does
    worker.process = get_context("spawn").Process(target=select.select, args=hung)
    worker.start()
    with ThreadPoolExecutor(1) as supervisor:
        asked = supervisor.submit(worker.is_ready, 10 * HUNG)
        worker.process.kill()
        assert asked.result(HUNG) is False
    kept, forgotten = ("counter_{}.db", "gauge_livesum_1{}.db"), "gauge_livesum_{}.db"
    for name in (*kept, forgotten):
        (tmp_path / name.format(worker.pid)).touch()
    worker.join()
    assert {path.name for path in tmp_path.iterdir()} == {name.format(worker.pid) for name in kept}
