"""Maps and policies: whose they are, what an id promises, how they go, and what they may take of the disk."""

import asyncio
import io
import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace

import httpx
import numpy as np
import pytest
import redis
from PIL import Image
from safetensors.numpy import load, save

from specshield.errors import InsufficientStorage, NotFound, StoreError
from specshield.policy.card import policy_id
from specshield.service.access.keys import OPEN, Key
from specshield.service.library.claims import Claims
from specshield.service.library.maps import Maps
from specshield.service.library.policies import Policies, describe
from specshield.service.settings import Settings
from specshield.service.storage import objects
from specshield.service.training.jobs import Jobs
from specshield.world.map_server import dump_map
from specshield.world.occupancy import OccupancyGrid
from specshield.world.regions import Rectangle
from tests.service.test_bad_input import YAML, problem
from tests.service.test_keys import caller, keyed
from tests.service.world import LOGITS, RESOLUTION, START, cells, grid_json, policy_files, send_policy
from tests.serving import serving, wait_for

__all__ = ["keyed"]  # a fixture


def grid(seed):
    """A map that no other test sends."""
    return json.loads(json.dumps(grid_json()).replace('"resolution": 0.1', f'"resolution": 0.1{seed}'))


def files(**change):
    """A policy's two files: with other weights, or with more in its card."""
    made = policy_files(seed=change.pop("seed", 1))
    tensors = {**load(made["weights"]), **change.pop("tensors", {})}
    card = {**json.loads(made["card"]), **change}
    return {"weights": ("w", save(tensors)), "card": ("c", json.dumps(card).encode())}


def test_the_id_of_a_policy_that_was_sent_covers_all_of_it(client, policy):
    bias = load(files()["weights"][1])["b1"]
    sent = [files(), files(tensors={"b1": bias + 1.0}), files(metrics={"satisfied": 0.5}), files(seed=2)]
    answers = [client.post("/v1/policies", files=parts) for parts in sent]
    assert [answer.status_code for answer in answers] == [202] * 4
    ids = [answer.json()["id"] for answer in answers]
    assert len(set(ids)) == 4
    assert json.loads(policy_files(seed=1)["card"])["id"] not in ids  # that of one that is made here
    assert client.post("/v1/policies", files=sent[0]).json()["id"] == ids[0]
    for id in ids:
        assert client.delete(f"/v1/policies/{id}").status_code == 204
        assert client.get(f"/v1/policies/{id}").status_code == 404


@pytest.mark.parametrize(
    ("change", "path"),
    [
        ({"tensors": {"more": np.zeros(3, np.float32)}}, "weights"),
        ({"tensors": {"more": np.zeros(3, np.float16)}}, "weights"),
        ({"tensors": {"b1": np.zeros((2, 2), np.float32)}}, "weights.b1"),
        ({"tensors": {"b2": np.full(4, np.nan, np.float32)}}, "weights.b2"),
        ({"metrics": {"satisfied": float("nan")}}, "card.metrics.satisfied"),
        ({"metrics": {"each": [1.0, float("inf")]}}, "card.metrics.each[1]"),
        ({"note": {"deep": [{"x": -float("inf")}]}}, "card.note.deep[0].x"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused_when_it_is_sent(client, policy, server, change, path):
    before = client.get("/v1/policies").json()
    answer = client.post("/v1/policies", files=files(**change))
    problem(answer, 422, "invalid-policy", path)
    assert str(server.data_dir) not in answer.text
    assert client.get("/v1/policies").json() == before


def test_a_map_goes_once_no_policy_is_for_it(client):
    map_id = client.post("/v1/maps", json=grid(1)).json()["id"]
    assert client.delete(f"/v1/maps/{map_id}").status_code == 204
    problem(client.get(f"/v1/maps/{map_id}"), 404, "not-found", "map_id")
    gone = problem(client.delete(f"/v1/maps/{map_id}"), 404, "not-found", "map_id")
    assert gone["expected"] == "an id or name from /v1/maps"
    assert map_id not in client.get("/v1/maps", params={"limit": 1000}).text
    problem(client.delete("/v1/maps/case1"), 409, "in-use", "map_id")


def test_a_map_and_a_policy_that_are_used_stay(keyed):
    with caller(keyed, "user") as user:
        map_id = user.post("/v1/maps", json=grid_json()).json()["id"]
        policy_id = send_policy(user)["id"]
        told = problem(user.delete(f"/v1/maps/{map_id}"), 409, "in-use", "map_id")
        assert told["policy_id"] == policy_id
        body = {"policy_id": policy_id, "initial_pose": START, "id": "r"}
        assert user.post("/v1/sessions", json=body).status_code == 201
        told = problem(user.delete(f"/v1/policies/{policy_id}"), 409, "in-use", "policy_id")
        assert told["session_id"] == "r"
        assert user.post("/v1/sessions/r/close", json={}).status_code == 200
        assert user.delete(f"/v1/policies/{policy_id}").status_code == 204
        body["id"] = "late"  # the shield of this policy is still in the server's memory
        problem(user.post("/v1/sessions", json=body), 404, "not-found", "policy_id")
        assert user.delete(f"/v1/maps/{map_id}").status_code == 204


def test_two_owners_of_one_content(keyed):
    with caller(keyed, "ann") as ann, caller(keyed, "ben") as ben:
        map_id = ann.post("/v1/maps", json=grid_json()).json()["id"]
        policy_id = send_policy(ann)["id"]
        for path in (f"/v1/maps/{map_id}", f"/v1/maps/{map_id}/image.png", f"/v1/policies/{policy_id}"):
            problem(ben.get(path), 404, "not-found")
            assert ben.delete(path.removesuffix("/image.png")).status_code == 404
        for what in ("maps", "policies"):
            assert {item["name"] for item in ben.get(f"/v1/{what}").json()["items"]} >= {"case1", "case2"}
            assert all(item["name"] for item in ben.get(f"/v1/{what}").json()["items"])
        body = {"policy_id": policy_id, "initial_pose": START}
        problem(ben.post("/v1/sessions", json=body), 404, "not-found", "policy_id")
        spec = {"formula": "x > 0", "map_id": map_id}
        problem(ben.post("/v1/specs/validate", json=spec), 404, "not-found", "map_id")
        unseen = ben.post("/v1/policies", files=files())
        assert unseen.status_code == 422, "a policy on a map that is another's"
        assert ben.post("/v1/maps", json=grid_json()).json()["id"] == map_id
        assert send_policy(ben)["id"] == policy_id
        assert ann.delete(f"/v1/policies/{policy_id}").status_code == 204
        assert ann.delete(f"/v1/maps/{map_id}").status_code == 204
        assert ann.get(f"/v1/maps/{map_id}").status_code == 404
        assert ben.post("/v1/sessions", json={**body, "id": "b"}).status_code == 201
        assert ben.delete("/v1/sessions/b").status_code == 204
        assert ben.delete(f"/v1/policies/{policy_id}").status_code == 204
        assert ben.delete(f"/v1/maps/{map_id}").status_code == 204
        assert not (keyed.data_dir / "maps" / map_id).exists()


def test_a_key_keeps_no_more_bytes_than_it_may(keyed):
    with caller(keyed, "full", bytes=2000) as full:
        first = answer = full.post("/v1/maps", json=grid(2))
        sides = iter(range(10, 99))
        while answer.is_success:
            answer = full.post("/v1/maps", json=grid(next(sides)))
        assert problem(answer, 507, "insufficient-storage")["limit"] == 2000
        assert full.delete(f"/v1/maps/{first.json()['id']}").status_code == 204
        assert full.post("/v1/maps", json=grid(3)).status_code == 201


def test_of_a_deletion_and_a_creation_one_wins(keyed):
    with caller(keyed, "race") as race:
        assert race.post("/v1/maps", json=grid_json()).status_code == 201
        for i in range(6):
            policy_id, together = send_policy(race)["id"], threading.Barrier(2)
            body = {"policy_id": policy_id, "initial_pose": START, "id": f"race-{i}"}

            def erase(policy_id=policy_id, together=together):
                together.wait()
                return race.delete(f"/v1/policies/{policy_id}").status_code

            def make(body=body, together=together):
                together.wait()
                return race.post("/v1/sessions", json=body).status_code

            with ThreadPoolExecutor(2) as both:
                erased, made = both.submit(erase), both.submit(make)
            assert (erased.result(), made.result()) in ((204, 404), (409, 201))
            assert race.get(f"/v1/sessions/race-{i}").status_code == (200 if made.result() == 201 else 404)
            race.delete(f"/v1/sessions/race-{i}")


@pytest.fixture
def claims(keyed):
    settings = Settings(data_dir=keyed.data_dir, store_timeout=30.0)
    jobs = Jobs(settings)
    return Claims(lambda: jobs.redis, settings)


def test_what_is_claimed_is_written_although_who_sent_it_has_gone(client, server):
    """A claim without its files would count for good, and nobody would find it."""
    id = client.post("/v1/maps", json=grid(77)).json()["id"]
    assert client.delete(f"/v1/maps/{id}").status_code == 204
    with closing(redis.Redis(unix_socket_path=f"{server.data_dir}/store/socket")) as store:
        mark = f"specshield:{{library}}:mark:maps:{id}"
        store.set(mark, "a deletion", px=60_000)  # so that the claim has to wait
        with pytest.raises(httpx.ReadTimeout):
            client.post("/v1/maps", json=grid(77), timeout=1.0)
        time.sleep(0.5)  # the process that writes it is told to end
        store.delete(mark)
    wait_for(lambda: client.get(f"/v1/maps/{id}").status_code == 200)
    assert (server.data_dir / "maps" / id / "map.json").is_file()
    assert client.delete(f"/v1/maps/{id}").status_code == 204


def test_nobody_begins_to_use_what_is_being_deleted(claims, monkeypatch):
    monkeypatch.setattr("specshield.service.library.claims.PATIENCE", 0.05)
    key, id = Key("marks", ""), "0" * 64
    with claims.adding("policies", id, key, 10):
        pass
    assert claims.mark("policies", id, "marks", "one") is None
    assert not asyncio.run(claims.settled("policies", id, "marks"))
    with pytest.raises(Exception, match="being deleted"), claims.adding("policies", id, Key("other", ""), 10):
        pass
    with pytest.raises(Exception, match="being deleted"):
        claims.mark("policies", id, "marks", "two")
    with pytest.raises(Exception, match="too long"):
        claims.free("policies", id, "marks", "two")
    assert claims.free("policies", id, "marks", "one")
    claims.unmark("policies", id, "one")
    assert claims.ids("policies", "marks") == []


def test_what_cannot_be_written_is_not_claimed(claims, tmp_path, monkeypatch):
    def full(path, content):
        raise OSError(28, "No space left on device", "/secret/path")

    before = claims._store().hgetall("specshield:{library}:sums")
    maps = Maps(Settings(data_dir=tmp_path), claims)
    monkeypatch.setattr(objects, "write_through", full)
    for _ in range(2):
        with pytest.raises(InsufficientStorage, match="disk is full") as told:
            maps.add(OccupancyGrid(np.zeros((5, 6), bool), 0.3), {}, OPEN)
        assert "secret" not in f"{told.value} {told.value.details}"
    assert claims.ids("maps", "") == []
    after = claims._store().hgetall("specshield:{library}:sums")
    assert {k: v for k, v in after.items() if v != b"0"} == {k: v for k, v in before.items() if v != b"0"}


def test_what_cannot_be_removed_from_a_read_only_disk_is_not_deleted(claims, tmp_path, monkeypatch):
    maps = Maps(Settings(data_dir=tmp_path), claims)
    id = maps.add(OccupancyGrid(np.zeros((5, 6), bool), 0.3), {}, OPEN).id
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(StoreError, match="cannot be removed"):
        maps.delete(id, "")
    assert maps.find(id, "").id == id
    monkeypatch.undo()
    maps.delete(id, "")
    assert not (tmp_path / "maps" / id).exists()


@pytest.fixture
def library(claims, tmp_path):
    """An empty one of a server's own."""
    settings = Settings(data_dir=tmp_path)
    maps = Maps(settings, claims)
    return Policies(settings, maps), maps


ANN, BEN = Key("ann", ""), Key("ben", "")


def rooms(**named):
    return {name: Rectangle((0.0, 0.0), (side, side)) for name, side in named.items()}


def asked(policies, map_id):
    about = replace(describe(json.loads(policy_files()["card"])), map_id=map_id)
    return policies.described(about, policies.task(about))


def erase(policies, claims, record, owner):
    assert claims.mark("policies", record.id, owner, "token") is None
    policies.delete(record, owner, "token")
    claims.unmark("policies", record.id, "token")


def sums(claims):
    found = claims._store().hgetall("specshield:{library}:sums")
    return {name: bytes for name, bytes in found.items() if bytes != b"0"}


def test_a_policy_is_for_its_owners_map_though_anothers_has_the_same_cells(library, claims):
    policies, maps = library
    small = OccupancyGrid(cells(), RESOLUTION)
    theirs = maps.add(small, rooms(Kitchen=1.0), ANN).id
    own = maps.add(small, rooms(Den=1.0), BEN).id
    made = policy_files()
    for map_id, key in ((theirs, ANN), (own, BEN)):
        card = json.loads(made["card"])
        policies.add(asked(policies, map_id), key)
        sent = policies.add_card(describe(card), card, made["weights"], key)
        assert sent.about.map_id == map_id
    for record in policies.page("ann", None, 99)[0]:
        if record.name is None:
            erase(policies, claims, record, "ann")
    maps.delete(theirs, "ann")
    left = [record for record in policies.page("ben", None, 99)[0] if record.name is None]
    assert len(left) == 2
    for record in left:
        assert maps.find(record.about.map_id, "ben").id == own
        assert policies.task(record.about).grid == small
        erase(policies, claims, record, "ben")
    maps.delete(own, "ben")


def test_a_server_lists_what_others_keep_behind_the_same_url_and_copies_weights_only_to_use_them(
    claims, tmp_path
):
    def server(name):
        settings = Settings(data_dir=tmp_path / name, data_url=f"memory://{tmp_path.name}")
        maps = Maps(settings, claims)
        return Policies(settings, maps), maps

    (policies, maps), (others, _) = server("one"), server("other")
    map_id = maps.add(OccupancyGrid(cells(), RESOLUTION), {}, ANN).id
    made = policy_files()
    card = json.loads(made["card"])
    sent = policies.add_card(describe(card), card, made["weights"], ANN)
    assert sent in others.page("ann", None, 99)[0]
    weights = others._kept.root / sent.id / "policy.safetensors"
    assert not weights.exists()
    assert others.policy(others.find(sent.id, "ann")).id == sent.id
    assert weights.read_bytes() == made["weights"]
    erase(others, claims, sent, "ann")
    assert sent.id not in [record.id for record in policies.page("ann", None, 99)[0]]
    maps.delete(map_id, "ann")


def test_policies_that_an_older_version_kept_go_on(library, claims):
    """Their ids did not cover the map, so that one was noted as used on two."""
    policies, maps = library
    small = OccupancyGrid(cells(), RESOLUTION)
    theirs, own = (
        maps.add(small, rooms(**{name: 2.0}), key).id for name, key in (("Kitchen", ANN), ("Den", BEN))
    )
    record = asked(policies, theirs)
    task, about = policies.task(record.about), record.about
    old = replace(record, id=policy_id(task.content_hash, about.method, about.options, about.seed))
    assert policies.add(old, ANN) == policies.record(old.id)
    assert asked(policies, theirs).id == old.id, "it is asked for again"
    assert asked(policies, own).id != old.id
    with claims.adding("policies", old.id, BEN, 10, own):
        pass
    for owner, map_id in (("ben", own), ("ann", theirs)):
        erase(policies, claims, old, owner)
        maps.delete(map_id, owner)


def test_what_owners_share_leaves_the_sum_as_it_came(library, claims):
    policies, maps = library
    before = sums(claims)
    map_id = maps.add(OccupancyGrid(cells(), RESOLUTION), {}, ANN).id
    maps.add(OccupancyGrid(cells(), RESOLUTION), {}, BEN)
    record = policies.add(asked(policies, map_id), ANN)
    checkpoint = policies.checkpoints(record.id) / "state.safetensors"
    checkpoint.parent.mkdir()
    checkpoint.write_bytes(bytes(50_000))
    policies.finish(record.id, bytes(9000), {})
    assert not checkpoint.parent.exists(), "nobody is charged for it, and nothing goes on from it any more"
    policies.add(record, BEN)
    assert sums(claims)[b"o:ben"] == sums(claims)[b"o:ann"], "both are charged what it takes"
    with claims.adding("policies", "2" * 64, ANN, 10), claims.adding("policies", "2" * 64, BEN, 3):
        pass
    for owner in ("ann", "ben"):
        erase(policies, claims, record, owner)
        erase(policies, claims, replace(record, id="2" * 64), owner)
        maps.delete(map_id, owner)
    assert sums(claims) == before


def test_what_goes_while_it_is_listed_is_left_out(library):
    policies, maps = library
    made = maps.add(OccupancyGrid(cells(), RESOLUTION), rooms(Den=3.0), ANN)
    record = policies.add(asked(policies, made.id), ANN)
    (maps._kept.root / made.id / "map.json").unlink()  # as it is between two looks of the server
    (policies._kept.root / record.id / "policy.json").unlink()
    assert made.id not in [item["id"] for item in maps.page("ann", None, 99)[0]]
    assert record.id not in [found.id for found in policies.page("ann", None, 99)[0]]
    for look, key in ((maps.show, made.id), (maps.find, made.grid.content_hash), (policies.find, record.id)):
        with pytest.raises(NotFound):
            look(key, "ann")


def test_maps_are_compressed_and_old_folders_are_read(claims, tmp_path):
    cells = np.zeros((900, 1100), bool)
    cells[200:210] = True
    made, settings = OccupancyGrid(cells, 0.05, (1.0, -2.0, 0.5)), Settings(data_dir=tmp_path)
    id = Maps(settings, claims).add(made, {}, OPEN).id
    folder = tmp_path / "maps" / id
    assert sum(path.stat().st_size for path in folder.iterdir()) < 5000  # a byte a cell were 990,000
    assert Maps(settings, claims).find(id, "").grid == made
    text, image = dump_map(made)
    (folder / "map.png").unlink()
    (folder / "map.yaml").write_text(text)
    (folder / "map.pgm").write_bytes(image)
    assert Maps(settings, claims).find(id, "").grid == made
    Maps(settings, claims).delete(id, "")
    assert not folder.exists()


def test_what_nobody_has_is_nobodys_until_it_is_sent_again(claims, tmp_path):
    """As where the store was lost, and the files were not."""
    settings, grid = Settings(data_dir=tmp_path), OccupancyGrid(np.zeros((5, 7), bool), 0.3)
    id = Maps(settings, claims).add(grid, {}, OPEN).id
    claims._store().delete("specshield:{library}:maps:", f"specshield:{{library}}:owners:maps:{id}")
    maps = Maps(settings, claims)
    assert id not in [item["id"] for item in maps.page("", None, 1000)[0]]
    with pytest.raises(NotFound):
        maps.find(id, "")
    assert maps.add(grid, {}, OPEN).id == id
    assert id in [item["id"] for item in maps.page("", None, 1000)[0]]
    maps.delete(id, "")
    assert not (tmp_path / "maps" / id).exists()


def test_a_full_disk_refuses_what_is_new_and_says_so(tmp_path, claims):
    few = Settings(data_dir=tmp_path, disk_reserve_bytes=1 << 60)
    claims._settings = few
    with pytest.raises(Exception, match="disk is full"):
        Maps(few, claims).add(OccupancyGrid(np.zeros((5, 8), bool), 0.3), {}, OPEN)


@pytest.mark.parametrize("gone", ["maps", "policies", "."])
def test_files_that_are_away_are_told_as_a_store_that_is(tmp_path, gone):
    """As where a network folder is not mounted any more. Sessions that run need none of them."""
    folder, other = tmp_path / "data" / gone, {**grid_json(), "data": [0] * len(grid_json()["data"])}
    with (
        serving(tmp_path / "data") as server,
        httpx.Client(base_url=server.url, timeout=None, verify=False) as client,
    ):
        kept = client.post("/v1/maps", json=grid_json()).json()["id"]
        begun = {"policy_id": send_policy(client)["id"], "initial_pose": START}
        session = client.post("/v1/sessions", json=begun).json()

        def sent():
            if gone == "policies":
                return client.post("/v1/policies", files=policy_files(seed=1))
            return client.post("/v1/maps", json=other)

        folder.resolve().rename(tmp_path / "away")
        detail = problem(sent(), 503, "store-unavailable")["detail"]
        assert detail == "the server's files cannot be used: No such file or directory"
        if gone != ".":  # else the embedded store is away too
            step = {"t": 0, "poses": [START], "logits": LOGITS}
            assert client.post(f"/v1/sessions/{session['id']}/steps", json=step).status_code == 200
        known = f"/v1/policies/{begun['policy_id']}" if gone == "policies" else f"/v1/maps/{kept}"
        for method in ("GET", "DELETE"):  # it is not said to be absent, nor to be removed
            problem(client.request(method, known), 503, "store-unavailable")
        (tmp_path / "away").rename(folder.resolve())
        assert client.get(known).status_code == 200
        assert sent().status_code in (201, 202)


def test_the_image_of_a_map_is_the_map(client):
    buffer = io.BytesIO()
    shades = np.full((6, 9), 255, np.uint8)
    shades[0, :4] = 0
    Image.fromarray(shades).save(buffer, "PNG")
    parts = {"metadata": ("m", YAML), "image": ("i", buffer.getvalue())}
    id = client.post("/v1/maps", files=parts).json()["id"]
    shown = httpx.get(f"{client.base_url}/v1/maps/{id}/image.png", timeout=None, verify=False)
    assert (np.asarray(Image.open(io.BytesIO(shown.content)).convert("L")) == shades).all()
    assert client.delete(f"/v1/maps/{id}").status_code == 204
