"""What tests share: a server, and the cases with the shields that came for them."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

from evaluation.shipped import shipped
from specshield.episode import Shield, make_shield
from specshield.sim.cases import Case, case_names, load_case
from tests.serving import RunningServer, serving

# How long an example takes depends on what else the machine does.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")

# What is imported from here on stays. To look for garbage in it takes a sixth of a collection's time.
gc.disable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Those of one module wait for nearly two minutes, for stores that do not answer. If they began late, all
    others would have ended before.
    """
    items.sort(key=lambda item: item.path.name != "test_stores.py")


def pytest_collection_finish() -> None:
    """What was imported stays: without this, each full collection looks at a million objects again."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """A real process with a data folder and an embedded store of its own; it trains nothing."""
    with serving(tmp_path_factory.mktemp("server") / "data") as running:
        yield running


@pytest.fixture(scope="session", params=case_names())
def case(request: pytest.FixtureRequest) -> Case:
    return load_case(request.param)


@pytest.fixture(scope="session", params=["dqn", "reachability"])
def shield(case: Case, request: pytest.FixtureRequest) -> Shield:
    """The case's shield: with the policy that came for it, computed or learned."""
    return make_shield([shipped(case, request.param)])
