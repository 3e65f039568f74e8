"""Tables of policies, and fields of planners, for the maps that sessions learn. Made in the background.

Until a session's tables are ready, and for changes of its map since then, policies search for ways around. A
decision's record has the digest of the map that its tables were made for, so that the decision can be made
again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from typing import NamedTuple

from specshield.errors import SpecshieldError
from specshield.service.heavy.background import Background
from specshield.service.library import files
from specshield.shield.decision import Shield
from specshield.shield.proposal import Proposer
from specshield.world.learned import LearnedMap, applied
from specshield.world.occupancy import OccupancyGrid

log = logging.getLogger("specshield")
ROOM = 64  # sessions whose tables are kept: about a megabyte each, more for a planner's fields. By hand.


class Made(NamedTuple):
    """The policies of a shield with tables for a session's own map. digest: of what was learned of the map.
    policies: the policies' ids.
    """

    digest: bytes
    policies: tuple[str, ...]
    proposers: tuple[Proposer, ...]


class Tables:
    """The newest tables of each session. One thread makes them, for one session at a time; kernels run
    without the interpreter's lock.
    """

    def __init__(self) -> None:
        self._threads = Background("tables")
        self._newest, self._making = files.Recent[Made](ROOM), files.Recent[tuple[bytes, Future[Made]]](ROOM)
        self._failed = files.Recent[bytes](ROOM)  # the digest of the map for which no tables could be made

    def of(self, session: str, shield: Shield, known: LearnedMap) -> tuple[Shield, bytes | None]:
        """The shield with the newest tables of the session, and their digest, None if it has none yet. Also
        begins to make the tables for `known`, unless others of the session are being made.

        session: its nonce, since its id may belong to other owners or to a later session too.
        """
        if not len(known) or not any(hasattr(each, "remade") for each in shield.proposers):
            return shield, None
        making = self._making.peek(session)
        if making is not None and making[1].done():
            self._making.drop(session)
            if (error := making[1].exception()) is None:
                self._newest.put(session, making[1].result())
            else:  # the session goes on without them, as before they were made
                self._failed.put(session, making[0])
                log.warning("tables for a session's own map cannot be made: %r", error)
            making = None
        newest = self._newest.peek(session)
        if newest is not None and newest.policies != _ids(shield):  # they are of an earlier rule
            newest = None
        have = self._failed.peek(session), None if newest is None else newest.digest
        if making is None and known.digest not in have:
            self._making.get(session, lambda: (known.digest, self._threads.submit(make, shield, known)))
        if newest is None:
            return shield, None
        return replace(shield, proposers=newest.proposers), newest.digest


def make(shield: Shield, known: LearnedMap) -> Made:
    """Makes the tables, which takes seconds. The result is the same on every machine."""
    grid = applied(shield.task.grid, known)
    return Made(known.digest, _ids(shield), tuple(_remade(each, grid) for each in shield.proposers))


def _remade(proposer: Proposer, grid: OccupancyGrid) -> Proposer:
    """The policy with tables for this map, or unchanged if it has none or they cannot be made."""
    remade: Callable[[OccupancyGrid], Proposer] | None = getattr(proposer, "remade", None)
    if remade is None:
        return proposer
    try:
        return remade(grid)
    except SpecshieldError as error:
        log.warning("policy %s keeps its tables on a session's own map: %s", proposer.id, error)
        return proposer


def _ids(shield: Shield) -> tuple[str, ...]:
    return tuple(each.id for each in shield.proposers)
