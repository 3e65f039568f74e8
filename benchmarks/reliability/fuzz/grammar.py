"""Formulas made by the language's own grammar, most of them valid (pure)."""

from __future__ import annotations

import random

NAMES = ("Charger1", "Kitchen", "x", "y", "theta", "battery", "_", "G1", "abs", "not", "U", "é", "a" * 80)
NUMBERS = ("0", "1", "-1", "2.5", "1e5", ".5", "1.", "1e-999", "1e999", "00", "9" * 25, "0x1", "inf", "nan")
BOUNDS = ("0", "1", "5", "60", "150", "1000", "999999", "10000000000", "-1", "1.5", "")
SPACES = ("", " ", " ", "  ", "\n", "\t", "\u00a0")


def formula(random: random.Random, depth: int = 0) -> str:
    """Text of any depth up to some 100; one in three has something wrong in it."""
    depth = depth or random.choice((1, 2, 3, 4, 5, 6))
    if random.random() < 0.01:
        return (
            random.choice(("(", "not ", "F[0,1] ", "- ", "abs(", "a and "))
            * random.choice((10, 63, 64, 65, 1000))
            + "a"
        )
    return _formula(random, depth)


def _formula(random: random.Random, depth: int) -> str:
    if depth <= 0:
        return _comparison(random, 2)
    inner = lambda: _formula(random, depth - 1)  # noqa: E731
    space = random.choice(SPACES)
    match random.randrange(10):
        case 0:
            return f"{random.choice(('not ', '!', 'NOT '))}{inner()}"
        case 1 | 2:
            return f"{random.choice(('G', 'F', 'always', 'eventually'))}{space}{_window(random)} {inner()}"
        case 3:
            return f"{inner()} {random.choice(('U', 'until'))}{_window(random)}{space} {inner()}"
        case 4 | 5:
            joint = random.choice((" and ", " & ", " or ", " | ", "&&"))
            return joint.join(inner() for _ in range(random.choice((2, 2, 3, 20 if depth < 3 else 2))))
        case 6:
            return f"{inner()} {random.choice(('->', 'implies'))} {inner()}"
        case 7:
            return f"({space}{inner()}{random.choice((')', ')', ')', ''))}"
        case 8:
            return f"{random.choice(('touches', 'inside'))}{space}({random.choice(NAMES)})"
    return _comparison(random, depth)


def _comparison(random: random.Random, depth: int) -> str:
    if random.random() < 0.4:
        return random.choice(NAMES)
    return f"{_sum(random, depth)} {random.choice(('<', '<=', '>', '>=', '==', '<>'))} {_sum(random, depth)}"


def _sum(random: random.Random, depth: int) -> str:
    if depth <= 0 or random.random() < 0.4:
        return random.choice(NAMES) if random.random() < 0.5 else random.choice(NUMBERS)
    match random.randrange(4):
        case 0:
            return f"abs({_sum(random, depth - 1)})"
        case 1:
            return f"-{_sum(random, depth - 1)}"
        case 2:
            return f"({_sum(random, depth - 1)})"
    return f"{_sum(random, depth - 1)} {random.choice('+-*/')} {_sum(random, depth - 1)}"


def _window(random: random.Random) -> str:
    a, b = random.choice(BOUNDS), random.choice(BOUNDS)
    if random.random() < 0.7:
        a, b = sorted(str(random.randrange(200)) for _ in range(2))
    return f"[{a}{random.choice(',,,:')}{b}{random.choice((']', ']', ']', ''))}"
