"""The owners' claims on maps and policies, and the bytes that these take. All but `Claims.settled` blocks.

Content is kept once, under its hash. Each owner that sent it or asked for it has a claim on it; it is removed
with the last claim. One script makes every change (claims.lua). So of a deletion and of a creation that needs
what is deleted only one succeeds, whichever servers they came to: a deletion sets a mark, looks for users,
and then takes the claim; a session is stored first, and then its policies are looked at (`Claims.settled`).
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from specshield.errors import Conflict, InputError, InsufficientStorage, LimitReached, NameTaken, NotFound
from specshield.service.access.keys import Key
from specshield.service.library import files
from specshield.service.settings import Settings
from specshield.service.storage.connect import reaching

SCRIPT = Path(__file__).with_name("claims.lua").read_text()
PATIENCE = 5.0  # [s] to wait for a deletion of the same id, which takes milliseconds. Chosen by hand.
WAIT = 0.02  # [s] between two looks whether the deletion has ended


class Claims:
    """kind: "maps" or "policies". Every method raises StoreError if the store cannot be reached."""

    def __init__(self, connected: Callable[[], Any], settings: Settings) -> None:
        """connected: returns a blocking client of the store. It is called when a claim is needed, since the
        store may be away before.
        """
        self._store, self._settings = connected, settings

    def ids(self, kind: str, owner: str) -> list[str]:
        return sorted(id.decode() for id in reached(lambda: self._store().hkeys(_key(kind, owner))))

    def holds(self, kind: str, id: str, owner: str) -> bool:
        return bool(reached(lambda: self._store().hexists(_key(kind, owner), id)))

    async def settled(self, kind: str, id: str, owner: str) -> bool:
        """Whether the owner has a claim, once no deletion of the thing is under way. This waits without a
        thread: many waiting callers would take the threads that the deletion needs.
        """
        deadline, key = time.monotonic() + PATIENCE, _key("mark", kind, id)
        while await asyncio.to_thread(reached, lambda: self._store().exists(key)):
            if time.monotonic() > deadline:
                return False
            await asyncio.sleep(WAIT)
        return await asyncio.to_thread(self.holds, kind, id, owner)

    def named(self, kind: str, name: str, owner: str) -> str | None:
        """The id of the owner's map or policy of this name."""
        return self._text(_key("names", kind, owner), name)

    def name_of(self, kind: str, id: str, owner: str) -> str | None:
        return self._text(_key("named", kind, owner), id)

    def _text(self, key: str, field: str) -> str | None:
        found = reached(lambda: self._store().hget(key, field))
        return None if found is None else str(found.decode())

    def names(self, kind: str, owner: str) -> dict[str, str]:
        """{id: name} of everything to which this owner gave a name."""
        found = reached(lambda: self._store().hgetall(_key("named", kind, owner)))
        return {id.decode(): name.decode() for id, name in found.items()}

    def name(self, kind: str, id: str, owner: str, name: str) -> None:
        """Gives a name to a thing of an owner; its former name becomes free. Raises NameTaken, NotFound."""
        said = self._run("name", kind, id, owner, "", name)
        if said == "none":
            raise NotFound(f"there is no {id!r} to which a name can be given", path="name", got=name)
        if said != "named":
            raise taken(name, said)

    @contextmanager
    def adding(self, kind: str, id: str, key: Key, size: int, map_id: str = "") -> Iterator[None]:
        """Claims `size` bytes before the block writes them, and gives them back if the block fails.

        map_id: for a policy, its map, "" if that is everybody's. Raises LimitReached and InsufficientStorage,
        Conflict if a deletion goes on for long, and NotFound for a map that was deleted.
        """
        settings = self._settings
        files.check_free(settings.data_dir, settings.disk_reserve_bytes + size)
        count = settings.max_maps if kind == "maps" else settings.max_policies
        most = settings.max_owner_bytes if key.bytes is None else min(key.bytes, settings.max_owner_bytes)
        limits = [size, count, most, settings.max_stored_bytes, map_id]
        said = self._patiently("claim", kind, id, key.name, "", *limits)
        if said == "count":
            raise LimitReached(
                f"the server keeps no more than {count} {kind}",
                expected=f"room for one more: delete one, or raise SPECSHIELD_MAX_{kind.upper()}",
            )
        if said in ("owner", "all"):
            whose, limit = ("this key's", most) if said == "owner" else ("the server's", limits[3])
            raise InsufficientStorage(
                f"{whose} maps and policies may take {limit} bytes, and {size} more do not fit",
                expected="room for it: delete a map or a policy",
                limit=limit,
            )
        if said == "no map":
            raise NotFound("the map was deleted", path="map_id", got=map_id, expected="an id from /v1/maps")
        try:
            yield
        except BaseException:
            if said == "made":
                token = secrets.token_hex(8)
                self._run("mark", kind, id, key.name, token)
                self._run("free", kind, id, key.name, token, map_id=map_id)
                self.unmark(kind, id, token)
            raise

    def mark(self, kind: str, id: str, owner: str, token: str) -> str | None:
        """Begins a deletion, from which on no use of the thing begins. Returns a policy that uses the map."""
        said = self._patiently("mark", kind, id, owner, token)
        if said == "none":
            raise missing(kind, id)
        return None if said == "marked" else said

    def free(self, kind: str, id: str, owner: str, token: str, map_id: str = "") -> bool:
        """Takes an owner's claim. True if it was the last one: then remove the files and call `unmark`."""
        said = self._run("free", kind, id, owner, token, map_id=map_id)
        if said == "lost":
            raise Conflict("the deletion took too long", path="id", got=id, expected="the request again")
        return said == "last"

    def unmark(self, kind: str, id: str, token: str) -> None:
        self._run("unmark", kind, id, "", token)

    def weigh(self, kind: str, id: str, size: int) -> None:
        """Notes how many bytes a thing has, as more was written after the claim."""
        for owner in reached(lambda: self._store().smembers(_key("owners", kind, id))):
            self._run("weigh", kind, id, owner.decode(), "", size)

    def owners(self, kind: str, id: str) -> int:
        """How many owners have a claim."""
        return int(reached(lambda: self._store().scard(_key("owners", kind, id))))

    def _patiently(self, what: str, *args: Any) -> str:
        """Runs the script once no deletion of the same thing is under way. Raises Conflict after PATIENCE."""
        deadline = time.monotonic() + PATIENCE
        while (said := self._run(what, *args)) == "busy":
            if time.monotonic() > deadline:
                raise Conflict("it is being deleted", path="id", got=args[1], expected="the request again")
            time.sleep(WAIT)
        return said

    def _run(
        self, what: str, kind: str, id: str, owner: str, token: str, *more: Any, map_id: str = ""
    ) -> str:
        about = id if kind == "maps" else (more[-1] if what == "claim" else map_id)
        places: list[tuple[str, ...]] = [(kind, owner), ("owners", kind, id), ("sums",), ("mark", kind, id)]
        places += [("uses", about, owner), ("maps", owner), ("mark", "maps", about)]
        places += [("names", kind, owner), ("named", kind, owner), ("policies", owner), ("sizes", kind)]
        keys = [_key(*place) for place in places]
        args = [what, kind, id, owner, token, *more]
        said = reached(lambda: self._store().eval(SCRIPT, len(keys), *keys, *args))
        return str(said.decode())


class Claimed:
    """What maps and policies share. claims: None where nothing is found by owner, added or deleted."""

    def __init__(self, kind: str, claims: Claims | None, settings: Settings) -> None:
        self._kind, self.given, self._settings = kind, claims, settings
        self._kept = files.Kept(settings, kind)
        self._named: Mapping[str, Any] = {}  # what came with the server

    def check_name(self, name: str, id: str, owner: str) -> None:
        """Raises NameTaken if something else than `id` has the name, InputError if nothing may have it."""
        shipped = {each: known.id for each, known in self._named.items()}
        if files.HASH.fullmatch(name):
            told, expected = "a name cannot have the form of an id", "another name"
            raise InputError(told, path="name", got=name, expected=expected)
        own = [each for each, its in shipped.items() if its == id]
        if own and name not in own:
            told, expected = "what came with the server keeps its name", f"'{own[0]}', or no name"
            raise InputError(told, path="name", got=name, expected=expected)
        bearer = shipped.get(name) or self.claims.named(self._kind, name, owner)
        if bearer not in (None, id):
            raise taken(name, str(bearer))

    @property
    def claims(self) -> Claims:
        assert self.given is not None
        return self.given

    def _id_of(self, key: str, owner: str) -> str:
        """The id of the owner's thing of this name; `key` itself if it is no name."""
        return key if files.HASH.fullmatch(key) else self.claims.named(self._kind, key, owner) or key


def _key(*parts: str) -> str:
    return ":".join(("specshield:{library}", *parts))


def missing(kind: str, key: str) -> NotFound:
    what, expected = "map" if kind == "maps" else "policy", f"an id or name from /v1/{kind}"
    return NotFound(f"there is no {what} {key!r}", path=f"{what}_id", got=key, expected=expected)


def taken(name: str, id: str) -> NameTaken:
    expected = "a name that nothing else has"
    return NameTaken(f"the name {name!r} is taken", path="name", got=name, expected=expected, id=id)


def reached(action: Callable[[], Any]) -> Any:
    """The result of an action on the store. Raises StoreError if the store cannot be reached."""
    with reaching():
        return action()
