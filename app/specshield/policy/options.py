"""The options of a method: a frozen dataclass says which there are, what each means and what it may be.

    @dataclass(frozen=True)
    class Options:
        pitch: float = option(0.1, "Side of a cell of the lattice [m].", low=0.02, high=1.0)

An option has the type of its default: a whole number, a number, several numbers, or a text out of `choices`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import Field, field, fields
from typing import Any, TypeVar

from specshield.errors import PolicyError

T = TypeVar("T")


def option(default: T, about: str, *, low: float = 0.0, high: float = 0.0, choices: Sequence[str] = ()) -> T:
    """A field of a dataclass of options. Numbers lie in [low, high], each of them where there are several."""
    metadata = {"about": about, "low": low, "high": high, "choices": tuple(choices)}
    made: T = field(default=default, metadata=metadata)
    return made


def read_options(cls: type[T], given: Mapping[str, Any]) -> T:
    """The options that `given` (JSON) names, the others at their defaults.

    Raises PolicyError with the path of the option at fault.
    """
    known: dict[str, Field[Any]] = {each.name: each for each in fields(cls)}  # type: ignore[arg-type]
    for name in given:
        if name not in known:
            expected = f"one of {', '.join(sorted(known))}"
            raise PolicyError("unknown option", path=f"options.{name}", got=name, expected=expected)
    return cls(**{name: _read(known[name], value) for name, value in given.items()})


def options_to_json(options: Any) -> dict[str, Any]:
    """Every option, as JSON that `read_options` reads back: what a policy's id is hashed from."""
    values = {each.name: getattr(options, each.name) for each in fields(options)}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def options_schema(cls: type[Any]) -> dict[str, Any]:
    """The options as a JSON schema."""
    properties = {}
    for each in fields(cls):
        rule, default = each.metadata, each.default
        shown: dict[str, Any] = {"minimum": rule["low"], "maximum": rule["high"]}
        if isinstance(default, str):
            shown = {"type": "string", "enum": list(rule["choices"])}
        elif isinstance(default, tuple):
            items = {"type": "number", **shown}
            shown = {"type": "array", "items": items, "minItems": len(default), "maxItems": len(default)}
            default = list(default)
        else:
            shown["type"] = "integer" if isinstance(default, int) else "number"
        properties[each.name] = {**shown, "default": default, "description": rule["about"]}
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _read(about: Field[Any], value: Any) -> Any:
    rule, default = about.metadata, about.default
    if isinstance(default, str):
        if value in rule["choices"]:
            return value
        expected = f"one of {', '.join(rule['choices'])}"
    elif isinstance(default, tuple):
        several = isinstance(value, Sequence) and len(value) == len(default)
        if several and all(_is_number(each, rule) for each in value):
            return tuple(map(float, value))
        expected = f"a list of {len(default)} numbers from {rule['low']:g} to {rule['high']:g}"
    else:
        whole = isinstance(default, int)
        if _is_number(value, rule) and (isinstance(value, int) or not whole):
            return value if whole else float(value)
        kind = "a whole number" if whole else "a number"
        expected = f"{kind} from {rule['low']:g} to {rule['high']:g}"
    raise PolicyError("the value is not valid", path=f"options.{about.name}", got=value, expected=expected)


def _is_number(value: Any, rule: Mapping[str, Any]) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and rule["low"] <= value <= rule["high"]
