"""What an operator sees: metrics, the log, the dashboard."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import httpx
import psutil
import pytest
from prometheus_client.parser import text_string_to_metric_families

from specshield import __version__
from specshield.service.leaving import COUNTS, folder_of_counts
from tests.serving import RunningServer, children, command_line, runs, serving, wait_for
from tests.stores import store_pid

START, LOGITS = [4.5, 5.0, 0.0], [0.0] * 20
SECRET = "a-key-that-no-line-may-hold"
TRACE = "0af7651916cd43dd8448eb211c80319c"
DASHBOARD = Path(__file__).parents[2] / "docker" / "grafana" / "specshield.json"


def samples(server: RunningServer, **headers: str) -> dict[tuple[str, ...], float]:
    """Every sample of /metrics by its name and its labels' values."""
    text = httpx.get(f"{server.url}/metrics", headers=headers, timeout=None, verify=False).text
    families = text_string_to_metric_families(text)
    return {(s.name, *s.labels.values()): s.value for family in families for s in family.samples}


def begin(server: RunningServer, **headers: str) -> str:
    body = {"policy_id": "case1", "initial_pose": START}
    response = httpx.post(f"{server.url}/v1/sessions", json=body, headers=headers, timeout=None, verify=False)
    assert response.status_code == 201, response.text
    return str(response.json()["id"])


def decide(server: RunningServer, session: str, t: int = 0, **fields: object) -> httpx.Response:
    body = {"t": t, "poses": [START] * (t + 1), "logits": LOGITS, **fields}
    return httpx.post(f"{server.url}/v1/sessions/{session}/steps", json=body, timeout=None, verify=False)


def ready(server: RunningServer, processes: int) -> None:
    """However long it takes until that many server processes have said so."""
    while server.log.read_text().count('"ready"') < processes:
        assert server.process.poll() is None
        time.sleep(0.05)


def workers(server: RunningServer) -> list[int]:
    return [pid for pid in children(server.process.pid) if "spawn_main" in command_line(pid)]


def test_what_several_processes_count_is_true_and_outlives_each_of_them_but_not_the_server(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # as that of the server
    with serving(tmp_path, "--workers", "2", SPECSHIELD_LOG_FORMAT="json") as server:
        ready(server, 2)

        def steps(n: int) -> None:
            for _ in range(n):
                session = begin(server)
                assert decide(server, session).status_code == 200
                assert decide(server, session).status_code == 200  # a replay
                assert decide(server, session, 3).status_code == 200  # two steps told later
                assert decide(server, session, 9, poses=[START]).json()["type"] == "history-gap"

        def counted(n: int) -> None:
            found = samples(server)
            modes = [value for key, value in found.items() if key[0] == "specshield_decisions_total"]
            assert sum(modes) == 2 * n
            assert found["specshield_replays_total",] == n
            assert found["specshield_steps_passed_over_total",] == 2 * n
            assert found["specshield_refusals_total", "history-gap"] == n
            for part in ("rollout", "store"):
                assert found["specshield_step_part_seconds_count", part] == 2 * n
                buckets = [
                    found["specshield_step_part_seconds_bucket", le, part] for le in ("0.0001", "+Inf")
                ]
                assert 0 <= buckets[0] <= buckets[1] == 2 * n
                assert found["specshield_step_part_seconds_sum", part] > 0
            assert found["specshield_feasible_mass_ratio_count",] == 2 * n
            route = ("POST", "/v1/sessions/{session_id}/steps")
            assert found[("specshield_requests_total", *route, "200")] == 3 * n
            assert found[("specshield_request_seconds_count", *route)] == 4 * n
            assert (found["specshield_store_up",], found["specshield_build_info", __version__]) == (1, 1)
            assert found["specshield_store_bytes",] > 0
            assert found["specshield_jobs", "dqn", "queued"] == 0

        steps(6)
        counted(6)
        with ExitStack() as watched:
            url = f"{server.url}/v1/sessions/{begin(server)}/events"
            for _ in range(3):
                watched.enter_context(httpx.stream("GET", url, timeout=None, verify=False))
            assert samples(server)["specshield_watchers",] == 3
            busier = max(workers(server), key=lambda pid: len(psutil.Process(pid).net_connections()))
            os.kill(busier, signal.SIGKILL)
            ready(server, 3)
            assert samples(server)["specshield_watchers",] <= 1  # its streams are closed
        counted(6)
        steps(6)
        counted(12)
        wait_for(lambda: samples(server)["specshield_sessions",] == 13)

        session = begin(server)
        assert len({decide(server, session).content for _ in range(8)}) == 1  # whichever answers
        pids = [store_pid(tmp_path), *children(server.process.pid)]
        assert len(pids) >= 3
        with folder_of_counts() as own:
            (folder,) = {str(each) for each in tmp_path.glob(f"{COUNTS}*")} - {own}  # that of the server
            server.kill()
            wait_for(lambda: not any(map(runs, pids)))
            with folder_of_counts():
                assert (Path(own).exists(), Path(folder).exists()) == (True, False)
        assert not list(tmp_path.glob(f"{COUNTS}*"))


def test_a_line_tells_who_asked_and_never_what_must_not_be_told(tmp_path):
    settings = {"SPECSHIELD_LOG_FORMAT": "json", "SPECSHIELD_LOG_LEVEL": "debug"}
    with serving(tmp_path, **settings, SPECSHIELD_API_KEY=SECRET) as server:
        key = {"Authorization": f"Bearer {SECRET}"}
        asked = {**key, "X-Request-Id": "asked-1", "traceparent": f"00-{TRACE}-b7ad6b7169203331-01"}
        with httpx.Client(base_url=server.url, verify=False, timeout=None, headers=asked) as client:
            session = begin(server, **asked)
            path = f"/v1/sessions/{session}"
            body = {"t": 0, "poses": [START], "logits": [0.123454321] * 20}
            assert client.post(f"{path}/steps", json=body).status_code == 200
            assert client.post(f"{path}/steps", json={**body, "t": -1}).status_code == 422
            assert client.get("/v1/sessions/a%0aINFO: forged").status_code == 422
            assert client.get(path, headers={"Authorization": "Bearer wrong-key"}).status_code == 401
            assert client.post(f"{path}/close", json={}).status_code == 200
            assert client.delete(path).status_code == 204
        text = server.log.read_text()
        assert SECRET not in text
        assert "wrong-key" not in text
        assert "0.123454321" not in text
        lines = [json.loads(line) for line in text.splitlines()]
        told = [line for line in lines if line.get("request_id") == "asked-1"]
        assert [line["message"] for line in told] == [
            "session begun", "decided", "refused", "refused", "refused", "session closed", "session erased",
        ]  # fmt: skip
        assert {line["trace_id"] for line in told} == {TRACE}
        assert {line["session_id"] for line in told if line["message"] != "refused"} == {session}
        decided = told[1]
        assert (decided["level"], decided["t"], decided["mode"]) == ("debug", 0, "shaped")
        assert 0.0 < decided["feasible_mass"] <= 1.0
        assert decided["rollout_ms"] > 0 < decided["store_ms"]
        assert [line["type"] for line in told[2:5]] == ["invalid-input", "invalid-input", "unauthorized"]


def test_lines_for_people_say_the_same_and_stay_one_line_each(tmp_path):
    with serving(tmp_path) as server:
        session = begin(server, **{"X-Request-Id": "r-1"})
        assert decide(server, session).status_code == 200
        assert (
            httpx.get(
                f"{server.url}/v1/sessions/a%0aINFO:     forged", timeout=None, verify=False
            ).status_code
            == 422
        )
        text = server.log.read_text()
        assert re.search(rf"^INFO:     session begun  session_id={session} .*request_id=r-1$", text, re.M)
        assert "\nINFO:     forged" not in text
        assert "decided" not in text  # only at debug


def test_lines_of_the_processes_for_heavy_work_are_of_the_same_form(tmp_path):
    settings = {"SPECSHIELD_LOG_FORMAT": "json", "SPECSHIELD_MAX_HORIZON": "100"}  # case2 asks for more
    with serving(tmp_path, **settings) as server:
        body = {"map_id": "case1", "spec": {"formula": "F[0,60] Kitchen"}}
        assert (
            httpx.post(f"{server.url}/v1/policies", json=body, timeout=None, verify=False).status_code == 503
        )
        lines = [json.loads(line) for line in server.log.read_text().splitlines()]
    left_out = [line["message"] for line in lines if "case2 is left out" in line["message"]]
    assert len(left_out) == 2  # by the server, and by the process that read the request


def test_lines_of_other_packages_are_of_the_same_form():
    program = """
import logging.config
from rq.logutils import setup_loghandlers
from specshield.service.watch import logs

logging.config.dictConfig(logs.config("json", "info"))
setup_loghandlers("WARNING")  # as rq's worker does
logging.getLogger("rq.worker").warning("from rq")
logging.getLogger("asyncio").error("from asyncio")
"""
    ran = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    assert ran.stdout == ""  # all lines go to standard error
    assert [json.loads(line)["message"] for line in ran.stderr.splitlines()] == ["from rq", "from asyncio"]


def metrics_named(expression: str) -> set[str]:
    return set(re.findall(r"\bspecshield_\w+", expression))


@pytest.fixture(scope="module")
def dashboard() -> dict[str, object]:
    return json.loads(DASHBOARD.read_text())


def test_dashboard_and_page_name_the_metrics_that_are_told(server, dashboard):
    begin(server)
    httpx.get(f"{server.url}/v1/sessions/none", timeout=None, verify=False)
    told = {name for name, *_ in samples(server)}
    panels = [panel for panel in dashboard["panels"] if panel["type"] != "row"]
    expressions = [target["expr"] for panel in panels for target in panel["targets"]]
    assert len(expressions) >= 15
    asked = set().union(*map(metrics_named, expressions))
    ended = {"specshield_jobs_ended_total"}  # which is told once a job has ended
    assert asked <= told | ended
    page = (DASHBOARD.parents[2] / "docs" / "watch.md").read_text()
    rows = set(re.findall(r"^\| `(specshield_\w+)", page, re.M))
    families = {re.sub(r"_(bucket|count|sum)$", "", name) for name in told}
    assert rows - ended == families - ended
    for panel in panels:
        place = panel["gridPos"]
        assert 0 <= place["x"] < place["x"] + place["w"] <= 24
        assert panel["title"]
        assert panel["datasource"]["uid"] == "${datasource}"
