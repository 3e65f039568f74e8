"""Owners. The owner of a thing is the name of the API key that made it, or "" if the server asks for no key
or the key was that of SPECSHIELD_API_KEY. A session's key in the store is `owner@id`, so two owners may
choose the same id, and nobody finds the session of another owner.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request

from specshield.service.access.keys import Key


def scoped(owner: str, id: str) -> str:
    """
    >>> scoped("alice", "run-1")
    'alice@run-1'
    """
    return f"{owner}@{id}"


def owner_of(key: str) -> str:
    """The owner in a session's key."""
    return key.partition("@")[0]


def shown(key: str) -> str:
    """The id, as callers know it, in a session's key."""
    return key.partition("@")[2]


async def _caller(request: Request) -> Key:
    key: Key = request.scope["state"]["key"]
    return key


Caller = Annotated[Key, Depends(_caller)]


async def _owner(caller: Caller) -> str:
    return caller.name


Owner = Annotated[str, Depends(_owner)]
