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


def read_step(body: bytes | str, packed: bool) -> StepBody:
    """packed: whether `body` is MessagePack. Raises InputError, or its subclass for the wrong field."""
    try:
        return _msgpack.decode(body) if packed and isinstance(body, bytes) else _json.decode(body)
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
        return _explained(_parsed(body, packed))


def accepts(header: str, kind: str) -> bool:
    """Whether the header Accept names this media type, and does not refuse it by q=0."""
    return (
        re.search(rf"(?<![^\s,]){kind}(?![^\s;,]|\s*;\s*q=0(\.0*)?\s*(,|$))", header, re.IGNORECASE)
        is not None
    )


def write_problem(error: SpecshieldError, packed: bool) -> bytes:
    document = problems.document(error)
    return _pack.encode(document) if packed else json.dumps(document).encode()


def _parsed(body: bytes | str, packed: bool) -> Any:
    name = "MessagePack" if packed else "JSON"
    try:
        return _any.decode(body) if packed and isinstance(body, bytes) else json.loads(body)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        reason = problems.UNREADABLE.get(type(error)) or getattr(error, "msg", str(error))
        raise InputError(
            f"the body is not {name}: {reason}", expected="a JSON object" if not packed else "a map"
        ) from None


def _explained(value: Any) -> StepBody:
    """Raises an InputError that names every wrong field, by pydantic: msgspec names only the first."""
    try:
        return StepBody(**StepRequest.model_validate(value).model_dump())
    except ValidationError as invalid:
        found = [{**item, "loc": ("body", *item["loc"])} for item in invalid.errors(include_url=False)]
        raise problems.from_validation(found, value) from None
