"""Requests and replies as values, the checks of what is sent, and the errors that replies stand for."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from urllib.parse import quote

from specshield.client.models import Pose
from specshield.errors import (
    BodyTooLarge,
    Conflict,
    InputError,
    LogitsError,
    NotFound,
    PoseError,
    SampleError,
    ServerError,
    SpecshieldError,
    TransportError,
    TransportTimeout,
    Unauthorized,
    tree,
)


class Array(Protocol):
    """Any array (numpy, torch, array.array), known by its `tolist`."""

    def tolist(self) -> Any: ...


Numbers = Iterable[float] | Array
Logits = Iterable[float | None] | Array
Points = Iterable[Numbers] | Array
TRIES = 6
FARTHEST = 1e8  # [m], [rad]; a server takes no larger numbers in poses and points
LONGEST = 1e6  # [s]; a socket takes no timeout of more than 2**31 ms
Content = bytes | str | os.PathLike[str]
FILES = (".json", ".pgm", ".png", ".safetensors", ".yaml", ".yml")  # how the name of a file ends


class Request(NamedTuple):
    """One request. slow: the server has to prepare something. tries: how often it is sent at most.

    t: the step that the answer has to be about (see `stale`). message: the body of a step, for a stream.
    listens: a successful answer is read while it comes.
    """

    method: str
    path: str
    body: bytes | None = None  # JSON, encoded once, so that every try sends the same bytes
    files: Mapping[str, tuple[str, bytes, str]] | None = None  # multipart: (file name, content, type)
    params: Mapping[str, str] | None = None
    slow: bool = False
    tries: int = TRIES
    t: int | None = None
    message: Mapping[str, Any] | None = None
    listens: bool = False


@dataclass(frozen=True)
class Reply:
    """An answer that took `seconds` of its try's `timeout`. left: the seconds left of the call's time."""

    status: int
    headers: Mapping[str, str]  # names in lower case
    content: bytes
    seconds: float
    timeout: float
    left: float = math.inf
    parsed: Any = None  # the content of an answer that came as a message of a stream, and not as JSON
    feed: Any = None  # the core.Feed of an answer that is read while it comes

    @cached_property
    def document(self) -> Any:
        """The content of the body; None if it is not JSON."""
        if self.parsed is not None:
            return self.parsed
        try:
            return json.loads(self.content)
        except (ValueError, RecursionError):
            return None


class Failure(NamedTuple):
    """A try without an answer; it took `seconds` of its `timeout`. left: seconds left of the call's time."""

    error: TransportError
    seconds: float
    timeout: float
    left: float = math.inf


def get(*segments: str, slow: bool = False, params: Mapping[str, str] | None = None) -> Request:
    return Request("GET", path(*segments), params=params, slow=slow)


def post(
    *segments: str, body: Mapping[str, Any], slow: bool = False, tries: int = TRIES, t: int | None = None
) -> Request:
    message = None if t is None else body
    return Request("POST", path(*segments), encode(body), slow=slow, tries=tries, t=t, message=message)


def path(*segments: str) -> str:
    """A path below /v1/. Raises InputError for an id that is empty, `.` or `..`, or has a slash."""
    for segment in segments:
        if not isinstance(segment, str) or segment in ("", ".", "..") or "/" in segment:
            told, expected = "this cannot be an id or a name", "an id or a name that the server gave"
            raise InputError(told, path="id", got=segment, expected=expected)
    return "/v1/" + "/".join(quote(segment, safe="", errors="replace") for segment in segments)


def encode(body: Mapping[str, Any]) -> bytes:
    """The body as JSON; arrays become lists. Raises InputError for NaN, infinity and other objects."""
    members, name = list[str](), "body"
    try:
        for name, value in body.items():
            members.append(_json({name: value})[1:-1])
    except (TypeError, ValueError, RecursionError) as error:
        expected = "finite numbers, texts, lists and objects of them"
        raise InputError(f"{name}: cannot be sent as JSON: {error}", path=name, expected=expected) from error
    return f"{{{','.join(members)}}}".encode()


def _listed(value: Any) -> Any:
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")


_json = json.JSONEncoder(allow_nan=False, separators=(",", ":"), default=_listed).encode


def content(source: object, where: str) -> bytes:
    """The bytes of a file (a path object) or a text, or the given bytes. Raises InputError, also for a text
    that is the name of a file.
    """
    if isinstance(source, os.PathLike):
        try:
            return Path(source).read_bytes()
        except OSError as error:
            told, expected = f"{where} cannot be read: {error.strerror}", "a file that can be read"
            raise InputError(told, path=where, got=str(source), expected=expected) from error
    if isinstance(source, str) and where != "name" and source.endswith(FILES) and "\n" not in source:
        told, expected = "this text is the name of a file, not its content", f"pathlib.Path({source!r})"
        raise InputError(told, path=where, got=source, expected=expected)
    if not isinstance(source, bytes | str):
        told, expected = f"{where} cannot be sent as a file", "bytes, a text, or the path object of a file"
        raise InputError(told, path=where, got=source, expected=expected)
    return source.encode() if isinstance(source, str) else source


def pose_values(pose: Numbers, where: str = "pose") -> Pose:
    """(x, y, theta) in [m, m, rad]. Raises PoseError unless these are three numbers up to `FARTHEST`."""
    x, y, theta = _finite(pose, PoseError, where, "a pose is three finite numbers x, y, theta", 3)
    return x, y, theta


def point_values(points: Points, where: str) -> list[list[float]]:
    """Points (x, y) [m], map frame. Raises InputError unless each is two numbers up to `FARTHEST`."""
    listed = points.tolist() if hasattr(points, "tolist") else points
    if not isinstance(listed, Iterable):
        raise InputError("these are no points", path=where, got=listed, expected="a list of points [x, y]")
    told = "a point is two finite numbers x, y"
    return [_finite(each, InputError, f"{where}[{i}]", told, 2) for i, each in enumerate(listed)]


def _finite(
    values: Any, error: type[InputError], where: str, told: str, count: int, most: float = FARTHEST
) -> list[float]:
    expected = "a finite number" if count == 1 else f"{count} numbers from {-most:g} to {most:g}"
    found = _floats(values, error, where, expected)
    if len(found) != count or not all(abs(value) <= most for value in found):
        raise error(told, path=where, got=found, expected=expected)
    return found


def logit_values(logits: Logits) -> list[float | None]:
    """One logit for each action; minus infinity becomes None. Raises LogitsError for NaN and +infinity."""
    values = _floats(logits, LogitsError, "logits", "one number for each action")
    for i, value in enumerate(values):
        if math.isnan(value) or value == math.inf:
            where, expected = f"logits[{i}]", "a finite number, -inf or None"
            raise LogitsError(f"logit {i} is {value}", path=where, got=str(value), expected=expected)
    return [None if value == -math.inf else value for value in values]


def signal_values(signals: Mapping[str, float]) -> dict[str, float]:
    """The samples by name. Raises SampleError unless all are finite numbers."""
    if not isinstance(signals, Mapping):
        raise SampleError("these are no signals", path="signals", got=signals, expected="numbers by name")
    told, most = "a signal is a finite number", sys.float_info.max
    return {
        name: _finite([value], SampleError, f"signals.{name}", told, 1, most)[0]
        for name, value in signals.items()
    }


def write_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Raises InputError for a file that cannot be written."""
    try:
        Path(path).write_bytes(content)
    except OSError as error:
        told, expected = f"{path} cannot be written: {error.strerror}", "a file in a folder that exists"
        raise InputError(told, path="path", got=str(path), expected=expected) from None


def check_flags(**flags: object) -> None:
    """Raises InputError unless each is True, False or None."""
    for name, flag in flags.items():
        if (flag.tolist() if hasattr(flag, "tolist") else flag) not in (True, False, None):
            raise InputError(f"{name} is not a boolean", path=name, got=flag, expected="True or False")


def seconds_value(seconds: object, name: str) -> float:
    """The seconds, at most `LONGEST`. Raises InputError unless they are a positive number."""
    value = float(seconds) if isinstance(seconds, Real) else math.nan
    if not 0.0 < value < math.inf:
        expected = "a number above 0"
        raise InputError(f"a {name} is a time in seconds", path=name, got=seconds, expected=expected)
    return min(value, LONGEST)


def _floats(values: Any, error: type[InputError], where: str, expected: str) -> list[float]:
    """The values as floats. None becomes minus infinity among logits, and is an error elsewhere."""
    listed = values
    try:
        if isinstance(values, str | bytes | Mapping | Set):  # iterable, but no ordered numbers
            raise TypeError
        if hasattr(values, "tolist"):
            listed = values.tolist()
        elif not isinstance(values, list | tuple):
            listed = list(values)
        if any(isinstance(value, str | bytes) for value in listed):
            raise TypeError
        return [-math.inf if value is None and error is LogitsError else float(value) for value in listed]
    except (TypeError, ValueError, OverflowError, RuntimeError) as cause:  # the last: tensors without values
        nested = isinstance(listed, list | tuple) and any(isinstance(value, list | tuple) for value in listed)
        told = "these are not numbers" if isinstance(listed, list | tuple) else "this is no list of numbers"
        told = "these are lists of numbers, as of a batch" if nested else told
        raise error(told, path=where, got=f"{listed!r:.80}", expected=expected) from cause


_BY_TYPE = {cls.type: cls for cls in tree()}
_BY_STATUS: dict[int, type[SpecshieldError]] = {
    401: Unauthorized, 403: Unauthorized, 404: NotFound, 409: Conflict, 413: BodyTooLarge,
}  # fmt: skip
# By the statuses that say that the server is not there now: the error where no server of ours says so.
AWAY: dict[int, type[TransportError]] = {502: TransportError, 503: TransportError, 504: TransportTimeout}


def json_object(reply: Reply) -> dict[str, Any]:
    """The JSON object of a successful reply. Raises the error that an unsuccessful one stands for."""
    check(reply)
    body = reply.document
    if not isinstance(body, dict):
        told = "the answer is not a JSON object; is this a specshield server?"
        raise ServerError(told, status=reply.status)
    return body


def check(reply: Reply) -> None:
    """Raises the error that an unsuccessful reply stands for."""
    if not 200 <= reply.status < 300:
        raise error_of(reply)


def error_of(reply: Reply) -> SpecshieldError:
    """The error that a problem document (RFC 9457) describes: its class by `type`, with all its members."""
    problem = reply.headers.get("content-type", "").startswith("application/problem+json")
    document = reply.document if problem and isinstance(reply.document, dict) else None
    if document is None and reply.status in AWAY:  # a proxy in front of the server has answered
        what = f"the server cannot be reached: status {reply.status}"
        return AWAY[reply.status](what, status=reply.status)
    if document is None:
        to = reply.headers.get("location")
        what = f": the server redirects to {to}" if to else " without a problem"
        document = {"detail": f"status {reply.status}{what}", "expected": "a specshield server at base_url"}
    default = _BY_STATUS.get(reply.status) or (InputError if 400 <= reply.status < 500 else ServerError)
    cls = _BY_TYPE.get(str(document.get("type")), default)
    message = str(document.get("detail") or document.get("title") or f"status {reply.status}")
    error = cls(message, **{name: document.get(name) for name in ("path", "got", "expected")})
    known = {"type"} if cls.type == document.get("type") else set()
    told = {"title", "detail", "path", "got", "expected"} | known
    error.details.update({"status": reply.status, **{k: v for k, v in document.items() if k not in told}})
    return error


def stale(request: Request, reply: Reply) -> bool:
    """Whether the reply is the decision of another step than the one that was asked for."""
    if request.t is None or reply.status != 200 or not isinstance(reply.document, dict):
        return False
    return bool(reply.document.get("t") != request.t)


def timings(reply: Reply) -> dict[str, float]:
    """The header Server-Timing, `total;dur=2.1, rollout;dur="1.5"`, as {"total": 2.1, "rollout": 1.5} [ms].
    Other entries are left out: a proxy in front of the server may add some.
    """
    entries = {}
    for metric in reply.headers.get("server-timing", "").split(","):
        name, *parameters = (part.strip() for part in metric.split(";"))
        for parameter in parameters:
            key, _, value = parameter.partition("=")
            if key == "dur":
                with contextlib.suppress(ValueError):
                    entries[name] = float(value.strip('"'))
    return entries
