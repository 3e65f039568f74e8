"""Whose a thing is. An owner is the name of the API key that made it; "" where the server asks for none, and
for the key of SPECSHIELD_API_KEY. A session's key in the store is `owner@id`: two owners may choose the same
id, and another's session is not there.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request

from specshield.service.access.keys import OPEN, Key


def scoped(owner: str, id: str) -> str:
    """
    >>> scoped("alice", "run-1")
    'alice@run-1'
    """
    return f"{owner}@{id}"


def shown(key: str) -> str:
    """The id that a caller knows: `scoped` undone."""
    return key.partition("@")[2]


def _owner(request: Request) -> str:
    return str(request.scope["state"].get("owner", ""))


def _caller(request: Request) -> Key:
    key: Key = request.scope["state"].get("key", OPEN)
    return key


Owner = Annotated[str, Depends(_owner)]
Caller = Annotated[Key, Depends(_caller)]
