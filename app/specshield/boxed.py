"""Structs of many arrays that Python hands to kernels by reference.

At each call numba takes a struct apart, in 0.15 us for each of its 27 to 43 arrays, by code that each kernel
has of its own and that takes 0.3 to 0.6 s to compile. A boxed struct is taken apart once, when it is boxed.
Then a call takes 0.4 us, and kernels read the struct from memory (*own script*).
"""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import numba.experimental.structref
from numba.core.types import StructRef

from specshield.compiled import kernel

S = TypeVar("S")
structref: Any = numba.experimental.structref
Proxy: Any = structref.StructRefProxy


class BoxedType(StructRef):
    """The type that kernels see: a reference to a struct `value`."""


class Boxed(Proxy, Generic[S]):  # type: ignore[misc]
    """A struct for kernels, which read its `value` too. It never changes."""

    __slots__ = ("value",)
    value: S

    def __reduce__(self) -> tuple[Any, ...]:
        return box, (self.value,)


structref.register(BoxedType)
structref.define_proxy(Boxed, BoxedType, ["value"])


def box(struct: S) -> Boxed[S]:
    boxed: Boxed[S] = _boxed(struct)
    boxed.value = struct
    return boxed


@kernel
def _boxed(struct: S) -> Boxed[S]:
    return Boxed(struct)
