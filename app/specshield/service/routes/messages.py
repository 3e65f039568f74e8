"""Reads the requests of steps and writes problems, in JSON or MessagePack, for HTTP and for streams."""

from __future__ import annotations

import json
import re
from typing import Any

import msgspec
from pydantic import ValidationError

from specshield.errors import InputError, SpecshieldError
from specshield.service import problems
from specshield.service.schemas.steps import StepBody, StepRequest

MSGPACK = "application/msgpack"

_json, _msgpack = msgspec.json.Decoder(StepBody), msgspec.msgpack.Decoder(StepBody)
_any = msgspec.msgpack.Decoder(ext_hook=lambda code, data: bytes(data))
_pack = msgspec.msgpack.Encoder()


def read_step(body: Any, packed: bool) -> StepBody:
    """body: bytes of MessagePack if `packed`, else JSON as bytes or as a text. Raises InputError, or its
    subclass for the wrong field.
    """
    try:
        return (_msgpack if packed else _json).decode(body)
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
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


def accepts(header: str, kind: str) -> bool:
    """Whether the header Accept names this media type, and does not refuse it by q=0."""
    return bool(re.search(rf"(?<![^\s,]){kind}(?![^\s;,]|\s*;\s*q=0(\.0*)?\s*(,|$))", header, re.IGNORECASE))


def write_problem(error: SpecshieldError, packed: bool) -> bytes:
    document = problems.document(error)
    return _pack.encode(document) if packed else json.dumps(document).encode()
