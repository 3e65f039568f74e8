"""The sessions that this process saw last: work that need not be done again, never an answer by itself.

What is kept may be old: another process may have gone on with the session, closed or erased it. The script
that appends compares versions, so a step that was decided on an old session is not written.
"""

from __future__ import annotations

from collections import OrderedDict

from specshield.service.sessions.session import Session

# Bytes that a session takes beside its state and its rows: its objects, and its parsed rules for each byte of
# their JSON. tracemalloc found 3,000, and 5 to 10, with rules of 1 to 200 kB.
OBJECTS, PARSED = 3_000, 10


class RecentSessions:
    """By their ids in the store; for one thread. room: bytes of memory, as far as they can be told.

    One that has finished is not kept: nobody goes on with it.
    """

    def __init__(self, room: int) -> None:
        self._room, self._used = room, 0
        self._kept = OrderedDict[str, tuple[Session, int]]()

    def get(self, id: str) -> Session | None:
        if id not in self._kept:
            return None
        self._kept.move_to_end(id)
        return self._kept[id][0]

    def put(self, id: str, session: Session) -> None:
        self.drop(id)
        if session.state.finished:
            return
        size = OBJECTS + PARSED * session.weight + len(session.state.packed()) + session.rows.nbytes
        self._kept[id] = session, size
        self._used += size
        while self._used > self._room:
            self._used -= self._kept.popitem(last=False)[1][1]

    def drop(self, id: str) -> None:
        if id in self._kept:
            self._used -= self._kept.pop(id)[1]
