"""The tree of errors is the one its docstring draws."""

from __future__ import annotations

import re

import pytest

from specshield import errors
from specshield.errors import InputError, SpecshieldError, tree


def drawn():
    """(depth, name) of each line of the drawing."""
    for line in errors.__doc__.splitlines():
        found = re.match(r"^((?:[│ ] {3})*)(?:[├└]── )?([A-Z]\w+)( |$)", line)
        if found and ("── " in line or line == "SpecshieldError"):
            yield len(found[1]) // 4 + ("── " in line), found[2]


def real(cls=SpecshieldError, depth=0):
    yield depth, cls.__name__
    for child in cls.__subclasses__():
        yield from real(child, depth + 1)


def test_the_drawing_is_the_tree():
    assert list(drawn()) == list(real())
    assert len(list(drawn())) > 20


def test_every_type_is_one_stable_word():
    types = [cls.type for cls in tree()]
    assert len(set(types)) == len(types)
    assert all(re.fullmatch(r"[a-z]+(-[a-z]+)*", word) for word in types)
    assert all("type" in vars(cls) for cls in tree())


def test_an_error_says_what_where_and_what_is_valid():
    error = InputError("not a number", path="radius", got="x", expected="a number", position=3)
    assert (error.path, error.got, error.expected) == ("radius", "x", "a number")
    assert str(error) == "radius: not a number; got 'x'; expected a number"
    assert error.details == {"position": 3}
    assert error.at("footprint").at("robot") is error
    assert error.path == "robot.footprint.radius"
    assert InputError("lost").at("spec").path == "spec"
    with pytest.raises(SpecshieldError, match=r"^robot\.footprint\.radius: not a number"):
        raise error
    assert str(InputError("t is late", path="t")) == "t is late", "the field is told already"
    assert str(InputError("the step is late", path="t")) == "t: the step is late"
    said = InputError("not a word; expected a word", got="1", expected="a word")
    assert str(said) == "not a word; got '1'; expected a word", "what is expected is told already"
    assert len(str(InputError("long", got="x" * 5000))) < 300
