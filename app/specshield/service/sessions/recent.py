"""The sessions that this process saw last: work that need not be done again, never an answer by itself.

What is kept may be old: another process may have gone on with the session, closed or erased it. The script
that appends compares versions, so a step that was decided on an old session is not written.
"""

from __future__ import annotations

from collections import OrderedDict

from specshield.service.sessions.session import Session

FIXED = 10_000  # bytes that a session takes beside its rows: config, carry, objects. A rough mean.


class RecentSessions:
    """By their ids in the store; for one thread. room: bytes of memory, as far as they can be told."""

    def __init__(self, room: int) -> None:
        self._room, self._used = room, 0
        self._kept = OrderedDict[str, Session]()

    def get(self, id: str) -> Session | None:
        found = self._kept.get(id)
        if found is not None:
            self._kept.move_to_end(id)
        return found

    def put(self, id: str, session: Session) -> None:
        self.drop(id)
        self._kept[id] = session
        self._used += _size(session)
        while self._used > self._room and self._kept:
            self._used -= _size(self._kept.popitem(last=False)[1])

    def drop(self, id: str) -> None:
        found = self._kept.pop(id, None)
        if found is not None:
            self._used -= _size(found)


def _size(session: Session) -> int:
    return FIXED + session.rows.nbytes
