"""The policies that come with the paper's cases."""

from __future__ import annotations

import json

from specshield.errors import NotFound
from specshield.policy.methods import load_policy
from specshield.shield.proposal import Proposer
from specshield.shipped import MODELS
from specshield.sim.cases import Case


def shipped(case: Case, method: str) -> Proposer:
    """The policy that came for a case: `models/<case>` is computed, `models/<case>-dqn` is learned.

    Raises NotFound where there is none.
    """
    folder = MODELS / (case.name if method == "reachability" else f"{case.name}-{method}")
    if not (folder / "card.json").is_file():
        raise NotFound(
            f"no policy came for {case.name}",
            path="method",
            got=method,
            expected=f"a folder {folder.name} in models/",
        )
    card = json.loads((folder / "card.json").read_text())
    return load_policy(folder / "policy.safetensors", card, case.task)
