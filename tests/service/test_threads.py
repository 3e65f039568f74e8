"""A server on a machine that has no threads left for it."""

import asyncio
import os

import httpx

from specshield.service.middleware import Observe
from tests.service.test_sessions import problem
from tests.serving import serving

# As the operating system, which refuses a thread for a while.
NO_THREADS = """
import os, threading
start = threading.Thread.start
def start_or_not(thread):
    if os.path.exists({flag!r}):
        raise RuntimeError("can't start new thread")
    start(thread)
threading.Thread.start = start_or_not
"""


def test_who_needs_a_thread_that_cannot_be_started_is_told_to_ask_again(tmp_path):
    flag, patch = tmp_path / "none", tmp_path / "patch"
    patch.mkdir()
    (patch / "sitecustomize.py").write_text(NO_THREADS.format(flag=str(flag)))
    path = os.pathsep.join(filter(None, (str(patch), os.environ.get("PYTHONPATH"))))
    with (
        serving(tmp_path / "data", PYTHONPATH=path) as server,
        httpx.Client(base_url=server.url, timeout=None, verify=False) as client,
    ):
        flag.touch()
        paths = ("/metrics", "/v1/sessions", "/v1/policies", "/v1/maps")
        answers = [client.get(path) for path in paths]  # some need no new thread
        refused = [answer for answer in answers if answer.status_code != 200]
        assert refused
        for answer in refused:
            problem(answer, 503, "busy")
        flag.unlink()
        assert all(client.get(path).status_code == 200 for path in paths)
    assert "Traceback" not in server.log.read_text()


def test_who_was_told_to_ask_again_keeps_the_connection_and_no_traceback_is_written():
    """An error that is raised once more after its answer makes uvicorn do both; a step's was."""
    sent = []

    async def step(scope, receive, send):
        raise RuntimeError("can't start new thread")

    async def send(message):
        sent.append(message)

    scope = {"type": "http", "method": "POST", "path": "/v1/sessions/a/steps", "headers": []}
    asyncio.run(Observe(step)(scope, None, send))
    assert [message.get("status") for message in sent] == [503, None]
