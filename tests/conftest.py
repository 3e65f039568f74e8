"""The server that tests share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from tests.serving import RunningServer, serving


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """A real process with a data folder and an embedded store of its own; it trains nothing."""
    with serving(tmp_path_factory.mktemp("server") / "data") as running:
        yield running
