"""Steps over HTTP: answers, replay, races, history, the end, reading back."""

import asyncio
import json
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import msgspec
import pytest
import redis

from specshield.cores import cores
from specshield.service.routes.sessions import _each, _listed
from specshield.service.sessions.state import State
from specshield.shield.decision import Carry
from tests.service import world
from tests.service.world import LOGITS, SPEC, START, ahead, send_policy


def problem(response, status, type):
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    body = response.json()
    assert (body["status"], body["type"]) == (status, type)
    return body


def state(client, session):
    return client.get(f"/v1/sessions/{session['id']}").json()


def test_a_session_as_the_contract_has_it(client, policy, begin):
    session = begin(seed=3)
    assert session["policy_ids"] == [policy["id"]]
    assert session["horizon"] == 8
    assert session["actions"] == ["forward", "left", "right", "wait", "end"]
    assert session["terminal_actions"] == [4]
    assert (session["next_t"], session["feasible"], session["spec_status"]) == (0, True, "pending")
    assert (session["main_task_done"], session["finished"], session["max_steps"]) == (False, False, 600)
    assert state(client, session) == session


def test_an_episode_to_its_end(client, begin, step):
    session, poses = begin(), [START]
    for t in range(9):
        answer = step(session, t, poses[-1:], logits=LOGITS).json()
        assert answer["t"] == t
        assert sum(answer["distribution"]) == pytest.approx(1.0)
        assert answer["distribution"][4] == 0.0
        poses.append(answer["next_poses"][0])
    assert answer["spec_status"] == "satisfied"
    assert not answer["finished"]
    answer = step(session, 9, poses[-1:], logits=None, main_task_done=True).json()
    assert answer["finished"]
    assert state(client, session)["finished"]
    problem(step(session, 10, [START]), 409, "session-finished")


def test_a_session_that_looks_ahead(begin, step):
    session, poses = begin(shaping="lookahead", slack=1, margin=0.01), [START]
    assert (session["shaping"], session["slack"], session["margin"]) == ("lookahead", 1, 0.01)
    for t in range(9):
        answer = step(session, t, poses[-1:], logits=LOGITS).json()
        assert answer["mode"] == ("shaped" if t < 8 else "prior")
        assert answer["distribution"][4] == 0.0
        poses.append(answer["next_poses"][0])
    assert answer["spec_status"] == "satisfied"


@pytest.mark.parametrize("formula", ["x < 9", "F[0,0] x < 9"])
def test_a_rule_that_is_over_at_once_leaves_nothing_to_look_ahead_to(client, begin, step, formula):
    made = send_policy(client, spec={"formula": formula, "regions": {}})
    session = begin(policy_id=made["id"], shaping="lookahead")
    assert step(session, 0, [START], logits=LOGITS).json()["mode"] == "prior"


def test_sessions_that_are_prepared_keep_no_step_waiting(client, policy, begin, step):
    """As many at once as there are threads for decisions, each for a task of its own: they take seconds."""
    session, count = begin(), cores() + 1
    formulas = [f"F[0,{250 + k}] Goal and F[{300 + k},{590 + k}] x < 1.2" for k in range(count)]
    made = [send_policy(client, spec={**SPEC, "formula": formula})["id"] for formula in formulas]

    def create(id):
        body = {"policy_id": id, "initial_pose": START, "shaping": "lookahead", "allow_infeasible": True}
        answer = client.post("/v1/sessions", json=body, timeout=None)
        assert answer.status_code == 201, answer.text
        return time.monotonic()

    with ThreadPoolExecutor(count) as pool:
        creating = [pool.submit(create, id) for id in made]
        time.sleep(0.1)
        assert step(session, 0, [START]).status_code == 200
        stepped = time.monotonic()
        assert stepped < min(each.result() for each in creating)


def test_timings_are_told(begin, step):
    session = begin()
    timing = dict(
        part.split(";dur=") for part in step(session, 0, [START]).headers["server-timing"].split(", ")
    )
    assert set(timing) == {"total", "rollout", "store"}
    assert float(timing["total"]) >= float(timing["rollout"]) > 0


def test_a_replay_is_the_same_bytes_and_changes_nothing(client, begin, step):
    session = begin(seed=5)
    first = step(session, 0, [START], witnesses=True)
    second = step(session, 1, ahead(1))
    before = state(client, session)
    again = step(session, 0, [START])  # asking for less is no other request
    assert again.content == first.content
    assert step(session, 1, ahead(1)[1:]).content == second.content
    assert state(client, session) == before


@pytest.mark.parametrize(
    "change",
    [
        {"logits": [1.0, 0.0, 0.5, -1.0, 0.0]},
        {"logits": [1.0, 0.0, 0.5, -1.0000000000000002, None]},
        {"main_task_done": True},
        {"signals": {"battery": 80.0}},
        {"poses": [[1.0000001, 1.5, 0.0]]},
    ],
)
def test_a_step_decided_and_sent_otherwise_is_a_conflict(client, begin, step, change):
    session = begin()
    step(session, 0, [START])
    before = state(client, session)
    answer = step(session, 0, **{"poses": [START], **change})
    told = problem(answer, 409, "step-conflict")
    name = "pose" if "poses" in change else next(iter(change))
    assert told["detail"] == f"step 0 was decided already, with other values of: {name}"
    assert told["expected_t"] == 1
    assert state(client, session) == before


def test_of_two_racing_callers_one_wins_and_the_other_is_told(begin, step):
    session = begin()
    with ThreadPoolExecutor(8) as pool:
        answers = list(
            pool.map(
                lambda i: step(session, 0, [START], logits=[1.0, 0.0, 0.1 * (i % 2), 0.0, None]), range(8)
            )
        )
    won = {answer.content for answer in answers if answer.status_code == 200}
    lost = [answer for answer in answers if answer.status_code != 200]
    assert len(won) == 1
    assert len(lost) == 4
    for answer in lost:
        problem(answer, 409, "step-conflict")


def test_back_filled_steps_carry_no_decision(client, begin, step):
    session = begin()
    step(session, 0, [START])
    answer = step(session, 3, ahead(3)[1:])
    assert answer.status_code == 200
    assert state(client, session)["next_t"] == 4
    assert problem(step(session, 2, ahead(2)), 409, "step-conflict")["expected_t"] == 4
    items = client.get(f"/v1/sessions/{session['id']}/trajectory").json()["items"]
    assert [item["decision"] is None for item in items] == [False, True, True, False]
    assert [item["pose"] for item in items] == ahead(3)
    assert items[3]["decision"] == answer.json()


def test_a_gap_and_a_differing_overlap_change_nothing(client, begin, step):
    session = begin()
    step(session, 0, [START])
    before = state(client, session)
    gap = problem(step(session, 3, ahead(3)[2:]), 409, "history-gap")
    assert gap["expected_t"] == 1
    wrong = [[1.1, 1.5, 0.0], *ahead(1)[1:]]
    conflict = problem(step(session, 1, wrong), 409, "history-conflict")
    assert (conflict["path"], conflict["t"]) == ("poses[0]", 0)
    assert state(client, session) == before
    assert len(client.get(f"/v1/sessions/{session['id']}/trajectory").json()["items"]) == 1


def test_the_main_task_stays_over(client, begin, step):
    session = begin()
    assert step(session, 0, [START], logits=None, main_task_done=True).json()["mode"] == "completion"
    assert problem(step(session, 1, ahead(1)), 409, "step-conflict")["path"] == "main_task_done"
    assert step(session, 1, ahead(1), main_task_done=True).status_code == 200
    assert state(client, session)["main_task_done"]


def test_the_last_step_is_max_steps(client, begin, step):
    session = begin(max_steps=8)
    for t in (9, 100_000):
        refused = problem(step(session, t, ahead(9)), 422, "invalid-input")
        assert (refused["path"], refused["got"], refused["expected"]) == ("t", t, "at most 8")
        assert "max_steps" in refused["detail"]
    assert problem(step(session, 8, ahead(8)[8:]), 409, "history-gap")["expected_t"] == 1
    for t in range(9):
        answer = step(session, t, ahead(t)[-1:]).json()
    assert answer["finished"]
    told = problem(step(session, 9, ahead(9)), 409, "session-finished")
    assert told["expected"].startswith("a new session")
    assert step(session, 8, ahead(8)[-1:]).json() == answer  # a replay


def test_a_refused_start_says_whether_that_is_proved_and_what_is_wrong_with_each_part(client, policy):
    body = {"policy_id": policy["id"], "initial_pose": [3.5, 0.5, 0.0]}
    refused = problem(client.post("/v1/sessions", json=body), 422, "infeasible-start")
    assert refused["proved"] is True
    assert "'F[0,6] Goal' needs it by step 6" in refused["detail"]
    goal, battery = refused["conjuncts"]
    assert (goal["formula"], goal["feasible_alone"]) == ("F[0,6] Goal", False)
    assert goal["robustness"] < 0.0 < goal["late_by"]
    short = {**body, "max_steps": 6 + goal["late_by"] - 1}  # the session would end before the later end
    refused = problem(client.post("/v1/sessions", json=short), 422, "infeasible-start")
    assert refused["conjuncts"][0]["late_by"] is None
    assert (battery["formula"], battery["feasible_alone"], battery["late_by"]) == (
        "G[0,8] battery > 10",
        True,
        None,
    )


def test_a_session_that_would_end_before_its_rule_is_decided_is_refused(client, policy):
    body = {"policy_id": policy["id"], "initial_pose": START, "max_steps": 7}
    refused = problem(client.post("/v1/sessions", json=body), 422, "invalid-input")
    assert (refused["path"], refused["got"]) == ("max_steps", 7)
    assert refused["expected"].startswith("at least 8")


def test_signals_hold_and_count(client, begin, step):
    session = begin()
    step(session, 0, [START], signals={"battery": 50.0})
    step(session, 2, ahead(2)[1:])
    answer = step(session, 3, ahead(3)[-1:], signals={"battery": 5.0}).json()
    assert answer["spec_status"] == "violated"
    assert answer["mode"] == "violated"
    items = client.get(f"/v1/sessions/{session['id']}/trajectory").json()["items"]
    assert [item["signals"]["battery"] for item in items] == [50.0, 50.0, 50.0, 5.0]
    problem(step(session, 4, ahead(4)[-1:], signals={"fuel": 1.0}), 422, "invalid-samples")


def test_later_poses_may_be_in_collision(begin, step):
    session = begin()
    step(session, 0, [START])
    assert step(session, 1, [[0.05, 1.5, 0.0]]).json()["in_collision"]


def test_close_gives_the_verdict_and_keeps_the_trajectory(client, begin, step):
    session = begin()
    step(session, 0, [START])
    path = f"/v1/sessions/{session['id']}/close"
    gap = problem(client.post(path, json={"t": 9, "poses": ahead(9)[-1:]}), 409, "history-gap")
    assert gap["expected_t"] == 1
    verdict = client.post(path, json={"t": 8, "poses": ahead(8)[1:]})
    assert verdict.status_code == 200, verdict.text
    assert verdict.json()["spec_status"] == "satisfied"
    low, high = verdict.json()["robustness_bounds"]
    assert low == high > 0
    assert client.post(path, json={}).json() == verdict.json()
    assert client.post(path, json={"t": 8, "poses": ahead(8)[-1:]}).json() == verdict.json()
    late = client.post(path, json={"t": 602, "poses": ahead(602)[9:]})
    assert problem(late, 422, "invalid-input")["path"] == "t"
    problem(client.post(path, json={"t": 9, "poses": ahead(9)[-1:]}), 409, "session-finished")
    problem(step(session, 9, ahead(9)[-1:]), 409, "session-finished")
    assert step(session, 0, [START]).status_code == 200  # a replay
    path = f"/v1/sessions/{session['id']}/trajectory"
    items = client.get(path).json()["items"]
    assert len(items) == 9
    assert client.get(path, params={"after": 5}).json()["items"] == items[6:]
    assert client.get(path, params={"after": 8}).json()["items"] == []
    assert problem(client.get(path, params={"after": -2}), 422, "invalid-input")["path"] == "after"


def test_a_finished_session_can_be_closed_once_policy_and_map_are_deleted(client, begin, step, monkeypatch):
    cells = world.cells()
    cells[25, 5] = True  # a map that no other test uses
    monkeypatch.setattr(world, "cells", lambda: cells)
    map_id = client.post("/v1/maps", json=world.grid_json()).json()["id"]
    policy = send_policy(client)["id"]
    ended = begin(policy_id=policy, max_steps=8)
    for t in range(9):
        assert step(ended, t, ahead(t)[-1:]).status_code == 200
    assert client.delete(f"/v1/policies/{policy}").status_code == 204
    assert client.delete(f"/v1/maps/{map_id}").status_code == 204
    path = f"/v1/sessions/{ended['id']}/close"
    verdict = client.post(path, json={}).json()
    assert (verdict["spec_status"], verdict["robustness_bounds"]) == ("satisfied", [None, None])
    assert client.post(path, json={}).json() == verdict


def test_close_with_nothing_new_is_a_verdict_on_what_there_is(client, begin):
    closed = client.post(f"/v1/sessions/{begin()['id']}/close", json={}).json()
    assert (closed["spec_status"], closed["finished"]) == ("pending", True)
    assert closed["robustness_bounds"][1] is not None


def test_the_trajectory_by_lines_is_the_one_by_object(client, begin, step):
    session = begin()
    step(session, 0, [START])
    path = f"/v1/sessions/{session['id']}/trajectory"
    items = client.get(path).json()["items"]
    for asked in ({"params": {"format": "ndjson"}}, {"headers": {"Accept": "application/x-ndjson"}}):
        lines = client.get(path, **asked)
        assert lines.headers["content-type"] == "application/x-ndjson"
        assert [json.loads(line) for line in lines.text.splitlines()] == items


@pytest.mark.parametrize("asked", ["json", "ndjson"])
def test_others_have_their_turn_while_a_long_trajectory_is_written(asked):
    turns = 0

    async def other():
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    async def scenario():
        task = asyncio.create_task(other())
        lines = (b'{"t":%d}' % t for t in range(1000))
        alone = asyncio.Lock()
        parts = _each(lines, alone) if asked == "ndjson" else _listed(lines, b"[]", alone)
        content = b"".join([part async for part in parts])
        task.cancel()
        return content

    content = asyncio.run(scenario())
    items = list(map(json.loads, content.splitlines())) if asked == "ndjson" else json.loads(content)["items"]
    assert items == [{"t": t} for t in range(1000)]
    assert turns > 50


def test_erased_is_gone(client, begin, step):
    session = begin()
    step(session, 0, [START])
    path = f"/v1/sessions/{session['id']}"
    assert client.delete(path).status_code == 204
    for response in (
        client.get(path),
        client.get(f"{path}/trajectory"),
        client.delete(path),
        step(session, 1, [START]),
    ):
        problem(response, 404, "not-found")
    assert begin(id=session["id"])["next_t"] == 0  # the name is free again


def test_an_id_of_ones_own_is_taken_once(client, policy, begin):
    begin(id="mine")
    body = {"policy_id": policy["id"], "initial_pose": START, "id": "mine"}
    problem(client.post("/v1/sessions", json=body), 409, "session-exists")


def test_listing_by_pages_finds_each_once(client, begin):
    made = {begin()["id"] for _ in range(5)}
    found, cursor = [], None
    while True:
        page = client.get(
            "/v1/sessions", params={"limit": 2, **({"cursor": cursor} if cursor else {})}
        ).json()
        found += [item["id"] for item in page["items"]]
        cursor = page["next"]
        if cursor is None:
            break
    assert len(found) == len(set(found))
    assert made <= set(found)


def test_nothing_waits_for_those_who_begin_while_their_policy_may_be_deleted(
    client, begin, step, policy, server
):
    session = begin()
    with closing(redis.Redis(unix_socket_path=str(server.data_dir / "store" / "socket"))) as store:
        mark = f"specshield:{{library}}:mark:policies:{policy['id']}"
        store.set(mark, "a deletion", px=60_000)
        with ThreadPoolExecutor(40) as pool:
            beginning = [pool.submit(begin) for _ in range(40)]  # more than Python has threads for
            time.sleep(0.5)
            try:
                began = time.monotonic()
                assert step(session, 0, [START], occupied=[[4.9, 4.9]]).status_code == 200  # in a thread
                assert client.get("/v1/maps").status_code == 200  # in another, as what deletes is
                assert time.monotonic() - began < 3.0  # those wait for 5 s
            finally:
                store.delete(mark)
            assert all(each.result()["next_t"] == 0 for each in beginning)


def test_a_session_whose_state_is_of_another_version_is_read_and_decides_no_step(client, begin, step, server):
    """One of November 2026 stored 6 bytes where nothing was learned yet, not 18 as `Taught` does now."""
    session = begin()
    first = step(session, 0, [START])
    assert first.status_code == 200
    path, t1 = f"/v1/sessions/{session['id']}", first.json()["next_poses"][0]
    driven = client.get(f"{path}/trajectory").content
    with closing(redis.Redis(unix_socket_path=str(server.data_dir / "store" / "socket"))) as store:
        key = f"specshield:v2:{{@{session['id']}}}:session"
        held = msgspec.msgpack.decode(store.hget(key, "state"))
        carry = held[State.__struct_fields__.index("carry")]
        carry[Carry._fields.index("learned")] = bytes(6)
        store.hset(key, mapping={"state": msgspec.msgpack.encode(held), "version": "another:1"})
    told = problem(step(session, 1, [t1]), 503, "store-unavailable")
    assert told["detail"].startswith("another version of specshield decided")
    spec = {"policy_id": session["policy_ids"][0], "t": 1, "poses": [t1], "clock": "keep"}
    problem(client.post(f"{path}/switch", json=spec), 503, "store-unavailable")
    problem(client.get(f"{path}/learned"), 503, "store-unavailable")
    assert step(session, 0, [START]).content == first.content
    assert client.get(f"{path}/trajectory").content == driven
    assert client.get(f"{path}/record").status_code == 200


def test_the_draw_is_the_seeds(begin, step):
    draws = []
    for seed in (1, 1, 2, 3, 4, 5):
        session = begin(seed=seed, uncertainty="none")  # which leaves every action allowed
        draws.append([step(session, t, [START]).json()["action"] for t in range(3)])
    assert draws[0] == draws[1]
    assert len({tuple(draw) for draw in draws}) > 1


def test_a_policy_in_use_stays_until_its_sessions_are_over(client, begin, policy):
    session = begin()
    answer = problem(client.delete(f"/v1/policies/{policy['id']}"), 409, "in-use")
    assert answer["session_id"]
    problem(client.delete("/v1/policies/case1"), 409, "in-use")
    for item in client.get("/v1/sessions", params={"limit": 1000}).json()["items"]:
        had = {id for rule in item["rules"] for id in rule["policy_ids"]}
        if policy["id"] in had and item["id"] != session["id"]:
            client.delete(f"/v1/sessions/{item['id']}")
    client.post(f"/v1/sessions/{session['id']}/close", json={})
    assert client.delete(f"/v1/policies/{policy['id']}").status_code == 204
    problem(client.get(f"/v1/policies/{policy['id']}"), 404, "not-found")
    assert client.post(f"/v1/sessions/{session['id']}/close", json={}).status_code == 200  # asks no policy
