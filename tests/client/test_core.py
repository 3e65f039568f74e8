"""The calls as generators: what they send, when they try again, what they make of the answers."""

import json
from dataclasses import replace

import pytest
from client_script import SESSION, answer, drive, lost, problem

from specshield import errors
from specshield.client import calls, core, events
from specshield.client.models import Policy, SessionInfo
from specshield.client.wire import Request, get, post

POLICY = {"id": "p", "status": "training", "progress": 0.5, "horizon": 140, "metrics": {}, "error": None}


@pytest.mark.parametrize(
    "passing", [lost(0.0), problem(503, "store-unavailable"), answer({}, 502), answer({}, 504)]
)
def test_a_lost_answer_is_asked_for_again_with_the_same_request(passing):
    request = post("specs", "validate", body={"formula": "a"})
    delivery, sent, waits = drive(core.deliver(request), passing, passing, answer({"ok": 1}))
    assert delivery.tries == 3
    assert sent == [request] * 3
    assert waits == [0.05, 0.1]


def test_tries_are_bounded_in_number():
    error, sent, waits = drive(core.deliver(get("maps")), *[lost(0.0)] * 6)
    assert type(error) is errors.TransportTimeout
    assert error.details["tries"] == len(sent) == 6
    assert waits == [0.05, 0.1, 0.2, 0.2, 0.2], "who is back is asked soon"


def test_tries_are_bounded_in_time():
    """Four timeouts are 2 s: three tries of 0.6 s and two waits are 1.95 s, a fourth would start too late."""
    error, sent, _ = drive(core.deliver(get("maps")), *[lost(0.6)] * 3)
    assert type(error) is errors.TransportTimeout
    assert len(sent) == 3
    assert error.details["seconds"] == pytest.approx(1.95)


def test_who_listens_asks_again_for_two_minutes():
    """As long as a server may take to come back on a busy machine, and never with long pauses."""
    request = Request("GET", "/v1/sessions/s/events", tries=events.RESUMING, listens=True)
    error, _, waits = drive(core.deliver(request), *[lost(0.0)] * 65)
    assert type(error) is errors.TransportTimeout
    assert waits == [0.05, 0.1, 0.2, 0.4, 0.8, 1.6] + [2.0] * 58  # 119.15 s


@pytest.mark.parametrize(
    "final",
    [
        problem(503, "training-unavailable"),
        problem(500, "internal-error"),
        problem(409, "step-conflict"),
        answer({}, 201),
    ],
)
def test_an_answer_that_would_not_change_is_taken(final):
    delivery, sent, _ = drive(core.deliver(get("maps")), final)
    assert delivery.reply is final
    assert len(sent) == 1


def test_a_gateway_that_stays_is_a_transport_error():
    error, sent, _ = drive(core.call(get("maps")), *[answer({}, 503)] * 6)
    assert type(error) is errors.TransportError
    assert len(sent) == 6


def create(**given):
    return calls.create_session(**{"policy_id": "p", "initial_pose": (1, 2, 0.5), **given})


def test_a_session_is_created_under_an_id_of_our_own():
    info, (request,), _ = drive(create(), answer(SESSION, 201))
    body = json.loads(request.body)
    assert len(body.pop("id")) == 36
    assert body == {
        "policy_id": "p",
        "initial_pose": [1.0, 2.0, 0.5],
        "seed": 0,
        "threshold": 1.0,
        "margin": 0.0,
        "slack": 0,
        "evaluation": "feasibility",
        "shaping": "projection",
        "allow_infeasible": False,
        "uncertainty": "learned",
        "learn_map": True,
        "map_memory": None,
        "threshold_over": "step",
    }
    assert info.policy_ids == ("p",)
    _, (again,), _ = drive(
        create(policy_id=None, policy_ids=("p", "q"), id="mine", max_steps=9), answer(SESSION, 201)
    )
    body = json.loads(again.body)
    assert (body["id"], body["policy_ids"], body["max_steps"], "policy_id" in body) == (
        "mine",
        ["p", "q"],
        9,
        False,
    )


@pytest.mark.parametrize("uncertainty", [None, ["learned"], 0.1])
def test_what_is_no_uncertainty_is_left_for_the_server_to_refuse(uncertainty):
    _, (request,), _ = drive(create(uncertainty=uncertainty), problem(422, "validation"))
    assert json.loads(request.body)["uncertainty"] == uncertainty


@pytest.mark.parametrize(
    "ids", [{}, {"policy_id": "p", "policy_ids": ["q"]}, {"policy_ids": "case1"}, {"policy_ids": 5}]
)
def test_exactly_one_way_to_name_policies(ids):
    error, sent, _ = drive(create(**{"policy_id": None, "policy_ids": None, **ids}))
    assert type(error) is errors.InputError
    assert sent == []


def test_session_exists_after_a_lost_answer_of_our_own_is_our_session():
    info, sent, _ = drive(
        create(), lost(), problem(409, "session-exists"), answer({**SESSION, "id": "read back"})
    )
    assert info.id == "read back"
    key = json.loads(sent[0].body)["id"]
    assert (sent[2].method, sent[2].path) == ("GET", f"/v1/sessions/{key}")


def test_session_exists_at_the_first_try_is_somebody_elses():
    error, sent, _ = drive(create(id="taken"), problem(409, "session-exists"))
    assert type(error) is errors.SessionExists
    assert len(sent) == 1


@pytest.mark.parametrize(
    "other",
    [
        {"next_t": 4},
        {"policy_ids": ["q"]},
        {"threshold": 0.1},
        {"seed": 1},
        {"map_memory": 9},
        {"uncertainty": {"translation": 0.02, "rotation": 0.1, "slip": 0.0}},
        {},
    ],
)
def test_a_callers_id_is_somebody_elses_even_after_a_lost_answer_unless_it_is_what_was_asked_for(other):
    asked = {"id": "taken", "policy_id": "name", "uncertainty": {"translation": 0.01, "rotation": 0.1}}
    told = {"seed": 0, "threshold": 1, "map_memory": None, **SESSION, "id": "taken"}
    told |= {"uncertainty": {**asked["uncertainty"], "slip": 0.0}, **other}
    named = [answer({**POLICY, "id": "p"})] if other.keys() <= {"policy_ids"} else []
    result, sent, _ = drive(create(**asked), lost(), problem(409, "session-exists"), answer(told), *named)
    assert type(result) is (errors.SessionExists if other else SessionInfo)
    assert [request.path for request in sent[3:]] == ["/v1/policies/name"] * len(named)


def test_erasing_what_a_lost_try_erased_succeeds_and_what_never_was_does_not():
    assert drive(calls.delete_session("s"), lost(), problem(404, "not-found"))[0] is None
    assert type(drive(calls.delete_session("s"), problem(404, "not-found"))[0]) is errors.NotFound


def test_deleting_a_policy_is_never_repeated():
    """The first DELETE cancels a training; the second would remove the policy."""
    error, sent, _ = drive(calls.delete_policy("p"), lost())
    assert type(error) is errors.TransportTimeout
    assert len(sent) == 1


def test_pages():
    page, (first,), _ = drive(
        core.page_of(Policy, "policies", None), answer({"items": [POLICY], "next": "p"})
    )
    assert (first.path, first.params, page.items[0].id, page.next) == ("/v1/policies", {}, "p", "p")
    page, (second,), _ = drive(core.page_of(Policy, "policies", "p"), answer({"items": [], "next": None}))
    assert (second.params, page.items, page.next) == ({"cursor": "p"}, (), None)


def test_waiting_ends_with_ready_or_failed_and_reports_on_the_way():
    seen = []
    answers = [answer({**POLICY, "progress": p}) for p in (0.1, 0.5)]
    done = answer({**POLICY, "status": "failed", "error": "killed"})
    policy, _, waits = drive(
        calls.wait_policy("p", timeout=60, interval=2, progress=lambda p: seen.append(p.progress)),
        *answers,
        done,
    )
    assert (policy.status, policy.error) == ("failed", "killed")
    assert seen == [0.1, 0.5, 0.5]
    assert waits == [2, 2]


def test_waiting_outlasts_a_server_that_is_away_for_a_while_but_not_one_that_never_was():
    outage = [lost()] * 4
    policy, _, _ = drive(
        calls.wait_policy("p", timeout=60, interval=1),
        answer(POLICY),
        *outage,
        *[starting("9")] * 2,  # it is there again, but not ready
        answer({**POLICY, "status": "ready"}),
    )
    assert policy.status == "ready"
    error, _, _ = drive(calls.wait_policy("p", timeout=60, interval=1), *outage)
    assert type(error) is errors.TransportTimeout


def test_waiting_has_an_end():
    """The time is used up, with a last question at its end, and told as it was."""
    asked = [answer(POLICY)] * 4
    error, _, waits = drive(calls.wait_policy("p", timeout=5, interval=2), *asked)
    assert type(error) is errors.TransportTimeout
    assert error.message.endswith("is training (50%) after 5.0 s")
    assert waits == pytest.approx([2, 2, 1 - 3 * 0.01])


def test_uploads_are_multipart_and_get_the_time_to_be_prepared():
    map_json = {
        "id": "m",
        "resolution": 0.05,
        "width": 2,
        "height": 1,
        "origin": [0, 0, 0],
        "bounds": [0, 0, 0.1, 0.05],
        "rooms": {},
        "from_the_future": 1,
    }
    uploaded, (request,), _ = drive(calls.upload_map("resolution: 0.05", b"P5"), answer(map_json, 201))
    assert uploaded.bounds == (0, 0, 0.1, 0.05)
    assert isinstance(request, Request)
    assert request.slow
    assert {name: part[1] for name, part in request.files.items()} == {
        "format": b"map_server",
        "metadata": b"resolution: 0.05",
        "image": b"P5",
    }
    _, (request,), _ = drive(calls.upload_policy(b"weights", {"seed": 0}), answer(POLICY, 202))
    assert {name: part[1] for name, part in request.files.items()} == {
        "weights": b"weights",
        "card": b'{"seed":0}',
    }


def test_an_answer_that_lacks_a_field_is_a_server_error():
    error, _, _ = drive(calls.get_policy("p"), answer({"id": "p"}))
    assert type(error) is errors.ServerError
    assert "status" in error.message


def starting(retry_after):
    reply = problem(503, "starting")
    return replace(reply, headers={**reply.headers, "retry-after": retry_after})


def test_a_starting_server_is_asked_again_when_it_says_so_and_no_try_is_counted():
    policy, sent, waits = drive(calls.get_policy("p"), *[starting("0.3")] * 6, answer(POLICY))
    assert policy.id == "p"
    assert len(sent) == 7  # more than the tries that lost answers get
    assert waits == [0.3] * 6


def test_a_server_that_starts_for_longer_than_a_call_may_take_is_said_to():
    error, sent, waits = drive(calls.get_policy("p"), *[starting("0.7")] * 3)
    assert type(error) is errors.Starting
    assert len(sent) == 3
    assert waits == [0.7, 0.7]  # a third pause would begin a try later than four timeouts of 0.5 s


def test_waiting_until_ready_outlasts_a_server_that_is_away_and_one_that_starts(caplog):
    maps = answer({"items": [], "next": None})
    ready = answer({"status": "ok"})  # of one process, while another is still starting
    outcomes = [lost(0.01), lost(0.01), starting("1"), ready, starting("9"), ready, maps]
    result, sent, waits = drive(calls.wait_until_ready(10.0), *outcomes)
    assert result is None
    assert [request.path for request in sent] == ["/readyz"] * 4 + ["/v1/maps", "/readyz", "/v1/maps"]
    assert waits == [calls.READY_EVERY] * 4
    assert [each.getMessage().split(":")[0] for each in caplog.records] == ["waiting"] * 2  # for each once


@pytest.mark.parametrize(
    "outcomes",
    [
        [replace(answer({}), content=b"<html>a page for every path</html>")],
        [answer({"status": "ok"}), answer({"detail": "Not Found"}, 404)],
        [answer({"status": "ok"}), answer({"status": "ok"})],
    ],
)
def test_waiting_until_ready_does_not_take_another_server_for_specshield(outcomes):
    error, _, waits = drive(calls.wait_until_ready(10.0), *outcomes)
    assert isinstance(error, errors.ServerError | errors.NotFound)
    assert "specshield server" in str(error)
    assert waits == []


def test_waiting_until_ready_ends_and_says_how_far_the_server_was():
    error, _, waits = drive(calls.wait_until_ready(0.5), lost(0.01), starting("1"), starting("1"))
    assert type(error) is errors.TransportTimeout
    assert error.message == "not ready after 0.5 s: starting"
    assert waits == pytest.approx([calls.READY_EVERY, 0.5 - 0.02 - calls.READY_EVERY])
    error, _, _ = drive(calls.wait_until_ready(0.5), problem(404, "not-found"))
    assert type(error) is errors.NotFound
    error, sent, _ = drive(calls.wait_until_ready("x"))
    assert (type(error), error.path, sent) == (errors.InputError, "timeout", [])
