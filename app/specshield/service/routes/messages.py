"""Reads the requests of steps and writes problems, in JSON or MessagePack, for HTTP and for streams."""

from __future__ import annotations

import json
import re
from typing import Any

import msgspec
from pydantic import ValidationError

from specshield.errors import InputError, SpecshieldError
from specshield.service import problems
from specshield.service.bounds.bodies import check_items
from specshield.service.schemas.steps import StepBody, StepRequest

MSGPACK = "application/msgpack"
SHORT = 64 << 10  # [bytes]; every wrong field of a shorter body is named, which takes a few ms

_json, _msgpack = msgspec.json.Decoder(StepBody), msgspec.msgpack.Decoder(StepBody)
_any = msgspec.msgpack.Decoder(ext_hook=lambda code, data: bytes(data))
_pack = msgspec.msgpack.Encoder()


def read_step(body: Any, packed: bool) -> StepBody:
    """body: bytes of MessagePack if `packed`, else JSON as bytes or as a text. Raises InputError, or its
    subclass for the wrong field.
    """
    if not packed and len(body) > SHORT:
        check_items(body)
    try:
        return (_msgpack if packed else _json).decode(body)
    except msgspec.MsgspecError as error:
        if len(body) > SHORT:
            raise _in_short(str(error)) from None
    except (UnicodeError, RecursionError):
        pass
    try:  # pydantic names every wrong field, msgspec only the first
        value = _any.decode(body) if packed else json.loads(body)
        return StepBody(**StepRequest.model_validate(value).model_dump())
    except ValidationError as invalid:
        found = [{**item, "loc": ("body", *item["loc"])} for item in invalid.errors(include_url=False)]
        raise problems.from_validation(found, value) from None
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        name, expected = ("MessagePack", "a map") if packed else ("JSON", "a JSON object")
        reason = problems.UNREADABLE.get(type(error)) or getattr(error, "msg", str(error))
        raise InputError(f"the body is not {name}: {reason}", expected=expected) from None


def _in_short(told: str) -> InputError:
    """The error from msgspec's message about a body that would take too long to be read by pydantic."""
    message, _, where = told.partition(" - at `$")
    path = where.strip(".`") or "body"
    kind = problems.FIELD_ERRORS.get(re.split(r"[.\[]", path)[0], InputError)
    return kind(f"{path} is not valid: {message}", path=path, expected="a step as /docs describes it")


def accepts(header: str, kind: str) -> bool:
    """Whether the header Accept names this media type, and does not refuse it by q=0."""
    return bool(re.search(rf"(?<![^\s,]){kind}(?![^\s;,]|\s*;\s*q=0(\.0*)?\s*(,|$))", header, re.IGNORECASE))


def write_problem(error: SpecshieldError, packed: bool) -> bytes:
    document = problems.document(error)
    return _pack.encode(document) if packed else json.dumps(document).encode()
