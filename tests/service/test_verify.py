"""A session's record: what is told of it, and that nothing in it can be changed unseen."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from specshield import __version__
from specshield.client import ShieldClient
from specshield.errors import InputError
from specshield.service.sessions import chain, record
from specshield.service.settings import Settings
from specshield.service.verify import verify
from tests.service.world import ahead
from tests.serving import HUNG, Forked, run_specshield


@pytest.fixture(scope="module")
def case1(server: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, str]:
    """A record of case 1, and its seal: steps decided, passed over, and with all witnesses."""
    file = tmp_path_factory.mktemp("record") / "case1.record"
    with ShieldClient(server.url, timeout=30.0) as client:
        pose = (4.5, 5.0, 0.0)
        with client.sessions.create(policy_id="case1", initial_pose=pose, seed=3, slack=2) as session:
            random = np.random.default_rng(0)
            for t in range(24):
                if t in (5, 6):
                    session.record(pose)
                    continue
                decision = session.step(pose, random.normal(size=20), witnesses=t == 3)
                pose = decision.next_poses[decision.execute]
            seal = session.save_record(file)
            with pytest.raises(InputError, match="cannot be written: No such file or directory"):
                session.save_record(file.parent / "none" / "record")
            session.close(pose)
            closed = session.save_record(file.with_suffix(".closed"))
    assert seal != closed
    return file.with_suffix(".closed").read_bytes(), closed


def told(capsys: Any, tmp_path: Any, content: bytes, **settings: Any) -> tuple[int, str]:
    file = tmp_path / "a.record"
    file.write_bytes(content)
    status = verify(file, Settings(**{"data_dir": tmp_path / "none", **settings}))
    return status, capsys.readouterr().out


def test_every_step_is_decided_again_to_the_same_bytes(case1, capsys, tmp_path):
    content, seal = case1
    status, said = told(capsys, tmp_path, content)
    assert status == 0, said
    assert f"seal {seal}" in said
    assert "22 decided steps, 25 poses" in said
    assert "every step is decided again" in said
    assert not (tmp_path / "none").exists()


def test_what_was_sent_to_a_server_is_found_in_its_data_folder(server, client, begin, step, capsys, tmp_path):
    session = begin()
    for t, pose in enumerate(ahead(6)):
        signals = {"battery": 80.0 - t} if t % 2 == 0 else None
        fields = {} if signals is None else {"signals": signals}
        assert step(session, t, [pose], **fields).status_code == 200
    answer = client.get(f"/v1/sessions/{session['id']}/record")
    assert answer.status_code == 200
    assert told(capsys, tmp_path, answer.content, data_dir=server.data_dir)[0] == 0
    other = with_config(answer.content, 0, signals={"battery": 91.0})
    status, said = told(capsys, tmp_path, other, data_dir=server.data_dir)
    assert (status, "the rule from step 0 on differs in signals" in said) == (1, True)
    status, said = told(capsys, tmp_path, answer.content)
    assert (status, "the chain is whole" in said, "NOT decided again" in said) == (2, True, True)
    assert client.get("/v1/sessions/none/record").json()["type"] == "not-found"


def test_where_a_policy_is_missing_the_options_that_name_folders_are_told(case1, capsys, tmp_path):
    status, said = told(capsys, tmp_path, case1[0], models_dir=tmp_path)
    assert (status, "--models-dir" in said, "/v1/" in said) == (2, True, False)


def test_a_file_that_cannot_be_read_is_none_that_differs(case1, capsys, tmp_path):
    for unread in (tmp_path / "none", tmp_path):
        ended = run_specshield("verify", unread)
        assert (ended.returncode, ended.stdout) == (3, "")
        assert f"{unread} cannot be read: " in ended.stderr
    (tmp_path / "maps").touch()  # where a server would have its maps
    status, said = told(capsys, tmp_path, case1[0], data_dir=tmp_path)
    assert (status, "the chain is whole" in said, "NOT decided again" in said) == (2, True, True)


@given(st.data())
def test_any_byte_that_is_changed_is_found(case1, data):
    content = bytearray(case1[0])
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= data.draw(st.integers(1, 255))
    with pytest.raises(InputError):
        chain.read(bytes(content))


@given(st.data())
def test_bytes_left_out_doubled_or_added_are_found(case1, data):
    content = case1[0]
    a, b = sorted(data.draw(st.lists(st.integers(0, len(content)), min_size=2, max_size=2, unique=True)))
    added = data.draw(st.binary(min_size=1, max_size=9))
    for changed in (content[:a] + content[b:], content[:b] + content[a:], content[:a] + added + content[a:]):
        with pytest.raises(InputError):
            chain.read(changed)


def test_what_no_hash_covers_is_as_a_server_writes_it(case1):
    """An empty step at the end; and the values of a signal from before the switch that brought it."""
    file = msgspec.msgpack.decode(case1[0])
    assert len(file["rows"]) > 24 * len(file["steps"])
    with pytest.raises(InputError, match="the last not empty"):
        chain.read(msgspec.msgpack.encode({**file, "steps": [*file["steps"], b""]}))

    rows, steps = np.frombuffer(file["rows"], "<f8").reshape(-1, 3)[:8], file["steps"][:4]
    config = json.loads(file["config"])
    config["spec"]["signals"] = {"alarm": 0.0}
    config |= {"from": 4, "origin": 4, "before": record.link(record.digest(steps[3]), rows[:0]).hex()}
    lines = file["config"] + b"\n" + json.dumps(config).encode()
    wide = np.hstack([rows, np.zeros((8, 1))])
    content, seal = chain.pack(lines, wide.tobytes(), steps)
    assert chain.read(content).seal == seal
    for t in range(8):
        changed = wide.copy()
        changed[t, 3] = -0.0  # one bit
        with pytest.raises(InputError, match="a signal has values" if t < 4 else "the seal"):
            chain.read(content.replace(wide.tobytes(), changed.tobytes()))


@given(st.binary(max_size=300))
def test_what_is_no_record_is_refused(content):
    with pytest.raises(
        InputError, match=r"no record of a session.*; expected what GET /v1/sessions/\{id\}/rec"
    ):
        chain.read(content)


def test_a_result_that_cannot_be_printed_is_not_that_of_a_record_that_differs(case1, tmp_path):
    """It was status 1. Other commands end with one line, too."""
    file, told = tmp_path / "a.record", tmp_path / "stderr"
    file.write_bytes(case1[0])
    for asked, status, said in (
        (["verify", str(file)], 3, "the result cannot be printed"),
        (["openapi"], 2, "what this command writes is not complete"),
    ):
        command = Forked(asked, {**os.environ}, stdout=Path("/dev/full"), stderr=told, cwd=tmp_path)
        assert command.wait(HUNG) == status
        assert told.read_text().splitlines()[-1] == f"{said}: No space left on device"


def test_a_record_whose_id_leads_to_another_folder_is_refused(case1):
    """By default a command names the file that it writes by the session's id."""
    file = msgspec.msgpack.decode(case1[0])
    for id in ("../../etc/cron", "a/b", "a\0b", "", ".."):
        config = json.dumps({**json.loads(file["config"]), "id": id}).encode()
        with pytest.raises(InputError, match="the session's id is none that a server would take"):
            chain.read(chain.pack(config, file["rows"], [])[0])


def forged(content: bytes, t: int, **changed: Any) -> bytes:
    """A whole chain of which one step says something else: who holds the server can make one."""
    file, steps = msgspec.msgpack.decode(content), list(chain.read(content).steps)
    if t >= 0:
        steps[t] = record.encode(msgspec.structs.replace(record.decode(steps[t]), **changed))
    return sealed_anew(content, file["config"], steps)


def sealed_anew(content: bytes, config: bytes, steps: list[bytes]) -> bytes:
    """The record with this config and these steps, each of which holds the hash of what comes before it."""
    found = chain.read(content)
    lines, steps, last, start = config.split(b"\n"), list(steps), record.digest(config.split(b"\n")[0]), 0
    for t, step in enumerate(steps):
        for i, old in enumerate(found.configs[1:], 1):
            if old.begins == t:
                lines[i] = lines[i].replace(
                    old.before.encode(), record.link(last, found.rows[start:t]).hex().encode()
                )
                last, start = record.digest(lines[i]), t
        if step:
            kept = record.decode(step)
            kept = msgspec.structs.replace(kept, before=record.link(last, found.rows[start : t + 1]))
            steps[t] = record.encode(kept)
            last, start = record.digest(steps[t]), t + 1
    return chain.pack(b"\n".join(lines), msgspec.msgpack.decode(content)["rows"], steps)[0]


def with_config(content: bytes, rule: int, **changed: Any) -> bytes:
    """A whole chain whose config says something else of this rule."""
    file = msgspec.msgpack.decode(content)
    configs = [json.loads(line) for line in file["config"].split(b"\n")]
    for name, value in changed.items():
        held = configs[rule]["spec"] if name in configs[rule]["spec"] else configs[rule]
        assert held.get(name) != value
        held[name] = value
    lines = [json.dumps(config, separators=(",", ":")).encode() for config in configs]
    return sealed_anew(content, b"\n".join(lines), file["steps"])


FORGED: dict[str, Any] = {
    "map_id": "0" * 64,
    "robot": {"footprint": {"radius": 0.01, "offset": [0, 0]}, "on_contact": "stay", "actions": []},
    "horizon": 3,
    "terminal_actions": [],
    "actions": [f"action {i}" for i in range(20)],
    "formula": "F[0,60] x > 1",
    "regions": {"Door": {"type": "circle", "center": [0.0, 0.0], "radius": 0.1}},
}


@pytest.mark.parametrize("name", FORGED)
def test_a_config_that_tells_of_another_task_than_the_policies_is_found_out(case1, name, capsys, tmp_path):
    assert with_config(case1[0], 0) == case1[0]
    status, said = told(capsys, tmp_path, with_config(case1[0], 0, **{name: FORGED[name]}))
    assert status == 1
    assert "the chain is whole" in said
    assert f"NOT as decided: the rule from step 0 on differs in {name}" in said


def test_a_config_that_no_server_wrote_breaks_nothing(case1, capsys, tmp_path):
    for changed in ({"uncertainty": {"drift": 1.0}}, {"policy_ids": []}, {"slack": -5}, {"evaluation": "x"}):
        status, said = told(capsys, tmp_path, with_config(case1[0], 0, **changed))
        assert (status, "NOT decided again" in said) == (2, True), changed


def test_a_switch_that_tells_of_another_rule_or_clock_is_found_out(server, capsys, tmp_path):
    pose, file = (4.5, 5.0, 0.0), tmp_path / "switched.record"
    with (
        ShieldClient(server.url, timeout=60.0) as client,
        client.sessions.create(policy_id="case1", initial_pose=pose) as session,
    ):
        for t in range(5):
            if t == 3:
                session.switch("case1", clock="keep", pose=pose)
            decision = session.step(pose, np.zeros(20))
            pose = decision.next_poses[decision.execute]
        session.save_record(file)
    content = file.read_bytes()
    assert with_config(content, 1) == content
    assert told(capsys, tmp_path, content)[0] == 0
    for changed, expected in (
        ({"horizon": 3}, "NOT as decided: the rule from step 3 on differs in horizon"),
        ({"formula": "F[0,60] x > 1"}, "NOT as decided: the rule from step 3 on differs in formula"),
        ({"clock": "restart"}, "NOT as it was: step 3: the origin"),
        ({"clock": "restart", "origin": 3}, "NOT as decided: step 3"),
    ):
        status, said = told(capsys, tmp_path, with_config(content, 1, **changed))
        assert status == 1, (changed, said)
        assert expected in said
    status, said = told(capsys, tmp_path, with_config(content, 0, clock="keep"))
    assert "NOT as it was: step 0" in said
    upgraded = with_config(content, 1, version="0.0.9")
    assert [told(capsys, tmp_path, forged(upgraded, t, kl=0.5))[0] for t in (2, 3)] == [1, 4]


def test_a_forged_chain_is_whole_and_its_answer_is_found_out(case1, capsys, tmp_path):
    content, seal = case1
    assert forged(content, -1) == content
    kept = record.decode(chain.read(content).steps[7])
    other = next(a for a in range(20) if a != kept.action)
    for changed, named in (
        ({"action": other}, "action"),
        ({"mode": "fallback"}, "mode"),
        ({"kl": 0.5}, "kl"),
    ):
        status, said = told(capsys, tmp_path, forged(content, 7, **changed))
        assert status == 1
        assert "the chain is whole" in said
        assert f"step 7 differs in {named}" in said
        assert seal not in said, "whoever kept the seal knows at once"


def test_what_another_version_decided_has_a_status_of_its_own(case1, capsys, tmp_path):
    content, _ = case1
    old = with_config(content, 0, version="0.0.9")
    status, said = told(capsys, tmp_path, old)
    assert (status, "decided by specshield 0.0.9\n" in said) == (0, True)
    status, said = told(capsys, tmp_path, forged(old, 7, kl=0.5))
    assert status == 4
    assert (
        f"decided by specshield 0.0.9, and otherwise by this one, {__version__}: step 7 differs in kl" in said
    )
    assert "NOT" not in said
    assert told(capsys, tmp_path, forged(old, 7, logits=b""))[0] == 4  # cannot be decided again at all
    config = json.loads(msgspec.msgpack.decode(content)["config"])
    assert config.pop("version") == __version__
    before = sealed_anew(content, json.dumps(config).encode(), msgspec.msgpack.decode(content)["steps"])
    assert told(capsys, tmp_path, before)[0] == 0
    assert told(capsys, tmp_path, forged(before, 7, kl=0.5))[0] == 1


HOSTILE = [
    {"logits": b""},
    {"logits": b"\xff" * 400},
    {"rows": b""},
    {"rows": bytes(range(20))},
    {"table": b"\xff" * 7},
    {"pool": b"123"},
    {"action": 10**9},
    {"pose": b"12"},
    {"pose": np.array([np.nan] * 3).tobytes()},
    {"signals": 2**62},
    {"distribution": b"\x00"},
    {"kl": float("nan")},
    {"main_task_done": True},
    {"logits": None},
]


@pytest.mark.parametrize("changed", HOSTILE, ids=str)
def test_a_hostile_step_is_told_of_and_breaks_nothing(case1, changed, capsys, tmp_path):
    status, said = told(capsys, tmp_path, forged(case1[0], 7, **changed))
    assert status == 1
    assert "NOT as" in said


def test_a_decision_by_tables_made_beside_is_decided_again_by_the_same_tables(server, capsys, tmp_path):
    """Something stands where the map has nothing. The robot waits until the tables for that are there. A
    session that begins anew by the same id, on which something else stands, has none of them.
    """
    pose = (4.5, 5.0, 0.0)
    box = [(0.05 * i + 0.025, 0.05 * j + 0.025) for i in range(70, 76) for j in range(96, 103)]
    file, logits = tmp_path / "learned.record", np.zeros(20)
    logits[4] = -np.inf  # `end`: the session goes on until they are
    with ShieldClient(server.url, timeout=60.0) as client:
        asked: dict[str, Any] = {
            "policy_id": "case1",
            "initial_pose": pose,
            "learn_map": False,
            "id": "again",
        }
        with client.sessions.create(**asked) as session:
            kept: list[Any] = []
            while not any(kept):
                decision = session.step(pose, logits, occupied=box)
                assert decision.map_revision == 1
                session.save_record(file)
                kept = [made.tables for _, _, made in chain.read(file.read_bytes()).decided()]
                time.sleep(0.5)
        session.save_record(file)
        client.sessions.delete("again")
        with client.sessions.create(**asked) as session:
            for _ in range(2):
                session.step(pose, logits, occupied=box[::2])
        session.save_record(tmp_path / "anew.record")
    for each in (file, tmp_path / "anew.record"):
        status, said = told(capsys, tmp_path, each.read_bytes())
        assert status == 0, said
        assert "every step is decided again" in said
