"""What schemathesis is told beside the description: how a formula is made, and one more check."""

from __future__ import annotations

import json
import random

import msgspec
import schemathesis
from hypothesis import strategies as st

from benchmarks.reliability.fuzz import grammar

# `invalid-input` is said of a body that does not fit the schema, with these words, and of little else.
NOT_FITTING = ("Input should", "Field required", "Extra inputs", "should have at")

schemathesis.openapi.format(
    "stl", st.integers(0, 10**9).map(lambda seed: grammar.formula(random.Random(seed)))
)


@schemathesis.check
def refusals_are_told(context, response, case) -> None:
    """Every refusal is a problem document that says what is valid; data that fit the schema are not refused
    as data that do not.
    """
    if response.status_code < 400 or response.status_code in (401, 403, 404, 405, 421):
        return
    told = response.json()
    assert told["status"] == response.status_code
    assert told["type"] != "internal-error"
    if response.status_code != 422:
        return
    assert told.get("expected") or told.get("errors"), f"a refusal that does not say what is valid: {told}"
    positive = case.meta is not None and case.meta.generation.mode.is_positive
    if positive and told["type"] == "invalid-input":
        said = str(told.get("expected")) + told["detail"]
        assert not any(words in said for words in NOT_FITTING), f"the schema allows what is refused: {told}"


@schemathesis.serializer("application/msgpack")
def packed(context, value) -> bytes:
    """Integers that MessagePack cannot hold are sent as floats."""
    return msgspec.msgpack.encode(json.loads(json.dumps(value), parse_int=_whole))


def _whole(text: str) -> int | float:
    return int(text) if -(2**63) <= int(text) < 2**64 else float(text)


@schemathesis.deserializer("application/msgpack")
def unpacked(context, response):
    return msgspec.msgpack.decode(response.content)
