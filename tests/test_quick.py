"""Frozen dataclasses that are made quickly are made as others are."""

from dataclasses import FrozenInstanceError, dataclass, field, replace

import pytest

from specshield.quick import quick


@quick
@dataclass(frozen=True)
class Point:
    x: float
    y: float = 2.0
    at: str = field(default="here", repr=False)

    def __post_init__(self) -> None:
        if self.x < 0.0:
            raise ValueError(self.x)


def test_what_is_made_quickly_has_its_defaults_and_stays_as_it_is():
    point = Point(1.0)
    assert (point.x, point.y, point.at) == (1.0, 2.0, "here")
    assert point == Point(x=1.0, at="here") != Point(1.0, 3.0)
    assert replace(point, y=3.0) == Point(1.0, 3.0)
    assert repr(point) == "Point(x=1.0, y=2.0)"
    with pytest.raises(FrozenInstanceError):
        point.x = 2.0


def test_what_is_made_quickly_is_checked_as_it_is_made():
    with pytest.raises(ValueError, match="-1"):
        Point(-1.0)
    with pytest.raises(TypeError):
        Point()


def test_what_needs_a_factory_is_refused():
    with pytest.raises(AssertionError):

        @quick
        @dataclass(frozen=True)
        class _List:
            of: list[int] = field(default_factory=list)
