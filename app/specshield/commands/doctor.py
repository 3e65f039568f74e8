"""`specshield doctor`: checks an installation, and says what to do about each problem."""

from __future__ import annotations

import contextlib
import email.utils
import os
import re
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import PackageNotFoundError, distributions, requires, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from specshield import __version__
from specshield.errors import SpecshieldError

if TYPE_CHECKING:
    import httpx

    from specshield.service.settings import Settings

CLOCK = 2.0  # [s] by which the clocks of this machine and of a server may differ
State = Literal["ok", "note", "wrong"]


class Finding(NamedTuple):
    """state: `note` if it works, with something to know. remedy: what to do, "" if nothing."""

    state: State
    what: str
    remedy: str = ""


def doctor(
    url: Annotated[str | None, typer.Option(help="A server to look at as well.")] = None,
    port: Annotated[int, typer.Option(help="The port to serve on.", min=1, max=65535)] = 8000,
) -> None:
    """Check this installation, and say what to do about each problem."""
    wrong = sum(_shown(check) for check in _checks(url, port))
    print("all is well" if not wrong else f"{wrong} of these keep specshield from working")
    raise typer.Exit(1 if wrong else 0)


def _checks(url: str | None, port: int) -> Iterator[Callable[[], Iterator[Finding]]]:
    """The checks. Each imports what it needs when it runs. Invalid settings are reported once."""
    yield from (_parts, _kernels)
    from specshield.service.settings import read_settings

    try:
        settings = read_settings()
    except SpecshieldError as error:
        yield partial(iter, [Finding("wrong", str(error))])
    else:
        yield from (partial(check, settings) for check in (_disk, _store))
    yield partial(_port, port) if url is None else partial(_server, url)


def _shown(check: Callable[[], Iterator[Finding]]) -> int:
    """Prints the findings of a check, and returns how many of them are wrong."""
    wrong = 0
    try:
        for finding in check():
            wrong += finding.state == "wrong"
            print(f"{finding.state:5}  {finding.what}")
            if finding.remedy:
                print(f"       -> {finding.remedy}")
    except SpecshieldError as error:
        print(f"wrong  {error}")
        return wrong + 1
    return wrong


def _parts() -> Iterator[Finding]:
    yield Finding("ok", f"Python {sys.version.split()[0]}, specshield {__version__}")
    if missing := missing_parts():
        yield Finding("wrong", f"a server lacks {', '.join(missing)}", "pip install 'specshield[server]'")
    else:
        yield Finding("ok", "the server's parts are installed")
    with contextlib.suppress(PackageNotFoundError):
        yield Finding("ok", f"torch {version('torch')}: policies can learn here")
        return
    yield Finding(
        "note",
        "torch is not installed: policies can be computed, but not learned (method `dqn`)",
        "pip install 'specshield[train]', if you want that",
    )


def missing_parts(module: str = "") -> list[str]:
    """The packages of the extra `server` that are not installed, or to which the missing `module` belongs."""
    asked = [each for each in requires("specshield") or () if re.search("extra == .server", each)]
    names = {re.split(r"[^\w.-]", each)[0] for each in asked}
    return sorted(name for name in names if name == module or not [*distributions(name=name)])


def _kernels() -> Iterator[Finding]:
    from specshield import compiled
    from specshield.service.startup import READY, TAKES

    mark = compiled.mark(READY)
    if mark is None:
        yield Finding(
            "note",
            f"no compiled kernel can be kept in {compiled.BASE}: every start compiles all of them",
            "set NUMBA_CACHE_DIR to a folder that can be written to",
        )
    elif mark.exists():
        yield Finding("ok", f"the kernels are compiled ({compiled.BASE})")
    else:
        yield Finding(
            "note",
            f"the next start compiles the kernels that are missing; all of them take {TAKES} s on two cores",
            "python -m specshield.service.startup compiles them now",
        )


def _disk(settings: Settings) -> Iterator[Finding]:
    from specshield.service.library.files import check_writable
    from specshield.service.storage.embedded import EmbeddedStore
    from specshield.service.storage.objects import open_objects

    own = settings.redis_url is None
    there, files = settings.data_dir, Path(settings.files_at)  # a URL names no folder that exists
    of = "SPECSHIELD_DATA_DIR" if settings.data_url is None else "SPECSHIELD_DATA_URL"
    kept = [(of, files), (of, files / "maps"), (of, files / "policies")]
    store = EmbeddedStore(there).folder if own else there
    used = [("SPECSHIELD_DATA_DIR", folder) for folder in (there, store, store / "appendonlydir")]
    for name, folder in (*used, *kept):
        if folder.exists():
            check_writable(folder, name)
    near = next(folder for folder in (there.absolute(), *there.absolute().parents) if folder.exists())
    if not os.access(near, os.W_OK):
        yield Finding("wrong", f"{near} cannot be written to", "set SPECSHIELD_DATA_DIR to another folder")
        return
    free = shutil.disk_usage(near).free
    if free < settings.disk_reserve_bytes:
        yield Finding(
            "wrong",
            f"{free >> 20} MiB are free for the data folder {there}",
            f"at least {settings.disk_reserve_bytes >> 20} MiB, or no session begins",
        )
    else:
        yield Finding("ok", f"data folder {there.absolute()}, {free >> 30} GiB free")
    if settings.data_url is not None:
        open_objects(settings.data_url)
    if own:
        yield Finding("ok", "the store is the server's own, in the data folder")


def _store(settings: Settings) -> Iterator[Finding]:
    from specshield.service.storage.connect import FAILURES, connect, drops, naming
    from specshield.service.storage.marker import check_first
    from specshield.service.training.jobs import Jobs

    if settings.redis_url is None:  # see `_disk`
        return
    began = time.perf_counter()
    try:
        with (
            naming(settings),
            contextlib.closing(
                connect(settings.redis_url, blocking=True, socket_timeout=settings.store_timeout)
            ) as store,
        ):
            store.ping()
            took = 1000 * (time.perf_counter() - began)
            yield Finding("ok", f"the store at REDIS_URL answers in {took:.1f} ms")
            if (told := drops(store)) is not None:
                yield Finding("note", told, "maxmemory-policy noeviction, at the store (docs/scale.md)")
            check_first(store, settings.files_at)
            Jobs(settings).counts()  # reads rq's keys, which the store may keep from its user
    except FAILURES as error:
        yield Finding(
            "wrong", f"the store at REDIS_URL does not answer: {error!s:.200}", "start it, or mend REDIS_URL"
        )


def _port(port: int) -> Iterator[Finding]:
    try:
        socket.create_server(("127.0.0.1", port)).close()
    except OSError as error:
        yield Finding(
            "note",
            f"port {port} cannot be served on: {str(error.strerror).partition(' (')[0]}",
            f"a server may run there already: specshield doctor --url http://127.0.0.1:{port}; "
            "or serve elsewhere, by --port",
        )
    else:
        yield Finding("ok", f"port {port} is free")


def _server(url: str) -> Iterator[Finding]:
    import httpx

    from specshield.client.network.bounded import is_direct
    from specshield.client.network.transport import address

    try:
        server, began = address(url), time.time()
    except SpecshieldError as error:
        error.path = "--url"
        raise
    at, proxies = str(server).rstrip("/"), not is_direct(server.host)
    elsewhere = "specshield serve, or another --url"
    try:
        ready = httpx.get(f"{at}/readyz", timeout=10.0, trust_env=proxies)
        told = httpx.get(f"{at}/openapi.json", timeout=10.0, trust_env=proxies)
    except httpx.HTTPError as error:
        yield Finding("wrong", f"no server answers at {url}: {error}", elsewhere)
        return
    said = _object(ready)
    if said.get("status") != "ok" and "type" not in said:  # neither the answer of /readyz nor a problem
        yield Finding("wrong", f"what answers at {url} is no specshield server", elsewhere)
        return
    if ready.status_code == 200:
        yield Finding("ok", f"the server at {url} is ready")
    else:
        yield Finding(
            "wrong", f"the server at {url} is not ready: {said.get('detail')}", "wait, or read its log"
        )
    theirs = _object(told).get("info", {}).get("version")
    if theirs not in (None, __version__):
        yield Finding(
            "note",
            f"the server is specshield {theirs}, this is {__version__}",
            "the same version on both sides",
        )
    date = email.utils.parsedate_tz(ready.headers.get("date"))
    if date is not None:
        apart = email.utils.mktime_tz(date) - began
        if abs(apart) > CLOCK + 1.0:  # the header has whole seconds
            yield Finding("note", f"the server's clock is {apart:+.0f} s from this one", "use ntp on both")


def _object(answer: httpx.Response) -> dict[str, Any]:
    """The JSON object that an answer holds; {} if it holds none."""
    try:
        found = answer.json()
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}
