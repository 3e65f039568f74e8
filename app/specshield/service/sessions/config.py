"""Converts a session's settings between the request, the stored config and the shield's `Config` (pure)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from specshield.service.library.policies import Description
from specshield.service.schemas.sessions import KnownUncertainty, SessionRequest, Uncertain
from specshield.shield.decision import Config
from specshield.shield.uncertainty import Uncertainty
from specshield.task import Task

# The settings that request, stored config and `Config` hold in the same form; `uncertainty` has others.
ALIKE = [
    each.name for each in fields(Config) if each.name in SessionRequest.model_fields.keys() - {"uncertainty"}
]
ANY_SIGNAL = "any_signal"  # no request has it: it follows from `uncertainty`


def settings_of(config: Mapping[str, Any]) -> Config:
    """The settings of a stored config. A config that is older than a setting has the paper's default for it.

    The core counts steps from the rule's origin. So the last step is moved, and the seed is another one: else
    the draws of actions would be repeated from each origin on.
    """
    alike = {name: config[name] for name in (*ALIKE, ANY_SIGNAL) if name in config}
    if origin := config.get("origin", 0):
        alike |= {"seed": alike["seed"] + origin, "max_steps": alike["max_steps"] - origin}
    return Config(**alike, uncertainty=_uncertainty(config.get("uncertainty", "none")))


def asked_for(request: SessionRequest) -> Config:
    """The settings of a request. Raises InputError for settings that do not go together."""
    alike = {name: getattr(request, name) for name in ALIKE}
    told = _told(request.uncertainty)
    return Config(**alike, uncertainty=_uncertainty(told), any_signal=told != "none")


def asked_by(policy_ids: Sequence[str], about: Description, task: Task) -> dict[str, Any]:
    """The members of a config that come from the policies and from their task."""
    return {
        "policy_ids": list(policy_ids),
        "map_id": about.map_id,
        "spec": {
            "formula": str(task.formula),
            "regions": about.spec.get("regions") or {},
            "signals": dict(sorted(task.signals.items())),
        },
        "robot": about.robot,
        "horizon": task.horizon,
        "actions": list(task.robot.action_names),
        "terminal_actions": np.flatnonzero(task.robot.terminal).tolist(),
    }


def stored(settings: Config, request: SessionRequest) -> dict[str, Any]:
    """The members of a config that hold the settings."""
    alike = {name: getattr(settings, name) for name in (*ALIKE, ANY_SIGNAL)}
    return {**alike, "uncertainty": _told(request.uncertainty)}


def _told(uncertainty: Uncertain) -> str | dict[str, float]:
    return uncertainty.model_dump() if isinstance(uncertainty, KnownUncertainty) else uncertainty


def _uncertainty(told: str | Mapping[str, float]) -> Uncertainty | None:
    if isinstance(told, str):
        return Uncertainty() if told == "learned" else None
    return Uncertainty(**told)
