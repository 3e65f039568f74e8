"""Frozen dataclasses that are made in a quarter of the time."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any, TypeVar

T = TypeVar("T")


def quick(made: type[T]) -> type[T]:
    """The same frozen dataclass. Its fields go straight into the instance's dictionary: dataclasses calls
    `object.__setattr__` for each, which takes 0.17 us, and a decision makes some 200 (Python 3.11).
    """
    known: Any = fields(made)  # type: ignore[arg-type]
    assert all(each.default_factory is MISSING for each in known)
    names = [each.name for each in known]
    lines = [f"to[{name!r}] = {name}" for name in names]
    lines += ["self.__post_init__()"] if hasattr(made, "__post_init__") else []
    space = dict[str, Any]()
    exec(f"def __init__(self, {', '.join(names)}):\n to = self.__dict__\n " + "\n ".join(lines), space)
    own, first = space["__init__"], made.__init__
    own.__defaults__, own.__annotations__, own.__qualname__ = (
        getattr(first, name) for name in ("__defaults__", "__annotations__", "__qualname__")
    )
    setattr(made, "__init__", own)  # noqa: B010  (mypy takes no assignment to it)
    return made
