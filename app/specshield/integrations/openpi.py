"""An openpi policy (pi0 and others, local or over its websocket) inside a rule.

    policy = ShieldedPolicy(WebsocketClientPolicy(...), shield, row_of)
    actions = policy.infer(observation)["actions"]           # one row; call `infer` again for the next one

See `samples` for what this cannot do. Leave openpi's ActionChunkBroker out: it would run rows that were not
judged. openpi-client asks for numpy below 2, with which the shield's core does not work: `pip install
--no-deps openpi-client` ignores that, and only its `BasePolicy` is used here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from openpi_client.base_policy import BasePolicy

from specshield.integrations.samples import Sampled


class ShieldedPolicy(Sampled, BasePolicy):  # type: ignore[misc]
    """`policy`, a BasePolicy, inside the rule of a shield's session; the arguments are those of `Sampled`."""

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        """The answer of one sample of the policy with one row, `actions` [1, D], and with `decision`."""
        answers = [self._policy.infer(obs) for _ in range(self._samples)]
        rows = [np.asarray(answer["actions"], dtype=np.float64)[0] for answer in answers]
        chosen = self._shield.choose(rows, obs)
        row = rows[chosen.like]
        if chosen.sample is None:
            row = self._instead(chosen, row)
        return {**answers[chosen.like], "actions": row[None], "decision": chosen.decision}
