"""The server of a command: one that runs already, or one that the command starts on the data folder."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager

from specshield.client import ShieldClient
from specshield.errors import InputError
from specshield.sim.progress import StatusLine
from specshield.sim.service import own_server

PATIENCE = 30.0  # [s] for one answer: the machine may be busy


def client_at(url: str, api_key: str | None = None) -> ShieldClient:
    """A client of the server at the option `--url`; the key is that of SPECSHIELD_API_KEY by default."""
    key = api_key or os.environ.get("SPECSHIELD_API_KEY") or None
    try:
        return ShieldClient(url, key, timeout=PATIENCE)
    except InputError as error:
        error.path = "--url" if error.path == "base_url" else "SPECSHIELD_API_KEY"
        raise


@contextmanager
def client_of(url: str | None, status: StatusLine, worker: bool = False) -> Iterator[ShieldClient]:
    """A client of the server at `url`, or of one that is started for the block on the data folder.

    The client uses the key of SPECSHIELD_API_KEY. worker: whether the started server makes policies.
    """
    if url is not None:
        with client_at(url) as client:
            yield client
        return
    from specshield.service.settings import read_settings

    key = os.environ.get("SPECSHIELD_API_KEY") or None
    data, key = read_settings().data_dir, key or secrets.token_urlsafe()  # the folder may hold keys
    status.say("starting the service ...")
    with own_server(worker, status.say, data, key) as own, ShieldClient(own, key, timeout=PATIENCE) as client:
        status.clear()
        yield client
