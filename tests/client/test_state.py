"""The session's state machine, step by step, against answers written by hand from the contract."""

import json

import numpy as np
import pytest
from client_script import SESSION, answer, drive, lost, problem

from specshield import errors
from specshield.client import wire
from specshield.client.models import Learned, SessionInfo, build
from specshield.client.state import SessionState

M, B, END = 0, 1, 2
LOGITS = [0.0, 0.0, 0.0]


def session(initial_pose=(0, 0, 0), **members):
    return SessionState(
        None,
        build(SessionInfo, {**SESSION, "actions": ["m", "b", "end"], "terminal_actions": [END], **members}),
        initial_pose,
    )


def decided(t, action, status="pending", **members):
    body = {
        "t": t,
        "mode": "shaped",
        "distribution": [0.5, 0.25, 0.25],
        "j_values": [1.0, 0.0, 1.0],
        "robustness": [0.2, -0.1, None],
        "action": action,
        "action_name": ["m", "b", "end"][action],
        "completion_action": B if status == "pending" else None,
        "spec_status": status,
        "feasible_mass": 0.7,
        "kl": 0.1,
        "reason": None,
        "finished": False,
        "in_collision": False,
        "next_poses": [[0.2, 0, 0], [-0.2, 0, 0], [0, 0, 0]],
        "residual": None,
        "witness": [M, M],
        **members,
    }
    return answer(body)


def step(state, x, *outcomes, logits=LOGITS, **more):
    """(decision or error, the bodies sent)"""
    flow = state._step((x, 0, 0), logits, **more)
    result, sent, _ = drive(flow, *outcomes)
    return result, [json.loads(request.body) for request in sent]


def sent_poses(body):
    return body["t"], [pose[0] for pose in body["poses"]]


def test_steps_count_t_and_send_the_newest_pose():
    state = session()
    decision, (first,) = step(state, 0, decided(0, M, residual={"translation": 0.01, "rotation": 0.0}))
    assert first == {
        "t": 0,
        "poses": [[0, 0, 0]],
        "logits": LOGITS,
        "main_task_done": False,
        "witnesses": False,
    }
    assert (decision.execute, decision.next_poses[M], decision.witness) == (M, (0.2, 0, 0), (M, M))
    assert decision.residual.translation == 0.01
    assert decision.witnesses is None
    _, (second,) = step(
        state, 0.2, decided(1, M, witnesses=[[M], None, [B]]), signals={"soc": 1}, witnesses=True
    )
    assert sent_poses(second) == (1, [0.2])
    assert (second["signals"], second["witnesses"]) == ({"soc": 1.0}, True)
    assert state.t == 2


def test_a_gap_is_filled_from_where_the_server_stands():
    state = session()
    for t in range(3):
        step(state, t, decided(t, M))
    _, bodies = step(state, 3, problem(409, "history-gap", expected_t=1), decided(3, M))
    assert [sent_poses(body) for body in bodies] == [(3, [3]), (3, [1, 2, 3])]


def test_a_gap_is_filled_once_only_and_not_where_poses_are_lacking():
    state = session()
    step(state, 0, decided(0, M))
    gap = problem(409, "history-gap", expected_t=0)
    error, bodies = step(state, 1, gap, gap)
    assert type(error) is errors.HistoryGap
    assert len(bodies) == 2
    resumed = session(None, next_t=5)
    error, bodies = step(resumed, 5, problem(409, "history-gap", expected_t=3))
    assert type(error) is errors.HistoryGap
    assert error.details["expected_t"] == 3
    assert len(bodies) == 1


def differs(t, x):
    """The server has another pose of step t."""
    return problem(409, "history-conflict", t=t, stored=[x, 0, 0])


def test_what_came_with_a_lost_answer_stands_whatever_was_recorded_of_that_step():
    state = session()
    step(state, 0, decided(0, M))
    for x in (1, 2):
        assert type(step(state, x, *[lost(0.0)] * 6)[0]) is errors.TransportTimeout
        state.record((x + 0.125, 0, 0))  # the robot has drifted
    _, bodies = step(state, 3, differs(1, 1), differs(2, 2), decided(3, M))
    assert [sent_poses(body) for body in bodies] == [(3, [1.125, 2.125, 3]), (3, [1, 2.125, 3]), (3, [2, 3])]
    assert state._poses[1] == (1.125, 0, 0), "the caller's own history is what it was told"
    state.record((4, 0, 0))
    verdict, bodies = close(state, None, differs(4, 5), VERDICT)
    assert (verdict.spec_status, [sent_poses(body) for body in bodies]) == ("violated", [(4, [4]), (4, [5])])


def test_a_conflict_about_the_present_pose_or_one_sent_as_stored_is_raised():
    state = session()
    step(state, 0, decided(0, M))
    error, bodies = step(state, 1, differs(1, 2))
    assert (type(error), len(bodies), state.t) == (errors.HistoryConflict, 1, 1)
    state.record((1, 0, 0))
    error, bodies = step(state, 2, differs(1, 3), differs(1, 3))
    assert (type(error), len(bodies), state.t) == (errors.HistoryConflict, 2, 2)


def test_a_session_that_was_finished_goes_on_under_a_new_rule():
    state = session()
    step(state, 0, decided(0, END, "satisfied"))
    assert state.finished
    info = answer({**SESSION, "actions": ["m", "b", "end"], "terminal_actions": [END], "next_t": 1})
    drive(state._switch("p2", clock="restart"), info)
    assert (state.finished, state.spec_status, state.main_task_done) == (False, "pending", True)
    decision, (body,) = step(state, 1, decided(1, M, "satisfied", finished=True), logits=None)
    assert (body["main_task_done"], decision.execute, state.finished) == (True, END, True)


def test_a_session_read_back_goes_on_where_the_server_stands():
    state = session(None, next_t=5)
    _, (body,) = step(state, 9, decided(5, M))
    assert sent_poses(body) == (5, [9])


def test_a_failed_step_changes_nothing_and_recorded_poses_follow_with_the_next():
    state = session()
    step(state, 0, decided(0, M))
    before = dict(vars(state))
    error, bodies = step(state, 1, *[lost(0.0)] * 6, main_task_done=True)
    assert type(error) is errors.TransportTimeout
    assert bodies == [bodies[0]] * 6
    assert vars(state) == before
    state.record((1, 0, 0))
    state.record((2, 0, 0))
    _, (body,) = step(state, 3, decided(3, M))
    assert sent_poses(body) == (3, [1, 2, 3])


@pytest.mark.parametrize("pose", [None, (1, 0, 0)])
def test_a_switch_has_the_time_of_what_prepares_something(pose):
    """A preference for another policy takes a server ten seconds."""
    state = session()
    step(state, 0, decided(0, M))
    command = next(state._switch("p2", pose=pose))
    assert isinstance(command, wire.Request)
    assert command.slow


@pytest.mark.parametrize(
    "bad", [{"logits": [float("nan")]}, {"signals": {"soc": float("inf")}}, {"explain": "yes"}]
)
def test_bad_input_is_refused_before_anything_is_sent(bad):
    state = session()
    error, bodies = step(state, 0, **bad)
    assert isinstance(error, errors.InputError)
    assert bodies == []
    assert state.t == 0


def test_end_drawn_while_pending_runs_the_completion_and_is_remembered():
    state = session()
    decision, _ = step(state, 0, decided(0, END))
    assert (decision.action, decision.execute) == (END, B)
    assert state.main_task_done
    assert not state.finished
    decision, (body,) = step(state, 1, decided(1, M, mode="completion"), logits=None)
    assert (body["main_task_done"], body["logits"]) == (True, None)
    assert decision.execute == M
    decision, (body,) = step(state, 2, decided(2, M, "satisfied", mode="prior", finished=True))
    assert body["main_task_done"]
    assert decision.execute == END, "all is done: nothing but stopping is left"
    assert state.finished


@pytest.mark.parametrize("status", ["satisfied", "violated"])
def test_end_drawn_once_the_spec_is_settled_finishes(status):
    state = session()
    decision, _ = step(state, 0, decided(0, END, status))
    assert decision.execute == END
    assert state.main_task_done
    assert state.finished


def test_the_main_task_goes_on_after_the_spec_is_settled():
    state = session()
    decision, _ = step(state, 0, decided(0, M, "satisfied"))
    assert decision.execute == M
    assert not state.finished
    assert state.spec_status == "satisfied"


def test_a_caller_that_draws_itself_is_not_bound_by_the_drawn_end():
    state = session()
    step(state, 0, decided(0, END), main_task_done=False)
    assert not state.main_task_done
    step(state, 1, decided(1, END, "satisfied"), main_task_done=False)
    assert not state.finished
    _, (body,) = step(state, 2, decided(2, M, "satisfied", finished=True), main_task_done=True)
    assert body["main_task_done"]
    assert state.finished


def test_terminal_actions_are_those_the_server_names():
    state = session(terminal_actions=[B])
    decision, _ = step(state, 0, decided(0, B, completion_action=M))
    assert decision.execute == M
    decision, _ = step(session(terminal_actions=[]), 0, decided(0, END))
    assert decision.execute == END


def close(state, pose, *outcomes, tries=6):
    result, sent, _ = drive(state._close(pose, tries), *outcomes)
    return result, [json.loads(request.body) for request in sent]


def test_the_trajectory_is_typed():
    items = [
        {"t": 0, "pose": [0, 0, 0], "signals": {}, "decision": {"t": 0, "mode": "shaped"}},
        {"t": 1, "pose": [1, 0, 0], "signals": {"soc": 0.5}, "decision": None},
    ]
    trajectory, _, _ = drive(session()._trajectory(), answer({"items": items, "next": None}))
    assert [item.pose[0] for item in trajectory] == [0, 1]
    assert (trajectory[0].decision["mode"], trajectory[1].decision) == ("shaped", None)


def test_what_was_learned_is_typed():
    told = {"t": 2, "map_id": "m", "map_revision": 1, "occupied": [425, 466], "free": []}
    learned, (request,), _ = drive(session()._learned(), answer(told))
    assert request.path.endswith("/learned")
    assert learned == Learned(2, "m", 1, (425, 466), ())


VERDICT = answer({"id": "s", "spec_status": "violated", "robustness_bounds": [None, -0.5]})


def test_closing_sends_the_last_poses_and_brings_the_verdict():
    state = session()
    step(state, 0, decided(0, M))
    verdict, (body,) = close(state, (1, 0, 0), VERDICT)
    assert body == {"t": 1, "poses": [[1, 0, 0]]}
    assert (verdict.spec_status, verdict.robustness_bounds) == ("violated", (None, -0.5))
    assert (state.closed, state.finished, state.spec_status) == (True, True, "violated")


def test_closing_without_a_pose_repeats_the_last_and_delivers_what_was_recorded():
    state = session()
    assert close(state, None, VERDICT)[1] == [{"t": 0, "poses": [[0, 0, 0]]}]
    state = session()
    step(state, 0, decided(0, M))
    assert close(state, None, VERDICT)[1] == [{"t": 0, "poses": [[0, 0, 0]]}]
    state = session()
    step(state, 0, decided(0, M))
    state.record((1, 0, 0))
    state.record((2, 0, 0))
    bodies = close(state, None, problem(409, "history-gap", expected_t=0), VERDICT)[1]
    assert [sent_poses(body) for body in bodies] == [(2, [1, 2]), (2, [0, 1, 2])]
    assert close(session(None, next_t=5), None, VERDICT)[1] == [{}]


FAILS = "no way was found after it that keeps the rule; the best way found does not keep 'F[50,100] Region2'"


@pytest.mark.parametrize(
    ("why", "line"),
    [
        ([-0.3, 4], f"{FAILS}: it comes 4 steps too late"),
        ([-0.3, 1], f"{FAILS}: it comes 1 step too late"),
        ([-0.3, None], f"{FAILS}: it falls short by 0.3"),
        ([None, None], "no way was found that keeps F[50,100] Region2"),
        ([-0.3, None, "'A' is not met"], f"{FAILS}: 'A' is not met"),
        ([0.05, None, "a way is known that keeps the rule"], "a way is known that keeps the rule"),
    ],
)
def test_a_decision_says_why_an_action_is_forbidden(why, line):
    told = {"conjunct": "F[50,100] Region2", "robustness": why[0], "late_by": why[1]}
    told |= {"detail": why[2]} if len(why) > 2 else {}
    decision, _ = step(session(), 0, decided(0, M, explanations=[None, told, None]))
    assert decision.why("b") == decision.why(B) == decision.why(np.int64(B)) == f"b is forbidden: {line}"
    assert decision.why("m") == "m is not forbidden"
    with pytest.raises(errors.InputError, match="no such action"):
        decision.why("x")


@pytest.mark.parametrize(
    ("margin", "slack", "late", "line"),
    [
        (
            0.04,
            20,
            2,
            "but not with the 20 steps in reserve that the session asks for: "
            "it comes 2 steps too late for that",
        ),
        (0.04, 0, None, "but with less to spare than the session asks for (0.04 m, 0 steps)"),
    ],
)
def test_what_the_session_keeps_in_hand_is_told_apart_from_the_rule(margin, slack, late, line):
    told = {"conjunct": "F[50,100] Region2", "robustness": 0.3, "late_by": late}
    answer = decided(0, M, explanations=[None, told, None], margin=margin, slack=slack)
    decision, _ = step(session(), 0, answer)
    assert decision.why("b") == f"b is forbidden: F[50,100] Region2 could still be kept, {line}"


def test_a_step_that_was_not_asked_to_explain_says_so():
    decision, _ = step(session(), 0, decided(0, M))
    assert "explain=True" in decision.why("b")
