"""The rules that a session has had, each with the settings of the session (pure).

A session's stored config has one line of JSON for each rule. The first line is what the session began with.
Each switch adds a line. The rows have a column for each signal that a rule so far declares: those of the
first rule in alphabetical order, then those that each further rule adds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any, Literal, TypedDict

import msgspec
import numpy as np

from specshield.arrays import Floats
from specshield.episode import handover
from specshield.service.library import files
from specshield.service.library.policies import Description
from specshield.service.schemas.sessions import KnownUncertainty, SessionRequest
from specshield.shield.decision import Carry, Config
from specshield.shield.uncertainty import Uncertainty
from specshield.task import Task

MOST_RULES = 256  # of one session; chosen by hand: every load of the session reads their lines
Told = Literal["learned", "none"] | dict[str, float]


class Spec(TypedDict):
    formula: str
    regions: dict[str, Any]
    signals: dict[str, float]


class Rule(msgspec.Struct, frozen=True, kw_only=True):
    """A rule, the policies for it, and the settings of the session. One that is older than a setting has the
    paper's default for it. version: of the server that began with the rule.

    begins: the first step that the rule decides. origin: the step from which its windows count, and its
    history. clock: as the request for the switch had it. before: the link of the chain (record.py) that the
    switch follows, in hex. way: the motions that the rule began with, in hex, if a search found them and no
    policy did; else empty.
    """

    id: str
    policy_ids: list[str]
    map_id: str
    spec: Spec
    robot: str | dict[str, Any]
    horizon: int
    actions: list[str]
    terminal_actions: list[int]
    seed: int
    threshold: float
    margin: float
    slack: int = 0
    evaluation: str
    max_steps: int
    shaping: str
    uncertainty: Told = "none"
    threshold_over: Literal["step", "episode"] = "step"
    learn_map: bool = False
    map_memory: int | None = None
    any_signal: bool = False
    created_at: str = ""
    owner: str = ""
    nonce: str = ""
    version: str = ""
    begins: int = msgspec.field(name="from", default=0)
    origin: int = 0
    clock: Literal["keep", "restart"] = "restart"
    before: str = ""
    way: str = ""

    @property
    def settings(self) -> Config:
        """The core counts steps from the rule's origin. So the last step is moved, and the seed is another
        one: else the draws of actions would be repeated from each origin on.
        """
        alike = {name: getattr(self, name) for name in ALIKE}
        alike |= {"seed": self.seed + self.origin, "max_steps": self.max_steps - self.origin}
        return Config(**alike, uncertainty=_uncertainty(self.uncertainty), any_signal=self.any_signal)

    @property
    def about(self) -> Description:
        """The rule's task. The policies may have been deleted, so that it names none."""
        return Description(self.map_id, self.robot, {**self.spec}, "", 0, {})

    @property
    def found(self) -> bytes | None:
        """The way that the rule began with, if a search found it and no policy did."""
        return bytes.fromhex(self.way) or None


# The settings that request, rule and `Config` hold in the same form; `uncertainty` has others.
ALIKE = [each.name for each in fields(Config) if each.name not in ("uncertainty", "any_signal")]


def asked_for(request: SessionRequest) -> Config:
    """The settings of a request. Raises InputError for settings that do not go together."""
    alike, told = {name: getattr(request, name) for name in ALIKE}, _told(request)
    return Config(**alike, uncertainty=_uncertainty(told), any_signal=told != "none")


def stored(settings: Config, request: SessionRequest) -> dict[str, Any]:
    """The members of a rule that hold the settings."""
    alike = {name: getattr(settings, name) for name in (*ALIKE, "any_signal")}
    return {**alike, "uncertainty": _told(request)}


def asked_by(policy_ids: Sequence[str], about: Description, task: Task) -> dict[str, Any]:
    """The members of a rule that come from the policies and from their task."""
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


def _told(request: SessionRequest) -> Told:
    asked = request.uncertainty
    return asked.model_dump() if isinstance(asked, KnownUncertainty) else asked


def _uncertainty(told: Told) -> Uncertainty | None:
    if isinstance(told, str):
        return Uncertainty() if told == "learned" else None
    return Uncertainty(**told)


def read(content: bytes) -> list[Rule]:
    """The rules of a config; the last one is in force. Raises msgspec.MsgspecError, UnicodeDecodeError."""
    return [_decoder.decode(line) for line in content.split(b"\n")]


_decoder = msgspec.json.Decoder(Rule)


def line(rule: Rule) -> bytes:
    """The rule as a line of a config."""
    return files.to_json(msgspec.to_builtins(rule))


def at(rules: Sequence[Rule], t: int) -> int:
    """The index of the rule that decides, or decided, step t."""
    return max(i for i, rule in enumerate(rules) if rule.begins <= t)


def columns(rules: Iterable[Rule]) -> list[list[str]]:
    """For each rule, the signals of the rows' columns, in order, up to those that this rule added."""
    names, found = list[str](), list[list[str]]()
    for rule in rules:
        names = [*names, *added(names, rule.spec["signals"])]
        found.append(names)
    return found


def added(names: Iterable[str], signals: Iterable[str]) -> list[str]:
    """The names of the columns that a rule with these signals adds to the columns `names`."""
    return sorted(set(signals) - set(names))


def signals_in(rows: Floats, names: Iterable[str]) -> dict[str, Floats]:
    """The samples [n] of each signal in rows [n, 3 + signals]. names: of the signals, by column."""
    return {name: rows[:, 3 + i] for i, name in enumerate(names)}


def widened(rows: Floats, names: Sequence[str], signals: Mapping[str, float]) -> Floats:
    """The rows with the columns that a rule with these signals adds, which hold their initial values."""
    first = [signals[name] for name in added(names, signals)]
    return np.hstack([rows, np.tile(first, (len(rows), 1))]) if first else rows


def carried_over(carry: Carry | None, old: Rule, new: Rule) -> Carry:
    """The memory that the first decision under the new rule gets from the last one under the old rule."""
    same_map, same_robot = old.map_id == new.map_id, old.robot == new.robot
    t, later = new.begins - new.origin, new.origin - old.origin
    return handover.carried_over(carry, same_map, same_robot, t, later)._replace(way=new.found)


def told(rules: Sequence[Rule], verdicts: Sequence[str]) -> list[dict[str, Any]]:
    """The rules as the contract shows them. verdicts: one for each rule."""
    return [
        handover.rule_told(msgspec.structs.asdict(rule), rule.begins, rule.origin, rule.clock, verdict)
        for rule, verdict in zip(rules, verdicts, strict=True)
    ]
