"""The record of a decided step: its request, its answer, and the hash of all that came before (pure).

A record is opaque bytes to the store and the archive. Together with the session's row of the step (pose and
signals) it gives the answer again, byte for byte, and all that is needed to make the decision again. Its
numbers are float64, to the last bit.

The records of a session form a chain. `before` is `link(SHA-256 of the previous record, rows)`, with the rows
from the step after the previous record's up to this step's. For the first record it is `link(SHA-256 of the
config, x_0 .. x_t)`. A switch to another rule is a link too: its line of the config holds the hash of what
came before, and the next record the hash of that line. So no later change of config, poses, signals or
records stays unseen.
"""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import msgspec
import numpy as np

from specshield.arrays import Floats
from specshield.episode.handover import explained
from specshield.service.schemas.answers import Explanation, Residual, StepAnswer
from specshield.service.sessions.packing import COLUMNS, full, pack_table, sparse, unpack_table
from specshield.shield.decision import Decision

FORMAT = 2
MOST_SIGNALS = 64  # columns of a session: MessagePack's integers have 64 bits


class Asked(NamedTuple):
    """What a caller sent with a step. pose: x_t. logits [A]: -inf for null. occupied, free: points [n, 2]."""

    pose: Sequence[float]
    logits: Floats | None
    main_task_done: bool
    signals: Mapping[str, float] = {}
    all_witnesses: bool = False
    occupied: Floats | None = None
    free: Floats | None = None
    explain: bool = False


class StepRecord(msgspec.Struct, frozen=True, array_like=True):
    """One decided step; A actions.

    format: `FORMAT`, of records of this layout. before: SHA-256, as `link` has it.

    Of the request: pose is x_t as it was sent, three float64, None where it equals the stored one bit by bit.
    logits: as `sparse` writes them. signals: bit i is set if the signal of column i was sent; the row has its
    value. all_witnesses: whether a witness was asked for each action. occupied, free: the points that were
    sent, two float64 each. explain: whether explanations were asked for. tables: the digest of the learned
    map that the policies' tables were made for; None: the policies' own tables.

    Of the answer: distribution, as `sparse` writes it. rows: for each action, the index of its row among the
    distinct rows of `table`. table: for each distinct row J, rho and the next pose (x, y, theta), as indices
    into the numbers that every record knows (packing.py), followed by `pool`: one byte each, or two where one
    does not suffice. Actions are one byte each: an action set has at most 256.
    """

    format: int
    before: bytes
    t: int
    pose: bytes | None
    logits: bytes | None
    main_task_done: bool
    signals: int
    all_witnesses: bool
    mode: str
    distribution: bytes
    rows: bytes
    table: bytes
    pool: bytes
    action: int
    completion_action: int | None
    spec_status: str
    feasible_mass: float | None
    kl: float | None
    reason: str | None
    finished: bool
    residual: tuple[float, float] | None
    in_collision: bool
    witness: bytes | None
    witnesses: tuple[bytes | None, ...]
    warnings: tuple[str, ...]
    margin: float
    slack: int
    threshold_left: float
    map_revision: int
    occupied: bytes | None
    free: bytes | None
    explain: bool
    explanations: tuple[Explanation | None, ...]
    tables: bytes | None = None
    any_signal: bool | None = None

    def asked(self, row: Floats, names: Sequence[str]) -> Asked:
        """What was sent with the step. row: the session's row of it; names: of its signals, by column."""
        pose = (row[:3] if self.pose is None else np.frombuffer(self.pose, "<f8")).tolist()
        signals = {name: float(row[3 + i]) for i, name in enumerate(names) if self.signals >> i & 1}
        logits, occupied, free = self.logits_sent(), _points(self.occupied), _points(self.free)
        return Asked(
            pose, logits, self.main_task_done, signals, self.all_witnesses, occupied, free, self.explain
        )

    def logits_sent(self) -> Floats | None:
        """[A], -inf where the logit was null; None where none were sent."""
        return None if self.logits is None else full(self.logits, len(self.rows), -math.inf, True)


def _points(sent: bytes | None) -> Floats | None:
    return None if sent is None else np.frombuffer(sent, "<f8").reshape(-1, 2)


# The members that a decision, its record and its answer hold in different forms, and those in the same form.
OTHERWISE = {"distribution", "residual", "witness", "witnesses", "any_signal", "explanations"}
ALIKE = [name for name in StepRecord.__struct_fields__ if name in {*StepAnswer.__struct_fields__} - OTHERWISE]
_values = attrgetter(*ALIKE)


def _alike(made: Decision | StepRecord) -> dict[str, Any]:
    return dict(zip(ALIKE, _values(made), strict=True))


_encoder = msgspec.msgpack.Encoder()
decode = msgspec.msgpack.Decoder(StepRecord).decode


def logits_json(record: StepRecord) -> list[float | None] | None:
    """The logits as they were sent: null is minus infinity."""
    sent = record.logits_sent()
    return None if sent is None else [None if value == -np.inf else value for value in sent.tolist()]


def encode(record: StepRecord) -> bytes:
    bare = record.any_signal is None  # then to the byte as before there was `any_signal`
    return _encoder.encode(msgspec.structs.astuple(record)[:-1] if bare else record)


def digest(content: bytes) -> bytes:
    """SHA-256 of a record or a config."""
    return hashlib.sha256(content).digest()


def link(last: bytes, rows: Floats) -> bytes:
    """SHA-256 over `last`, the digest of the previous record or of the config, and the rows since then."""
    return hashlib.sha256(last + rows.astype("<f8", copy=False).tobytes()).digest()


def make(
    decision: Decision,
    asked: Asked,
    row: Floats,
    names: Sequence[str],
    before: bytes,
    tables: bytes | None = None,
) -> StepRecord:
    """The record of a decision. row: the session's row of its step; names: of its signals, by column. before,
    tables: members of the record.
    """
    pose, logits, main_task_done, signals, all_witnesses, occupied, free, explain = asked
    sent = struct.pack("<3d", *pose)
    actions = np.empty((len(decision.distribution), COLUMNS))
    actions[:, 0], actions[:, 1] = decision.j_values, decision.robustness  # None becomes NaN
    actions[:, 2:] = decision.next_poses
    rows, table, pool = pack_table(actions, row)
    return StepRecord(
        format=FORMAT,
        before=before,
        pose=None if sent == row[:3].tobytes() else sent,
        logits=None if logits is None else sparse(logits, -math.inf, True),
        main_task_done=main_task_done,
        signals=sum(1 << i for i, name in enumerate(names) if name in signals),
        all_witnesses=all_witnesses,
        distribution=sparse(decision.distribution, 0.0, False),
        rows=rows,
        table=table,
        pool=pool,
        residual=decision.residual,
        witness=None if decision.witness is None else bytes(decision.witness),
        witnesses=tuple(None if w is None else bytes(w) for w in decision.witnesses),
        occupied=None if occupied is None else occupied.astype("<f8").tobytes(),
        free=None if free is None else free.astype("<f8").tobytes(),
        explain=explain,
        explanations=explained(decision, Explanation),
        tables=tables,
        any_signal=decision.any_signal,
        **_alike(decision),
    )


def told(decision: Decision, all_witnesses: bool, explain: bool) -> StepAnswer:
    """The caller's answer, made from the decision. `answer` takes three times as long to make the same."""
    return _answer(
        decision,
        all_witnesses,
        explained(decision, Explanation) if explain else None,
        action_name=decision.action_name,
        distribution=decision.distribution.tolist(),
        j_values=list(decision.j_values),
        robustness=list(decision.robustness),
        next_poses=decision.next_poses.tolist(),
    )


def answer(record: StepRecord, row: Floats, names: Sequence[str]) -> StepAnswer:
    """The caller's answer, made from the record. row: the session's row of it. names: of the actions."""
    table = unpack_table(record.rows, record.table, record.pool, row)
    return _answer(
        record,
        record.all_witnesses,
        record.explanations if record.explain else None,
        action_name=names[record.action],
        distribution=full(record.distribution, len(record.rows), 0.0, False).tolist(),
        j_values=[None if value != value else value for value in table[:, 0].tolist()],
        robustness=[None if value != value else value for value in table[:, 1].tolist()],
        next_poses=table[:, 2:].tolist(),
    )


def _answer(
    made: Decision | StepRecord,
    all_witnesses: bool,
    explanations: tuple[Explanation | None, ...] | None,
    **own: Any,
) -> StepAnswer:
    """The answer of a decision or of its record. own: the members that these two hold in different forms.
    explanations: None if they were not asked for.
    """
    if made.any_signal is not None:
        own["any_signal"] = made.any_signal
    if explanations is not None:
        own["explanations"] = explanations
    if all_witnesses:
        own["witnesses"] = tuple(None if w is None else list(w) for w in made.witnesses)
    return StepAnswer(
        residual=None if made.residual is None else Residual(*made.residual),
        witness=None if made.witness is None else list(made.witness),
        **_alike(made),
        **own,
    )
