"""The server that a command asks: one that runs already, or one of its own on the same data folder."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager

from specshield.client import ShieldClient
from specshield.sim.progress import StatusLine
from specshield.sim.service import own_server

PATIENCE = 30.0  # [s] for one answer: other work may share the machine


@contextmanager
def client_of(url: str | None, status: StatusLine, worker: bool = False) -> Iterator[ShieldClient]:
    """A client of the server at `url`. Without one a server is started, which keeps what it makes.

    The client shows the key of SPECSHIELD_API_KEY. worker: whether policies are to be made there.
    """
    key = os.environ.get("SPECSHIELD_API_KEY") or None
    if url is not None:
        with ShieldClient(url, key, timeout=PATIENCE) as client:
            yield client
        return
    from specshield.service.settings import read_settings

    data, key = read_settings().data_dir, key or secrets.token_urlsafe()  # the folder may hold keys
    status.say("starting the service ...")
    with own_server(worker, status.say, data, key) as own, ShieldClient(own, key, timeout=PATIENCE) as client:
        status.clear()
        yield client
