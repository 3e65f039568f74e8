import pytest

from specshield.shield.episode import make_shield
from specshield.sim.cases import case_names, load_case, shipped


@pytest.fixture(scope="session", params=case_names())
def case(request):
    return load_case(request.param)


@pytest.fixture(scope="session", params=["dqn", "reachability"])
def shield(case, request):
    """The case's shield: with the policy that came for it, computed or learned."""
    return make_shield([shipped(case, request.param)])
