"""Bodies that are read in another process."""

from __future__ import annotations

from fastapi import Request

from specshield.service.bounds.body import Body

TOO_MUCH = {"_503": "`busy`: too much is asked of the server just now; ask again after `Retry-After`."}


def received(request: Request) -> Body:
    """The body that bounds/bodies.py has taken in."""
    body: Body = request.scope["state"]["body"]
    return body
