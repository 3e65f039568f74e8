"""The settings of a session in this process, with the same bounds as on a server."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from specshield.errors import InputError
from specshield.lookahead.preferences import PREFERENCES, PROJECTION
from specshield.shield.uncertainty import MOST_TRANSLATION, Uncertainty


class Kind(NamedTuple):
    """The valid values of a setting: in words, and as a test."""

    told: str
    holds: Callable[[Any], bool]


def _number(low: float, high: float, *types: type) -> Kind:
    told = f"a {'number' if float in types else 'whole number'} from {low} to {high}"
    return Kind(
        f"{told} or None" if NONE in types else told,
        lambda value: type(value) in types and (value is None or low <= value <= high),
    )


def _one_of(*words: str) -> Kind:
    return Kind(" or ".join(map(repr, words)), lambda value: value in words)


NONE = type(None)
FLAG = Kind("True or False", lambda value: isinstance(value, bool))
SETTINGS: Mapping[str, Kind] = {
    "id": Kind("a text or None", lambda value: value is None or isinstance(value, str)),
    "seed": _number(0, 2**63 - 1, int),
    "threshold": _number(0.0, 1e8, int, float),
    "margin": _number(0.0, 1e8, int, float),
    "slack": _number(0, 1000, int),
    "evaluation": _one_of("feasibility", "robustness"),
    "shaping": _one_of(PROJECTION, *PREFERENCES.names()),
    "max_steps": _number(1, 1_000_000, int, NONE),
    "allow_infeasible": FLAG,
    "uncertainty": Kind(
        "'learned', 'none' or an object of numbers: translation, rotation and, if it slips, slip",
        lambda value: isinstance(value, Mapping) or value in ("learned", "none"),
    ),
    "learn_map": FLAG,
    "map_memory": _number(1, 1_000_000, int, NONE),
    "threshold_over": _one_of("step", "episode"),
}
KNOWN: Mapping[str, Kind] = {
    "translation": _number(0.0, MOST_TRANSLATION, int, float),
    "rotation": _number(0.0, math.pi, int, float),
    "slip": _number(0.0, 1.0, int, float),
}


def read_settings(given: Mapping[str, Any]) -> dict[str, Any]:
    """The given settings, with the defaults that differ from the core's and `uncertainty` in the core's form.
    Raises InputError with the path of the wrong setting.
    """
    values = _read({"uncertainty": "learned", "learn_map": True, **given}, SETTINGS)
    told = values["uncertainty"]
    known = Uncertainty() if told == "learned" else None
    if isinstance(told, Mapping):
        asked = {"translation": None, "rotation": None, "slip": 0.0, **told}
        known = Uncertainty(**_read(asked, KNOWN, "uncertainty."))
    return {**values, "uncertainty": known, "any_signal": told != "none"}


def _read(given: Mapping[str, Any], kinds: Mapping[str, Kind], at: str = "") -> dict[str, Any]:
    values: dict[str, Any] = plain(given)
    for name, value in values.items():
        kind = kinds.get(name, Kind(f"one of {', '.join(kinds)}", lambda _: False))
        if not kind.holds(value):
            wrong = "the setting is not valid" if name in kinds else "there is no such setting"
            raise InputError(wrong, path=f"{at}{name}", got=value, expected=kind.told)
    return values


def plain(value: Any) -> Any:
    """The value with lists and numbers of Python in place of those of numpy, also in its members, whose names
    are texts.
    """
    if isinstance(value, Mapping):
        return {str(name): plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return value.tolist() if hasattr(value, "tolist") else value
