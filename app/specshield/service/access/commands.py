"""`specshield keys`: the API keys of the store that the settings name."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import ExitStack, aclosing
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from specshield.errors import StoreError

if TYPE_CHECKING:
    from specshield.service.access.keys import Keys
    from specshield.service.settings import Settings

R = TypeVar("R")
app = typer.Typer(
    name="keys", help="API keys: each owns what is made with it, and may have limits.", no_args_is_help=True
)
Name = Annotated[str, typer.Argument(help="Whose key it is: what was made with it belongs to this name.")]


@app.command()
def create(
    name: Name,
    requests: Annotated[
        float | None, typer.Option(help="Most requests a second, steps counted apart.", min=0.1, max=1e9)
    ] = None,
    sessions: Annotated[int | None, typer.Option(help="Most sessions kept.", min=0)] = None,
    bytes: Annotated[int | None, typer.Option(help="Most bytes of maps and policies kept.", min=0)] = None,
) -> None:
    """Make a key and print it: it cannot be read again."""

    async def made(keys: Keys) -> None:
        print(await keys.create(name, requests=requests, sessions=sessions, bytes=bytes))

    on_keys(made, changes=True)


@app.command("list")
def show() -> None:
    """The names of the keys, with their limits."""
    listed = _on_keys_there(lambda keys: keys.listed())
    if not listed:
        typer.echo("there are no keys", err=True)
    for key in listed:
        limits = {"requests a second": key.requests, "sessions": key.sessions, "bytes": key.bytes}
        given = {what: f"{limit:,}".removesuffix(".0") for what, limit in limits.items() if limit is not None}
        told = ", ".join(f"{limit} {what}" for what, limit in given.items())
        print(f"{key.name}  made {key.created_at}  {told or 'no limits'}")


@app.command()
def revoke(name: Name) -> None:
    """Revoke a key: servers refuse it within 2 s. What was made with it is kept."""
    _on_keys_there(lambda keys: keys.revoke(name), changes=True)
    print(f"the key {name} is revoked")


def _on_keys_there(action: Callable[[Keys], Awaitable[R]], changes: bool = False) -> R:
    """As `on_keys`. Where there is no data folder, none is made."""
    from specshield.service.settings import read_settings

    with TemporaryDirectory(prefix="specshield-") as folder:
        return on_keys(action, read_settings().or_empty(folder), changes)


def on_keys(
    action: Callable[[Keys], Awaitable[R]], settings: Settings | None = None, changes: bool = False
) -> R:
    """The result of an action on the keys of the store. changes: whether it changes them, which has to reach
    as many replicas as the settings ask for. Raises StoreError.
    """
    from specshield.service.access.keys import Keys
    from specshield.service.settings import read_settings
    from specshield.service.storage.connect import naming
    from specshield.service.storage.embedded import EmbeddedStore
    from specshield.service.storage.store import Store

    settings = settings or read_settings()

    async def act() -> R:
        of = settings.store_url, settings.store_timeout, settings.session_ttl, settings.store_replicas
        async with aclosing(Store(*of)) as store:
            result = await action(Keys(store.redis))
            try:
                if changes:
                    await store.follow()
            except StoreError as error:
                told = f"the keys are changed, but a failover may undo that: {error.message}"
                raise error.retold(told) from error.__cause__
            return result

    with ExitStack() as opened:
        if settings.redis_url is None:
            embedded = EmbeddedStore(settings.data_dir)
            embedded.join()
            opened.callback(embedded.leave)
        with naming(settings):
            return asyncio.run(act())
