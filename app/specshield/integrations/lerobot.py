"""A LeRobot policy inside a rule, with the same `select_action`.

    shielded = ShieldedPolicy(policy, shield, row_of)
    action = shielded.select_action(batch)                   # [1, D], as the policy's own

This is for policies that draw a new sample at each call (pi0, SmolVLA, Diffusion, TD-MPC). ACT returns the
same chunk each time: if that is forbidden, the certified continuation replaces it at once (see `samples`). A
policy with discrete actions does not need this: give its logits to `session.step`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import torch

from specshield.client.models import Decision, LocalDecision
from specshield.errors import InputError
from specshield.integrations.samples import Sampled


class Policy(Protocol):
    """The used methods of lerobot's PreTrainedPolicy (0.4)."""

    def predict_action_chunk(self, batch: dict[str, Any]) -> torch.Tensor: ...
    def select_action(self, batch: dict[str, Any]) -> torch.Tensor: ...
    def reset(self) -> None: ...


class ShieldedPolicy(Sampled):
    """`policy` inside the rule of a shield's session; the arguments are those of `Sampled`."""

    _policy: Policy
    decision: Decision | LocalDecision | None = None

    @torch.no_grad()
    def select_action(self, observation: Mapping[str, Any]) -> torch.Tensor:
        """One action [1, D]. Raises InputError for a batch of several observations."""
        batch = self._observed(observation)
        chunks = [self._policy.predict_action_chunk(dict(batch)) for _ in range(self._samples)]
        if any(chunk.ndim != 3 or len(chunk) != 1 for chunk in chunks):
            what, got = "one observation at a time", [list(chunk.shape) for chunk in chunks]
            raise InputError(what, path="batch", got=got, expected="chunks of shape [1, n, D]")
        rows = [chunk[0, 0].double().cpu().numpy() for chunk in chunks]
        chosen = self._shield.choose(rows, observation)
        self.decision = chosen.decision
        if chosen.sample is not None:
            return chunks[chosen.sample][:, 0]
        return torch.as_tensor(np.asarray(self._instead(chosen, rows[chosen.like]))[None]).to(chunks[0])

    def _observed(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        """The batch for `predict_action_chunk`. A policy that looks at several observations keeps them in
        queues, which its own `select_action` fills; of the batch it then reads only the names.
        """
        queues: dict[str, Any] = getattr(self._policy, "_queues", None) or {}
        kept = [name for name in queues if name != "action"]
        if not kept:
            return observation
        queues["action"].clear()  # else it would finish an older chunk before it draws a new one
        self._policy.select_action(dict(observation))
        return dict.fromkeys(kept)
