"""The client's connections."""

import asyncio
import math
import multiprocessing
import threading
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import httpx
import pytest

from specshield.client import AsyncShieldClient, ShieldClient
from specshield.client.network import bounded
from specshield.client.wire import Request
from tests.serving import HUNG, wait_for


class _Port(BaseHTTPRequestHandler):
    """Answers with the port that the request's connection comes from."""

    protocol_version = "HTTP/1.1"

    def do_GET(self):
        content = str(self.client_address[1]).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_):
        pass


def test_a_forked_process_opens_connections_of_its_own():
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Port)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = httpx.URL(f"http://127.0.0.1:{server.server_port}")
    fork = multiprocessing.get_context("fork")
    ports = fork.SimpleQueue()
    with httpx.Client(base_url=url, transport=bounded.Transport(url)) as client:
        first = client.get("/").text
        child = fork.Process(target=lambda: [ports.put(client.get("/").text) for _ in range(2)])
        child.start()
        its = [ports.get(), ports.get()]
        child.join()
        assert its[0] == its[1] != first  # it keeps its own, too
        assert client.get("/").text == first
    server.shutdown()
    server.server_close()


def test_event_loops_that_run_at_once_keep_connections_of_their_own():
    """They ask in turn, so that each would lose what it has if the other's took its place."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Port)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = httpx.URL(f"http://127.0.0.1:{server.server_port}")
    client = httpx.AsyncClient(base_url=url, transport=bounded.AsyncTransport(url))
    turns = threading.Barrier(2)

    async def ports():
        asked = []
        for _ in range(3):
            turns.wait(HUNG)
            asked.append((await client.get("/")).text)
        return asked

    with ThreadPoolExecutor(2) as threads:
        first, second = threads.map(lambda _: asyncio.run(ports()), range(2))
    assert len(set(first)) == len(set(second)) == 1
    assert first != second
    server.shutdown()
    server.server_close()


def test_another_event_loop_opens_connections_of_its_own():
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Port)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    url = httpx.URL(f"http://127.0.0.1:{server.server_port}")
    client = httpx.AsyncClient(base_url=url, transport=bounded.AsyncTransport(url))

    async def ports():
        return [(await client.get("/")).text for _ in range(2)]

    first, second = asyncio.run(ports()), asyncio.run(ports())
    assert first[0] == first[1] != second[0] == second[1]
    asyncio.run(client.aclose())  # in a third one, in which it has none
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("stream", [False, True])
def test_a_machine_without_a_thread_left_is_told_as_a_server_that_cannot_be_reached(monkeypatch, stream):
    """Then `on_failure` holds. The error of Python's own went past it, and ended the robot's loop."""

    def none_left(thread):
        raise RuntimeError("can't start new thread")

    async def ask(request):
        async with AsyncShieldClient("http://localhost:1", stream=stream) as client:
            with monkeypatch.context() as patch:
                patch.setattr(threading.Thread, "start", none_left)
                return await client._perform(request, math.inf)

    for message in (None, {"t": 0}):
        request = Request("POST", "/v1/sessions/a/steps", b"{}", message=message)
        outcomes = [asyncio.run(ask(request))]
        with ShieldClient("http://localhost:1", stream=stream) as client, monkeypatch.context() as patch:
            patch.setattr(threading.Thread, "start", none_left)
            outcomes.append(client._perform(request, math.inf))
        for outcome in outcomes:
            assert "can't start new thread" in str(outcome.error)


def test_what_is_made_after_an_interrupt_is_given_to_be_left(monkeypatch):
    """Ctrl-C, or a signal handler that raises, while a stream connects: nobody waits for it any more."""

    def interrupted(futures, timeout):
        raise KeyboardInterrupt

    monkeypatch.setattr(bounded, "wait", interrupted)
    going_on, left = threading.Event(), []
    with pytest.raises(KeyboardInterrupt):
        bounded.in_thread(lambda: going_on.wait(10.0), math.inf, left.append)
    assert left == []
    going_on.set()
    wait_for(lambda: left)
    assert left[0].result()
