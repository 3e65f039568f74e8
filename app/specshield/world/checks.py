"""Checks of the parts of a request. Each raises MapError with the path, the value and what is valid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from specshield.errors import MapError

LIMIT = 1e8  # [m] beyond any map; a float64 still tells 1e-7 m apart there


def number(value: Any, path: str, low: float = -LIMIT, high: float = LIMIT) -> float:
    """`value` as a float in [low, high]. Booleans, strings, NaN and infinities are errors."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise wrong("number", path, value, f"a number from {low:g} to {high:g}")
    return float(value)


def integer(value: Any, path: str, low: int, high: int) -> int:
    """`value` as an int in [low, high]. 3.0 is an error: it is not an int."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise wrong("integer", path, value, f"an integer from {low} to {high}")
    return value


def numbers(value: Any, length: int, path: str) -> tuple[float, ...]:
    """`value` as `length` finite floats."""
    return tuple(number(v, f"{path}[{i}]") for i, v in enumerate(items(value, path, length, length)))


def items(value: Any, path: str, low: int = 0, high: int = 1_000_000) -> Sequence[Any]:
    """`value`, which has to be a list of low to high items."""
    if not isinstance(value, Sequence) or isinstance(value, str | bytes) or not low <= len(value) <= high:
        raise wrong("list", path, value, f"{low} items" if low == high else f"{low} to {high} items")
    return value


def mapping(value: Any, path: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise wrong("object", path, value, "an object")
    return value


def text(value: Any, path: str) -> str:
    if not isinstance(value, str):
        raise wrong("text", path, value, "text")
    return value


def member(value: Any, key: str, path: str) -> Any:
    """`value[key]`. An empty path stands for the top of the document."""
    if key not in mapping(value, path or "document"):
        where = f"{path}.{key}" if path else key
        raise MapError(f"{where} is missing", path=where, expected=f"a member {key!r}")
    return value[key]


def wrong(kind: str, path: str, value: Any, expected: str) -> MapError:
    return MapError(f"{path} is not a usable {kind}", path=path, got=shown(value), expected=expected)


def shown(value: Any) -> Any:
    """`value` as an error repeats it: short values whole, of others the type and size."""
    if isinstance(value, str):
        return value if len(value) <= 100 else f"{value[:100]}... ({len(value)} characters)"
    if value is None or isinstance(value, bool | float) or (isinstance(value, int) and abs(value) < 1 << 63):
        return value
    if isinstance(value, Mapping | Sequence):
        return f"{'an object' if isinstance(value, Mapping) else 'a list'} of {len(value)}"
    return type(value).__name__
