"""What has left the store for the archive: nothing is lost, doubled or brought back from the dead."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import redis

from specshield.errors import SessionDamaged, SessionExists, StoreError
from specshield.service.sessions.mover import Mover
from specshield.service.sessions.state import State
from specshield.service.settings import Settings
from specshield.service.storage.archive import DAMAGED, Archive, Entry, unpack
from specshield.service.storage.archiving import ArchivingStore
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.objects import left_out, open_objects
from specshield.service.storage.store import Change, Dump
from tests.service.world import LOGITS, START, ahead, grid_json, send_policy
from tests.serving import HUNG, free_port, serving, wait_for
from tests.stores import answers, needs_redis, running

TTL = 3600
ROW = bytes(range(24))


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    embedded = EmbeddedStore(tmp_path_factory.mktemp("data"))
    embedded.join()
    yield embedded.url
    embedded.leave()


@pytest.fixture(params=["own", pytest.param("redis", marks=needs_redis)])
def bounded(request, tmp_path):
    """The URL of a store whose memory may be bounded: Redis refuses more than the server's own then."""
    if request.param == "own":
        yield request.getfixturevalue("url")
        return
    port = free_port()
    with running(tmp_path / "redis", "--port", str(port), "--save", ""), redis.Redis(port=port) as client:
        wait_for(lambda: answers(client))
        yield f"redis://127.0.0.1:{port}"


@pytest.fixture(params=["folder", "fsspec"])
def archive(request, tmp_path):
    place = str(tmp_path / "archive") if request.param == "folder" else f"memory://{tmp_path.name}"
    return Archive(open_objects(place))


def run(url: str, archive: Archive, story: Callable[[ArchivingStore], Awaitable[None]]) -> None:
    async def play() -> None:
        store = ArchivingStore(url, 10.0, TTL, archive)
        try:
            await story(store)
        finally:
            await store.redis.flushall()
            await store.aclose()

    asyncio.run(play())


def change(t: int) -> Change:
    return Change(f"state after {t}".encode(), ROW, 24 * t, t, f"step {t}".encode() * 20)


async def begin(store: ArchivingStore, id: str, steps: int) -> bytes:
    version = await store.create(id, f"config of {id}".encode(), Change(b"state", ROW))
    for t in range(steps):
        version = await store.append(id, version, change(t))
    return version


async def move(store: ArchivingStore, id: str) -> Dump:
    dump = await store.dump(id)
    assert dump is not None
    assert await store.put_away(id, time.time() + TTL, dump)
    return dump


async def in_store(store: ArchivingStore, id: str) -> bool:
    return bool(await store.redis.exists(f"specshield:v2:{{{id}}}:session"))


def test_a_session_that_its_server_was_killed_over_is_found_by_others(url, archive):
    async def story(store):
        await begin(store, "back", 2)
        dump = await move(store, "back")
        killed = ArchivingStore(url, 10.0, TTL, archive)
        lists = killed._claim

        async def claim(keys, args):
            if await in_store(store, args[0]):
                raise asyncio.CancelledError  # as the end of the process would cut it off
            return await lists(keys=keys, args=args)

        killed._claim = claim
        with pytest.raises(asyncio.CancelledError):
            await killed.append("back", dump.version, change(2))
        with pytest.raises(asyncio.CancelledError):
            await killed.create("new", b"config", Change(b"state", ROW))
        await killed.aclose()
        found, _ = await store.idle(None, 10, -1.0)
        assert sorted(id for id, *_ in found) == ["back", "new"]

    run(url, archive, story)


def test_a_session_that_has_left_is_read_byte_for_byte_and_goes_on(url, archive):
    async def story(store):
        await begin(store, "robot", 5)
        before = await store.dump("robot")
        await move(store, "robot")
        assert not await in_store(store, "robot")
        assert await store.dump("robot") == before
        assert [(await store.load("robot", t)).step for t in range(5)] == before.steps
        assert (await store.load("robot", 5)).step is None
        await begin(store, "alice@mine", 1)
        await move(store, "alice@mine")
        with pytest.raises(SessionExists, match="a session 'mine'") as refused:
            await store.create("alice@mine", b"another", Change(b"state", ROW))
        assert refused.value.got == "mine"  # the id that the caller knows, not the key

        assert not await in_store(store, "robot")  # reading brings nothing back
        version = await store.append("robot", before.version, change(5))
        assert isinstance(version, bytes)
        assert (await store.append("robot", before.version, change(5))).version == version  # lost the race
        dump = await store.dump("robot")
        assert dump.steps == [*before.steps, change(5).step]
        assert dump.rows == before.rows + ROW
        await move(store, "robot")
        assert await store.dump("robot") == dump
        assert len(archive.entries("robot")) == 1  # the older file has gone
        assert await store.delete("robot")
        assert await store.load("robot") is None
        assert not await store.delete("robot")
        assert archive.entries("robot") == []

    run(url, archive, story)


def test_a_session_that_moves_again_is_counted_once(url, archive):
    async def story(store):
        version = await begin(store, "twice@robot", 1)
        for t in (1, 2, 3):
            await move(store, "twice@robot")
            version = await store.append("twice@robot", version, change(t))
        await move(store, "twice@robot")
        ((entry, size),) = archive.sizes()
        assert entry.key == "twice@robot"
        assert (await store.sizes())["twice"] == size

    run(url, archive, story)


def test_two_servers_that_bring_a_session_back_decide_one_step(url, archive):
    async def story(store):
        version = await begin(store, "robot", 3)
        await move(store, "robot")
        other = ArchivingStore(url, 10.0, TTL, archive)
        got = await asyncio.gather(*(s.append("robot", version, change(3)) for s in [store, other] * 8))
        await other.aclose()
        assert sum(isinstance(one, bytes) for one in got) == 1
        assert len((await store.dump("robot")).steps) == 4

    run(url, archive, story)


class Held(Archive):
    """An archive whose next read, write or list waits until it is let go."""

    def __init__(self, archive: Archive) -> None:
        super().__init__(archive._objects)
        self.reached, self.go = threading.Event(), threading.Event()

    def read(self, entry: Entry) -> Dump | None:
        found = super().read(entry)
        self.reached.set()
        self.go.wait()
        return found

    def put(self, key: str, expires: float, dump: Dump) -> tuple[Entry, int]:
        self.reached.set()
        self.go.wait()
        return super().put(key, expires, dump)

    def after(self, owner: str, id: str | None) -> Iterator[Entry]:
        found = list(super().after(owner, id))
        self.reached.set()
        self.go.wait()
        yield from found


def test_a_server_that_is_slow_to_bring_a_session_back_comes_too_late(url, archive):
    """Or the robot would go on from a state that others have left behind, or from one that was erased."""

    async def story(store):
        for erased in (False, True):
            version = await begin(store, "robot", 3)
            await move(store, "robot")
            slow = ArchivingStore(url, 10.0, TTL, Held(archive))
            late = asyncio.create_task(slow.append("robot", version, change(3)))
            await asyncio.to_thread(slow.archive.reached.wait)
            assert isinstance(await store.append("robot", version, change(3)), bytes)
            moved = await move(store, "robot")
            if erased:
                await store.delete("robot")
            slow.archive.go.set()
            told = await late
            assert told is None if erased else told.version == moved.version
            assert await store.dump("robot") == (None if erased else moved)
            await slow.aclose()
            await store.delete("robot")

    run(url, archive, story)


def test_a_server_that_is_slow_to_move_a_session_harms_nothing_that_came_after(url, archive):
    async def story(store):
        for after in ("goes on", "moves", "is erased"):
            version = await begin(store, "robot", 3)
            slow = ArchivingStore(url, 10.0, TTL, Held(archive))
            dump = await store.dump("robot")
            late = asyncio.create_task(slow.put_away("robot", time.time() + TTL, dump))
            await asyncio.to_thread(slow.archive.reached.wait)
            await store.append("robot", version, change(3))
            kept = await store.dump("robot")
            if after == "moves":
                await move(store, "robot")
            if after == "is erased":
                await store.delete("robot")
            slow.archive.go.set()
            assert not await late
            assert await store.dump("robot") == (None if after == "is erased" else kept)
            assert len(archive.entries("robot")) == (after == "moves")
            await slow.aclose()
            await store.delete("robot")

    run(url, archive, story)


def test_a_listing_holds_store_and_archive_in_order_and_each_session_once(url, archive):
    async def story(store):
        ids = ["a", "abc", "abcdefgh", "abcdefghi", "abcdefghij", "b", "robot-1", "robot-10", "robot-2", "z"]
        sample = random.Random(1).sample(ids, len(ids))
        for owner in ("@", "ann@", "ann.b@"):
            for i, id in enumerate(sample):
                version = await begin(store, owner + id, 1)
                if i % 3:
                    await move(store, owner + id)
                if i % 3 == 2:  # is back, and its file is still there
                    assert await store.append(owner + id, version, change(1))
        for limit in (1, 3, 100):
            for owner in ("", "ann", "ann.b"):
                listed, after = [], None
                while True:
                    page, after = await store.everything(owner, after, limit)
                    listed += [config.removeprefix(b"config of ").decode() for config, _ in page]
                    if after is None:
                        break
                assert listed == [f"{owner}@{id}" for id in ids]
        assert {e.key for e, _ in archive.sizes()} == {
            owner + id for owner in ("@", "ann@", "ann.b@") for i, id in enumerate(sample) if i % 3
        }

    run(url, archive, story)


@pytest.mark.parametrize("before", [False, True])
def test_a_session_that_moves_while_they_are_listed_is_listed(url, archive, before):
    """Or a policy could be deleted that it uses. before: whether an older state of it lies in the archive."""

    async def story(store):
        version = await begin(store, "ann@robot", 1)
        if before:
            await move(store, "ann@robot")
            assert isinstance(await store.append("ann@robot", version, change(1)), bytes)
        slow = ArchivingStore(url, 10.0, TTL, Held(archive))
        listing = asyncio.create_task(slow.everything("ann", None, 10))
        await asyncio.to_thread(slow.archive.reached.wait)
        await move(store, "ann@robot")
        slow.archive.go.set()
        page, _ = await listing
        assert [config for config, _ in page] == [b"config of ann@robot"]
        await slow.aclose()

    run(url, archive, story)


@pytest.mark.parametrize("how", ["left", "erased"])
def test_a_session_that_another_server_has_back_at_once_stays_on_the_list(url, archive, how):
    """Or nobody would find it, and no mover move it."""

    async def story(store):
        version = await begin(store, "robot", 3)
        other = ArchivingStore(url, 10.0, TTL, archive)

        async def interrupted(keys, args, script=store._leave if how == "left" else store._erase):
            told = await script(keys=keys, args=args)
            await (other.append("robot", version, change(3)) if how == "left" else begin(other, "robot", 1))
            return told

        store._leave = store._erase = interrupted
        await (move(store, "robot") if how == "left" else store.delete("robot"))
        assert await in_store(store, "robot")
        assert await store.count(None) == 1
        await other.aclose()

    run(url, archive, story)


def test_a_store_whose_memory_is_full_is_freed_by_moves_and_deletions(bounded, archive):
    async def story(store: ArchivingStore) -> None:
        await begin(store, "mover@moves", 3)
        await begin(store, "mover@goes", 3)
        await store.redis.config_set("maxmemory", 1)
        try:
            with pytest.raises(StoreError, match="the store refuses"):
                await begin(store, "mover@new", 0)
            for what in ("turn", "sweep"):
                assert await store.my_turn(what, "me", 30)
                assert await store.my_turn(what, "me", 30)
                assert not await store.my_turn(what, "another", 30)
            dump = await store.dump("mover@moves")
            assert await store.put_away("mover@moves", time.time() + TTL, dump)
            assert (await store.sizes())["mover"] > 0
            assert await store.delete("mover@goes")
            assert (await store.load("mover@moves")).version == dump.version
            assert await store.delete("mover@moves")
            assert await store.sizes() == {"mover": 0}
            assert await store.redis.keys("specshield:v2:*") == []
        finally:
            await store.redis.config_set("maxmemory", 0)

    run(bounded, archive, story)


def test_what_has_expired_is_not_read_and_its_file_is_removed(url, archive):
    async def story(store):
        await begin(store, "@old", 1)
        dump = await store.dump("@old")
        assert await store.put_away("@old", time.time() - 0.001, dump)
        assert await store.load("@old") is None
        assert await store.everything("", None, 10) == ([], None)
        await begin(store, "@old", 0)  # its id is free again
        whole = Entry.of("@old", "00000001,0,06a000000")  # as older versions name a file
        assert whole is not None
        assert whole.expires == 0x6A000000
        entry, _ = archive.put("@new", time.time(), dump)
        assert entry.until == f"{int(entry.until, 16):09x}"  # by this form they find the files of this one

    run(url, archive, story)


def test_a_damaged_file_is_said_to_be_one(url, tmp_path):
    archive = Archive(open_objects(str(tmp_path)))

    async def story(store):
        await begin(store, "robot", 3)
        await move(store, "robot")
        file = next(path for path in tmp_path.rglob("*") if path.is_file())
        whole = file.read_bytes()
        for broken in (b"", whole[:-9], whole[:40] + b"?" + whole[41:], whole[:-5] + b"????" + whole[-1:]):
            file.write_bytes(broken)
            with pytest.raises(SessionDamaged, match="archive"):
                await store.dump("robot")
        dump = unpack(whole)
        for i, byte in enumerate(whole * 8):  # some say that very much memory is needed
            damaged = bytearray(whole)
            damaged[i % len(whole)] = byte ^ 1 << i // len(whole)
            with contextlib.suppress(*DAMAGED):
                assert unpack(damaged) == dump  # not every bit counts
        file.write_bytes(whole)
        (file.parent / "notes.txt").write_text("not ours")
        assert len((await store.dump("robot")).steps) == 3

    run(url, archive, story)


def test_a_file_that_is_not_whole_or_not_ours_is_left_out_of_lists_and_named_once(url, tmp_path, caplog):
    archive = Archive(open_objects(str(tmp_path)))

    async def story(store):
        for id in ("ann@broken", "ann@whole"):
            await begin(store, id, 3)
            await move(store, id)
        (file,) = (tmp_path / "ann@" / "broken").rglob("*,*")
        whole = file.read_bytes()
        loop = tmp_path / "ann@" / "loop" / "loop" / file.name
        loop.parent.mkdir(parents=True)
        loop.symlink_to(loop)
        for broken in (b"", whole[:30], b"?" * 100, whole[:40] + b"?" + whole[41:]):
            file.write_bytes(broken)
            caplog.clear()
            left_out.cache_clear()
            for _ in range(2):
                page, _ = await store.everything("ann", None, 10)
                assert [config for config, _ in page] == [b"config of ann@whole"]
            assert [file.name in line for line in caplog.messages] == [True]
            with pytest.raises(SessionDamaged, match=file.name):
                await store.dump("ann@broken")
        assert await store.delete("ann@broken")

    run(url, archive, story)


def test_a_file_that_was_left_half_written_does_not_stand_for_the_session(url, archive):
    """Not every file system puts a file there whole or not at all. The session would be lost with it."""

    async def story(store):
        await begin(store, "robot", 3)
        dump, expires = await store.dump("robot"), time.time() + TTL
        entry, size = archive.put("robot", expires, dump)
        assert archive.put("robot", expires, dump) == (entry, 0)
        archive._objects.write(entry.path, archive._objects.read(entry.path)[:-9])
        assert archive.put("robot", expires, dump) == (entry, size)
        assert await store.put_away("robot", expires, dump)
        assert await store.dump("robot") == dump

    run(url, archive, story)


@pytest.mark.parametrize("instead", ["nothing", "a file"])
def test_of_an_archive_that_is_away_nothing_is_known_to_be_absent(url, tmp_path, instead):
    """As where a network folder is not mounted. An archived session was said to have expired, which a robot
    takes for the end; and one that was erased came back with the folder.
    """
    folder, aside = tmp_path / "archive", tmp_path / "aside"

    async def story(store):
        for id in ("robot", "erased"):
            await begin(store, id, 3)
            assert await store.put_away(id, time.time() + TTL, dump := await store.dump(id))
        await begin(store, "running", 3)
        folder.rename(aside)
        if instead == "a file":
            folder.touch()
        for asked in (
            lambda: store.load("robot"),
            lambda: store.dump("robot"),
            lambda: begin(store, "robot", 3),
            lambda: store.everything("", None, 10),
            lambda: store.delete("erased"),
            lambda: store.delete("running"),
            lambda: Mover(store, Settings()).sweep(),
        ):
            with pytest.raises(StoreError, match="files cannot be used"):
                await asked()
        if instead == "a file":
            folder.unlink()
        aside.rename(folder)
        assert (await store.dump("robot")).steps == dump.steps
        assert await store.dump("running")
        assert await store.delete("erased")
        assert not archive.entries("erased")

    archive = Archive(open_objects(str(folder)))
    run(url, archive, story)


def test_links_and_copies_among_the_files_keep_no_sweep_from_its_end(url, tmp_path, caplog):
    archive = Archive(open_objects(str(tmp_path)))
    left_out.cache_clear()

    async def story(store):
        await begin(store, "ann@robot", 3)
        dump = await move(store, "ann@robot")
        (tmp_path / "loop").symlink_to("loop")
        (tmp_path / "ann@" / "up").symlink_to("..")
        shutil.copytree(tmp_path / "ann@" / "robot", tmp_path / "ann@" / "robot.bak")
        mover = Mover(store, Settings())
        for _ in range(2):
            assert await mover.sweep() == {"ann": sum(size for _, size in archive.sizes())}
        assert len(list(archive.sizes())) == 1
        assert await store.dump("ann@robot") == dump
        for name, told in zip(["ann@/up", "loop"], caplog.messages, strict=True):
            assert str(tmp_path / name) in told

    run(url, archive, story)


def test_a_session_that_another_version_stored_otherwise_keeps_no_other_from_moving(url, archive):
    async def story(store):
        await begin(store, "@another", 1)
        state = State(1, 1, True, "satisfied", time.time() + TTL, b"", finished=True)
        await store.create("@ended", b"config", Change(state.packed(), ROW))
        mover = Mover(store, Settings())
        mover._ended = -1.0  # whatever has ended is due
        assert await mover.move() == 1
        assert (await in_store(store, "@another"), await in_store(store, "@ended")) == (True, False)

    run(url, archive, story)


MOVER = """
import asyncio, sys, time
from specshield.service.storage.archive import Archive
from specshield.service.storage.archiving import ArchivingStore
from specshield.service.storage.objects import open_objects
async def main():
    store = ArchivingStore(sys.argv[1], 10.0, 3600, Archive(open_objects(sys.argv[2])))
    print("moving", flush=True)
    while True:
        for id in "abc":
            dump = await store.dump(id)
            if dump is not None:
                await store.put_away(id, time.time() + 3600, dump)
asyncio.run(main())
"""


def test_no_step_is_lost_or_doubled_however_often_a_mover_is_killed(url, tmp_path):
    place = str(tmp_path / "archive")

    async def story(store):
        versions = {id: await begin(store, id, 0) for id in "abc"}
        answered = dict.fromkeys("abc", 0)
        for kill in range(6):
            command = [sys.executable, "-c", MOVER, url, place]
            mover = subprocess.Popen(command, stdout=subprocess.PIPE, env=os.environ)
            await asyncio.to_thread(mover.stdout.readline)
            for _ in range(10 + kill):
                for id in "abc":
                    got = await store.append(id, versions[id], change(answered[id]))
                    assert isinstance(got, bytes), (id, got)
                    versions[id], answered[id] = got, answered[id] + 1
            mover.kill()
            mover.wait()
            for id in "abc":
                dump = await store.dump(id)
                assert dump.steps == [change(t).step for t in range(answered[id])]
                assert dump.version == versions[id]

    run(url, Archive(open_objects(place)), story)
    assert list(Path(place).rglob("*"))


def test_a_file_that_is_written_while_its_session_is_erased_is_not_the_session(url, archive):
    """As by a mover that is slow: it has read the session before, and removes its file afterwards."""

    async def story(store: ArchivingStore) -> None:
        await begin(store, "a", 3)
        dump = await store.dump("a")
        assert await store.delete("a")
        expires = time.time() + TTL
        archive.put("a", expires, dump)
        assert await store.load("a") is None
        assert await store.dump("a") is None
        assert await store.append("a", dump.version, change(3)) is None
        version = await begin(store, "a", 1)
        assert not await store.put_away("a", expires, dump)
        assert (await store.load("a")).version == version
        assert await move(store, "a")
        assert (await store.load("a")).version == version

    run(url, archive, story)


@contextlib.contextmanager
def archiving(tmp_path: Path) -> Iterator[tuple[httpx.Client, dict[str, Any]]]:
    """A client of a server whose sessions move to the archive after a second, and how to begin one there."""
    with (
        serving(tmp_path, SPECSHIELD_ARCHIVE_AFTER="1") as server,
        httpx.Client(base_url=server.url, verify=False, timeout=HUNG) as client,
    ):
        client.post("/v1/maps", json=grid_json())
        yield client, {"policy_id": send_policy(client)["id"], "initial_pose": START, "id": "robot"}


def test_the_routes_answer_for_archived_sessions_as_for_any(tmp_path):
    with archiving(tmp_path) as (client, begun):
        assert client.post("/v1/sessions", json=begun).status_code == 201

        def step(t: int) -> httpx.Response:
            body = {"t": t, "poses": ahead(t)[-1:], "logits": LOGITS, "occupied": [[2.55, 1.05]]}
            return client.post("/v1/sessions/robot/steps", json=body)

        def archived() -> bool:
            keys = redis.Redis(unix_socket_path=str(tmp_path / "store" / "socket")).keys("*{*robot}:session")
            return not keys and any(path.is_file() for path in (tmp_path / "archive").rglob("*"))

        answers = [step(t).content for t in range(3)]
        session = client.get("/v1/sessions/robot").json()
        trajectory = client.get("/v1/sessions/robot/trajectory").content
        learned = client.get("/v1/sessions/robot/learned").json()
        assert learned["occupied"] == [425]
        wait_for(archived)
        assert client.get("/v1/sessions/robot/learned").json() == learned
        assert client.get("/v1/sessions/robot").json() == session
        assert client.get("/v1/sessions/robot/trajectory").content == trajectory
        assert [item["id"] for item in client.get("/v1/sessions").json()["items"]] == ["robot"]
        assert [step(t).content for t in range(3)] == answers
        assert client.post("/v1/sessions", json=begun).status_code == 409
        assert step(5).json()["type"] == "history-gap"
        assert archived()  # none of this brought it back

        assert step(3).status_code == 200
        assert client.get("/v1/sessions/robot").json()["next_t"] == 4
        wait_for(archived)
        last = {"t": 4, "poses": ahead(4)[-1:]}
        closed = client.post("/v1/sessions/robot/close", json=last)
        assert closed.status_code == 200
        wait_for(archived)
        assert client.post("/v1/sessions/robot/close", json=last).json() == closed.json()

        (file,) = (path for path in (tmp_path / "archive").rglob("*") if path.is_file())
        file.write_bytes(file.read_bytes()[:-9])
        another = client.post("/v1/sessions", json={**begun, "id": "another"})
        assert another.status_code == 201
        for path in ("robot", "robot/trajectory", "robot/record", "robot/image.svg", "robot/events?after=-1"):
            told = client.get(f"/v1/sessions/{path}")
            assert (told.status_code, told.json()["type"]) == (410, "session-damaged"), path
            assert "Retry-After" not in told.headers
        assert step(3).status_code == 410
        with client.stream("GET", "/v1/events?session=robot:-1&session=another:-1") as both:
            assert client.delete("/v1/sessions/another").status_code == 204
            told = [json.loads(line[6:])["session"] for line in both.iter_lines() if line.startswith("data")]
            assert told == ["another"]
        assert [item["id"] for item in client.get("/v1/sessions").json()["items"]] == ["robot"]
        assert client.delete("/v1/sessions/robot").status_code == 204
        assert client.get("/v1/sessions/robot").status_code == 404
        assert client.get("/v1/sessions").json()["items"] == []
        assert not any(path.is_file() for path in (tmp_path / "archive").rglob("*"))


def test_who_watches_an_archived_session_hears_of_its_end_and_of_no_other_one(tmp_path):
    with archiving(tmp_path) as (client, begun):
        for again in (False, True):
            assert client.post("/v1/sessions", json=begun).status_code == 201
            body = {"t": 0, "poses": ahead(0)[-1:], "logits": LOGITS}
            assert client.post("/v1/sessions/robot/steps", json=body).status_code == 200
            with client.stream("GET", "/v1/sessions/robot/events?after=-1") as watched:
                lines = watched.iter_lines()
                assert "id: 0" in lines
                wait_for(lambda: any(path.is_file() for path in (tmp_path / "archive").rglob("*")))
                assert client.delete("/v1/sessions/robot").status_code == 204
                if again:
                    assert client.post("/v1/sessions", json=begun).status_code == 201
                    assert client.post("/v1/sessions/robot/steps", json=body).status_code == 200
                rest = list(lines)
                assert "event: end" in rest
                assert not any(line.startswith("id: ") for line in rest)
