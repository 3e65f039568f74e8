"""API keys with names: what each may, what each owns, and what it may use."""

import asyncio
import json
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

import httpx
import pytest
import redis
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from specshield.errors import InputError, NotFound, RateLimited, Unauthorized
from specshield.service.access.keys import KEYS, MISS_EVERY, OPEN, REFRESH, Key, Keys, Rates
from specshield.service.storage.embedded import EmbeddedStore
from specshield.service.storage.store import Store
from tests.service.test_bad_input import problem
from tests.service.world import START, grid_json, send_policy
from tests.serving import HUNG, free_port, run_specshield, serving, wait_for
from tests.stores import answers, needs_redis, running

POSE = [4.5, 5.0, 0.0]  # from which case 1 can be satisfied
UNTOLD = 12.0  # [s] in which a stream that is open tells nothing, if nothing is decided: less than HEARTBEAT


@pytest.fixture(scope="module")
def keyed(tmp_path_factory):
    """A server whose operator has a key, and the store beside it."""
    with serving(tmp_path_factory.mktemp("keyed") / "data", SPECSHIELD_API_KEY="operator") as running:
        yield running


def on_keys(server, action):
    """What `specshield keys` does, without a process."""

    async def act():
        store = Store(EmbeddedStore(server.data_dir).url, 30.0, 60)
        try:
            return await action(Keys(store.redis))
        finally:
            await store.aclose()

    return asyncio.run(act())


@contextmanager
def caller(server, name, **limits):
    """A client with a key of this name, which is revoked afterwards."""
    secret = on_keys(server, lambda keys: keys.create(name, **limits))
    with httpx.Client(
        base_url=server.url, timeout=None, headers={"Authorization": f"Bearer {secret}"}
    ) as client:
        yield client
    on_keys(server, lambda keys: keys.revoke(name))


def begin(client, **fields):
    body = {"policy_id": "case1", "initial_pose": [0.9, 5.0, 0.0], "allow_infeasible": True, **fields}
    return client.post("/v1/sessions", json=body)


def own_world(client):
    assert client.post("/v1/maps", json=grid_json()).status_code == 201
    return send_policy(client)["id"]


def test_a_newline_at_the_end_of_a_path_opens_nothing(keyed):
    with httpx.Client(base_url=keyed.url, timeout=None, verify=False) as client:
        for path in ("/metrics%0a", "/livez%0a"):
            problem(client.get(path), 404, "not-found")
        key = {"Authorization": "Bearer operator"}
        for path in ("/v1/maps%0a", "/v1/policies%0a", "/v1/sessions/a/steps%0a"):
            problem(client.post(path, json=grid_json(), headers=key), 404, "not-found")


def test_a_command_acts_as_the_owner_of_the_key_that_it_starts_a_server_with(keyed):
    async def act(keys):
        secret = await keys.create("dora")
        servers = Keys(keys._store, secret)
        await servers.refresh()
        found = await servers.check(f"Bearer {secret}".encode())
        await keys.revoke("dora")
        return found.name

    assert on_keys(keyed, act) == "dora"


def test_keys_made_listed_and_revoked_by_the_command_line(keyed, tmp_path):
    def keys(*arguments):
        return run_specshield("keys", *arguments, SPECSHIELD_DATA_DIR=str(keyed.data_dir))

    assert keys("list").stderr == "there are no keys\n"
    none = tmp_path / "none"
    for asked in (("list",), ("revoke", "carol")):
        run_specshield("keys", *asked, SPECSHIELD_DATA_DIR=str(none))
    assert not none.exists()
    for endless in ("inf", "nan"):
        refused = keys("create", "carol", "--requests", endless)
        assert (refused.returncode, "--requests" in refused.stderr) == (2, True)
    made = keys("create", "carol", "--requests", "7.5", "--sessions", "3", "--bytes", f"1{400 * '0'}")
    secret = made.stdout.strip()
    assert len(secret) > 40, made.stderr
    with httpx.Client(
        base_url=keyed.url, timeout=None, headers={"Authorization": f"Bearer {secret}"}
    ) as client:
        assert client.get("/v1/sessions").status_code == 200  # at once
        listed = keys("list").stdout
        assert "carol" in listed
        assert "7.5 requests a second, 3 sessions, 10,000,000" in listed
        assert secret not in listed
        assert keys("revoke", "carol").stdout == "the key carol is revoked\n"
        wait_for(lambda: client.get("/v1/sessions").status_code == 401)
    assert "carol" not in keys("list").stdout
    again = keys("revoke", "carol")
    assert again.returncode == 2
    assert "Traceback" not in again.stderr


@needs_redis
def test_a_change_of_keys_that_a_failover_may_undo_is_said_to_be_one(tmp_path):
    port, second = free_port(), free_port()
    given = {"REDIS_URL": f"redis://127.0.0.1:{port}", "SPECSHIELD_DATA_DIR": str(tmp_path / "data")}

    def keys(*arguments, timeout):
        more = {"SPECSHIELD_STORE_REPLICAS": "1", "SPECSHIELD_STORE_TIMEOUT": timeout}
        return run_specshield("keys", *arguments, **given, **more)

    with running(tmp_path / "first", "--port", str(port)), redis.Redis(port=port) as first:
        wait_for(lambda: answers(first))
        made = keys("create", "carol", timeout="1")
        assert (made.returncode, made.stdout[:3]) == (2, "ss_")  # nobody could read the key later
        said = (
            "the keys are changed, but a failover may undo that: 0 of 1 replicas of the store had the answer"
        )
        assert said in made.stderr  # though the store has never seen the script
        assert "(" not in made.stderr, "the reason is told once, not as its own cause too"
        follows = ("--replicaof", f"127.0.0.1 {port}", "--repl-diskless-sync-delay", "0")
        with running(tmp_path / "second", "--port", str(second), *follows), redis.Redis(port=second) as other:
            wait_for(lambda: answers(other) and other.info()["master_link_status"] == "up")
            assert other.hexists(KEYS, "carol")
            revoked = keys("revoke", "carol", timeout="60")
            assert (revoked.returncode, other.hexists(KEYS, "carol")) == (0, False), revoked.stderr


def test_a_revoked_key_ends_the_streams_of_events_that_it_opened_and_no_other(keyed):
    def decide(client, t):
        body = {"t": t, "poses": [POSE] * (t + 1), "logits": [0.0] * 20}
        assert client.post("/v1/sessions/w/steps", json=body).status_code == 200

    with ExitStack() as open:
        own, other = (open.enter_context(caller(keyed, name)) for name in ("erin", "frank"))
        for client in (own, other):
            assert begin(client, id="w", initial_pose=POSE).status_code == 201
        streams = {
            (client, path): open.enter_context(client.stream("GET", path, timeout=UNTOLD))
            for client in (own, other)
            for path in ("/v1/sessions/w/events?after=-1", "/v1/events?session=w:-1")
        }
        lines = {asked: stream.iter_lines() for asked, stream in streams.items()}
        on_keys(keyed, lambda keys: keys.revoke("erin"))
        secret = on_keys(keyed, lambda keys: keys.create("erin"))  # who goes on with the session
        began = time.monotonic()
        for (client, path), told in lines.items():
            if client is own:
                assert not [line for line in told if line.startswith(("data", "event"))], path
                assert client.get(path).status_code == 401
        assert time.monotonic() - began < UNTOLD
        own.headers["Authorization"] = f"Bearer {secret}"
        decide(own, 0)
        decide(other, 0)
        for (client, path), told in lines.items():
            if client is other:
                assert any(line.startswith("data") for line in told), path


def test_a_revoked_key_ends_the_streams_of_steps_that_it_opened_and_no_other(keyed):
    def stream(client):
        assert begin(client, id="s", initial_pose=POSE).status_code == 201
        url = f"ws{keyed.url.removeprefix('http')}/v1/sessions/s/stream"
        key = {"Authorization": client.headers["Authorization"]}
        return open.enter_context(connect(url, additional_headers=key, ping_interval=None))

    def decide(stream, t):
        stream.send(json.dumps({"t": t, "poses": [POSE] * (t + 1), "logits": [0.0] * 20}))
        return json.loads(stream.recv(HUNG))

    with ExitStack() as open:
        own, other = (stream(open.enter_context(caller(keyed, name))) for name in ("erin", "frank"))
        assert decide(own, 0)["t"] == decide(other, 0)["t"] == 0
        on_keys(keyed, lambda keys: keys.revoke("erin"))
        on_keys(keyed, lambda keys: keys.create("erin"))
        with pytest.raises(ConnectionClosed) as closed:
            own.recv(UNTOLD)
        assert closed.value.rcvd.code == 1008
        assert decide(other, 1)["t"] == 1
    assert "Traceback" not in keyed.log.read_text()


def test_what_a_name_may_be(keyed):
    for name in ("", "../x", "a b", "a@b", "x" * 65):
        with pytest.raises(InputError):
            on_keys(keyed, lambda keys, name=name: keys.create(name))
    with pytest.raises(NotFound):
        on_keys(keyed, lambda keys: keys.revoke(""))
    with caller(keyed, "twice"), pytest.raises(InputError):
        on_keys(keyed, lambda keys: keys.create("twice"))


def test_only_the_hash_of_a_key_is_kept(keyed):
    secret = on_keys(keyed, lambda keys: keys.create("hashed"))
    kept = b"".join(path.read_bytes() for path in keyed.data_dir.rglob("*.aof"))
    assert b"hashed" in kept
    assert secret.encode() not in kept
    on_keys(keyed, lambda keys: keys.revoke("hashed"))


def test_a_key_owns_its_sessions(keyed):
    with caller(keyed, "alice") as alice, caller(keyed, "alice2") as other:
        session = begin(alice, id="run-1")
        assert session.status_code == 201, session.text
        assert "owner" not in session.json()
        for method, path in (
            ("GET", ""),
            ("GET", "/trajectory"),
            ("GET", "/learned"),
            ("DELETE", ""),
            ("POST", "/close"),
            ("POST", "/steps"),
        ):
            body = {"t": 0, "poses": [START], "logits": [0.0] * 20} if path == "/steps" else {}
            answer = other.request(
                method, f"/v1/sessions/run-1{path}", json=body if method == "POST" else None
            )
            problem(answer, 404, "not-found")
            assert "alice" not in answer.text
        assert other.get("/v1/sessions").json()["items"] == []
        assert begin(other, id="run-1").status_code == 201  # its own, of the same id
        problem(begin(alice, id="run-1"), 409, "session-exists", "id")
        assert other.delete("/v1/sessions/run-1").status_code == 204
        assert [s["id"] for s in alice.get("/v1/sessions").json()["items"]] == ["run-1"]
        assert alice.delete("/v1/sessions/run-1").status_code == 204


def test_pages_of_one_owners_sessions(keyed):
    with caller(keyed, "dora") as dora, caller(keyed, "dora-x") as other:
        for i in range(3):
            assert begin(dora, id=f"s{i}").status_code == 201
        assert begin(other, id="s1b").status_code == 201
        page = dora.get("/v1/sessions", params={"limit": 2}).json()
        rest = dora.get("/v1/sessions", params={"limit": 2, "cursor": page["next"]}).json()
        assert [s["id"] for s in page["items"] + rest["items"]] == ["s0", "s1", "s2"]


def test_a_key_keeps_no_more_sessions_than_it_may(keyed):
    with caller(keyed, "small", sessions=1) as small:
        assert begin(small, id="one").status_code == 201
        problem(begin(small, id="two"), 429, "limit-reached")
        problem(begin(small, id="one"), 409, "session-exists")  # as after an answer that was lost
        assert small.delete("/v1/sessions/one").status_code == 204
        assert begin(small, id="two").status_code == 201


def test_a_key_keeps_no_more_sessions_than_it_may_though_they_begin_at_once(keyed):
    with caller(keyed, "hasty", sessions=2) as hasty, ThreadPoolExecutor(12) as threads:
        answers = list(threads.map(lambda i: begin(hasty, id=f"s{i}"), range(12)))
        assert {answer.status_code for answer in answers} <= {201, 429}
        kept = [session["id"] for session in hasty.get("/v1/sessions").json()["items"]]
        assert kept == sorted(answer.json()["id"] for answer in answers if answer.status_code == 201)
        assert len(kept) == 2


def test_a_key_whose_sessions_fill_its_part_of_the_archive_begins_none(tmp_path):
    settings = {"SPECSHIELD_ARCHIVE_AFTER": "1", "SPECSHIELD_MAX_OWNER_ARCHIVE_BYTES": "1"}
    with (
        serving(tmp_path / "data", SPECSHIELD_API_KEY="operator", **settings) as server,
        caller(server, "gina") as gina,
        caller(server, "hal") as hal,
        httpx.Client(
            base_url=server.url, timeout=None, headers={"Authorization": "Bearer operator"}
        ) as operator,
    ):
        kept = tmp_path / "data" / "archive" / "@"  # before those of gina, so that it counts too
        wait_for(lambda: begin(operator).status_code == 201 and kept.exists())
        wait_for(lambda: begin(gina).status_code == 429)
        found = problem(begin(gina), 429, "limit-reached")
        assert "this key's sessions in the archive take" in found["detail"]
        assert begin(hal).status_code == 201
        assert begin(operator).status_code == 201
        for session in gina.get("/v1/sessions").json()["items"]:
            assert gina.delete(f"/v1/sessions/{session['id']}").status_code == 204
        wait_for(lambda: begin(gina).status_code == 201)


def test_the_rate_of_a_key_leaves_its_robots_room(keyed):
    with caller(keyed, "busy", requests=0.1) as busy:
        with httpx.Client(base_url=keyed.url, verify=False, headers=busy.headers, timeout=None) as client:
            session = begin(client, id="robot")
            assert session.status_code == 201, session.text
            refused = client.get("/v1/maps")
        told = problem(refused, 429, "rate-limited")
        # At 0.1 a second the next request has its turn within 10 s, told in whole seconds.
        assert 1 <= int(refused.headers["retry-after"]) == told["retry_after"] <= 10
        step = {"t": 0, "poses": [[0.9, 5.0, 0.0]], "logits": [0.0] * 20}
        assert busy.post("/v1/sessions/robot/steps", json=step).status_code == 200


def test_a_rate_counts_what_was_asked_and_fills_up_again():
    rates, key = Rates(), Key("k", "", requests=2.0)
    for step in (True, False):
        rates.take(key, step)
        rates.take(key, step)
        with pytest.raises(RateLimited):
            rates.take(key, step)
    left, then = rates._buckets["k", True]
    rates._buckets["k", True] = left, then - 0.6  # as if that long had passed
    rates.take(key, True)
    with pytest.raises(RateLimited):
        rates.take(key, True)


def test_a_key_that_was_lost_with_all_of_the_store_is_refused_and_one_made_since_is_known(keyed):
    async def act(keys):
        server, lost = Keys(keys._store), await keys.create("lost")
        try:
            await server.refresh()
            assert (await server.check(f"Bearer {lost}".encode())).name == "lost"
            await keys._store.delete("specshield:keys")  # as FLUSHALL does
            for shown in (f"Bearer {lost}".encode(), b""):
                await server.refresh()
                with pytest.raises(Unauthorized):
                    await server.check(shown)
            made = await keys.create("made")
            assert (await server.check(f"Bearer {made}".encode())).name == "made"
            await keys._store.delete("specshield:keys")
            again = await keys.create("again")  # before the server has looked
            assert (await server.check(f"Bearer {again}".encode())).name == "again"
            with pytest.raises(Unauthorized):
                await server.check(f"Bearer {made}".encode())
        finally:
            await keys._store.delete("specshield:keys")

    on_keys(keyed, act)


def test_a_key_is_revoked_in_a_store_whose_memory_is_full(keyed):
    async def act(keys):
        server, secret = Keys(keys._store, "own"), await keys.create("full")
        await server.refresh()
        assert (await server.check(f"Bearer {secret}".encode())).name == "full"
        await keys._store.config_set("maxmemory", 1)
        try:
            await keys.revoke("full")
        finally:
            await keys._store.config_set("maxmemory", 0)
        await server.refresh()
        with pytest.raises(Unauthorized):
            await server.check(f"Bearer {secret}".encode())
        with pytest.raises(NotFound):
            await keys.revoke("full")

    on_keys(keyed, act)


def test_a_key_that_a_newer_version_made_is_read_by_this_one(keyed):
    """Its record may say more. While one version replaces the other, both know all keys."""

    async def made(keys):
        await keys.create("newer", sessions=7)
        record = json.loads(await keys._store.hget(KEYS, "newer"))
        await keys._store.hset(KEYS, "newer", json.dumps({**record, "more": 1}))
        found = [key.sessions for key in await keys.listed() if key.name == "newer"]
        await keys.revoke("newer")
        return found

    assert on_keys(keyed, made) == [7]


def test_unknown_keys_do_not_ask_the_store_each():
    asked = 0

    class Counting:
        async def hget(self, key, field):
            nonlocal asked
            asked += 1

    async def try_many():
        keys = Keys(Counting(), "own")
        tried = await asyncio.gather(
            *(keys.check(b"Bearer %d" % i) for i in range(1000)), return_exceptions=True
        )
        assert {type(error) for error in tried} == {Unauthorized}
        assert (await keys.check(b"Bearer own")).name == ""

    asyncio.run(try_many())
    assert asked <= 2
    assert REFRESH <= 2.0  # as the help of `keys revoke` says


class Empty:
    """A store without a key, which counts how often it is asked."""

    asked = 0

    async def hget(self, key, field):
        self.asked += 1


def test_a_header_costs_an_open_server_one_look_at_the_store():
    """As of a proxy that has its own keys: with each look, the request would wait for MISS_EVERY."""

    async def try_often():
        keys = Keys(store := Empty())
        for _ in range(100):
            assert await keys.check(b"Basic eA==") == await keys.check(b"Bearer x") == OPEN
        return store.asked

    assert asyncio.run(try_often()) <= 2


def test_a_server_that_others_reach_stays_closed_though_its_store_was_emptied():
    async def try_once(given):
        with pytest.raises(Unauthorized):
            await Keys(Empty(), always=True).check(given)

    for given in (b"", b"Bearer x"):
        asyncio.run(try_once(given))


def test_keys_are_followed_on_when_a_connection_is_lost_at_the_moment_at_which_the_store_is_asked():
    """uvloop has no OSError for a write to what is closed by then. Keys revoked later went on to be taken."""

    class Closed:
        async def hget(self, key, field):
            raise RuntimeError("unable to perform operation on <UnixTransport>; the handler is closed")

    async def follow():
        keys = Keys(Closed(), "own")
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(keys.follow(), 2 * MISS_EVERY)
        with pytest.raises(Unauthorized):
            await keys.check(b"Bearer other")

    asyncio.run(follow())
