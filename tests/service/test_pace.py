"""Where a decision is made: on the event loop, on it with the processor's time measured, or in a thread."""

import asyncio
import threading
from collections import defaultdict
from itertools import groupby

import numpy as np
import pytest
from msgspec.structs import replace

from specshield.service.heavy.heavy import Heavy
from specshield.service.heavy.threads import Threads
from specshield.service.heavy.uploads import policies_of
from specshield.service.schemas.steps import StepBody
from specshield.service.sessions.session import Session
from specshield.service.sessions.shields import Shields
from specshield.service.sessions.state import State
from specshield.service.sessions.steps import (
    LONG,
    SEVERAL,
    SHORT,
    WATCHED,
    Pace,
    Steps,
    alike,
    decided,
    learns,
)
from specshield.service.settings import Settings
from specshield.service.storage.store import Store
from specshield.shield.decision import Config
from specshield.shield.uncertainty import Uncertainty
from tests.service.world import rule


@pytest.fixture
def known():
    """The pace of a policy whose first decisions, made in threads, were short."""
    pace = Pace()
    for _ in range(SEVERAL):
        assert not pace.short
        pace.add(0.0001, 0.0001)
    assert pace.short
    assert not pace.doubted
    return pace


def test_a_late_decision_alone_changes_nothing(known):
    known.add(10 * SHORT, None)
    assert known.short
    assert not known.doubted
    for _ in range(SEVERAL):
        known.add(0.0001, None)
    known.add(10 * SHORT, None)
    assert known.short
    assert not known.doubted


def test_a_busy_machine_does_not_send_short_decisions_to_threads(known):
    for _ in range(3):
        known.add(10 * SHORT, None)
        known.add(10 * SHORT, None)
        for _ in range(SEVERAL):
            assert known.short
            assert known.doubted
            known.add(10 * SHORT, 0.0001)  # late by the clock, short by the processor
        assert known.short
        assert not known.doubted


def test_decisions_that_compute_long_are_made_in_threads(known):
    known.add(2 * SHORT, None)
    known.add(2 * SHORT, None)
    known.add(2 * SHORT, 2 * SHORT)
    for _ in range(WATCHED):
        assert not known.short
        known.add(0.0001, 0.0001)
    assert known.short
    assert not known.long


def test_after_several_that_take_very_long_another_process_decides(known):
    for _ in range(SEVERAL - 1):
        known.add(2 * LONG, 2 * LONG)
    assert not known.long
    known.add(2 * LONG, 2 * LONG)
    assert known.long


def test_a_step_that_may_change_the_map_is_seen_before_it_is_decided(tmp_path):
    """A search for a way around takes up to a tenth of a second, which no other robot is to wait for."""
    shields = Shields(policies_of(Settings(data_dir=tmp_path)))
    case = [rule(policy_ids=[shields.policies.find("case1", "").id])]
    first = [4.5, 5.0, 0.0]
    forward = [0.0] + [None] * 19  # logits of a model that drives on

    def asked(t, pose, **more):
        return StepBody(t, [pose], forward, **more)

    def begun(**settings):
        config = Config(uncertainty=Uncertainty(), max_steps=600, **settings)
        new = Session(case, config, State(0, 0, True, "pending", 0.0, b""), b"", np.empty((0, 3)), [], 0, 0)
        made = decided(shields, new._replace(rows=np.array([first])), asked(0, first))
        state = replace(new.state, length=1, next_t=1, carry=made.decision.carry)
        return new._replace(state=state, rows=np.array([first]))

    session = begun(learn_map=True)
    ahead = session.state.carry.next_poses[0].tolist()
    assert ahead[0] > first[0] + 0.1
    half = [0.5 * (a + b) for a, b in zip(first, ahead, strict=True)]
    off = [ahead[0] + 0.004, *ahead[1:]]
    assert [learns(shields, session, asked(1, pose)) for pose in (ahead, off, half)] == [False, False, True]
    assert learns(shields, session, asked(1, ahead, occupied=[[1.0, 1.0]]))
    assert not learns(shields, begun(learn_map=False), asked(1, half))
    after = decided(shields, session, asked(1, half)).decision
    assert after.map_revision > 0
    later = session._replace(state=replace(session.state, carry=after.carry))
    assert learns(shields, later, asked(2, half))


def test_how_long_some_decisions_take_says_nothing_of_those_of_other_kinds():
    step, mine = StepBody(0, [[0.0, 0.0, 0.0]]), rule(policy_ids=["p"], owner="me")
    kinds = [
        alike(mine, step),
        alike(mine, StepBody(0, [[0.0, 0.0, 0.0]], explain=True)),
        alike(rule(policy_ids=["p"], owner="you"), step),
        alike(rule(policy_ids=["p", "q"], owner="me"), step),
        alike(rule(policy_ids=["p"], owner="me", shaping="lookahead"), step),
    ]
    assert len(set(kinds)) == len(kinds)
    assert alike(mine, StepBody(9, [[1.0, 2.0, 0.0]])) == kinds[0]


def test_policies_that_this_process_has_not_read_are_read_in_a_thread(tmp_path):
    """Those of a large floor take so long that other robots would wait."""
    settings, read_in = Settings(data_dir=tmp_path), set()

    class Noting(Shields):
        def of(self, session):
            read_in.add(threading.current_thread())
            return super().of(session)

    shields = Noting(policies_of(settings))
    case = [rule(policy_ids=[shields.policies.find("case1", "").id])]
    state = State(1, 0, True, "pending", 0.0, b"")
    session = Session(case, Config(max_steps=600), state, b"", np.array([[4.5, 5.0, 0.0]]), [], 0, 0)

    async def decide():
        store = Store("redis://127.0.0.1:1", 1.0, 60)  # is not asked here
        steps = Steps(store, shields, Threads(), Heavy(settings), 60, lambda *_: None)
        return await steps._decide(session, StepBody(0, [[4.5, 5.0, 0.0]], [0.0] * 20), defaultdict(float))

    assert asyncio.run(decide()).decision.t == 0
    assert threading.main_thread() not in read_in


def test_steps_with_long_histories_come_one_at_a_time_and_after_a_step_that_is_being_decided(tmp_path):
    """Each takes some ms of the event loop: of eight at once, another robot waited for all."""
    settings, told = Settings(data_dir=tmp_path), []

    class Noting(Shields):
        def of(self, session):
            told.append(session.id)
            return super().of(session)

    shields, start = Noting(policies_of(settings)), [4.5, 5.0, 0.0]
    case1 = shields.policies.find("case1", "").id

    async def decide():
        store = Store("redis://127.0.0.1:1", 1.0, 60)  # is not asked here
        steps = Steps(store, shields, Threads(), Heavy(settings), 60, lambda *_: None)

        async def long(id):
            state = State(1, 0, True, "pending", 0.0, b"")
            begun = [rule(policy_ids=[case1], id=id)], Config(max_steps=9000), state, b"", np.array([start])
            request = StepBody(8000, [start] * 8001, [0.0] * 20)
            await steps._decide(Session(*begun, [], 0, 0), request, defaultdict(float))

        steps.deciding = 3  # another step, and these
        both = asyncio.gather(long("a"), long("b"))
        for _ in range(3):
            await asyncio.sleep(0)
        told.append("the other step is decided")
        steps.deciding -= 1
        await both

    asyncio.run(decide())
    assert [name for name, _ in groupby(told)] == ["the other step is decided", "a", "b"]
