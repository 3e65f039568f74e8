"""Errors as problem documents (RFC 9457). One table has the HTTP status of each branch of their tree."""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Match
from starlette.types import Receive, Scope, Send

from specshield import errors
from specshield.errors import InputError, SpecshieldError
from specshield.service.schemas.base import ID, ID_TOLD
from specshield.service.storage.connect import cause_of
from specshield.service.storage.objects import unusable

if TYPE_CHECKING:
    from fastapi import FastAPI

MEDIA_TYPE = "application/problem+json"
CLIENT_GONE = 499  # nginx's status for a request whose client has left; it is never sent
log = logging.getLogger("specshield")


class ClientGone(Exception):
    """The caller has closed its connection: nobody is there to be answered."""


async def until_gone(receive: Receive) -> None:
    """Returns when the caller has closed its connection."""
    while (await receive())["type"] != "http.disconnect":
        pass


STATUS: Mapping[type[SpecshieldError], int] = {
    errors.BodyTooLarge: 413,
    errors.UnsupportedMediaType: 415,
    errors.HeadersTooLarge: 431,
    errors.InputError: 422,
    errors.NotFound: 404,
    errors.MethodNotAllowed: 405,
    errors.Conflict: 409,
    errors.SessionDamaged: 410,
    errors.Unauthorized: 401,
    errors.CrossSite: 403,
    errors.MisdirectedRequest: 421,
    errors.LimitReached: 429,
    errors.Busy: 503,
    errors.RequestTimeout: 408,
    errors.InsufficientStorage: 507,
    errors.TrainingUnavailable: 503,
    errors.Starting: 503,
    errors.Stopping: 503,
    errors.StoreError: 503,
    SpecshieldError: 500,
}

# The error for a field that fails its schema is that of a wrong value there, so that clients need one type
# only.
FIELD_ERRORS: Mapping[str, type[InputError]] = {
    "logits": errors.LogitsError,
    "poses": errors.PoseError,
    "initial_pose": errors.PoseError,
    "signals": errors.SampleError,
    "robot": errors.RobotError,
    "formula": errors.FormulaError,
}

UNREADABLE: Mapping[type[Any], str] = {  # by the error of parsing: why a body is no JSON
    RecursionError: "it is nested too deeply",
    UnicodeDecodeError: "its text is not UTF-8",
    ValueError: "a number has too many digits",
}
LONGEST = 2000  # characters of a sentence that tells of an error from another process; chosen by hand
LISTS = ("errors", "conjuncts")  # are not shortened, since their entries are short already


def status_of(error: SpecshieldError) -> int:
    return next(STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)


def document(error: SpecshieldError) -> dict[str, Any]:
    """type, title, status and detail; path, got and expected if the error has them; its other details."""
    body: dict[str, Any] = {
        "type": error.type,
        "title": error.type.replace("-", " ").capitalize(),
        "status": status_of(error),
        "detail": error.message,
    }
    if error.path is not None:
        body |= {"path": error.path, "got": plain(error.got)}
    elif error.got is not None:
        body["got"] = plain(error.got)
    if error.expected is not None:
        body["expected"] = error.expected
    return body | {name: value if name in LISTS else plain(value) for name, value in error.details.items()}


def shortened(error: SpecshieldError) -> SpecshieldError:
    """The error, with no part of it longer than a problem document needs. What it was raised for may be as
    large as an upload, such as a name in a map.
    """
    error.message = plain(error.message, LONGEST)
    error.args = (error.message,)
    error.path, error.got = plain(error.path), plain(error.got)
    error.expected = plain(error.expected, LONGEST)
    return error


def plain(value: Any, room: int = 400) -> Any:
    """`value` if it is finite JSON of bounded size, else a text that shows it."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, bytes):
        value = value.decode(errors="replace")
    if isinstance(value, str):
        return value if len(value) <= room + 1 else value[:room] + "…"
    try:
        text = json.dumps(value, allow_nan=False)
    except (TypeError, ValueError, RecursionError):
        return str(value)[:room]
    return value if len(text) <= room else text[:room] + "…"


class ProblemResponse(Response):
    """A problem document. When it is sent, its type is written into `scope["state"]["problem"]`."""

    def __init__(self, error: SpecshieldError, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(json.dumps(document(error)), status_of(error), headers, media_type=MEDIA_TYPE)
        self._type = error.type
        if self.status_code == 401:
            self.headers["WWW-Authenticate"] = "Bearer"
        if self.status_code == 503:
            self.headers["Retry-After"] = "1"
        if isinstance(error, errors.RateLimited):
            self.headers["Retry-After"] = str(error.details["retry_after"])

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope["state"]["problem"] = self._type
        await super().__call__(scope, receive, send)


def known(error: Exception) -> SpecshieldError | None:
    """What callers are told of an error, None for one that nobody has foreseen. Where the machine lacks
    something, such as room on its disk or a thread, they may ask again.
    """
    if isinstance(error, SpecshieldError):
        return error
    lost = isinstance(error, ConnectionError | TimeoutError)
    if isinstance(error, OSError) and error.strerror is not None and not lost:
        return unusable(error)
    if isinstance(error, RuntimeError) and str(error) == "can't start new thread":
        return errors.Busy("the server can start no thread just now", expected="the request again in a while")
    return None


def failed() -> Response:
    """The answer after an unexpected error. The error is also raised again, so that uvicorn logs the
    traceback and closes the connection: the header tells the caller that.
    """
    error = errors.ServerError("the server failed on this request; its log says more")
    return ProblemResponse(error, {"Connection": "close"})


def tell(scope: Scope, error: SpecshieldError) -> Response:
    """The answer for an error, which is logged too if the server or its store is the reason."""
    if status_of(error) >= 500 and not isinstance(error, errors.Starting | errors.Stopping):
        told = error.message + (cause_of(error) if isinstance(error, errors.StoreError) else "")
        log.warning("%s %s: %s", scope.get("method", "WEBSOCKET"), scope["path"], told)
    return ProblemResponse(error)


def from_validation(found: Sequence[Mapping[str, Any]], body: Any, below: str = "") -> InputError:
    """One error for all that a schema refuses: its message is about the first, and `errors` has them all.

    below: the field of the request that `body` is, "" for the whole body.
    """
    if found[0]["type"] == "json_invalid":
        reason = found[0].get("ctx", {}).get("error", "")
        where = found[0]["loc"][-1:]  # FastAPI says at which character; pydantic's reason says at which line
        at = f" at character {where[0]}" if where and isinstance(where[0], int) else ""
        told = f"{below or 'the body'} is not JSON: {reason}{at}"
        return InputError(told, path=below or None, expected="a JSON object")
    if isinstance(body, bytes):  # FastAPI has not read it
        told, expected = "the body is not declared as JSON", "the header Content-Type: application/json"
        return errors.UnsupportedMediaType(told, path="Content-Type", expected=expected)
    # Where a word and an object are valid, the errors of an object are about its members, not about the word.
    found = [
        e for e in found if e["type"] != "literal_error" or not isinstance(e.get("input"), dict)
    ] or found
    found = sorted(found, key=lambda e: e["type"] == "missing")  # perhaps since its name is misspelt: last
    listed = [
        {
            "path": ".".join(filter(None, (below, _path(item, body)[:200]))),
            "got": plain(item.get("input")),
            "expected": valid(item),
        }
        for item in found[:20]
    ]
    first = listed[0]
    parts = re.split(r"[.\[]", first["path"])
    kind = next((FIELD_ERRORS[part] for part in parts if part in FIELD_ERRORS), InputError)
    wrong = {
        **dict.fromkeys(("missing", "union_tag_not_found"), "is missing"),
        "extra_forbidden": "is not a field of this request",
    }
    message = f"{first['path'] or 'the body'} {wrong.get(found[0]['type'], 'is not valid')}"
    ways = dict.fromkeys(each["expected"] for each in listed if each["path"] == first["path"])
    expected = " or ".join(ways)
    return kind(message, path=first["path"], got=first["got"], expected=expected, errors=listed)


def valid(item: Mapping[str, Any]) -> str:
    """What is valid where pydantic found an error."""
    said, context = str(item["msg"]), item.get("ctx", {})
    if item["type"].startswith("union_tag") and "expected_tags" in context:
        return f"one of {context['expected_tags']}"
    told = {
        **dict.fromkeys(("missing", "union_tag_not_found"), "a value: this field is required"),
        **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), "an object"),
        **dict.fromkeys(("int_parsing", "int_type", "int_from_float"), "a whole number"),
        **dict.fromkeys(("float_parsing", "float_type"), "a number"),
        **dict.fromkeys(("bool_parsing", "bool_type"), "true or false"),
        "string_type": "a text",
        "list_type": "a list",
        "string_too_short": "a text of {min_length} or more characters",
        "string_too_long": "a text of at most {max_length} characters",
        "string_pattern_mismatch": "a text of the form {pattern}",
        "too_short": "{min_length} or more items",
        "too_long": "at most {max_length} items",
    }
    if item["type"] == "finite_number" and "logits" in item["loc"]:
        return "a finite number, or null for minus infinity"
    if context.get("pattern") == f"^{ID}$":
        return ID_TOLD
    if item["type"] in ("list_type", "too_short", "too_long"):
        where = (None, *item["loc"])
        if where[-1] == "initial_pose" or where[-2] == "poses":
            return "three numbers [x, y, theta], in metres and radians"
    if item["type"] in told:
        return told[item["type"]].format(**context)
    return said.removeprefix("Value error, ").removeprefix("Input should be ")


def _path(item: Mapping[str, Any], body: Any) -> str:
    """The path as 'poses[0][2]', without the names by which pydantic marks the branch of a union."""
    source, *rest = item["loc"]
    if item["type"].startswith("union_tag"):
        rest.append(item["ctx"]["discriminator"].strip("'"))
    parts: list[str] = []
    here = body
    for i, part in enumerate(rest):
        held = _held(here, part)
        missing = i == len(rest) - 1 and item["type"].startswith(("missing", "union_tag"))
        if held is _ABSENT and source == "body" and not missing:
            continue
        here = held
        parts.append(f"[{part}]" if isinstance(part, int) else f".{part}")
    return "".join(parts).removeprefix(".")


_ABSENT = object()


def _held(value: Any, part: str | int) -> Any:
    if isinstance(value, Mapping):
        return value.get(part, _ABSENT)
    if isinstance(value, list) and isinstance(part, int) and part < len(value):
        return value[part]
    return _ABSENT


def _allowed(request: Request) -> str:
    """All methods of a path, which may have several routes."""
    asked = [
        {**request.scope, "method": method} for method in ("DELETE", "GET", "HEAD", "PATCH", "POST", "PUT")
    ]
    routes = request.app.routes
    return ", ".join(one["method"] for one in asked if any(r.matches(one)[0] is Match.FULL for r in routes))


def install(app: FastAPI) -> None:
    """Makes the app answer every error with a `ProblemResponse`."""
    from fastapi.exceptions import RequestValidationError  # the processes for heavy work need no FastAPI

    @app.exception_handler(SpecshieldError)
    @app.exception_handler(OSError)
    @app.exception_handler(RuntimeError)
    async def foreseen(request: Request, error: Exception) -> Response:
        if (told := known(error)) is None:
            raise error
        return tell(request.scope, told)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> Response:
        return ProblemResponse(from_validation(error.errors(), error.body))

    @app.exception_handler(HTTPException)
    async def http(request: Request, error: HTTPException) -> Response:
        path = request.url.path
        if error.status_code == 404:
            told, expected = f"there is no {path} here", "a path listed at /docs"
            if path.startswith("/v1/v1/"):
                expected += "; the base_url of the SDK ends before /v1"
            return ProblemResponse(errors.NotFound(told, got=path, expected=expected))
        if error.status_code == 405:
            told, allowed = f"{path} does not take {request.method}", _allowed(request)
            wrong = errors.MethodNotAllowed(told, got=request.method, expected=allowed)
            return ProblemResponse(wrong, {"Allow": allowed})
        reason = UNREADABLE.get(type(error.__cause__))
        if reason is not None:
            return ProblemResponse(InputError(f"the body is not JSON: {reason}", expected="a JSON object"))
        told, expected = str(error.detail), "a request in the form that /docs describes"
        return ProblemResponse(InputError(told, expected=expected))

    @app.exception_handler(ClientGone)
    async def gone(request: Request, error: Exception) -> Response:
        request.scope["state"]["status"] = CLIENT_GONE
        return Response(status_code=CLIENT_GONE)  # nobody reads it

    @app.exception_handler(Exception)
    async def unknown(request: Request, error: Exception) -> Response:
        return failed()
