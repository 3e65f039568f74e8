"""What changes in a session, as it is stored: MessagePack, since every step writes it."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from specshield.shield.decision import Carry, Stuck


class State(msgspec.Struct, frozen=True, array_like=True):
    """Of a session after its last change.

    length: of the stored poses. next_t: the step after the last decided one. expires_at [s since 1970]. head:
    SHA-256 of the last step's record, of the config where none was decided under it. carry: as `pack_carry`
    has it. verdicts: of the rules that held before the one in force. any_signal: of where the rule in force
    began to hold, as `Decision` has it.
    """

    length: int
    next_t: int
    feasible: bool
    spec_status: str
    expires_at: float
    head: bytes
    main_task_done: bool = False
    finished: bool = False
    closed: bool = False
    carry: PackedCarry | None = None
    verdicts: tuple[str, ...] = ()
    any_signal: bool | None = None

    @staticmethod
    def of(content: bytes) -> State:
        """Raises msgspec.DecodeError for what `packed` did not make."""
        return _decoder.decode(content)

    def packed(self) -> bytes:
        return _encoder.encode(self)


class PackedCarry(msgspec.Struct, frozen=True, array_like=True):
    """A `Carry`, field by field in its order, with its next poses as float64 bytes, three a motion."""

    t: int
    next_poses: bytes
    witnesses: tuple[bytes | None, ...]
    memory: bytes | None
    residuals: bytes | None = None
    threshold_left: float | None = None
    learned: bytes | None = None
    action: int | None = None
    way: bytes | None = None
    stuck: tuple[Stuck, ...] = ()

    def unpacked(self) -> Carry:
        t, poses, *rest = msgspec.structs.astuple(self)
        # Writable: kernels were compiled for that.
        return Carry(t, np.frombuffer(poses, "<f8").reshape(-1, 3).copy(), *rest)


def pack_carry(carry: Carry) -> PackedCarry:
    values: tuple[Any, ...] = carry
    t, poses, *rest = values
    return PackedCarry(t, poses.astype("<f8", copy=False).tobytes(), *rest)


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(State)
