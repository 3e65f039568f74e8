"""A session's record as a file: its config, poses, signals and step records, sealed by a hash (pure).

As record.py says, each step record holds the hash of all that came before it. The `seal` is the hash that a
further step record would hold. Since a file may come from strangers, `read` bounds its size and checks it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from specshield.arrays import Floats
from specshield.errors import InputError
from specshield.service.schemas.base import ID, ID_TOLD
from specshield.service.sessions import record
from specshield.service.sessions import rules as ruled
from specshield.service.sessions.record import StepRecord
from specshield.service.sessions.rules import Rule, columns, widened

FORMAT: Literal["specshield-record-1"] = "specshield-record-1"
WHERE = "what GET /v1/sessions/{id}/record answers, or `save_record` of the SDK writes"
LARGEST = 256 << 20  # [bytes]; a session of 10,000 steps takes about 7 MB
MEDIA_TYPE = "application/vnd.specshield.record"


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """config, rows: as stored (rules.py). steps: each step's record, b"" if it has none. seal: SHA-256."""

    format: Literal["specshield-record-1"]
    config: bytes
    rows: bytes
    steps: list[bytes]
    seal: bytes


class Chain(NamedTuple):
    """A record whose chain was checked. configs: one for each rule. names: for each rule, the signals of the
    columns that the rows had by then. rows [n, 3 + signals]. steps: b"" without a decision. seal: in hex.
    """

    configs: Sequence[Rule]
    names: Sequence[list[str]]
    rows: Floats
    steps: Sequence[bytes]
    seal: str

    def rule_at(self, t: int) -> int:
        return ruled.at(self.configs, t)

    def decided(self) -> Iterator[tuple[int, bytes, StepRecord]]:
        for t, content in enumerate(self.steps):
            if content:
                yield t, content, record.decode(content)


def pack(config: bytes, rows: bytes, steps: Sequence[bytes]) -> tuple[bytes, str]:
    """The file, and its seal in hex. rows: exactly those that the session has."""
    configs = ruled.read(config)
    held = np.frombuffer(rows, "<f8").reshape(-1, 3 + len(columns(configs)[-1]))
    last, begin = record.digest(config.rpartition(b"\n")[2]), configs[-1].begins
    for t, content in enumerate(steps):
        if content and t >= begin:
            last, begin = record.digest(content), t + 1
    seal = record.link(last, held[begin:])
    return msgspec.msgpack.encode(_File(FORMAT, config, rows, list(steps), seal)), seal.hex()


def read(content: bytes) -> Chain:
    """Raises InputError where the file is no record, or its chain is broken. The error's `t` is the first
    wrong step, None where the file as a whole is wrong.
    """
    if len(content) > LARGEST:
        raise _broken(None, "the file is too large", f"at most {LARGEST} bytes")
    try:
        file = msgspec.msgpack.decode(content, type=_File)
        configs, lines = ruled.read(file.config), file.config.split(b"\n")
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        raise _broken(None, "the file is no record of a session, or not all of one", WHERE) from None
    if not all(re.fullmatch(ID, config.id) for config in configs):  # a command may name a file by it
        raise _broken(None, "the session's id is none that a server would take", ID_TOLD)
    if msgspec.msgpack.encode(file) != content:
        raise _broken(None, "the file was changed: a server would write it otherwise", "the original bytes")
    names = columns(configs)
    rows = _rows(file.rows, 3 + len(names[-1]))
    if len(file.steps) > len(rows) or not all(file.steps[-1:]):  # no hash covers an empty one at the end
        told = f"there are {len(file.steps)} steps for {len(rows)} poses, or the last step is empty"
        raise _broken(None, told, "no more steps than poses, the last not empty")
    _check_switches(configs, names, rows)
    last, begin, rule = record.digest(lines[0]), 0, 0
    for t in range(len(rows) + 1):
        while rule + 1 < len(configs) and configs[rule + 1].begins == t:
            linked = record.link(last, rows[begin:t, : 3 + len(names[rule])])
            rule += 1
            if configs[rule].before != linked.hex():
                raise _broken(t, "the chain is broken: something before this switch was changed", None)
            last, begin = record.digest(lines[rule]), t
        step = file.steps[t] if t < len(file.steps) else b""
        if not step:
            continue
        found = _decode(t, step)
        if found.before != record.link(last, rows[begin : t + 1, : 3 + len(names[rule])]):
            raise _broken(t, "the chain is broken: something before this step was changed", None)
        last, begin = record.digest(step), t + 1
    if file.seal != record.link(last, rows[begin:]):
        raise _broken(None, "the seal does not fit the last record and what follows it", None)
    return Chain(configs, names, rows, file.steps, file.seal.hex())


def _check_switches(configs: Sequence[Rule], names: Sequence[list[str]], rows: Floats) -> None:
    """Raises InputError unless the rules follow each other in time, and each column that a rule added holds
    the signal's initial value until that rule begins.
    """
    if configs[0].begins or configs[0].origin or configs[0].clock == "keep":
        raise _broken(0, "the first rule does not begin with the session", None)
    for i in range(1, len(configs)):
        config, old = configs[i], configs[i - 1]
        if not old.begins <= config.begins <= len(rows):
            raise _broken(config.begins, "a rule begins before the one that it follows, or too late", None)
        if config.origin != (config.begins if config.clock == "restart" else old.origin):
            raise _broken(config.begins, f"the origin of a rule is not what `{config.clock}` means", None)
        first, known = rows[: config.begins, : 3 + len(names[i])], names[i - 1]
        if widened(first[:, : 3 + len(known)], known, config.spec["signals"]).tobytes() != first.tobytes():
            raise _broken(config.begins, "a signal has values before its rule began", None)


def _rows(content: bytes, width: int) -> Floats:
    if len(content) % (8 * width) or not content:
        raise _broken(None, "the poses are not whole", f"a multiple of {8 * width} bytes")
    rows = np.frombuffer(content, "<f8").reshape(-1, width)
    if not np.isfinite(rows).all():
        raise _broken(None, "a pose or a signal is not finite", "finite numbers")
    return rows


def _decode(t: int, content: bytes) -> StepRecord:
    try:
        found = record.decode(content)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise _broken(t, f"the step's record is malformed: {error}", None) from None
    if found.format != record.FORMAT or found.t != t or record.encode(found) != content:
        raise _broken(t, "the step's record is malformed", f"format {record.FORMAT}, t = {t}")
    numbers = (found.feasible_mass, found.kl, *(found.residual or ()))
    if not all(value is None or math.isfinite(value) for value in numbers):
        raise _broken(t, "the step's record is malformed: a number is not finite", None)
    return found


def _broken(t: int | None, message: str, expected: str | None) -> InputError:
    where = "" if t is None else f"step {t}: "
    return InputError(f"{where}{message}", expected=expected, t=t)
