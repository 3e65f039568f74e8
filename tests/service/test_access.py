"""Who may use a server: addresses, pages and keys."""

import http.client
import json

import pytest

from specshield.errors import InputError
from specshield.service.access.site import is_loopback, names_server
from specshield.service.settings import read_settings
from tests.service.test_bad_input import PGM, YAML, problem
from tests.service.world import grid_json
from tests.serving import run_specshield

ALLOWED = frozenset({"robots.example", "lab:8443"})


@pytest.mark.parametrize(
    ("host", "address", "named"),
    [
        ("127.0.0.1:8000", "127.0.0.1", True),
        ("localhost:8000", "127.0.0.1", True),
        ("[::1]:8000", "::1", True),
        ("localhost:8000", "::ffff:127.0.0.1", True),
        ("localhost:8001", "127.0.0.1", False),
        ("localhost", "127.0.0.1", False),
        ("evil.example:8000", "127.0.0.1", False),
        ("localhost.evil.example:8000", "127.0.0.1", False),
        ("10.0.0.5:8000", "127.0.0.1", False),
        ("robots.example", "127.0.0.1", True),
        ("robots.example:9", "127.0.0.1", True),
        ("lab:8443", "127.0.0.1", True),
        ("lab:8000", "127.0.0.1", False),
        ("10.0.0.5:8000", "10.0.0.5", True),  # a probe of a pod
        ("127.0.0.1:80", "172.17.0.2", True),  # a container's port on its host
        ("[fd00::5]:8000", "fd00::5", True),
        ("evil.example:8000", "10.0.0.5", False),
        ("10.0.0.5.evil.example:8000", "10.0.0.5", False),
        ("", "10.0.0.5", False),
        ("a@127.0.0.1:8000", "127.0.0.1", False),
        ("anything", "/run/specshield.sock", True),
    ],
)
def test_the_hosts_that_name_a_server(host, address, named):
    port = None if address.startswith("/") else 8000
    assert names_server(host, address, port, ALLOWED) is named


def test_the_addresses_that_only_this_machine_reaches():
    assert [name for name in ("127.0.0.1", "127.9.9.9", "::1", "localhost") if not is_loopback(name)] == []
    assert [name for name in ("0.0.0.0", "::", "10.0.0.5", "robots.example") if is_loopback(name)] == []


@pytest.fixture
def kept(client):
    """What is there stays as it is."""

    def show():
        return [client.get(f"/v1/{what}").json() for what in ("maps", "policies", "sessions")]

    before = show()
    yield
    assert show() == before


PATHS = ("/livez", "/readyz", "/metrics", "/docs", "/v1/maps", "/v1/sessions/x", "/nothing")


@pytest.mark.parametrize("path", PATHS)
def test_another_host_is_misdirected(client, path):
    answer = client.get(path, headers={"Host": f"evil.example:{client.base_url.port}"})
    problem(answer, 421, "misdirected-request", "Host")


def test_a_request_without_a_host_is_misdirected(client):
    connection = http.client.HTTPConnection("127.0.0.1", client.base_url.port)
    connection.putrequest("GET", "/livez", skip_host=True)
    connection.endheaders()
    assert connection.getresponse().status in (400, 421)
    connection.close()


@pytest.mark.parametrize("name", ["Host", "Origin", "Authorization", "Content-Type"])
def test_a_header_that_says_who_may_do_what_comes_once(client, name):
    """Else a proxy may judge by one of the two, and the server by the other."""
    port = client.base_url.port
    connection = http.client.HTTPConnection("127.0.0.1", port)
    connection.putrequest("GET", "/v1/maps", skip_host=True)
    for header in {"Host", name}:
        for _ in range(1 + (header == name)):
            connection.putheader(header, f"127.0.0.1:{port}")
    connection.endheaders()
    answer = connection.getresponse()
    assert (answer.status, json.load(answer)["path"]) == (422, name)
    connection.close()


GRID = {"content": json.dumps(grid_json()).replace("0.1", "0.3")}
FILES = {"files": {"metadata": ("map.yaml", YAML.replace(b"0.05", b"0.07")), "image": ("map.pgm", PGM)}}


@pytest.mark.parametrize("body", [GRID, FILES], ids=["json", "multipart"])
@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "http://127.0.0.1:1"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"},
    ],
    ids=lambda headers: next(iter(headers.values())),
)
def test_a_page_of_another_origin_sends_nothing(client, kept, body, headers):
    if "content" in body:
        headers = {**headers, "Content-Type": "application/json"}
    problem(client.post("/v1/maps", headers=headers, **body), 403, "cross-site", "Origin")


def test_a_page_of_another_origin_reads_and_deletes_nothing(client, kept):
    origin = {"Origin": "http://evil.example"}
    for method in ("GET", "DELETE", "OPTIONS", "HEAD"):
        assert client.request(method, "/v1/policies/case1", headers=origin).status_code == 403
    frame = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "iframe"}
    assert client.get("/docs", headers=frame).status_code == 403
    assert client.get("/docs", headers={**frame, "Sec-Fetch-Dest": "document"}).status_code == 200  # a link


def test_the_servers_own_pages_may(client):
    own = {"Origin": str(client.base_url).rstrip("/"), "Sec-Fetch-Site": "same-origin"}
    assert client.post("/v1/specs/validate", json={"formula": "x > 0"}, headers=own).status_code == 200


@pytest.mark.parametrize("declared", ["text/plain", "application/x-www-form-urlencoded", "", "jsonish"])
def test_a_body_that_is_not_said_to_be_json(client, kept, declared):
    for path in ("/v1/maps", "/v1/policies", "/v1/sessions", "/v1/specs/validate"):
        answer = client.post(path, content=GRID["content"], headers={"Content-Type": declared})
        told = problem(answer, 415, "unsupported-media-type", "Content-Type")
        assert "application/json" in told["expected"]


def test_types_that_a_route_does_not_take(client, kept):
    for declared in ("multipart/form-data; boundary=x", "application/msgpack"):
        answer = client.post("/v1/specs/validate", content=b"x", headers={"Content-Type": declared})
        problem(answer, 415, "unsupported-media-type", "Content-Type")
    asked = {"url": "/v1/specs/validate", "json": {"formula": "x > 0"}}
    assert client.post(**asked, headers={"Content-Encoding": "identity"}).status_code == 200
    answer = client.post(**asked, headers={"Content-Encoding": "gzip"})
    problem(answer, 415, "unsupported-media-type", "Content-Encoding")


def serve(*options, **environment):
    """What a server that must not start says."""
    done = run_specshield("serve", "--port", "0", *options, **environment)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    return done.stderr


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_beyond_this_machine_a_key_is_needed(tmp_path, host):
    said = serve("--host", host, SPECSHIELD_DATA_DIR=str(tmp_path))
    assert "SPECSHIELD_API_KEY" in said
    assert "--insecure" in said


@pytest.mark.parametrize("key", ["", " ", "käse", "a\tb", "trailing "])
def test_keys_that_no_header_carries(monkeypatch, key):
    monkeypatch.setenv("SPECSHIELD_API_KEY", key)
    with pytest.raises(InputError) as caught:
        read_settings()
    assert caught.value.path == "SPECSHIELD_API_KEY"
    assert not key.strip() or key.strip() not in str(caught.value)
