"""The part of a session that every step changes, stored as MessagePack."""

from __future__ import annotations

import struct
import zlib

import msgspec
import numpy as np

from specshield.caution.taught import HEAD, Taught
from specshield.errors import StoreError
from specshield.shield.decision import Carry
from specshield.world.learned import NONE, LearnedMap


class State(msgspec.Struct, frozen=True, array_like=True):
    """A session's state after its last change.

    length: the number of stored poses. next_t: the step after the last decided one. expires_at [s since
    1970]. head: SHA-256 of the last step's record, or of the config if that has no decided step yet. carry:
    the memory of the last decision; stored field by field, its poses as float64 bytes. verdicts: of the rules
    before the one in force. any_signal: as in `Decision`, at the first step of the rule in force.
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
    carry: Carry | None = None
    verdicts: tuple[str, ...] = ()
    any_signal: bool | None = None

    @staticmethod
    def of(content: bytes) -> State:
        """Raises msgspec.DecodeError for what `packed` did not make."""
        return _decoder.decode(content)

    def packed(self) -> bytes:
        return _encoder.encode(self)

    @property
    def has_learned(self) -> bool:
        """Whether the session's own map has ever changed, or `learned` raises; without unpacking it."""
        known = None if self.carry is None else self.carry.learned
        return known is not None and len(known) != HEAD.size

    @property
    def learned(self) -> LearnedMap:
        """The learned map after the last decision. Raises StoreError where another version stored it."""
        try:
            return Taught.from_bytes(self.carry.learned).map if self.carry and self.has_learned else NONE
        except (struct.error, zlib.error, ValueError) as error:
            told = "another version of specshield decided the session's last step: no further one is decided"
            raise StoreError(told, expected="a server of that version, or a new session") from error


_encoder = msgspec.msgpack.Encoder(enc_hook=lambda poses: poses.astype("<f8", copy=False).tobytes())
_decoder = msgspec.msgpack.Decoder(  # of poses that are writable: kernels were compiled for that
    State, dec_hook=lambda _, raw: np.frombuffer(raw, "<f8").reshape(-1, 3).copy()
)
