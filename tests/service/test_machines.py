"""Servers that come and go behind a balancer, and the stores that several of them share."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from specshield.errors import InputError
from specshield.service.library import files
from specshield.service.settings import Settings
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.marker import check_files
from tests.service.world import LOGITS, START, ahead, grid_json, send_policy
from tests.serving import HUNG, RunningServer, children, command_line, serving, wait_for


@pytest.mark.parametrize("options", [(), ("--workers", "2")], ids=["one process", "two processes"])
def test_a_server_that_is_told_to_stop_says_so_first_and_goes_on_meanwhile(tmp_path, options):
    with (
        serving(tmp_path, *options, SPECSHIELD_DRAIN="3600") as server,
        httpx.Client(base_url=server.url, verify=False, timeout=None) as client,
    ):
        # The process that this connection leads to, which need not be the one that was ready first.
        wait_for(lambda: client.get("/readyz").status_code == 200)
        assert client.post("/v1/maps", json=grid_json()).status_code == 201
        policy = send_policy(client)
        session = client.post("/v1/sessions", json={"policy_id": policy["id"], "initial_pose": START}).json()
        os.kill(server.process.pid, signal.SIGTERM)

        def stopping() -> bool:
            ready = client.get("/readyz")
            return ready.status_code == 503 and ready.json()["type"] == "stopping"

        wait_for(stopping)
        body = {"t": 0, "poses": ahead(0)[-1:], "logits": LOGITS}
        assert client.post(f"/v1/sessions/{session['id']}/steps", json=body).status_code == 200
        assert server.process.poll() is None
        for process in processes(server):  # a second time: it stops at once
            os.kill(process, signal.SIGTERM)
        assert server.process.wait(HUNG) == 0


def processes(server: RunningServer) -> list[int]:
    """Those that serve: it alone, or its children."""
    serve = [pid for pid in children(server.process.pid) if "spawn_main" in command_line(pid)]
    return serve or [server.process.pid]


def test_a_server_that_is_told_to_stop_does_so_when_its_time_is_over(tmp_path):
    with serving(tmp_path, SPECSHIELD_DRAIN="1") as server:
        told = time.monotonic()
        os.kill(server.process.pid, signal.SIGTERM)
        assert server.process.wait(HUNG) == 0
        assert time.monotonic() - told >= 1.0


def test_servers_of_one_store_that_keep_their_files_apart_do_not_start(tmp_path):
    embedded = EmbeddedStore(tmp_path)
    embedded.join()
    shared, other = str(tmp_path / "shared"), str(tmp_path / "other")
    with ThreadPoolExecutor(8) as servers:  # that all start for the first time
        list(servers.map(lambda _: check_files(embedded.url, shared, 10.0), range(8)))
    check_files(embedded.url, shared, 10.0)
    with pytest.raises(InputError, match="SPECSHIELD_DATA_URL"):
        check_files(embedded.url, other, 10.0)
    for command in ("serve", "worker"):
        done = subprocess.run(
            [sys.executable, "-m", "specshield.cli", command],
            env={**os.environ, "REDIS_URL": embedded.url, "SPECSHIELD_DATA_DIR": other},
            capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 1
        assert len(done.stderr.strip().splitlines()) == 1
        assert "elsewhere than in" in done.stderr
    embedded.leave()


def test_what_one_server_keeps_behind_a_url_another_finds_and_loads_from_its_own_copy(tmp_path):
    def settings(name: str) -> Settings:
        nothing = tmp_path / "nothing"
        nothing.mkdir(exist_ok=True)
        return Settings(
            data_dir=tmp_path / name,
            data_url=f"memory://{tmp_path.name}",
            maps_dir=nothing,
            models_dir=nothing,
        )

    one, other = settings("one"), settings("other")
    here, there = (files.kept(each, "policies") / ("a" * 64) for each in (one, other))
    assert not files.there(there)
    files.write_folder(here, {"policy.json": b"{}"})
    assert files.there(there)
    assert not (there / "card.json").exists()
    files.write_file(here / "policy.safetensors", b"weights")
    files.write_file(here / "card.json", b"{}")
    assert files.there(there)
    assert (there / "policy.safetensors").read_bytes() == b"weights"
    files.remove_folder(there)
    assert not files.there(here)


def test_a_copy_that_several_fetch_at_once_is_whole(tmp_path):
    def folders(name: str) -> Path:
        nothing = tmp_path / "nothing"
        nothing.mkdir(exist_ok=True)
        settings = {"data_url": f"memory://{tmp_path.name}", "maps_dir": nothing, "models_dir": nothing}
        return files.kept(Settings(data_dir=tmp_path / name, **settings), "policies")

    here, there = folders("one"), folders("other")
    weights, ids = bytes(1 << 20), [f"{number:064x}" for number in range(20)]
    for id in ids:
        files.write_folder(here / id, {"policy.json": b"{}", "policy.safetensors": weights})

    def fetched(id: str, *names: str) -> bytes:
        assert files.there(there / id, *names)
        assert files.there(there / id)
        return (there / id / "policy.safetensors").read_bytes()

    with ThreadPoolExecutor(6) as several:
        asked = [several.submit(fetched, id, *names) for id in ids for names in ((), ("policy.json",), ())]
        assert all(each.result() == weights for each in asked)
    assert not list(there.glob("*/.draft-*"))
