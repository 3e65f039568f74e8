"""An openpi policy (pi0 and others, local or over its websocket) inside a rule.

    policy = ShieldedPolicy(WebsocketClientPolicy(...), shield, row_of)
    actions = policy.infer(observation)["actions"]           # one row; ask again after it was run

See `samples` for what this cannot do. openpi's ActionChunkBroker would run rows that nobody judged: leave it
out. openpi-client asks for numpy below 2, which the shield's core is not made for: `pip install --no-deps
openpi-client` takes it as it is, and this needs no more of it than `BasePolicy`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from openpi_client.base_policy import BasePolicy

from specshield.arrays import Floats
from specshield.integrations.samples import SampleShield


class ShieldedPolicy(BasePolicy):  # type: ignore[misc]
    """`policy` inside the rule of a shield's session.

    row_of: a row of actions [D] that makes the robot's motion of `translate` [m] and `rotate` [rad], like the
    given row in all else: what is run where no sample is allowed. samples: how often the policy is asked.
    """

    def __init__(
        self,
        policy: BasePolicy,
        shield: SampleShield,
        row_of: Callable[[float, float, Floats], Floats],
        samples: int = 8,
    ) -> None:
        self._policy, self._shield, self._row_of, self._samples = policy, shield, row_of, samples

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        """The answer of one of the policy's samples, `actions` [1, D], and `decision` beside it."""
        answers = [self._policy.infer(obs) for _ in range(self._samples)]
        rows = [np.asarray(answer["actions"], dtype=np.float64)[0] for answer in answers]
        chosen = self._shield.choose(rows, obs)
        sample = chosen.sample or 0
        row = rows[sample]
        if chosen.sample is None:
            action = self._shield.robot.actions[chosen.action]
            row = self._row_of(action.translate, action.rotate, row)
        return {**answers[sample], "actions": row[None], "decision": chosen.decision}

    def reset(self) -> None:
        """Of the policy; a session is for one episode, so a new one takes a new wrapper."""
        self._policy.reset()
