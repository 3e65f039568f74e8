"""What pages of other origins reach in a real browser: nothing. Needs Chromium on the machine."""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from PIL import Image

from tests.browsing import needs_chromium
from tests.serving import HUNG

pytestmark = needs_chromium
ATTACKS = """<!doctype html><body><iframe name="sink"></iframe><img src="/wait"><script>
const target = "%(target)s", told = {};
const grid = JSON.stringify(%(grid)s);
async function attack(name, path, options) {
  try {
    const answer = await fetch(target + path, options);
    told[name] = answer.type === "opaque" ? "opaque" : "read " + (await answer.text()).slice(0, 80);
  } catch (error) { told[name] = "failed"; }
}
function files() {
  const form = new FormData();
  form.append("metadata", new Blob([%(yaml)s]));
  form.append("image", new Blob(["P5\\n2 2\\n255\\n\\xfe"]));
  return form;
}
function socket() {
  return new Promise((done) => {
    const ws = new WebSocket(target.replace("http", "ws") + "/v1/sessions/robot/stream");
    ws.onopen = () => { told.socket = "open"; done(); };
    ws.onerror = () => { told.socket = "failed"; done(); };
  });
}
(async () => {
  const form = Object.assign(document.createElement("form"), {
    method: "POST", action: target + "/v1/maps", enctype: "text/plain", target: "sink"});
  const name = grid.slice(0, -1) + ',"x":"';
  form.append(Object.assign(document.createElement("input"), {name, value: '"}'}));
  document.body.append(form);
  form.submit();
  await attack("read", "/v1/maps", {});
  await attack("read opaque", "/v1/maps", {mode: "no-cors"});
  await attack("json", "/v1/maps", {
    method: "POST", body: grid, headers: {"Content-Type": "application/json"}});
  await attack("text", "/v1/maps", {method: "POST", body: grid, mode: "no-cors"});
  await attack("blob", "/v1/maps", {method: "POST", body: new Blob([grid]), mode: "no-cors"});
  await attack("files", "/v1/maps", {method: "POST", body: files(), mode: "no-cors"});
  await attack("delete", "/v1/sessions/robot", {method: "DELETE"});
  await socket();
  await fetch("/told", {method: "POST", body: JSON.stringify(told)});
})();
</script></body>"""


@pytest.fixture
def attacker(client):
    """attacker(target): the port of a page that attacks the target, and what it tells of that afterwards.

    The browser waits until a page is loaded. This one is once it has told.
    """
    from tests.service.test_bad_input import YAML
    from tests.service.world import grid_json

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            content = self.rfile.read(int(self.headers["Content-Length"]))
            self.server.told.update(json.loads(content))
            self.server.done.set()
            self.send_response(204)
            self.end_headers()

        def do_GET(self):
            if self.path == "/wait":
                self.server.done.wait(HUNG)
                self.send_response(204)
                self.end_headers()
                return
            grid = json.dumps({**grid_json(), "info": {**grid_json()["info"], "resolution": 0.77}})
            content = ATTACKS % {
                "target": self.server.target,
                "grid": grid,
                "yaml": json.dumps(YAML.decode()),
            }
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(content.encode())

        def log_message(self, *args):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()

        def serve(target):
            server.target, server.told, server.done = target, {}, threading.Event()
            return server.server_address[1], server.told

        yield serve
        server.shutdown()


@pytest.fixture
def kept(client, begin):
    """What is there stays as it is: a session of this name, and no map more."""
    begin(id="robot")

    def show():
        return [client.get(f"/v1/{what}", params={"limit": 1000}).json() for what in ("maps", "sessions")]

    before = show()
    yield
    assert show() == before
    assert client.delete("/v1/sessions/robot").status_code == 204


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "evil.example"])
def test_a_page_of_another_origin_makes_reads_and_deletes_nothing(client, kept, attacker, browse, host):
    """As evil.example, which is made to point here, the page asks under its own name: DNS rebinding."""
    port, told = attacker(f"http://{host}:{client.base_url.port}")
    with browse() as (page, _):
        page.goto(f"http://{host}:{port}/")
    assert len(told) == 8, told
    assert set(told.values()) <= {"failed", "opaque"}, told


def test_a_name_that_is_made_to_point_here_is_misdirected(client, browse):
    with browse() as (page, _):
        page.goto(f"http://evil.example:{client.base_url.port}/v1/maps")
        seen = page.content()
    assert "misdirected-request" in seen
    assert "case1" not in seen


def test_the_docs_work_without_the_internet_behind_a_proxy_with_a_path_of_its_own(client, browse, tmp_path):
    """A browser that reaches nothing but the server draws the page."""
    elsewhere = []

    def pass_on(route):
        _, there, path = route.request.url.partition("http://proxy.example/robots/")
        if not there:
            elsewhere.append(route.request.url)
        answer = client.get(f"/{path}")
        kind = answer.headers["content-type"]
        route.fulfill(status=answer.status_code, body=answer.content, headers={"content-type": kind})

    with browse() as (page, complaints):
        page.route("**", pass_on)
        page.goto("http://proxy.example/robots/docs")
        for shown in ("Decide one step", "Check a formula", "Send a map"):
            page.get_by_text(shown, exact=True).first.wait_for()
        assert "/v1/sessions/{session_id}/steps" in page.content().replace("\u200b", "")
        page.screenshot(path=tmp_path / "docs.png")
        page.get_by_text("Is it alive?").click()
        page.get_by_role("button", name="Execute").click()
        page.locator(".live-responses-table").wait_for()
        assert '"status": "ok"' in page.locator(".live-responses-table").inner_text()
    assert (elsewhere, complaints) == ([], [])
    drawn = np.asarray(Image.open(tmp_path / "docs.png").convert("L"))
    assert (drawn < 128).mean() > 0.005  # text
    assert len(np.unique(drawn)) > 50
