import json

import pytest

from specshield.policy.load import load_policy
from specshield.policy.reachability import synthesise
from specshield.shield.episode import make_shield
from specshield.sim.cases import MODELS, case_names, load_case


@pytest.fixture(scope="session", params=case_names())
def case(request):
    return load_case(request.param)


@pytest.fixture(scope="session", params=["dqn", "reachability"])
def shield(case, request):
    """The case's shield: with the policy that is shipped for it, or with one computed."""
    if request.param == "reachability":
        return make_shield([synthesise(case.task)])
    folder = MODELS / case.name
    card = json.loads((folder / "card.json").read_text())
    return make_shield([load_policy((folder / "policy.safetensors").read_bytes(), card, case.task)])
