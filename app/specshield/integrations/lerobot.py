"""A LeRobot policy inside a rule, in the place where its `select_action` is called.

    shielded = ShieldedPolicy(policy, shield, row_of)
    action = shielded.select_action(batch)                   # [1, D], as the policy's own

For policies whose `predict_action_chunk` draws a new sample at each call from the batch alone (pi0, SmolVLA).
A Diffusion policy keeps a queue of observations that its own `select_action` fills, so its
`predict_action_chunk` cannot be asked several times: it does not fit here yet. ACT gives the same chunk each
time, so that a forbidden one is replaced by the certified continuation at once (see `samples`). A policy with
discrete actions needs none of this: give its logits to `session.step`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
import torch

from specshield.arrays import Floats
from specshield.client.models import Decision
from specshield.integrations.samples import SampleShield


class Policy(Protocol):
    """What is used of lerobot's PreTrainedPolicy (0.4)."""

    def predict_action_chunk(self, batch: dict[str, torch.Tensor]) -> torch.Tensor: ...
    def reset(self) -> None: ...


class ShieldedPolicy:
    """`policy` inside the rule of a shield's session; row_of and samples as in `openpi.ShieldedPolicy`."""

    def __init__(
        self,
        policy: Policy,
        shield: SampleShield,
        row_of: Callable[[float, float, Floats], Floats],
        samples: int = 8,
    ) -> None:
        self._policy, self._shield, self._row_of, self._samples = policy, shield, row_of, samples
        self.decision: Decision | None = None

    @torch.no_grad()
    def select_action(self, batch: Mapping[str, Any]) -> torch.Tensor:
        """One action [1, D] for a batch of one observation."""
        chunks = [self._policy.predict_action_chunk(dict(batch)) for _ in range(self._samples)]
        rows = [chunk[0, 0].double().cpu().numpy() for chunk in chunks]
        chosen = self._shield.choose(rows, batch)
        self.decision = chosen.decision
        if chosen.sample is not None:
            return chunks[chosen.sample][:, 0]
        action = self._shield.robot.actions[chosen.action]
        row = self._row_of(action.translate, action.rotate, rows[0])
        return torch.as_tensor(np.asarray(row)[None]).to(chunks[0])

    def reset(self) -> None:
        """Of the policy; a session is for one episode, so a new one takes a new wrapper."""
        self._policy.reset()
