"""`specshield verify`: checks that a session's record is complete, and makes every decision again."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from specshield import __version__
from specshield.caution.taught import Taught
from specshield.episode.handover import begun
from specshield.errors import InputError, NotFound, SpecshieldError
from specshield.lookahead.preferences import PROJECTION, prepare
from specshield.service.heavy.tables import Made, make
from specshield.service.library.maps import Maps
from specshield.service.library.policies import Policies
from specshield.service.sessions import chain, history, record
from specshield.service.sessions.chain import Chain
from specshield.service.sessions.record import StepRecord
from specshield.service.sessions.rules import Rule, asked_by, carried_over
from specshield.service.sessions.session import decide
from specshield.service.settings import Settings
from specshield.shield.decision import Carry, Shield, make_shield
from specshield.world.learned import LearnedMap


def verify(file: Path, settings: Settings) -> int:
    """Checks a record and prints the result. Returns 0 if every step is right, 1 if something differs, 2 if
    only the chain could be checked, 4 if a step differs that another version decided. Raises InputError if
    the file cannot be read.
    """
    try:
        with open(file, "rb") as opened:
            content = opened.read(chain.LARGEST + 1)
    except OSError as error:
        raise InputError(f"{file} cannot be read: {error.strerror}", path="FILE", got=str(file)) from None
    try:
        found = chain.read(content)
    except InputError as error:
        print(f"NOT as it was: {error}")
        return 1
    decided = sum(map(bool, found.steps))
    print(f"session {found.configs[0].id}: {decided} decided steps, {len(found.rows)} poses")
    for config in found.configs:
        if len(found.configs) > 1:
            print(f"from step {config.begins}, windows from step {config.origin}: {config.spec['formula']}")
        print(f"map {config.map_id}")
        print(f"policies {', '.join(config.policy_ids)}")
        print(f"decided by specshield {config.version or 'of a version that the record does not name'}")
    print("the chain is whole: no byte was changed since it was sealed")
    print(f"seal {found.seal}")
    try:
        shields, wrong = _shields(found, settings)
    except NotFound as error:
        print(f"NOT decided again: {error.message}; --data-dir, --models-dir and --maps-dir say where it is")
        return 2
    except (SpecshieldError, OSError, TypeError) as error:  # or a record that no server made
        print(f"NOT decided again: {error}")
        return 2
    for config, names in zip(found.configs, wrong, strict=True):
        if names:
            print(f"NOT as decided: the rule from step {config.begins} on differs in {', '.join(names)}")
    return 1 if any(wrong) else _decide(found, shields)


def _decide(found: Chain, shields: Sequence[Shield]) -> int:
    """Makes all decisions again, and prints those that differ. Once another version has decided a step, its
    effect is in all later ones, so that a difference there has a status of its own.
    """
    others = [config for config in found.configs if config.version not in ("", __version__)]

    def told(t: int) -> tuple[str, int]:
        if not others or t < others[0].begins:
            return "NOT as decided", 1
        return f"decided by specshield {others[0].version}, and otherwise by this one, {__version__}", 4

    try:
        differing = list(differences(found, shields))
    except (SpecshieldError, ValueError, IndexError) as error:  # a record that no server made
        said, status = told(len(found.steps))
        print(f"{said}: it cannot be decided again: {error}")
        return status
    for t, fields in differing[:20]:
        print(f"{told(t)[0]}: step {t} differs in {', '.join(fields)}")
    if differing:
        print(f"steps that differ: {len(differing)}")
        return told(differing[0][0])[1]
    print("every step is decided again to the same bytes")
    return 0


def differences(found: Chain, shields: Sequence[Shield]) -> Iterator[tuple[int, list[str]]]:
    """The steps whose decision differs now, each with the fields that differ. shields: one for each rule."""
    configs, rule = found.configs, 0
    carry = begun(configs[0].found)
    maps, made = dict[bytes, LearnedMap](), dict[tuple[int, bytes], Made]()
    for t, content, kept in found.decided():
        while rule < found.rule_at(t):
            carry = carried_over(carry, configs[rule], configs[rule + 1])
            rule += 1
        shield = shields[rule]
        known = Taught.from_bytes(None if carry is None else carry.learned).map
        maps[known.digest] = known
        if kept.tables is not None:
            if kept.tables not in maps:
                raise InputError("it names tables for a map that the session never had", t=t)
            key = rule, kept.tables
            made[key] = made[key] if key in made else make(shield, maps[kept.tables])
            shield = replace(shield, proposers=made[key].proposers)
        again, following = _again(found, shield, t, kept, carry)
        if record.encode(again) != content and shield.preference is not None:
            # The server projects as long as the preference is not prepared.
            projected, other = _again(found, replace(shield, preference=None), t, kept, carry)
            if record.encode(projected) == content:
                again, following = projected, other
        carry = following
        if record.encode(again) != content:
            made_now, found_there = msgspec.structs.asdict(again), msgspec.structs.asdict(kept)
            packed = msgspec.msgpack.encode
            yield t, [name for name in made_now if packed(made_now[name]) != packed(found_there[name])]


def _again(
    found: Chain, shield: Shield, t: int, kept: StepRecord, carry: Carry | None
) -> tuple[StepRecord, Carry | None]:
    rule = found.rule_at(t)
    config, names = found.configs[rule], found.names[rule]
    rows = found.rows[config.origin : t + 1, : 3 + len(names)]
    if len(kept.rows) != len(config.actions):
        told = f"step {t} has {len(kept.rows)} actions, and the robot has {len(config.actions)}"
        raise InputError(told, t=t)
    asked = kept.asked(rows[-1], names)
    if not history.agree(np.array(asked.pose), rows[-1, :3]).all():
        raise InputError(f"the pose sent at step {t} is not the one stored", t=t)
    decision, made = decide(shield, asked, t, rows, names, carry, kept.before, kept.tables)
    return made, decision.carry


def _shields(found: Chain, settings: Settings) -> tuple[list[Shield], list[list[str]]]:
    """The shields that the server had, one for each rule, with `_unlike` of each. Raises SpecshieldError."""
    with tempfile.TemporaryDirectory() as folder:
        settings = settings.or_empty(folder)
        policies = Policies(settings, Maps(settings))
        last = len(found.rows) - 1
        starts = [found.rows[min(config.origin, last), :3].tolist() for config in found.configs]
        made = [_shield(config, start, policies) for config, start in zip(found.configs, starts, strict=True)]
        return [shield for shield, _ in made], [wrong for _, wrong in made]


def _shield(config: Rule, pose: list[float], policies: Policies) -> tuple[Shield, list[str]]:
    """The shield of a rule, with `_unlike` of its config. pose: the pose at the rule's origin."""
    records = [policies.record(id) for id in config.policy_ids]
    proposers = [policies.policy(each) for each in records]
    shield = replace(make_shield(proposers), config=config.settings)
    wrong = _unlike(config, asked_by(config.policy_ids, records[0].about, shield.task))
    if config.shaping != PROJECTION and not wrong:
        shield = replace(shield, preference=prepare(config.shaping, shield.task, proposers, pose))
    return shield, wrong


def _unlike(config: Rule, asked: Mapping[str, Any]) -> list[str]:
    """The members of a config that differ from those that a server would store for the same policies."""
    said = msgspec.to_builtins(config)
    said, asked = {**said, **said["spec"]}, {**asked, **asked["spec"]}
    return [name for name in asked if name != "spec" and said[name] != asked[name]]
