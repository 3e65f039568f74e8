"""What one caller can take of the server, and what the others keep."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from http.client import HTTPResponse
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import psutil
import pytest

from specshield.errors import StoreError
from specshield.service.bounds.bodies import IN_MEMORY, Body, Budget
from tests.service.world import grid_json
from tests.serving import HUNG, RunningServer, serving, wait_for

MOST = 12  # connections of the server below


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """A server with little room. It does not have to be ready: connections are the same before."""
    folder = tmp_path_factory.mktemp("small")
    settings = {
        "SPECSHIELD_MAX_CONNECTIONS": str(MOST),
        "SPECSHIELD_REQUEST_TIMEOUT": "2",
        "SPECSHIELD_MAX_HEADER_BYTES": "4096",
        "SPECSHIELD_MIN_BODY_RATE": str(10 << 20),
    }
    with serving(folder, ready=False, **settings) as server:
        wait_for(lambda: _alive(server))
        yield server


def _alive(server: RunningServer) -> bool:
    with contextlib.suppress(httpx.TransportError):
        return httpx.get(f"{server.url}/livez", timeout=HUNG, verify=False).status_code == 200
    return False


def _connect(server: RunningServer) -> socket.socket:
    parts = urlsplit(server.url)
    return socket.create_connection((str(parts.hostname), int(parts.port or 0)), timeout=HUNG)


def _answer(connection: socket.socket) -> tuple[int, dict[str, Any]]:
    """The status and the problem document of an answer after which the server closes."""
    received = b""
    with contextlib.suppress(ConnectionResetError):  # it may have bytes that it did not read
        while part := connection.recv(65536):
            received += part
    head, _, body = received.partition(b"\r\n\r\n")
    return int(head.split()[1]), json.loads(body)


def test_a_head_that_is_too_large_is_refused(small: RunningServer) -> None:
    with _connect(small) as connection:
        connection.sendall(b"GET /livez HTTP/1.1\r\nX-Large: " + b"a" * 5_000 + b"\r\n\r\n")
        status, problem = _answer(connection)
    assert (status, problem["type"], problem["limit"]) == (431, "headers-too-large", 4096)


def test_what_comes_with_the_end_of_a_head_is_not_taken_for_a_part_of_it(small: RunningServer) -> None:
    """As in a network that delivers the head's beginning first: a step was refused for its body."""
    body = b'{"formula": "F[0,5] x > 0", "more": "' + b"a" * 5_000 + b'"}'
    head = f"POST /v1/specs/validate HTTP/1.1\r\nHost: {urlsplit(small.url).netloc}\r\nConnection: close\r\n"
    head += f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    with _connect(small) as connection:
        for piece in (head[:40].encode(), head[40:].encode() + body):
            connection.sendall(piece)
            time.sleep(0.1)
        status, problem = _answer(connection)
    assert (status, problem["path"]) == (422, "more")


def test_a_head_that_never_ends_is_refused_while_it_comes(small: RunningServer) -> None:
    with _connect(small) as connection, contextlib.suppress(OSError):
        connection.sendall(b"GET /livez HTTP/1.1\r\nX-Large: ")
        for _ in range(64):
            connection.sendall(b"a" * (1 << 20))
        pytest.fail("64 MB of one header were taken")


def test_a_head_that_comes_too_slowly_is_refused(small: RunningServer) -> None:
    with _connect(small) as connection:
        connection.sendall(b"GET /livez HTTP/1.1\r\nX-Slow: ")
        status, problem = _answer(connection)
    assert (status, problem["type"]) == (408, "request-timeout")


@pytest.mark.parametrize("line", ["POST /x HTTP/1.1", "GET /x HTTP/1.1", "GET /x HTTP/1.0"])
def test_what_cannot_open_a_websocket_is_refused(small: RunningServer, line: str) -> None:
    opening = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nContent-Length: 2\r\n\r\n"
    with _connect(small) as connection:
        connection.sendall(f"{line}\r\nHost: 127.0.0.1\r\n{opening}{key}".encode())
        status, problem = _answer(connection)
    assert (status, problem["type"]) == (422, "invalid-input")


def test_a_request_that_also_asks_for_another_protocol_is_answered_as_any(server: RunningServer) -> None:
    """As the HTTP client of Java and `curl --http2` do; its body may come with the head or later."""
    body = b'{"formula": "F[0,3] x > 0"}'
    head = f"""POST /v1/specs/validate HTTP/1.1
Host: {urlsplit(server.url).netloc}
Connection: Upgrade, HTTP2-Settings
Upgrade: h2c
HTTP2-Settings: AAMAAABk
Content-Type: application/json
Content-Length: {len(body)}

""".replace("\n", "\r\n").encode()
    with _connect(server) as connection:
        for parts in ((head + body,), (head[:-3], head[-3:], body)):
            for part in parts:
                connection.sendall(part)
                time.sleep(0.01)  # so that it comes by itself, most likely
            answer = HTTPResponse(connection)
            answer.begin()
            assert (answer.status, json.loads(answer.read())["horizon"]) == (200, 3)
        twice = head.replace(b"Upgrade: h2c", b"Upgrade: h2c\r\nConnection: keep-alive")
        connection.sendall(head + body + twice + body + head + body)
        answered = b""
        while (count := answered.count(b'"horizon":3')) < 3:
            answered += (got := connection.recv(1 << 16))
            assert got, answered
        assert count == answered.count(b"HTTP/1.1 200 ") == 3


def test_trailers_are_no_headers(server: RunningServer) -> None:
    """A field after the body takes no part in who asks and what is asked: who checked the head saw none."""
    head = """POST /v1/specs/validate HTTP/1.1
Host: {host}
Content-Type: application/json
Transfer-Encoding: chunked

2
{{}}
0
Host: {trailer}
X-Request-ID: of-a-trailer

""".replace("\n", "\r\n")
    own = urlsplit(server.url).netloc
    for host, trailer, status in ((own, "evil.example", 422), ("evil.example", own, 421)):
        with _connect(server) as connection:
            connection.sendall(head.format(host=host, trailer=trailer).encode())
            answer = HTTPResponse(connection)
            answer.begin()
        assert answer.status == status
        assert answer.headers["X-Request-ID"] != "of-a-trailer"


def test_a_caller_who_leaves_before_its_answer_writes_no_traceback(server: RunningServer) -> None:
    """The connection is reset between the answer and its sending, in the next round of the event loop."""
    request = f"GET /livez HTTP/1.1\r\nHost: {urlsplit(server.url).netloc}\r\n\r\n".encode()
    for _ in range(100):
        with _connect(server) as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # resets
            connection.sendall(50 * request)
    assert httpx.get(f"{server.url}/livez", timeout=HUNG, verify=False).status_code == 200
    assert "Traceback" not in server.log.read_text()


def test_a_connection_that_says_nothing_is_closed(small: RunningServer) -> None:
    with _connect(small) as connection:
        assert connection.recv(1) == b""


def test_a_client_that_does_not_read_its_answers_is_cut_off(small: RunningServer) -> None:
    def held_by_server(client: socket.socket) -> bool:
        held = psutil.Process(small.process.pid).net_connections("tcp")
        return client.getsockname() in [each.raddr for each in held if each.raddr]

    with _connect(small) as connection:
        request = b"GET /static-offline-docs/swagger-ui-bundle.js HTTP/1.1\r\nHost: %s\r\n\r\n"
        connection.sendall(20 * (request % urlsplit(small.url).netloc.encode()))  # 30 MB
        wait_for(lambda: held_by_server(connection))
        wait_for(lambda: not held_by_server(connection))


def test_silent_connections_make_room_for_those_who_ask(small: RunningServer) -> None:
    with contextlib.ExitStack() as held:
        for _ in range(2 * MOST):
            held.enter_context(_connect(small))
        assert httpx.get(f"{small.url}/livez", timeout=HUNG, verify=False).status_code == 200


def test_those_at_work_keep_their_connections_when_new_ones_are_refused(small: RunningServer) -> None:
    with contextlib.ExitStack() as held:
        working = [
            held.enter_context(httpx.Client(base_url=small.url, timeout=HUNG, verify=False))
            for _ in range(MOST)
        ]
        for robot in working:
            assert robot.get("/livez").status_code == 200
        status, problem = _answer(held.enter_context(_connect(small)))
        assert (status, problem["type"]) == (503, "busy")
        for robot in working:
            assert robot.get("/livez").status_code == 200


def test_a_large_upload_is_read_while_others_ask(server: RunningServer, client: httpx.Client) -> None:
    """F1: a valid map of 4 million cells, sent while another caller goes on."""
    grid = grid_json()
    grid["info"] |= {"width": 2000, "height": 2000}
    grid["data"] = [0] * 4_000_000
    answers: list[httpx.Response] = []
    sending = threading.Thread(
        target=lambda: answers.append(
            httpx.post(f"{server.url}/v1/maps", json=grid, timeout=None, verify=False)
        )
    )
    sending.start()
    asked = 0
    while sending.is_alive():
        assert client.get("/livez").status_code == 200
        asked += 1
    assert answers[0].status_code == 201, answers[0].text
    assert asked > 0
    assert answers[0].json()["width"] == 2000


def test_a_client_that_goes_away_in_an_upload_is_no_failure(server: Any, client: httpx.Client) -> None:
    """F13: it is counted as gone, and nothing is logged as an error."""
    before = server.log.read_text().count("Traceback")
    for sent in (b"", b"[" * 100):
        with _connect(server) as connection:
            host = urlsplit(server.url).netloc
            connection.sendall(
                f"POST /v1/maps HTTP/1.1\r\nHost: {host}\r\nContent-Type: application/json\r\n"
                "Content-Length: 1000\r\n\r\n".encode()
                + sent
            )

    def gone() -> bool:
        return 'status="499"' in client.get("/metrics").text

    wait_for(gone)
    assert server.log.read_text().count("Traceback") == before
    assert list((server.data_dir / "incoming").glob("*")) == []


def test_a_large_upload_that_the_disk_does_not_take_is_refused_and_no_failure(tmp_path: Path) -> None:
    (tmp_path / "incoming").touch()  # where its folder would be
    body = Body(Budget(2 * IN_MEMORY), tmp_path / "incoming", "")
    with pytest.raises(StoreError):
        asyncio.run(body.add(bytes(IN_MEMORY + 1)))


def test_thousands_of_unknown_fields_are_refused_with_one_error(client: httpx.Client) -> None:
    for path in ("/v1/specs/validate", "/v1/sessions/none/steps", "/v1/sessions", "/v1/policies"):
        body = {f"f{i}": 0 for i in range(3000)}
        answer = client.post(path, json=body)
        assert answer.status_code == 422, path
        assert len(answer.json().get("errors", [answer.json()])) == 1, path
        assert "/v1" not in answer.json()["expected"]
    many = client.post("/v1/specs/validate", json={f"f{i}": 0 for i in range(60_000)})
    assert (many.status_code, many.json()["path"]) == (422, "body")


def test_lists_do_not_hold_regions(client: httpx.Client, begin: Any) -> None:
    session = begin()
    assert session["spec"]["regions"]
    listed = client.get("/v1/policies", params={"limit": 1000}).json()["items"]
    assert any(item["id"] in session["policy_ids"] for item in listed)
    sessions = client.get("/v1/sessions", params={"limit": 1000}).json()["items"]
    assert any(item["id"] == session["id"] for item in sessions)
    for item in [*listed, *sessions]:
        assert "regions" not in item["spec"]
        assert item["spec"]["formula"]


def test_a_policy_keeps_only_the_regions_that_its_formula_names(client: httpx.Client, tmp_path: Path) -> None:
    """F2: the others would go into every session."""
    from tests.service.world import SPEC, grid_json, policy_files

    client.post("/v1/maps", json=grid_json())
    other = {"type": "polygon", "vertices": [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]}
    spec = {**SPEC, "regions": {**SPEC["regions"], **{f"Other{i}": other for i in range(20)}}}
    plain = client.post("/v1/policies", files=policy_files(seed=77)).json()
    sent = client.post("/v1/policies", files=policy_files(spec, seed=77)).json()
    assert sent["id"] == plain["id"]
    assert list(client.get(f"/v1/policies/{sent['id']}").json()["spec"]["regions"]) == ["Goal"]
