"""Servers that come and go behind a balancer, and the stores that several of them share."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from specshield.errors import InputError, SpecshieldError
from specshield.service.leaving import ECHO
from specshield.service.library.files import Kept
from specshield.service.settings import Settings
from specshield.service.storage.connect import connect
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.marker import KEY, check_files, stay_marked
from tests.service.world import LOGITS, START, ahead, grid_json, send_policy
from tests.serving import HUNG, RunningServer, children, command_line, run_specshield, serving, wait_for


@pytest.mark.parametrize("options", [(), ("--workers", "2")], ids=["one process", "two processes"])
def test_a_server_that_is_told_to_stop_says_so_first_and_goes_on_meanwhile(tmp_path, options):
    with (
        serving(tmp_path, *options, SPECSHIELD_DRAIN="3600") as server,
        httpx.Client(base_url=server.url, verify=False, timeout=None) as client,
    ):
        assert client.post("/v1/maps", json=grid_json()).status_code == 201
        policy = send_policy(client)
        session = client.post("/v1/sessions", json={"policy_id": policy["id"], "initial_pose": START}).json()
        tell_all(server)  # as systemd does; a supervisor then tells its workers once more

        def stopping() -> bool:
            ready = client.get("/readyz")
            return ready.status_code == 503 and ready.json()["type"] == "stopping"

        wait_for(stopping)
        body = {"t": 0, "poses": ahead(0)[-1:], "logits": LOGITS}
        assert client.post(f"/v1/sessions/{session['id']}/steps", json=body).status_code == 200
        assert server.process.poll() is None
        time.sleep(ECHO)
        tell_all(server)  # a second time: it stops at once
        assert server.process.wait(HUNG) == 0


def tell_all(server: RunningServer) -> None:
    for process in {server.process.pid, *processes(server)}:
        os.kill(process, signal.SIGTERM)


def processes(server: RunningServer) -> list[int]:
    """Those that serve: it alone, or its children."""
    serve = [pid for pid in children(server.process.pid) if "spawn_main" in command_line(pid)]
    return serve or [server.process.pid]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_server_that_is_told_to_stop_does_so_when_its_time_is_over(tmp_path, number):
    if signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip("the tests run under nohup, and so would the server: it ignores SIGHUP then")
    with serving(tmp_path, SPECSHIELD_DRAIN="1") as server:
        told = time.monotonic()
        os.kill(server.process.pid, number)
        assert server.process.wait(HUNG) == 0
        assert time.monotonic() - told >= 1.0


def test_servers_of_one_store_that_keep_their_files_apart_do_not_start(tmp_path):
    embedded = EmbeddedStore(tmp_path)
    embedded.join()
    shared, other = str(tmp_path / "shared"), str(tmp_path / "other")
    with pytest.raises(SpecshieldError):  # a first start that could not write its files binds nobody
        check_files(embedded.url, "/proc", 10.0)
    with ThreadPoolExecutor(8) as servers:  # that all start for the first time
        list(servers.map(lambda _: check_files(embedded.url, shared, 10.0), range(8)))
    check_files(embedded.url, shared, 10.0)

    def told(*words: str) -> subprocess.CompletedProcess[str]:
        return run_specshield(*words, REDIS_URL=embedded.url, SPECSHIELD_DATA_DIR=other)

    with ThreadPoolExecutor(2) as several:  # each waits for 5 s, in case that the file is only just written
        started = [several.submit(told, *words) for words in (("serve", "--port", "0"), ("worker",))]
        with pytest.raises(InputError, match="SPECSHIELD_DATA_URL"):
            check_files(embedded.url, other, 10.0)
    for each in started:
        done = each.result()
        assert done.returncode == 2
        assert len(done.stderr.strip().splitlines()) == 1
        assert "elsewhere than in" in done.stderr
    embedded.leave()
    again = {"SPECSHIELD_DATA_URL": shared, "SPECSHIELD_LOG_FORMAT": "json"}
    with serving(tmp_path / "another-store", **again) as server:  # may be right: the former one may be lost
        lines = [json.loads(line) for line in server.log.read_text().splitlines()]
    (told,) = (line["message"] for line in lines if line["level"] == "warning")
    assert "the store does not know the files" in told


def test_a_store_that_was_emptied_gets_its_name_back_from_a_server_that_runs(tmp_path):
    embedded, place = EmbeddedStore(tmp_path), str(tmp_path / "files")
    embedded.join()

    async def scene():
        async with connect(embedded.url) as store:
            mark = await store.get(KEY)
            running = asyncio.create_task(stay_marked(embedded.url, place, 60.0, every=0.01))
            await store.flushall()
            while await store.get(KEY) != mark:
                await asyncio.sleep(0.01)
            running.cancel()

    check_files(embedded.url, place, 60.0)
    asyncio.run(scene())
    embedded.leave()


def kept(tmp_path: Path, name: str) -> Kept:
    """The policies of a server of this name, which are behind a URL."""
    return Kept(Settings(data_dir=tmp_path / name, data_url=f"memory://{tmp_path.name}"), "policies")


def test_what_one_server_keeps_behind_a_url_another_finds_and_loads_from_its_own_copy(tmp_path):
    here, there, id = kept(tmp_path, "one"), kept(tmp_path, "other"), "a" * 64
    assert there.find(id, "policy.json") is None
    here.write(id, {"policy.json": b"{}"})
    assert there.find(id, "policy.json") == {}
    assert there.find(id, "card.json") is None
    here.write(id, {"card.json": b"{}", "policy.safetensors": b"weights"})
    assert there.find(id, "card.json") == {}
    assert there.weight(id) == len(b"{}{}weights")
    for each, name in ((here, "one"), (there, "other")):
        copy = each.file(id, "policy.safetensors")
        assert copy == tmp_path / name / "copies" / "policies" / id / "policy.safetensors"
        assert copy.read_bytes() == b"weights"
    there.remove(id)
    assert not (there.root / id).exists()
    assert here.find(id, "policy.json") is None
    assert not (here.root / id).exists(), "what is made anew under this id has other weights"
    assert not here.file(id, "policy.safetensors").exists()


def test_a_copy_that_several_fetch_at_once_is_whole(tmp_path):
    here, there = kept(tmp_path, "one"), kept(tmp_path, "other")
    weights, ids = bytes(1 << 20), [f"{number:064x}" for number in range(20)]
    for id in ids:
        here.write(id, {"policy.json": b"{}", "policy.safetensors": weights})

    def fetched(id: str) -> bytes:
        assert there.find(id, "policy.json") == {}
        return there.file(id, "policy.safetensors").read_bytes()

    with ThreadPoolExecutor(6) as several:
        asked = [several.submit(fetched, id) for id in ids for _ in range(3)]
        assert all(each.result() == weights for each in asked)
    assert not list(there.root.glob("*/.draft-*"))


@pytest.mark.parametrize("behind", [True, False], ids=["a URL", "a folder"])
def test_what_is_not_written_or_removed_to_the_end_is_not_there(tmp_path, monkeypatch, behind):
    each = kept(tmp_path, "one") if behind else Kept(Settings(data_dir=tmp_path), "policies")
    files = {"card.json": b"{}", "policy.json": b"{}", "policy.safetensors": b"weights"}
    write, id = each._objects.write, "a" * 64

    def killed_after(most: int) -> None:
        written = iter(range(most))
        monkeypatch.setattr(each._objects, "write", lambda *file: (next(written), write(*file)))
        with pytest.raises(StopIteration):
            each.write(id, files)

    for most in range(len(files)):
        killed_after(most)
        assert each.find(id, "policy.json") is None
        assert (each.find(id, "card.json") is None) == (most < 2), "the weights come before the card"
    monkeypatch.undo()
    each.write(id, files)
    assert each.find(id, "policy.json") == {}
    remove = each._objects.remove
    monkeypatch.setattr(each._objects, "remove", lambda path: (remove(path), 1 / 0))
    with pytest.raises(ZeroDivisionError):
        each.remove(id)
    assert each.find(id, "policy.json") is None
    monkeypatch.undo()
    each.remove(id)
    assert each.weight(id) == 0
