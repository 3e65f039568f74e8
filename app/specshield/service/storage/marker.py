"""Servers and workers of one store have to share their files too, or one does not find what another made.

So the file `store-id` and the store hold the same name. A server or worker that finds other names does not
start.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import time
from contextlib import closing, suppress
from typing import Any

from specshield.errors import InputError, StoreError
from specshield.service.storage.connect import connect, reaching
from specshield.service.storage.objects import open_objects, without_password

FILE = "store-id"
KEY = "specshield:store-id"
WAIT = 5.0  # [s] for another server, whose first start is under way, to write the file
log = logging.getLogger("specshield")


def check_files(url: str, place: str, timeout: float) -> None:
    """Compares the names in the files and in the store, and writes them at the first start. place: the folder
    or URL of maps and policies. timeout: of the store [s]. This blocks.

    Raises InputError if the servers of this store use other files, and StoreError if the files or the store
    cannot be reached.
    """
    files = open_objects(place)
    mine = files.read(FILE)
    made = secrets.token_hex(16).encode()
    with reaching(), closing(connect(url, blocking=True, socket_timeout=timeout)) as store:
        first = store.set(KEY, mine or made, nx=True)
        theirs = store.get(KEY)
        if first and mine is None:
            try:
                files.write(FILE, made)
            except Exception:  # else no server would find its files the right ones, once they can be written
                store.delete(KEY)
                raise
            return
    if first:
        log.warning(
            "the store does not know the files in %s, which were used with a store before: either it has "
            "lost what it held, or this is another store. Sessions that ran in the other one are not found "
            "here",
            without_password(place),
        )
    deadline = time.monotonic() + WAIT
    while mine is None and time.monotonic() < deadline:
        time.sleep(0.1)
        mine = files.read(FILE)
    if mine != theirs:
        raise _elsewhere(place)


async def stay_marked(url: str, place: str, timeout: float, every: float = 60.0) -> None:
    """Compares the names again every so many seconds until it is cancelled: a store that was emptied gets its
    name back before a server with other files gives it another.
    """
    while True:
        await asyncio.sleep(every)
        with suppress(StoreError):
            try:
                await asyncio.to_thread(check_files, url, place, timeout)
            except InputError as error:
                log.error("%s", error)


def check_first(store: Any, place: str) -> None:
    """Compares the names without writing or waiting, before a server starts. store: a blocking client."""
    files, theirs = open_objects(place), store.get(KEY)
    if theirs is not None and files.read(FILE) != theirs:
        raise _elsewhere(place)


def _elsewhere(place: str) -> InputError:
    return InputError(
        f"the servers of this store keep their maps and policies elsewhere than in {without_password(place)}",
        path="SPECSHIELD_DATA_URL",
        expected="one folder or URL for all servers and workers that share REDIS_URL. If these files are "
        f"the right ones, delete the key {KEY} from the store and start all of them again",
    )
