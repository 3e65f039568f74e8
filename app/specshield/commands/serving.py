"""The server that a command asks: one that runs already, or one of its own on the same data folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from specshield.client import ShieldClient
from specshield.sim.progress import StatusLine
from specshield.sim.service import own_server

PATIENCE = 30.0  # [s] for one answer: other work may share the machine


@contextmanager
def client_of(url: str | None, status: StatusLine, worker: bool = False) -> Iterator[ShieldClient]:
    """A client of the server at `url`. Without one a server is started, which keeps what it makes.

    worker: whether policies are to be made there.
    """
    if url is not None:
        with ShieldClient(url, timeout=PATIENCE) as client:
            yield client
        return
    from specshield.service.settings import read_settings

    status.say("starting the service ...")
    with (
        own_server(worker, status.say, read_settings().data_dir) as own,
        ShieldClient(own, timeout=PATIENCE) as client,
    ):
        yield client
