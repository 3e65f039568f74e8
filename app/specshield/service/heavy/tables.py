"""Tables of policies, and fields of planners, for the maps that sessions learn. Made in the background.

Until a session's tables are ready, and for changes of its map since then, policies search for ways around. A
decision's record has the digest of the map that its tables were made for, so that the decision can be made
again.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from specshield.errors import SpecshieldError
from specshield.service.heavy.background import Background
from specshield.service.library import files
from specshield.shield.decision import Shield
from specshield.shield.proposal import Proposer
from specshield.world.learned import LearnedMap, applied
from specshield.world.occupancy import OccupancyGrid

log = logging.getLogger("specshield")
ROOM = 256 << 20  # [bytes] of tables. A session's take about 1 MB, a planner's up to 100. Chosen by hand.
SESSIONS = 1000  # of which it is remembered what tables were last begun for. Chosen by hand.


class Made(NamedTuple):
    """The policies of a shield with tables for a session's own map. digest: of what was learned of the map.
    policies: the policies' ids.
    """

    digest: bytes
    policies: tuple[str, ...]
    proposers: tuple[Proposer, ...]

    @property
    def size(self) -> int:
        """The bytes of the tables, about: those of the arrays that a policy holds."""
        return sum(_bytes(vars(each)) for one in self.proposers if (each := getattr(one, "again", None)))


class Tables:
    """The newest tables of each session. One thread makes them, for one session at a time, and owners take
    turns; kernels run without the interpreter's lock. If too many sessions have tables, those that were used
    longest ago are let go, and made again once their sessions learn something new.
    """

    def __init__(self) -> None:
        self._threads = Background("tables")
        self._newest = files.Recent[Made](ROOM, attrgetter("size"))
        # By session: the map and the policies that its tables were last begun for, and whether they are done.
        self._last = files.Recent[tuple[object, Future[None]]](SESSIONS)

    def of(self, session: str, shield: Shield, known: LearnedMap, owner: str) -> tuple[Shield, bytes | None]:
        """The shield with the newest tables of the session, and their digest, None if it has none yet. Also
        begins to make the tables for `known`, unless others of the session are being made.

        session: its nonce, since its id may belong to other owners or to a later session too.
        """
        if not len(known) or not any(hasattr(each, "remade") for each in shield.proposers):
            return shield, None
        wanted, last = (known.digest, _ids(shield)), self._last.peek(session)
        if last is None or (last[0] != wanted and last[1].done()):
            with suppress(RuntimeError):  # no thread can be started just now: the next step tries again
                made = self._threads.submit(self._make, session, shield, known, owner=owner)
                self._last.put(session, (wanted, made))
        newest = self._newest.peek(session)
        if newest is None or newest.policies != _ids(shield):  # of an earlier rule
            return shield, None
        return replace(shield, proposers=newest.proposers), newest.digest

    def _make(self, session: str, shield: Shield, known: LearnedMap) -> None:
        """A session whose tables cannot be made goes on without new ones."""
        try:
            self._newest.put(session, make(shield, known))
        except Exception as error:
            log.warning("tables for a session's own map cannot be made: %r", error)


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


def _bytes(value: object) -> int:
    """The bytes of all arrays in a value."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else ()
    return sum(map(_bytes, parts))
