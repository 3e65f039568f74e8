"""Numbers and objects of a request, checked: a wrong one raises MapError with path, value and range."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from specshield.errors import MapError

LIMIT = 1e8  # metres: beyond any map, and its square still fits a float64 with millimetres to spare


def number(value: Any, path: str, low: float = -LIMIT, high: float = LIMIT) -> float:
    """`value` as a float in [low, high]. Booleans, strings, NaN and infinities are errors."""
    wrong_type = isinstance(value, bool) or not isinstance(value, int | float)
    if wrong_type or not low <= value <= high or not math.isfinite(value):
        raise MapError(
            f"{path} is not a usable number",
            path=path,
            got=value,
            expected=f"a number from {low:g} to {high:g}",
        )
    return float(value)


def integer(value: Any, path: str, low: int, high: int) -> int:
    """`value` as an int in [low, high]; 3.0 is not one."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise MapError(
            f"{path} is not a usable integer",
            path=path,
            got=value,
            expected=f"an integer from {low} to {high}",
        )
    return value


def numbers(value: Any, length: int, path: str) -> tuple[float, ...]:
    """`value` as that many finite floats."""
    if not is_list(value) or len(value) != length:
        raise MapError(
            f"{path} is not a list of {length} numbers", path=path, got=value, expected=f"{length} numbers"
        )
    return tuple(number(v, f"{path}[{i}]") for i, v in enumerate(value))


def is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


def mapping(value: Any, path: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise MapError(f"{path} is not an object", path=path, got=type(value).__name__, expected="an object")
    return value


def member(value: Mapping[str, Any], key: str, path: str) -> Any:
    """`value[key]`, or an error that names the missing member."""
    if key not in value:
        raise MapError(
            f"{path} has no member {key!r}", path=f"{path}.{key}", got=None, expected=f"a member {key!r}"
        )
    return value[key]
