"""What a robot is told while the service is away, step by step, against answers written by hand."""

import asyncio
import itertools
import json
import math

import httpx
import pytest
from client_script import SESSION, answer, drive, lost, problem
from test_state import END, LOGITS, B, M, decided, session

from specshield import errors
from specshield.client import (
    AsyncSession,
    AsyncShieldClient,
    LocalDecision,
    Session,
    SessionInfo,
    ShieldClient,
)
from specshield.client.away import LONGEST_PAUSE
from specshield.client.models import build
from specshield.client.wire import TRIES


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def robust(on_failure="witness", **members):
    state = session(**members)
    state.on_failure, state._circuit.clock = on_failure, Clock()
    return state


def step(state, x, *outcomes, y=0.0, logits=LOGITS, main_task_done=None):
    """(decision or error, the bodies sent)"""
    flow = state._step((x, y, 0), logits, main_task_done=main_task_done)
    result, sent, _ = drive(flow, *outcomes)
    return result, [json.loads(request.body) for request in sent]


AWAY = [lost(0.0)] * TRIES


def test_the_certified_continuation_is_followed_and_the_service_told_later():
    state = robust()
    step(state, 0.0, decided(0, M, witness=[M, B, M]))
    first, bodies = step(state, 0.2, *AWAY)
    assert isinstance(first, LocalDecision)
    assert (first.source, first.t, first.execute, first.witness) == ("witness", 1, M, (B, M))
    assert first.next_pose == pytest.approx((0.4, 0, 0))
    assert isinstance(first.error, errors.TransportTimeout)
    assert len(bodies) == TRIES
    second, bodies = step(state, 0.4)
    assert (second.source, second.t, second.execute, bodies) == ("witness", 2, B, [])
    assert second.error is None, "a moment ago it was away: it is not asked"
    assert state.unsent == {1: (0.2, 0, 0), 2: (0.4, 0, 0)}
    state._circuit.clock.now += LONGEST_PAUSE
    back, (body,) = step(state, 0.2, decided(3, M))
    assert (back.source, body["t"], [pose[0] for pose in body["poses"]]) == ("service", 3, [0.2, 0.4, 0.2])
    assert not state._circuit.open
    assert state.unsent == {}


def test_while_it_is_away_it_is_asked_once_at_growing_bounded_pauses():
    state = robust()
    step(state, 0.0, decided(0, M, witness=[B, M] * 200))
    clock, asked = state._circuit.clock, []
    pose = 0.2
    for number in range(300):
        due = state._circuit.due
        outcomes = () if not due else AWAY if number == 0 else AWAY[:1]
        decision, bodies = step(state, pose, *outcomes)
        pose = decision.next_pose[0]
        if bodies:
            asked.append(clock.now)
        clock.now += 0.1
    pauses = [b - a for a, b in itertools.pairwise(asked)]
    assert pauses[0] == pytest.approx(0.3)  # the first step after 0.25 s
    assert max(pauses) <= LONGEST_PAUSE + 0.11
    assert pauses[-1] == pytest.approx(LONGEST_PAUSE, abs=0.11)


@pytest.mark.parametrize(("x", "y"), [(0.4, 0.0), (0.2, 0.1), (0.0, 0.0)])
def test_a_robot_that_is_not_where_the_continuation_leads_is_told_to_stop(x, y):
    state = robust()
    step(state, 0.0, decided(0, M, witness=[M, M]))
    decision, _ = step(state, x, *AWAY, y=y)
    assert (decision.source, decision.execute, decision.t) == ("stop", None, 1)
    assert "where the certified continuation leads" in decision.reason
    assert state.t == 1, "a step on which the robot stands does not count"
    state._circuit.clock.now += LONGEST_PAUSE
    again, bodies = step(state, x, decided(1, M), y=y)
    assert (again.source, bodies[0]["t"]) == ("service", 1)


def test_a_margin_is_room_for_the_robot_beside_its_way():
    state = robust(margin=0.2)
    step(state, 0.0, decided(0, M, witness=[M, M]))
    decision, _ = step(state, 0.3, *AWAY, y=0.1)
    assert decision.source == "witness"


def test_where_the_continuation_has_ended_and_where_there_never_was_one_the_robot_stops():
    state = robust()
    step(state, 0.0, decided(0, M, witness=[M]))
    assert step(state, 0.2, *AWAY)[0].source == "witness"
    ended, _ = step(state, 0.4)
    assert (ended.source, "has ended" in ended.reason) == ("stop", True)
    none, _ = step(robust(), 0.0, *AWAY)
    assert (none.source, "no continuation" in none.reason) == ("stop", True)
    uncertified = robust()
    step(uncertified, 0.0, decided(0, M, witness=None))
    assert step(uncertified, 0.2, *AWAY)[0].source == "stop"


def test_stop_stops_although_there_is_a_continuation():
    state = robust("stop")
    step(state, 0.0, decided(0, M, witness=[M, M]))
    decision, _ = step(state, 0.2, *AWAY)
    assert (decision.source, decision.execute) == ("stop", None)


@pytest.mark.parametrize("on_failure", ["stop", "witness"])
def test_a_step_that_says_to_stop_costs_nothing_while_it_is_away(on_failure):
    """The robot stands off its continuation for 30 s and asks ten times a second."""
    state = robust(on_failure)
    step(state, 0.0, decided(0, M, witness=[M, M]))
    clock, asked = state._circuit.clock, []
    for number in range(300):
        due = state._circuit.due
        stopped, bodies = step(state, 9.0, *(() if not due else AWAY if number == 0 else AWAY[:1]))
        assert (stopped.source, stopped.execute, stopped.t, state.t) == ("stop", None, 1, 1)
        assert (len(bodies), stopped.error is None) == (
            (0, True) if not due else (1 if number else TRIES, False)
        )
        asked += [clock.now] * due
        clock.now += 0.1
    pauses = [b - a for a, b in itertools.pairwise(asked)]
    assert pauses[0] == pytest.approx(0.3)  # the first step after 0.25 s
    assert max(pauses) <= LONGEST_PAUSE + 0.11
    clock.now += LONGEST_PAUSE
    assert step(state, 9.0, decided(1, M))[0].source == "service"
    assert len(step(state, 9.0, *AWAY)[1]) == TRIES, "away anew: what is known of before counts no longer"


def test_the_main_task_may_end_at_a_step_that_is_not_asked_for():
    state = robust("stop")
    step(state, 0.0, *AWAY)
    stopped, bodies = step(state, 0.0, main_task_done=True)
    assert (stopped.source, bodies, state.main_task_done) == ("stop", [], True)


@pytest.mark.parametrize("asynchronous", [False, True])
def test_both_clients_stop_at_once_while_the_service_is_known_to_be_away(asynchronous):
    asked = []

    def refuse(request):
        asked.append(request)
        raise httpx.ConnectError("refused")

    options = {"base_url": "http://robot.test", "transport": httpx.MockTransport(refuse)}
    info = build(SessionInfo, SESSION)

    async def awaited():
        async with AsyncShieldClient(**options) as client:
            held = AsyncSession(client._run, info, (0, 0, 0), "stop")
            return [await held.step((0, 0, 0), LOGITS) for _ in range(3)]

    def blocking():
        with ShieldClient(**options) as client:
            held = Session(client._run, info, (0, 0, 0), "stop")
            return [held.step((0, 0, 0), LOGITS) for _ in range(3)]

    first, *later = asyncio.run(awaited()) if asynchronous else blocking()
    assert isinstance(first.error, errors.TransportError)
    assert [(each.source, each.error) for each in later] == [("stop", None)] * 2
    assert len(asked) == TRIES


@pytest.mark.parametrize(
    "outcome",
    [
        lost(0.0),
        answer({}, 502),
        problem(503, "store-unavailable"),
        problem(500, "internal-error"),
        problem(429, "limit-reached"),
        problem(507, "from-the-future"),
    ],
)
def test_a_service_that_cannot_answer_now_is_away(outcome):
    state = robust()
    step(state, 0.0, decided(0, M, witness=[M, M]))
    tries = 1 if getattr(outcome, "status", 0) in (500, 429, 507) else TRIES
    assert step(state, 0.2, *[outcome] * tries)[0].source == "witness"


@pytest.mark.parametrize(
    ("outcome", "error"),
    [
        (problem(404, "not-found"), errors.NotFound),
        (problem(401, "unauthorized"), errors.Unauthorized),
        (problem(422, "invalid-logits"), errors.LogitsError),
        (problem(409, "step-conflict"), errors.StepConflict),
    ],
)
def test_what_the_service_does_answer_is_raised(outcome, error):
    state = robust()
    step(state, 0.0, decided(0, M, witness=[M, M]))
    assert type(step(state, 0.2, outcome)[0]) is error
    assert state.t == 1


def test_who_raises_is_told_how_to_pass_over_a_step_that_was_decided_after_all():
    state = robust("raise")
    for conflict in (problem(409, "step-conflict"), taken(0, 0.2)):
        assert "session.record(pose)" in step(state, 0.0, conflict)[0].expected
    other = problem(409, "step-conflict", path="main_task_done")
    assert "session.record" not in str(step(state, 0.0, other)[0].expected)
    state.record((0.2, 0, 0))
    assert step(state, 0.4, decided(1, M))[0].t == 1


def test_a_closed_session_notes_no_further_poses():
    state = robust()
    drive(state._end(), answer({"spec_status": "pending", "robustness_bounds": [None, None]}))
    with pytest.raises(errors.SessionFinished):
        state.record((0.2, 0, 0))
    assert state.t == 0


def test_bad_input_is_refused_also_while_the_service_is_away():
    state = robust()
    step(state, 0.0, decided(0, M, witness=[M, M]))
    step(state, 0.2, *AWAY)
    assert isinstance(step(state, math.nan)[0], errors.PoseError)
    assert isinstance(step(state, 0.4, logits=[math.nan])[0], errors.LogitsError)


def test_a_decision_that_was_never_heard_is_passed_over_by_a_robot_that_stood():
    """Its first question was answered to nobody; by now its model says something else."""
    state = robust()
    stopped, _ = step(state, 0.0, *AWAY)
    assert stopped.source == "stop"
    assert step(state, 0.0, logits=[1.0, 0.0, 0.0])[1] == []
    state._circuit.clock.now += LONGEST_PAUSE
    conflict = problem(409, "step-conflict", expected_t=1)
    decision, bodies = step(state, 0.0, conflict, decided(1, M), logits=[1.0, 0.0, 0.0])
    assert (decision.source, decision.t, state.t) == ("service", 1, 2)
    assert [(body["t"], len(body["poses"])) for body in bodies] == [(0, 1), (1, 1)]


@pytest.mark.parametrize("on_failure", ["witness", "stop"])
def test_a_decision_whose_question_was_cancelled_is_passed_over_too(on_failure):
    """As by asyncio's `wait_for`, or by Ctrl-C: the service may have decided it all the same."""
    state = robust(on_failure)
    step(state, 0.0, decided(0, M, witness=[M, M]))
    cancelled = state._step((0.2, 0, 0), LOGITS)
    next(cancelled)
    next(cancelled)  # the request is on its way
    assert type(step(state, 0.2, problem(422, "invalid-logits"))[0]) is errors.LogitsError
    conflict = problem(409, "step-conflict", expected_t=2)
    decision, bodies = step(state, 0.2, conflict, decided(2, M), logits=[1.0, 0.0, 0.0])
    assert (decision.source, decision.t, state.t) == ("service", 2, 3)
    assert [body["t"] for body in bodies] == [1, 2]
    assert isinstance(step(state, 0.4, conflict)[0], errors.StepConflict), "this one nobody asked for here"


def taken(t, x):
    """The service has another x_t already."""
    return problem(409, "history-conflict", t=t, stored=[x, 0, 0])


SWITCHED = answer({**SESSION, "actions": ["m", "b", "end"], "terminal_actions": [END], "next_t": 1})


@pytest.mark.parametrize("answers", [[SWITCHED], AWAY])
def test_a_robot_that_stood_since_a_switch_goes_on_from_where_it_is_measured_now(answers):
    """Two measurements of a robot that stands are never the same, and the service has the first."""
    state = robust()
    step(state, 0.0, decided(0, M))
    drive(state._switch("p2", pose=(0.2, 0, 0)), *answers)
    decision, bodies = step(state, 0.203, taken(1, 0.2), decided(2, M))
    assert (decision.source, decision.t, state.t) == ("service", 2, 3)
    assert [(body["t"], body["poses"][-1][0]) for body in bodies] == [(1, 0.203), (2, 0.203)]
    assert isinstance(step(state, 0.4, taken(3, 0.5))[0], errors.HistoryConflict), "nobody told of this one"


@pytest.mark.parametrize("ask", ["_switch", "_end"])
def test_a_switch_and_a_close_pass_over_a_decision_that_was_never_heard(ask):
    state = robust("stop")
    step(state, 0.0, decided(0, M))
    step(state, 0.2, *AWAY)
    asked = {"_switch": ("p2", None), "_end": ()}[ask]
    conflict = {"_switch": problem(409, "step-conflict", expected_t=2), "_end": taken(1, 0.2)}[ask]
    done = {
        "_switch": SWITCHED,
        "_end": answer({"spec_status": "pending", "robustness_bounds": [None, None]}),
    }
    result, sent, _ = drive(getattr(state, ask)(*asked, pose=(0.203, 0, 0)), conflict, done[ask])
    assert not isinstance(result, Exception)
    assert [json.loads(request.body)["t"] for request in sent] == [1, 2]
    assert state.t == 2


def test_a_session_read_back_passes_over_a_pose_that_came_with_a_switch():
    """The process that told of it is gone, and the robot has been measured anew."""
    state = robust(initial_pose=None, next_t=5)
    decision, bodies = step(state, 0.203, taken(5, 0.2), decided(6, M))
    assert (decision.t, [body["t"] for body in bodies]) == (6, [5, 6])


def test_a_main_task_taken_back_is_told_to_the_caller_and_passes_nothing_over():
    state = robust(initial_pose=None, next_t=5)
    conflict = problem(409, "step-conflict", path="main_task_done")
    error, bodies = step(state, 0.2, conflict, main_task_done=False)
    assert (type(error), len(bodies), state.t) == (errors.StepConflict, 1, 5)


def test_after_a_step_is_passed_over_the_continuation_that_began_before_it_is_not_followed():
    """It would come a step late, and its rule may not have one to spare."""
    state = robust()
    step(state, 0.0, decided(0, M, witness=[M, M]))
    cancelled = state._step((0.2, 0, 0), LOGITS)
    [next(cancelled) for _ in range(2)]
    decision, bodies = step(state, 0.2, problem(409, "step-conflict", expected_t=2), *AWAY)
    assert (decision.source, decision.execute, decision.t) == ("stop", None, 2)
    assert [body["t"] for body in bodies] == [1, *[2] * TRIES]


def test_a_session_that_was_over_by_an_answer_that_nobody_heard_ends_the_loop():
    state = robust()
    step(state, 0.0, decided(0, M, witness=[M, M]))
    assert step(state, 0.2, *AWAY)[0].execute == M
    state._circuit.clock.now += LONGEST_PAUSE
    decision, _ = step(state, 0.4, over := problem(409, "session-finished"))
    assert (decision.source, decision.execute, decision.finished) == ("stop", None, True)
    assert state.finished
    assert isinstance(decision.error, errors.SessionFinished)
    heard = robust()
    step(heard, 0.0, decided(0, M, witness=[M, M]))
    assert isinstance(step(heard, 0.2, over)[0], errors.SessionFinished), "somebody else has closed it"


@pytest.mark.parametrize("taken", [False, True])
def test_the_main_task_that_ends_at_a_step_that_says_to_stop_has_ended(taken):
    """Whether the service took that step or not: of the first, nobody heard the answer."""
    state = robust("stop")
    stopped, _ = step(state, 0.0, *AWAY, main_task_done=True)
    assert (stopped.source, state.main_task_done) == ("stop", True)
    state._circuit.clock.now += LONGEST_PAUSE
    outcomes = [problem(409, "step-conflict", expected_t=1), decided(1, M)] if taken else [decided(0, M)]
    _, bodies = step(state, 0.0, *outcomes)
    assert all(body["main_task_done"] for body in bodies)


def test_the_main_task_that_ends_while_the_service_is_away_has_ended():
    state = robust()
    step(state, 0.0, decided(0, M, witness=[M, M, M]))
    decision, _ = step(state, 0.2, *AWAY, main_task_done=True)
    assert (decision.source, decision.execute) == ("witness", M)
    state._circuit.clock.now += LONGEST_PAUSE
    _, (body,) = step(state, 0.4, decided(2, M), logits=None)
    assert body["main_task_done"]


def test_after_end_was_drawn_the_completion_is_what_is_followed():
    state = robust()
    decision, _ = step(state, 0.0, decided(0, END, witness=[M, M]))
    assert decision.execute == B
    followed, _ = step(state, -0.2, *AWAY)
    assert (followed.source, followed.execute) == ("witness", M)
    assert state.main_task_done


def test_a_caller_that_draws_itself_and_asks_for_witnesses_is_followed_too():
    state = robust()
    step(state, 0.0, decided(0, M, witness=[M, M], witnesses=[[M, M], [B, B], None]), main_task_done=False)
    decision, _ = step(state, -0.2, *AWAY, main_task_done=False)
    assert (decision.source, decision.execute) == ("witness", B)


def test_a_session_read_back_brings_the_continuation_received_last():
    leads = [[[0.2 * t + 0.2, 0, 0], [0.2 * t - 0.2, 0, 0], [0.2 * t, 0, 0]] for t in range(2)]
    answers = [json.loads(decided(t, M, witness=[B, M], next_poses=leads[t]).content) for t in range(2)]
    items = [{"t": t, "pose": [0.2 * t, 0, 0], "signals": {}, "decision": answers[t]} for t in range(2)]
    state = robust(initial_pose=None, next_t=2)
    _, (request,), _ = drive(state._recall(), answer({"items": items, "next": None}))
    assert request.params == {"after": "-1"}
    decision, _ = step(state, 0.4, *AWAY)
    assert (decision.source, decision.execute, decision.t) == ("witness", B, 2)
    items.append({"t": 2, "pose": [0.4, 0, 0], "signals": {}, "decision": None})
    state = robust(initial_pose=None, next_t=3)
    drive(state._recall(), answer({"items": items, "next": None}))
    assert step(state, 0.4, *AWAY)[0].source == "stop", "a step without a decision came after it"
    state = robust(initial_pose=None, next_t=9_000)
    _, (request,), _ = drive(state._recall(), answer({"items": items, "next": None}))
    assert request.params == {"after": "8899"}, "a long session is not read back as a whole"
