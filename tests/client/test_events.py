"""The events of a session, from a network that breaks off, drips and never ends, through both shells."""

import asyncio
import contextlib
import itertools
import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import httpx
import pytest
from client_script import SESSION
from test_deadline import decided

from specshield import errors
from specshield.client import AsyncSession, AsyncShieldClient, Session, SessionInfo, ShieldClient, events
from specshield.client.models import build
from specshield.commands.watch import watch as watched

INFO = build(SessionInfo, SESSION)
END = b'event: end\ndata: {"next_t": 9, "spec_status": "satisfied", "finished": true}\n\n'


def told(*steps):
    return b"".join(b"id: %d\ndata: %s\n\n" % (t, json.dumps(decided(t)).encode()) for t in steps)


@pytest.fixture(params=["sync", "async"])
def watch(request, monkeypatch):
    """watch(*answers, most=None): the decisions that are read, and the queries of the requests made.

    An answer is the bytes of a stream, a status, or an endless iterator of pieces.
    """
    monkeypatch.setattr(events, "PAUSE", 0.01)

    def run(*answers, most=99, kind="text/event-stream"):
        script, asked, over = list(answers), [], threading.Event()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                asked.append(self.path.partition("?")[2])
                answer = script.pop(0)
                self.send_response(answer if isinstance(answer, int) else 200)
                self.send_header("Content-Type", kind)
                self.end_headers()
                if isinstance(answer, bytes):
                    self.wfile.write(answer)
                elif not isinstance(answer, int):
                    with contextlib.suppress(OSError):
                        for piece in answer:
                            self.wfile.write(piece)
                            if over.wait(0.01):
                                return

            def log_message(self, *_):
                pass

        def blocking(url):
            with ShieldClient(url, timeout=10.0) as client:
                found = Session(client._run, INFO).events(-1)
                return [decision.t for decision in itertools.islice(found, most)]

        async def awaited(url):
            async with AsyncShieldClient(url, timeout=10.0) as client:
                found = []
                async for decision in AsyncSession(client._run, INFO).events(-1):
                    found.append(decision.t)
                    if len(found) == most:
                        break
                return found

        with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            url = f"http://127.0.0.1:{server.server_port}"
            try:
                return blocking(url) if request.param == "sync" else asyncio.run(awaited(url)), asked
            finally:
                over.set()
                server.shutdown()

    return run


def test_a_stream_that_breaks_off_goes_on_where_it_was(watch):
    whole = b"retry: 1000\n\n" + told(0) + b": alive\n\n" + told(1)
    found, asked = watch(whole[:-9], b"", told(1, 2), told(4) + END)
    assert found == [0, 1, 2, 4]
    assert asked == ["after=-1", "after=0", "after=0", "after=2"]


def test_where_nothing_follows_it_ends_at_once(watch):
    assert watch(204) == ([], ["after=-1"])


def test_a_reader_may_leave_in_between(watch):
    assert watch(iter(lambda: told(0), None), most=1)[0] == [0]


def test_what_brings_no_whole_line_is_given_up(watch, monkeypatch):
    monkeypatch.setattr(events, "SILENCE", 0.3)
    found, asked = watch(iter(lambda: b"data: ", None), told(3) + END)
    assert (found, len(asked)) == ([3], 2)


@pytest.mark.parametrize(
    "stream", [iter(lambda: b"data: " * 1000, None), b"data: [1]\n\n", b"data: {\n\n", b'data: {"t": 0}\n\n']
)
def test_what_is_no_stream_of_events_is_an_error(watch, stream, monkeypatch):
    monkeypatch.setattr(events, "LONGEST", 50_000)
    with pytest.raises(errors.ServerError):
        watch(stream)


def test_a_page_is_no_stream(watch):
    with pytest.raises(errors.ServerError, match="specshield server"):
        watch(b"<html>", kind="text/html")


def test_a_session_that_is_gone_is_not_found(watch):
    with pytest.raises(errors.NotFound):
        watch(told(0), 404)


def test_a_rule_that_a_session_knew_and_is_told_of_again_displaces_no_later_one():
    """It knows of two switches, reads the first of them again, and then of a third in its turn."""
    about = {"actions": ["m", "end"], "terminal_actions": [1]}
    rules = [{**about, "from": t, "formula": f"F[0,3] p{t}", "spec_status": "pending"} for t in (0, 2, 4, 6)]
    switches = [b"event: switch\ndata: %s\n\n" % json.dumps(rule).encode() for rule in rules]
    over = json.dumps({**rules[1], "spec_status": "satisfied"}).encode()
    pieces = [told(0, 1), b"event: switch\ndata: " + over + b"\n\n" + told(2), told(3)]
    pieces += [switches[2] + told(4), switches[3] + told(6), END]

    def serve(request):
        return httpx.Response(200, content=iter(pieces), headers={"content-type": "text/event-stream"})

    known = build(SessionInfo, {**SESSION, "rules": rules[:3]})
    with ShieldClient("http://robot.test", transport=httpx.MockTransport(serve)) as client:
        session = Session(client._run, known)
        read = session.events(-1)
        assert [next(read).t for _ in range(3)] == [0, 1, 2]
        assert [session.rule_at(t)[-2:] for t in range(8)] == ["p0", "p0", "p2", "p2", *["p4"] * 4]
        assert [decision.t for decision in read] == [3, 4, 6]
        assert [session.rule_at(t)[-2:] for t in (1, 3, 5, 7)] == ["p0", "p2", "p4", "p6"]


def test_a_watched_session_is_headed_with_the_rule_of_the_decisions_that_follow(monkeypatch, capsys):
    """It has had a second rule by the time it is read, and is given a third while it is watched."""
    rules = [
        {"from": t, "formula": formula, "actions": ["m", "end"], "terminal_actions": [1]}
        for t, formula in ((0, "F[0,3] a"), (2, "F[0,3] b"), (4, "F[0,3] c"))
    ]
    switch = b"event: switch\ndata: %s\n\n" % json.dumps(rules[2]).encode()

    def serve(request):
        if not request.url.path.endswith("/events"):
            now = {**SESSION, "spec": {"formula": "F[0,3] b"}, "next_t": 4, "rules": rules[:2]}
            return httpx.Response(200, json=now)
        steps = range(int(request.url.params["after"]) + 1, 6)
        body = b"".join(told(t) for t in steps if t < 4) + switch + told(4, 5) + END
        return httpx.Response(200, content=body, headers={"content-type": "text/event-stream"})

    def client(url, api_key, timeout):
        return ShieldClient(url, api_key, timeout, transport=httpx.MockTransport(serve))

    monkeypatch.setattr("specshield.commands.serving.ShieldClient", client)
    shown = []
    for after in (-1, 1):
        watched("s", "http://robot.test", after, None)
        head, _, *lines = capsys.readouterr().out.splitlines()
        shown.append([head, *(line if "from" in line else int(line.split()[0]) for line in lines)])
    later = ["from step 4: F[0,3] c", 4, 5]
    assert shown[0] == ["session s: F[0,3] a", 0, 1, "from step 2: F[0,3] b", 2, 3, *later]
    assert shown[1] == ["session s: F[0,3] b", 2, 3, *later]
