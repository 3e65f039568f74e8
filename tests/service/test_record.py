"""The record of a step: it reads back to the last bit, answers in the same bytes, and is small."""

import hashlib
import math

import httpx
import msgspec
import numpy as np
import pytest
import redis
from hypothesis import given
from hypothesis import strategies as st

from specshield.client import ShieldClient
from specshield.policy.dqn.environment import free_poses
from specshield.service.schemas.answers import to_json, to_msgpack
from specshield.service.sessions import record
from specshield.shield.decision import Carry, Decision, Explanation
from specshield.sim.cases import load_case
from specshield.sim.episodes import with_shield
from specshield.sim.learned.model import load_learned
from tests.serving import serving

number = st.floats(allow_nan=False, allow_infinity=False)
maybe = st.none() | number
detail = st.sampled_from([None, "'A' is not met"])


@st.composite
def decisions(draw):
    """(decision, row, what was asked): values of every kind, many of them equal."""
    count, few = draw(st.integers(1, 256)), draw(st.lists(number, min_size=1, max_size=5))
    some = st.sampled_from([*few, 0.0, -0.0, 1.0]) if draw(st.booleans()) else number
    row = np.array([draw(some), draw(some), draw(some), 7.0, draw(number)])
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    values = [draw(some) for _ in range(8)] + row[:3].tolist()

    def pick(*shape):
        return random.choice(values, shape) if draw(st.booleans()) else random.normal(size=shape)

    def holes(of):
        return tuple(
            None if hole else value for value, hole in zip(of, random.random(count) < 0.3, strict=True)
        )

    def actions():
        return tuple(random.integers(0, count, draw(st.integers(0, 30))).tolist())

    every = draw(st.booleans())
    decision = Decision(
        t=draw(st.integers(0, 10_000)),
        mode="shaped",
        distribution=np.where(random.random(count) < 0.5, 0.0, pick(count)),
        j_values=holes(pick(count).tolist()),
        robustness=holes(pick(count).tolist()),
        action=count - 1,
        action_name=f"a{count - 1}",
        completion_action=draw(st.none() | st.integers(0, count - 1)),
        spec_status="pending",
        feasible_mass=draw(maybe),
        kl=draw(maybe),
        reason=draw(st.sampled_from([None, "infeasible"])),
        finished=draw(st.booleans()),
        next_poses=pick(count, 3),
        residual=draw(st.none() | st.tuples(number, number)),
        in_collision=draw(st.booleans()),
        witness=draw(st.sampled_from([None, actions()])),
        witnesses=holes([actions() for _ in range(count)]) if every else (),
        warnings=draw(st.sampled_from([(), ("a policy's motions could not be used", "é")])),
        margin=draw(number),
        slack=draw(st.integers(0, 1000)),
        threshold_left=draw(number),
        map_revision=draw(st.integers(0, 1000)),
        any_signal=draw(st.sampled_from([None, True, False])),
        explanations=holes(
            [Explanation("F[0,9] A", draw(number), draw(st.none() | st.integers(1, 9)), draw(detail))] * count
        )
        if (explain := draw(st.booleans()))
        else (),
        carry=Carry(0, np.zeros((1, 3)), (None,)),
    )
    short = random.normal(size=count).astype(np.float32).astype(float)
    logits = draw(st.sampled_from([None, pick(count), short]))
    if logits is not None:
        logits = np.where(random.random(count) < 0.2, -math.inf, logits)
    pose = row[:3].tolist() if draw(st.booleans()) else [draw(number) for _ in range(3)]
    signals = {"battery": 7.0} if draw(st.booleans()) else {}
    done, points = (
        draw(st.booleans()),
        [draw(st.none() | st.just(random.normal(size=(n, 2)))) for n in (0, 3)],
    )
    return decision, row, record.Asked(pose, logits, done, signals, every, *points, explain)


def expected(decision, every, explain):
    """The answer's members, straight from the decision."""
    residual = decision.residual
    shown = {name: getattr(decision, name) for name in decision._fields if name != "carry"}
    shown |= {
        "distribution": decision.distribution,
        "next_poses": decision.next_poses,
        "residual": None if residual is None else {"translation": residual[0], "rotation": residual[1]},
    }
    if not every:
        del shown["witnesses"]
    if decision.any_signal is None:
        del shown["any_signal"]
    if not explain:
        del shown["explanations"]
    told = msgspec.to_builtins(shown, enc_hook=lambda array: array.tolist())
    for why in filter(None, told.get("explanations", ())):
        if why["detail"] is None:
            del why["detail"]
    return told


@given(decisions())
def test_a_record_reads_back_to_the_last_bit_and_answers_in_the_same_bytes(made):
    decision, row, asked = made
    pose, logits, done, signals, every, occupied, free, explain = asked
    names, declared = [f"a{i}" for i in range(len(decision.distribution))], ["battery", "fuel"]
    kept = record.make(decision, asked, row, declared, b"before")
    content = record.encode(kept)
    again = record.decode(content)
    assert record.encode(again) == content
    first, replayed = record.told(decision, every, explain), record.answer(again, row, names)
    assert to_json(first) == to_json(replayed)
    assert to_msgpack(first) == to_msgpack(replayed)
    whole = msgspec.json.encode(
        expected(decision, every, explain)
    )  # every value, in the order of the contract
    assert to_json(first) == whole
    assert msgspec.json.encode(msgspec.msgpack.decode(to_msgpack(first))) == whole
    sent = again.asked(row, declared)
    assert np.array(sent.pose).tobytes() == np.array(pose).tobytes()
    assert (sent.logits is None) == (logits is None)
    assert logits is None or sent.logits.tobytes() == logits.tobytes()
    assert sent.signals == signals
    for kept_points, points in ((sent.occupied, occupied), (sent.free, free)):
        assert (kept_points is None) == (points is None)
        assert points is None or kept_points.tolist() == points.tolist()
    assert (sent.main_task_done, sent.all_witnesses, again.before) == (done, every, b"before")


@pytest.mark.parametrize("name", ["case1", "case2"])
def test_a_step_takes_at_most_700_bytes_of_the_store_and_hangs_on_the_one_before(tmp_path, name):
    case = load_case(name)
    with serving(tmp_path) as server, ShieldClient(server.url, timeout=60.0) as client:
        (start,) = free_poses(case.task, case.body, 1, np.random.default_rng(1)).tolist()
        session = client.sessions.create(policy_id=name, initial_pose=start, seed=1, allow_infeasible=True)
        id = session.id
        episode = with_shield(session, case, load_learned(case.instruction), start, 1)
        steps = len(episode.round_trip_ms)
        with redis.Redis(unix_socket_path=str(tmp_path / "store" / "socket")) as store:
            keys = [f"specshield:v2:{{@{id}}}:{part}" for part in ("session", "rows", "steps")]
            used = [store.memory_usage(key, samples=0) for key in keys]
            config, rows = store.hget(keys[0], "config"), store.get(keys[1])
            records = store.lrange(keys[2], 0, -1)
        answers = httpx.get(f"{server.url}/v1/sessions/{id}/trajectory", timeout=None, verify=False).json()[
            "items"
        ]
    assert steps > 100
    assert sum(used) / steps <= 700, used
    held = np.frombuffer(rows, "<f8").reshape(-1, 3)
    last = hashlib.sha256(config).digest()
    for t, content in enumerate(records):
        assert record.decode(content).before == record.link(last, held[t : t + 1])
        last = hashlib.sha256(content).digest()
    told = [
        record.answer(record.decode(c), held[t], list(case.task.robot.action_names))
        for t, c in enumerate(records)
    ]
    assert [msgspec.json.decode(to_json(answer)) for answer in told] == [
        item["decision"] for item in answers[: len(told)]
    ]
