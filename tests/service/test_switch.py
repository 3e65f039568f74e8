"""Another rule or robot in mid-session: what holds from then on, what stays, and what is refused."""

from __future__ import annotations

import asyncio
import re
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import msgspec
import pytest

from specshield.client import AsyncShieldClient, ShieldClient
from specshield.errors import HistoryGap, InfeasibleSwitch, InputError
from specshield.service.sessions import chain
from tests.service.test_sessions import problem, state
from tests.service.test_verify import told
from tests.service.world import LOGITS, ROBOT, START, ahead, send_policy

END = {"type": "circle", "center": [3.2, 1.5], "radius": 0.4}  # entered by the seventh move after step 3
ORIGIN = {"type": "circle", "center": START[:2], "radius": 0.3}
LATER = {"formula": "F[0,8] End", "regions": {"End": END}}
TOO_SOON = {"formula": "F[0,2] End", "regions": {"End": END}}
BEHIND = {"formula": "F[0,20] Origin", "regions": {"Origin": ORIGIN}}  # its policy drives ahead for ever
BOTH = {"formula": "F[0,3] Origin and F[0,20] End", "regions": {"End": END, "Origin": ORIGIN}}
ALARMED = {"formula": "F[0,16] End and G[0,16] alarm < 1", "regions": {"End": END}, "signals": {"alarm": 0.0}}
AHEAD = [40.0, 0.0, 0.0, 0.0, None]  # so that the drawn action is the first
CRAWLER: dict[str, Any] = {
    "footprint": ROBOT["footprint"],
    "on_contact": "stay",
    "actions": [{"name": "crawl", "translate": 0.1}, {"name": "done", "terminal": True}, {"name": "rest"}],
}


@pytest.fixture
def switch(client):
    """switch(session, t, spec, **fields): the response."""

    def switch(session, t, spec, robot=ROBOT, **fields):
        policy = send_policy(client, spec=spec, robot=robot)
        body = {"t": t, "policy_id": policy["id"], **fields}
        return client.post(f"/v1/sessions/{session['id']}/switch", json=body)

    return switch


def signalled(prefix):
    """LATER with 40 signals."""
    names = [f"{prefix}{i}" for i in range(40)]
    formula = f"F[0,12] End and G[0,12] ({' and '.join(f'{name} < 1' for name in names)})"
    return {"formula": formula, "regions": {"End": END}, "signals": dict.fromkeys(names, 0.0)}


CONJUNCT = {"formula", "feasible_alone", "robustness", "late_by", "smaller_by", "regions"}


def driven(step, session, poses, since=0):
    """The contents of the answers to a step a pose."""
    answers = [step(session, since + i, [pose], logits=AHEAD) for i, pose in enumerate(poses)]
    assert all(answer.status_code == 200 for answer in answers), answers[-1].text
    return [answer.content for answer in answers]


def record_of(client, session):
    return client.get(f"/v1/sessions/{session['id']}/record").content


def test_each_rule_holds_over_its_own_steps(server, client, begin, step, switch, capsys, tmp_path):
    session, poses = begin(), ahead(12)
    before = driven(step, session, poses[:3])
    answer = switch(session, 3, LATER, clock="restart")
    assert answer.status_code == 200, answer.text
    shown = answer.json()
    assert (shown["next_t"], shown["horizon"], shown["spec"]["formula"]) == (3, 8, "F[0,8] End")
    assert [rule["spec_status"] for rule in shown["rules"]] == ["pending", "pending"]
    assert [(rule["from"], rule["origin"], rule["clock"]) for rule in shown["rules"]] == [
        (0, 0, "restart"),
        (3, 3, "restart"),
    ]
    assert switch(session, 3, LATER, clock="restart").json()["rules"] == shown["rules"]

    driven(step, session, poses[3:11], since=3)
    assert driven(step, session, poses[:3]) == before
    assert switch(session, 3, LATER, clock="restart").json()["next_t"] == 11
    assert problem(switch(session, 3, LATER), 409, "step-conflict")["expected_t"] == 11
    rules = state(client, session)["rules"]
    assert [rule["spec_status"] for rule in rules] == ["pending", "satisfied"]

    trajectory = client.get(f"/v1/sessions/{session['id']}/trajectory").json()
    assert [item["rule"] for item in trajectory["items"]] == [0] * 3 + [1] * 8
    assert [set(item["signals"]) for item in trajectory["items"][2:4]] == [{"battery"}, set()]
    assert trajectory["items"][10]["decision"]["t"] == 10
    assert trajectory["rules"] == rules
    status, said = told(capsys, tmp_path, record_of(client, session), data_dir=server.data_dir)
    assert status == 0, said
    assert "from step 3, windows from step 3: F[0,8] End" in said


def test_all_poses_that_are_told_with_a_switch_are_kept(
    server, client, begin, step, switch, capsys, tmp_path
):
    session, poses = begin(), ahead(10)
    driven(step, session, poses[:3])
    for _ in range(2):  # the same switch again is the same
        answer = switch(session, 6, LATER, clock="restart", poses=poses[3:7])
        assert answer.status_code == 200, answer.text
    driven(step, session, poses[6:9], since=6)
    items = client.get(f"/v1/sessions/{session['id']}/trajectory").json()["items"]
    assert [item["pose"] for item in items] == poses[:9]
    status, said = told(capsys, tmp_path, record_of(client, session), data_dir=server.data_dir)
    assert status == 0, said


def test_the_state_in_which_a_rule_ends_is_its_last(client, begin, step, switch):
    """x_3 is in the first goal; the server hears of it after the switch, and before."""
    for told_later in (True, False):
        session, poses = begin(), ahead(9)
        driven(step, session, poses[:3])
        spec = {"formula": "F[0,3] Goal", "regions": {"Goal": {**END, "center": [2.0, 1.5], "radius": 0.5}}}
        assert switch(session, 0, spec).status_code == 409
        assert switch(session, 3, spec, clock="keep").status_code == 200
        fields = {} if told_later else {"poses": poses[2:4]}
        shown = switch(session, 3, LATER, clock="restart", **fields).json()
        assert shown["rules"][1]["spec_status"] == ("pending" if told_later else "satisfied")
        driven(step, session, poses[3:4], since=3)
        verdicts = [rule["spec_status"] for rule in state(client, session)["rules"]]
        assert verdicts == ["pending", "satisfied", "pending"]


@pytest.mark.parametrize("last", [3, 8])
@pytest.mark.parametrize("fields", [{}, {"poses": [ahead(3)[3]]}], ids=["x_t comes later", "x_t is told"])
def test_the_signals_of_the_state_in_which_a_rule_ends_count_for_it(
    client, begin, step, switch, last, fields
):
    """They come with the step, under a rule that does not read them; until then the policy is needed."""
    spec = {"formula": f"G[0,{last}] battery > 10", "regions": {}, "signals": {"battery": 90.0}}
    old, poses = send_policy(client, spec=spec, seed=last)["id"], ahead(3)
    session = begin(policy_id=old)
    driven(step, session, poses[:3])
    assert switch(session, 3, LATER, clock="restart", **fields).status_code == 200
    problem(client.delete(f"/v1/policies/{old}"), 409, "in-use")
    assert step(session, 3, poses[3:], signals={"battery": 5.0}).status_code == 200
    assert [rule["spec_status"] for rule in state(client, session)["rules"]] == ["violated", "pending"]
    assert client.delete(f"/v1/policies/{old}").status_code == 204
    for _ in range(2):
        closed = client.post(f"/v1/sessions/{session['id']}/close", json={}).json()
        assert [rule["spec_status"] for rule in closed["rules"]] == ["violated", "pending"]


def test_what_cannot_be_kept_changes_nothing(client, begin, step, switch):
    session, poses = begin(), ahead(8)
    driven(step, session, poses[:3])
    before, record = state(client, session), record_of(client, session)
    for spec, fields in ((TOO_SOON, {"clock": "restart"}), (TOO_SOON, {}), (BOTH, {"clock": "restart"})):
        for poses_sent in ({}, {"poses": [poses[3]]}):
            told = problem(switch(session, 3, spec, **fields, **poses_sent), 422, "infeasible-switch")
            assert ("restart" in told["expected"]) == ("clock" not in fields)
    problem(switch(session, 3, LATER, poses=[[99.0, 1.5, 0.0]], robot=CRAWLER), 422, "invalid-pose")
    assert problem(switch(session, 5, LATER), 409, "history-gap")["expected_t"] == 3
    problem(switch(session, 3, LATER, clock="later"), 422, "invalid-input")
    assert state(client, session) == before
    assert record_of(client, session) == record
    driven(step, session, poses[3:], since=3)


@pytest.mark.parametrize("action", [1, 3], ids=["left", "wait"])
def test_a_second_switch_at_a_step_begins_where_the_first_robot_goes(client, begin, step, switch, action):
    """Four steps of the crawler reach the goal from where `forward` leads, not from where the robot goes. Its
    action 1 ends the task, and it has no action 3.
    """
    goal = {"Goal": {"type": "circle", "center": [2.0, 1.5], "radius": 0.5}}
    far, near = ({"formula": f"F[0,{last}] Goal", "regions": goal} for last in (40, 4))
    session = begin(policy_id=send_policy(client, spec=far)["id"])
    decided = step(session, 0, [START], logits=[0.0 if i == action else None for i in range(5)]).json()
    assert decided["action"] == action
    assert switch(session, 1, far, CRAWLER).status_code == 200
    assert b"<svg" in client.get(f"/v1/sessions/{session['id']}/image.svg").content
    before = state(client, session)
    problem(switch(session, 1, near, CRAWLER, clock="restart"), 422, "infeasible-switch")
    assert state(client, session) == before
    assert switch(session, 1, far, clock="restart").status_code == 200
    assert step(session, 1, [decided["next_poses"][action]]).json()["mode"] == "shaped"


def test_what_no_session_can_hold_is_refused_and_changes_nothing(client, begin, step, switch):
    session, poses = begin(max_steps=40), ahead(5)
    driven(step, session, poses[:1])
    assert switch(session, 1, signalled("a")).status_code == 200
    before = state(client, session)
    assert problem(switch(session, 1, signalled("b")), 422, "invalid-input")["got"] == 81
    driven_on = [*poses[1:], *[poses[-1]] * 45]
    far = {**LATER, "formula": "F[0,40] End"}
    refused = problem(switch(session, 50, far, poses=driven_on), 422, "invalid-input")
    assert (refused["path"], refused["expected"]) == ("t", "at most 41")
    assert state(client, session) == before


def test_a_way_that_a_search_found_and_no_policy_did_is_taken(
    server, client, begin, step, switch, capsys, tmp_path
):
    session, poses = begin(), ahead(5)
    driven(step, session, poses[:5])
    assert switch(session, 5, BEHIND, clock="restart").status_code == 200
    t, pose = 5, poses[5]
    while (answer := step(session, t, [pose], logits=AHEAD).json())["spec_status"] == "pending":
        assert answer["mode"] == "shaped"
        t, pose = t + 1, answer["next_poses"][answer["action"]]
    assert answer["spec_status"] == "satisfied"
    status, said = told(capsys, tmp_path, record_of(client, session), data_dir=server.data_dir)
    assert status == 0, said


def test_a_history_that_counts_and_one_that_does_not(begin, step, switch):
    """BOTH asks to be at the start first: it has been there, if that counts."""
    session, poses = begin(), ahead(6)
    driven(step, session, poses[:5])
    refused = problem(switch(session, 5, BOTH, clock="restart"), 422, "infeasible-switch")
    assert isinstance(refused["proved"], bool)
    assert [set(part) for part in refused["conjuncts"]] == [CONJUNCT] * len(refused["conjuncts"]) != []
    shown = switch(session, 5, BOTH, clock="keep").json()
    assert (shown["rules"][1]["from"], shown["rules"][1]["origin"]) == (5, 0)
    assert step(session, 5, poses[5:6]).json()["mode"] == "shaped"


def test_a_refusal_names_a_smaller_keep_out_that_is_taken_as_it_is(client, begin, step, switch):
    """The robot was at x = 2.0 m, 0.15 m deep in Wet, when the new rule's windows had begun already."""
    session, poses = begin(), ahead(7)
    driven(step, session, poses[:7])
    corners = [[1.65, 1.35], [2.6, 1.35], [2.6, 1.85], [1.65, 1.85]]
    wet = {"type": "polygon", "vertices": corners}
    spec = {"formula": "F[0,16] End and G[0,16] not Wet", "regions": {"End": END, "Wet": wet}}
    refused = problem(switch(session, 7, spec), 422, "infeasible-switch")
    reach, keep_out = refused["conjuncts"]
    assert (reach["smaller_by"], reach["regions"], reach["feasible_alone"]) == (None, None, True)
    assert (keep_out["smaller_by"], keep_out["feasible_alone"], keep_out["late_by"]) == (0.16, False, None)
    taken = {**spec, "regions": {**spec["regions"], **keep_out["regions"]}}
    assert keep_out["regions"]["Wet"]["vertices"][0] == [1.81, 1.51]
    assert refused["detail"].endswith("already. A way was found with Wet smaller by 0.16 m all round")
    assert switch(session, 7, taken).status_code == 200
    assert step(session, 7, poses[7:8]).json()["mode"] == "shaped"


def test_another_robot_with_other_signals_and_back(server, client, begin, step, switch, capsys, tmp_path):
    session, poses = begin(), ahead(3)
    before = driven(step, session, poses[:3])
    shown = switch(session, 3, ALARMED, CRAWLER, clock="restart", poses=[poses[3]]).json()
    assert (shown["actions"], shown["terminal_actions"]) == (["crawl", "done", "rest"], [1])
    pose, crawled = poses[3], []
    for t in range(3, 6):
        # A robot may go on sending what the rule before read.
        body: dict[str, Any] = {
            "logits": [0.0, None, 1.0],
            "signals": {"alarm": 0.1 * t, "battery": 80.0 - t},
        }
        answer = step(session, t, [pose], **body)
        crawled.append((t, [pose], body, answer.content))
        assert answer.json()["action_name"] in ("crawl", "rest")
        pose = answer.json()["next_poses"][0]
    problem(step(session, 6, [pose], logits=LOGITS), 422, "invalid-logits")
    unknown = step(session, 6, [pose], logits=[0.0, None, 1.0], signals={"charge": 1.0})
    assert "one of alarm, battery," in problem(unknown, 422, "invalid-samples")["expected"]
    shown = switch(session, 6, LATER, clock="restart").json()
    assert shown["max_steps"] == 600
    assert step(session, 6, [pose], logits=LOGITS).json()["action_name"] in session["actions"]

    assert driven(step, session, poses[:3]) == before
    for t, sent, body, content in crawled:
        assert step(session, t, sent, **body).content == content
    items = client.get(f"/v1/sessions/{session['id']}/trajectory").json()["items"]
    assert [item["signals"] for item in items[2:4]] == [{"battery": 90.0}, {"alarm": pytest.approx(0.3)}]
    content = record_of(client, session)
    status, said = told(capsys, tmp_path, content, data_dir=server.data_dir)
    assert status == 0, said
    assert chain.read(content).rows.shape == (7, 5)


def test_a_switch_that_was_written_otherwise_is_found(client, begin, step, switch):
    session = begin()
    driven(step, session, ahead(2))
    assert switch(session, 3, LATER, clock="restart").status_code == 200
    driven(step, session, ahead(4)[3:], since=3)
    content = record_of(client, session)
    config = msgspec.msgpack.decode(content)["config"]
    for a, b in ((b'"from":3', b'"from":2'), (b'"origin":3', b'"origin":0'), (b"F[0,8] End", b"F[0,9] End")):
        assert config.count(a) == 1
        with pytest.raises(InputError):
            chain.read(content.replace(a, b))


def test_a_policy_stays_until_the_last_pose_of_its_rule_is_known(client, begin, step, switch):
    """What the rule says of that pose is worked out on its map, which goes once no policy is on it."""
    old = send_policy(client, seed=77)["id"]
    session, poses = begin(policy_id=old), ahead(4)
    driven(step, session, poses[:3])
    assert switch(session, 3, LATER, clock="restart").status_code == 200
    problem(client.delete(f"/v1/policies/{old}"), 409, "in-use")
    driven(step, session, poses[3:4], since=3)
    assert client.delete(f"/v1/policies/{old}").status_code == 204
    driven(step, session, poses[4:], since=4)


def test_of_a_step_and_a_switch_at_once_one_is_first(client, begin, step, switch):
    poses = ahead(4)
    for _ in range(4):
        session = begin()
        driven(step, session, poses[:3])
        with ThreadPoolExecutor(4) as pool:
            stepping = [pool.submit(step, session, 3, [poses[3]], logits=AHEAD) for _ in range(2)]
            switching = [pool.submit(switch, session, 3, LATER, clock="restart") for _ in range(2)]
            stepped = [each.result() for each in stepping]
            switched = [each.result() for each in switching]
        assert len({answer.content for answer in stepped}) == 1
        assert stepped[0].status_code == 200
        rules = state(client, session)["rules"]
        assert len({answer.status_code for answer in switched}) == 1
        assert len(rules) == (2 if switched[0].status_code == 200 else 1)
        if len(rules) == 1:
            problem(switched[0], 409, "step-conflict")


def test_the_sdk_switches_and_watches(server, client, begin, step):
    later = send_policy(client, spec=LATER)["id"]
    crawling = send_policy(client, spec=ALARMED, robot=CRAWLER)["id"]
    too_soon = send_policy(client, spec=TOO_SOON)["id"]
    policy, poses = begin()["policy_ids"][0], ahead(12)
    with (
        ShieldClient(server.url, timeout=30.0) as shield,
        shield.sessions.create(policy_id=policy, initial_pose=START, uncertainty="none") as session,
    ):
        for pose in poses[:3]:
            session.step(pose, LOGITS)
        session.record(poses[3])
        with pytest.raises(HistoryGap):
            session.switch(later, clock="restart")
        with pytest.raises(InfeasibleSwitch):
            session.switch(too_soon, clock="restart", pose=poses[4])
        assert session.info.policy_ids == (policy,)
        info = session.switch(policy_ids=[crawling], clock="restart", pose=poses[4])
        assert session.info is info
        assert info.actions == ("crawl", "done", "rest")
        assert [session.rule_at(t) for t in (3, 4)] == [rule["formula"] for rule in info.rules]
        decision = session.step(poses[4], [0.0, 9.0, 0.0])
        assert (decision.t, decision.execute in (0, 2)) == (4, True)
        events = session.events(-1)
        assert [next(events).t for _ in range(4)] == [0, 1, 2, 4]
        events.close()
        again = shield.sessions.get(session.id, on_failure="witness")
        assert [rule["from"] for rule in again.info.rules] == [0, 4]
    text = client.get(f"/v1/sessions/{session.id}/events", params={"after": 1}).text
    assert [line for line in text.splitlines() if line.startswith(("id", "event"))] == [
        "id: 2",
        "event: switch",
        "id: 4",
        "event: end",
    ]


def test_the_sdk_switches_awaiting(server, client, begin):
    later, policy = send_policy(client, spec=LATER)["id"], begin()["policy_ids"][0]

    async def main():
        async with AsyncShieldClient(server.url, timeout=30.0) as shield:
            session = await shield.sessions.create(policy_id=policy, initial_pose=START)
            async with session:
                await session.step(START, LOGITS)
                info = await session.switch(later, clock="restart", pose=ahead(1)[1])
                assert (info.rules[-1]["from"], session.t) == (1, 1)
                assert (await session.step(ahead(1)[1], LOGITS)).t == 1

    asyncio.run(main())


def test_what_the_map_has_learned_goes_on_with_its_age(server, client, begin, step, switch, capsys, tmp_path):
    """A point that is remembered for 4 steps was seen at step 1: it counts to step 5, by either clock."""
    for clock in ("restart", "keep"):
        session, poses = begin(map_memory=4, learn_map=False), ahead(9)
        for t in range(7):
            if t == 3:
                spec = LATER if clock == "restart" else {**LATER, "formula": "F[0,14] End"}
                assert switch(session, 3, spec, clock=clock).status_code == 200
            seen = {"occupied": [[1.0, 2.5]]} if t == 1 else {}
            answer = step(session, t, [poses[t]], logits=AHEAD, **seen).json()
            assert answer["map_revision"] == [0, 1, 1, 1, 1, 1, 2][t], (clock, t)
        status, said = told(capsys, tmp_path, record_of(client, session), data_dir=server.data_dir)
        assert status == 0, said


def test_a_picture_shows_the_present_floor_and_counts_the_session_s_steps(client, begin, step, switch):
    session, poses = begin(), ahead(6)

    def drawn():
        picture = client.get(f"/v1/sessions/{session['id']}/image.svg").text
        return re.findall(r'class="way" points="([^"]*)"', picture)[0].split(), picture

    driven(step, session, poses[:3])
    assert switch(session, 3, LATER, clock="restart").status_code == 200
    driven(step, session, poses[3:6], since=3)
    way, picture = drawn()
    assert (len(way), "step 5. " in picture, "last step is 11." in picture) == (6, True, True)
    case1 = {"t": 6, "policy_id": "case1", "poses": [[4.5, 5.0, 0.0]], "clock": "restart"}
    assert client.post(f"/v1/sessions/{session['id']}/switch", json=case1).status_code == 200
    assert step(session, 6, [[4.5, 5.0, 0.0]], logits=[0.0] * 20).status_code == 200
    way, picture = drawn()
    assert (len(way), "step 6. " in picture, "last step is 146." in picture) == (1, True, True)


def test_a_picture_is_drawn_before_any_pose_on_the_new_floor_is_known(client):
    begun = {"policy_id": "case1", "initial_pose": [4.5, 5.0, 0.0]}
    path = f"/v1/sessions/{client.post('/v1/sessions', json=begun).json()['id']}"
    first = {"t": 0, "poses": [[4.5, 5.0, 0.0]], "logits": [0.0] * 20}
    assert client.post(f"{path}/steps", json=first).status_code == 200
    switched = client.post(f"{path}/switch", json={"t": 1, "policy_id": "case2", "clock": "restart"})
    assert switched.status_code == 200, switched.text
    picture = client.get(f"{path}/image.svg")
    assert picture.status_code == 200, picture.text
    assert "No pose" in picture.text
    assert "way driven" not in picture.text
