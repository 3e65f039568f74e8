import array
import json
import math
from pathlib import Path

import numpy as np
import pytest

from specshield import errors
from specshield.client import wire
from specshield.client.wire import Reply


def reply(status, document=None, content_type="application/problem+json", **headers):
    content = b"" if document is None else json.dumps(document).encode()
    return Reply(status, {"content-type": content_type, **headers}, content, 0.01, 0.5)


@pytest.mark.parametrize("cls", list(errors.tree()))
def test_every_problem_type_becomes_its_class_with_all_the_document_says(cls):
    document = {
        "type": cls.type,
        "title": "A title",
        "status": 422,
        "detail": "what was wrong",
        "path": "spec.formula",
        "got": "G[5,2] a",
        "expected": "a window [a,b] with a <= b",
        "position": 1,
        "expected_t": 4,
    }
    error = wire.error_of(reply(422, document))
    assert type(error) is cls
    assert error.message == "what was wrong"
    told = "spec.formula: what was wrong; got 'G[5,2] a'; expected a window [a,b] with a <= b"
    assert str(error) == told
    assert (error.path, error.got, error.expected) == (
        "spec.formula",
        "G[5,2] a",
        "a window [a,b] with a <= b",
    )
    assert error.details == {"status": 422, "position": 1, "expected_t": 4}


@pytest.mark.parametrize(
    ("status", "cls"),
    [
        (400, errors.InputError),
        (401, errors.Unauthorized),
        (404, errors.NotFound),
        (409, errors.Conflict),
        (413, errors.BodyTooLarge),
        (302, errors.ServerError),
        (500, errors.ServerError),
        (502, errors.TransportError),
        (503, errors.TransportError),
        (504, errors.TransportTimeout),
    ],
)
def test_an_answer_without_a_document_is_judged_by_its_status(status, cls):
    error = wire.error_of(reply(status, {"type": "not-found"}, "text/html"))
    assert type(error) is cls
    assert str(status) in error.message
    assert error.details == {"status": status}


def test_who_is_redirected_is_told_where_to():
    """As from http to https, by a proxy."""
    error = wire.error_of(Reply(301, {"location": "https://robots.example/v1/sessions"}, b"", 0.0, 0.5))
    assert type(error) is errors.ServerError
    assert str(error) == (
        "status 301: the server redirects to https://robots.example/v1/sessions; "
        "expected a specshield server at base_url"
    )


def test_an_unknown_type_is_kept_and_falls_back_to_the_status():
    error = wire.error_of(reply(409, {"type": "from-the-future", "detail": "no"}))
    assert type(error) is errors.Conflict
    assert error.details == {"status": 409, "type": "from-the-future"}


@pytest.mark.parametrize("content", [b"<html>", b"[1]", b"\xff", b""])
def test_a_success_that_is_no_json_object_is_a_server_error(content):
    with pytest.raises(errors.ServerError, match="specshield"):
        wire.json_object(Reply(200, {}, content, 0.0, 0.5))


@pytest.mark.parametrize(
    "logits",
    [
        [0.1, -math.inf, 2],
        (0.1, None, 2),
        np.array([0.1, -np.inf, 2.0]),
        [np.float64(0.1), None, np.int64(2)],
        array.array("d", [0.1, -math.inf, 2.0]),
        (value for value in [0.1, None, 2]),
    ],
)
def test_logits_of_any_sequence_go_out_as_float64_and_minus_infinity_as_null(logits):
    assert json.loads(wire.encode({"logits": wire.logit_values(logits)})) == {"logits": [0.1, None, 2.0]}


def test_float32_logits_keep_their_value():
    (value,) = wire.logit_values(np.array([0.1], dtype=np.float32))
    assert value == float(np.float32(0.1))


@pytest.mark.parametrize(
    "bad",
    [
        [0.0, math.nan],
        [0.0, math.inf],
        [0.0, "x"],
        [[0.0, 1.0]],
        3.0,
        {0: 5.0, 1: 7.0},
        {0.0, 1.0},
        ["0", "1"],
        np.array(["1"]),
        b"12",
    ],
)
def test_bad_logits_are_refused_before_anything_is_sent(bad):
    with pytest.raises(errors.LogitsError) as caught:
        wire.logit_values(bad)
    assert caught.value.path.startswith("logits")
    assert caught.value.expected


def test_logits_of_a_batch_are_told_so():
    for batch in (np.zeros((1, 20)), [[0.0] * 20]):
        with pytest.raises(errors.LogitsError, match="lists of numbers, as of a batch"):
            wire.logit_values(batch)


def test_the_path_of_a_bad_logit_is_the_servers():
    with pytest.raises(errors.LogitsError) as caught:
        wire.logit_values([0.0, math.nan])
    assert caught.value.path == "logits[1]"


@pytest.mark.parametrize(
    "bad",
    [(0, 0), (0, 0, 0, 0), (0, 0, math.nan), (0, 0, None), (0, 0, "north"), None, (0, 0, 1e9), (-1e9, 0, 0)],
)
def test_bad_poses_are_refused(bad):
    with pytest.raises(errors.PoseError):
        wire.pose_values(bad)


def test_poses_of_any_sequence():
    assert (
        wire.pose_values(np.array([1.5, -2.0, 0.25]))
        == wire.pose_values([1.5, -2, 0.25])
        == (1.5, -2.0, 0.25)
    )


def test_a_point_beyond_what_a_server_takes_is_refused():
    with pytest.raises(errors.InputError) as caught:
        wire.point_values([[1, 2], np.array([1e9, 2.0])], "occupied")
    assert caught.value.path == "occupied[1]"
    assert wire.point_values(np.array([[1.0, -1e8]]), "free") == [[1.0, -1e8]]


@pytest.mark.parametrize("bad", [math.nan, math.inf, None, "low"])
def test_bad_signals_name_the_signal(bad):
    with pytest.raises(errors.SampleError) as caught:
        wire.signal_values({"battery": bad})
    assert caught.value.path == "signals.battery"


def test_what_is_none_is_told_as_none():
    """Minus infinity, which None stands for among logits, is nothing that the caller has sent."""
    with pytest.raises(errors.PoseError) as pose:
        wire.pose_values((None, 0, 0))
    with pytest.raises(errors.SampleError) as signal:
        wire.signal_values({"battery": None})
    assert (pose.value.got, signal.value.got) == ("(None, 0, 0)", "[None]")


@pytest.mark.parametrize("seconds", [2, 2.0, np.float32(2.0), np.int64(2)])
def test_seconds_may_be_any_real_number(seconds):
    assert wire.seconds_value(seconds, "deadline") == 2.0


def test_bodies_take_arrays_and_refuse_what_json_cannot_hold():
    body = json.loads(
        wire.encode({"data": np.array([0, 100, -1], dtype=np.int8), "centre": (np.float64(0.5), 1)})
    )
    assert body == {"data": [0, 100, -1], "centre": [0.5, 1]}
    deep = []
    for _ in range(100_000):
        deep = [deep]
    for bad in (math.nan, [1, math.inf], object(), deep):
        with pytest.raises(errors.InputError) as caught:
            wire.encode({"fine": 1.0, "x": bad})
        assert (caught.value.path, bool(caught.value.expected)) == ("x", True)


def test_content_is_bytes_a_text_or_a_file(tmp_path: Path):
    (tmp_path / "map.yaml").write_text("resolution: 0.05")
    assert (
        wire.content(tmp_path / "map.yaml", "metadata")
        == wire.content("resolution: 0.05", "metadata")
        == wire.content(b"resolution: 0.05", "metadata")
    )
    for wrong in (tmp_path / "none.pgm", "flat.pgm"):  # a text is content, so a file's name is none
        with pytest.raises(errors.InputError, match=r"\.pgm") as caught:
            wire.content(wrong, "image")
        assert caught.value.path == "image"
    for none in (0.05, None, {"resolution": 0.05}):
        with pytest.raises(errors.InputError, match="metadata cannot be sent as a file") as caught:
            wire.content(none, "metadata")
        assert caught.value.path == "metadata"
    for text, where in (("flat.pgm", "name"), ("resolution: 0.05\nimage: flat.pgm", "metadata")):
        assert wire.content(text, where) == text.encode()


def test_an_id_cannot_leave_its_place_in_the_path():
    assert wire.path("maps", "..?x=1", "image.png") == "/v1/maps/..%3Fx%3D1/image.png"

    for id in ("", ".", "..", "../policies", "/", None):
        with pytest.raises(errors.InputError) as caught:
            wire.path("sessions", id)
        assert caught.value.path == "id"
    assert wire.path("maps", "\ud800") == "/v1/maps/%3F"


def test_server_timing():
    header = 'total;dur=2.5, rollout;desc="J";dur=1.25, miss, edge;dur="5", bad;dur=x'
    timed = reply(200, {}, **{"server-timing": header})
    assert wire.timings(timed) == {"total": 2.5, "rollout": 1.25, "edge": 5.0}
    assert wire.timings(reply(200, {})) == {}
