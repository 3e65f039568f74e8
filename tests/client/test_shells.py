"""Both shells over httpx: how a network fails, what goes over the wire, and that they mirror each other."""

import asyncio
import inspect
import json
import socket
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import httpx
import pytest
from client_script import SESSION

import specshield.client
from specshield import errors
from specshield.client import AsyncShieldClient, ShieldClient, aio, sync

NO_NAME = f"http://{'a' * 64}.test:1"  # a part of a name has 63 characters at most
SPEC = {"formula": "F[0,3] a", "horizon": 3, "names": ["a"]}


@pytest.fixture(params=["sync", "async"])
def use(request):
    """use(handler or base_url, action): what `action(client)` gives through the one shell or the other."""

    def blocking(client, action):
        with client:
            result = action(client)
            return list(result) if inspect.isgenerator(result) else result

    async def awaiting(client, action):
        async with client:
            result = action(client)
            return await result if inspect.isawaitable(result) else [item async for item in result]

    def use(server, action, **options):
        if callable(server):
            options["transport"] = httpx.MockTransport(server)
            server = "http://robot.test/prefix"
        if request.param == "sync":
            return blocking(ShieldClient(server, **options), action)
        return asyncio.run(awaiting(AsyncShieldClient(server, **options), action))

    return use


def validate(client):
    return client.specs.validate("F[0,3] a")


def failing(*failures, then=SPEC):
    """A network on which the first requests go wrong."""
    script, seen = list(failures), []

    def handler(request):
        seen.append(request)
        fault = script.pop(0) if script else None
        if isinstance(fault, Exception):
            raise fault
        return httpx.Response(200 if fault is None else fault, json=then)

    return handler, seen


def test_a_session_may_begin_at_a_pose_that_can_be_gone_through_once(use):
    handler, _ = failing(then=SESSION)
    pose = iter([1, 2, 0.5])
    session = use(handler, lambda client: client.sessions.create(policy_id="p", initial_pose=pose))
    assert session._poses == {0: (1.0, 2.0, 0.5)}


@pytest.mark.parametrize(
    "fault",
    [
        httpx.ConnectError("refused"),
        httpx.ReadTimeout(""),
        httpx.RemoteProtocolError("Server disconnected"),
        httpx.ReadError(""),
        502,
        503,
        504,
    ],
)
def test_a_passing_failure_is_not_noticed(use, fault):
    handler, seen = failing(fault, fault)
    assert use(handler, validate).horizon == 3
    assert len(seen) == 3
    assert seen[0].content == seen[2].content


@pytest.mark.parametrize(
    ("fault", "cls"),
    [
        (httpx.ReadTimeout(""), errors.TransportTimeout),
        (httpx.ConnectError("refused"), errors.TransportError),
    ],
)
def test_a_lasting_failure_is_a_transport_error_with_its_cause(use, fault, cls):
    handler, seen = failing(*[fault] * 6)
    with pytest.raises(errors.TransportError) as caught:
        use(handler, validate)
    assert type(caught.value) is cls
    assert caught.value.__cause__ is fault
    assert "POST http://robot.test/prefix/v1/specs/validate" in caught.value.message
    assert len(seen) == 6


def test_a_server_that_never_answers_costs_a_bounded_time(use):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(errors.TransportTimeout) as caught:
            use(url, validate, timeout=0.1)
        # They begin after 0, 0.15 and 0.35 s; a fourth would begin after 0.65 s, and four timeouts are 0.4 s.
        # Fewer are made where a busy machine has used up that time before.
        assert 1 <= caught.value.details["tries"] <= 3


def test_a_closed_port_is_a_transport_error(use):
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"http://127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(errors.TransportError, match=url):
        use(url, validate)


def test_a_server_without_tls_is_told(use, server):
    with pytest.raises(errors.TransportError, match=r"http:// in place of https:// for a server without TLS"):
        use(server.url.replace("http://", "https://"), validate, timeout=60.0)


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_host_that_no_name_can_be_is_a_transport_error(use):
    with pytest.raises(errors.TransportError):
        use(NO_NAME, validate, timeout=60.0)


@pytest.mark.parametrize(
    "url", ["127.0.0.1:8000", "localhost", "http://", "ftp://robot", "http://a:b", "http://a:99999", "", None]
)
def test_an_address_that_is_none_is_refused_at_once(use, url):
    with pytest.raises(errors.InputError) as caught:
        use(url, validate)
    assert (caught.value.path, caught.value.got) == ("base_url", url)


@pytest.mark.parametrize("key", ["ключ", "abc\n", " abc", "", b"abc"])
def test_a_key_that_cannot_be_sent_is_refused_at_once(use, key):
    handler, seen = failing()
    with pytest.raises(errors.InputError) as caught:
        use(handler, validate, api_key=key)
    assert caught.value.path == "api_key"
    assert seen == []


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("nan"), float("inf"), None, "5"])
@pytest.mark.parametrize("client", [ShieldClient, AsyncShieldClient])
def test_a_timeout_that_is_no_time_is_refused_at_once(client, timeout):
    with pytest.raises(errors.InputError) as caught:
        client("http://robot.test", timeout=timeout)
    assert caught.value.path == "timeout"


def test_a_timeout_may_be_longer_than_a_socket_takes():
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"http://127.0.0.1:{server.getsockname()[1]}"
    with ShieldClient(url, timeout=1e12) as client, pytest.raises(errors.TransportError, match="refused"):
        validate(client)


def test_a_closed_client_says_so():
    with ShieldClient("http://robot.test") as client:
        pass
    with pytest.raises(errors.TransportError, match="closed"):
        validate(client)

    async def after():
        async with AsyncShieldClient("http://robot.test") as client:
            pass
        await validate(client)

    with pytest.raises(errors.TransportError, match="closed"):
        asyncio.run(after())


def test_a_proxy_that_the_environment_names_is_used(use, monkeypatch):
    seen, answer = [], json.dumps(SPEC).encode()

    class Proxy(BaseHTTPRequestHandler):
        def do_POST(self):
            seen.append((self.path, self.headers["Proxy-Authorization"]))
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(200)
            self.send_header("Content-Length", str(len(answer)))
            self.end_headers()
            self.wfile.write(answer)

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Proxy) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setenv("http_proxy", f"http://me:secret@127.0.0.1:{server.server_port}")
        assert use("http://robot.test", validate, timeout=10.0).horizon == 3
        for here in ("127.0.0.1", "localhost"):  # which the proxy would take for itself
            assert use(f"http://{here}:{server.server_port}", validate, timeout=10.0).horizon == 3
        monkeypatch.setenv("no_proxy", "robot.test")
        with pytest.raises(errors.TransportError):
            use("http://robot.test", validate)
        server.shutdown()
    directly = [("/v1/specs/validate", None)] * 2
    assert seen == [("http://robot.test/v1/specs/validate", "Basic bWU6c2VjcmV0"), *directly]


def test_what_goes_over_the_wire(use):
    handler, seen = failing()
    use(handler, validate, api_key="secret", timeout=0.25)
    (request,) = seen
    assert (request.method, str(request.url)) == ("POST", "http://robot.test/prefix/v1/specs/validate")
    assert request.headers["authorization"] == "Bearer secret"
    assert request.headers["content-type"] == "application/json"
    assert json.loads(request.content) == {"formula": "F[0,3] a"}
    assert request.headers["accept-encoding"] == "identity"
    assert request.extensions["timeout"] == {"connect": 0.25, "read": 0.25, "write": 0.25, "pool": 0.25}


def test_without_a_key_nothing_is_claimed_and_what_prepares_gets_time(use):
    handler, seen = failing(then=SESSION)
    use(handler, lambda client: client.sessions.create(policy_id="p", initial_pose=(0, 0, 0)))
    assert "authorization" not in seen[0].headers
    assert seen[0].extensions["timeout"] == {"connect": 0.5, "read": 30.0, "write": 30.0, "pool": 30.0}


def test_lists_follow_their_pages(use):
    def handler(request):
        cursor = request.url.params.get("cursor")
        item = {**SESSION, "id": cursor or "first"}
        return httpx.Response(
            200, json={"items": [item], "next": {None: "second", "second": "third"}.get(cursor)}
        )

    sessions = use(handler, lambda client: client.sessions.list())
    assert [info.id for info in sessions] == ["first", "second", "third"]


class Closing:
    """A server that creates sessions and answers `close` as told; counts what comes."""

    def __init__(self, answer):
        self.answer, self.closes = answer, 0

    def __call__(self, request):
        if not request.url.path.endswith("/close"):
            return httpx.Response(201, json=SESSION)
        self.closes += 1
        if self.answer is None:
            raise httpx.ReadTimeout("")
        status, body = self.answer
        kind = "application/json" if status == 200 else "application/problem+json"
        return httpx.Response(status, content=json.dumps(body), headers={"content-type": kind})


CLOSED = (200, {"spec_status": "pending", "robustness_bounds": [None, 0.5]})
GONE = (404, {"type": "not-found", "detail": "gone"})
LOST = None


def in_session(use, server, block):
    """Run `block(session)` inside a session's `with`, in either shell."""
    begin = {"policy_id": "p", "initial_pose": (0, 0, 0)}

    def action(client):
        if isinstance(client, ShieldClient):
            with client.sessions.create(**begin) as session:
                return block(session)

        async def run():
            async with await client.sessions.create(**begin) as session:
                result = block(session)
                return await result if inspect.isawaitable(result) else result

        return run()

    return use(server, action, timeout=5.0)


def test_leaving_the_block_closes_the_session_once(use):
    server = Closing(CLOSED)
    assert in_session(use, server, lambda session: session.finished) is False
    assert server.closes == 1
    verdict = in_session(use, server, lambda session: session.close((1, 0, 0)))
    assert verdict.robustness_bounds == (None, 0.5)
    assert server.closes == 2, "closed in the block: not again at its end"


@pytest.mark.parametrize("answer", [CLOSED, LOST, GONE])
def test_an_error_of_the_block_is_never_masked(use, answer):
    server = Closing(answer)

    def block(session):
        raise KeyError("the robot's own")

    with pytest.raises(KeyError, match="the robot's own"):
        in_session(use, server, block)
    assert server.closes == 1


def test_a_close_that_fails_is_said_unless_the_session_is_gone(use):
    with pytest.raises(errors.TransportTimeout):
        in_session(use, Closing(LOST), lambda session: None)
    assert in_session(use, Closing(GONE), lambda session: session.id) == "s"


PAIRS = ["ShieldClient", "Session"]  # what else there is, both have in common


@pytest.mark.parametrize("name", PAIRS)
def test_the_shells_mirror_each_other(name):
    def surface(cls):
        return {
            key: str(inspect.signature(member)).replace("Async", "")
            for key, member in inspect.getmembers(cls, inspect.isfunction)
            if not key.startswith("_") or key == "__init__"
        }

    assert surface(getattr(sync, name)) == surface(getattr(aio, f"Async{name}"))


@pytest.mark.parametrize("client", [ShieldClient, AsyncShieldClient])
def test_help_says_that_sessions_are_given_and_not_what_is_known_of_one(client):
    sessions = client("http://127.0.0.1:1").sessions
    for method in (sessions.create, sessions.get):
        assert inspect.signature(method).return_annotation == "Session"
    assert sessions.list.__name__ == "list"


def test_the_public_names():
    assert specshield.client.__all__ == [
        "AsyncSession",
        "AsyncShieldClient",
        "Decision",
        "Explanation",
        "Learned",
        "LocalDecision",
        "Map",
        "Policy",
        "Residual",
        "Session",
        "SessionInfo",
        "ShieldClient",
        "Spec",
        "TrajectoryItem",
        "Verdict",
    ]
    assert all(hasattr(specshield.client, name) for name in specshield.client.__all__)
    public = {name for name in vars(sync.Session) | vars(sync.SessionState) if not name.startswith("_")}
    assert public == {
        "step",
        "record",
        "unsent",
        "trajectory",
        "learned",
        "save_record",
        "events",
        "close",
        "switch",
        "id",
        "rule_at",
    }


def test_importing_the_client_brings_httpx_and_nothing_heavy():
    heavy = ["torch", "fastapi", "numpy", "pydantic", "numba", "redis", "scipy", "starlette", "typer"]
    code = (
        "import sys; from specshield.client import ShieldClient;"
        f"print([name for name in {heavy} if name in sys.modules],"
        "sorted(name for name in sys.modules if name.startswith('specshield.') and '.client' not in name))"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.strip() == "[] ['specshield.errors']"
