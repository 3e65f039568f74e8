"""A client, and sessions in the small world."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.browsing import Browse, chromium
from tests.service.world import LOGITS, START, grid_json, send_policy


@pytest.fixture(scope="module")
def browse() -> Iterator[Browse]:
    """`browse()` opens a page in a browser that the tests of a module share: to start one takes 2 s."""
    with chromium() as browse:
        yield browse


@pytest.fixture
def client(server: Any) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url, verify=False, timeout=None) as client:
        yield client


@pytest.fixture
def policy(client: httpx.Client) -> dict[str, Any]:
    """The small world's policy, sent for each test; the server knows it after the first."""
    assert client.post("/v1/maps", json=grid_json()).status_code == 201
    return send_policy(client)


@pytest.fixture
def begin(client: httpx.Client, policy: dict[str, Any]) -> Any:
    """begin(**options): a new session at START."""

    def begin(**options: Any) -> dict[str, Any]:
        body = {"policy_id": policy["id"], "initial_pose": START, **options}
        response = client.post("/v1/sessions", json=body)
        assert response.status_code == 201, response.text
        session: dict[str, Any] = response.json()
        return session

    return begin


@pytest.fixture
def step(client: httpx.Client) -> Any:
    """step(session, t, poses, **fields): the response."""

    def step(session: dict[str, Any], t: int, poses: Any, **fields: Any) -> httpx.Response:
        body = {"t": t, "poses": poses, "logits": LOGITS, **fields}
        return client.post(f"/v1/sessions/{session['id']}/steps", json=body)

    return step
