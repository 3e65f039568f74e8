"""The tokens of formula text."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

from specshield.errors import FormulaError
from specshield.stl.formula import KEYWORDS

MAX_LENGTH = 10_000  # characters

_TOKEN = re.compile(
    r"(?P<space>[ \t\r\n]+)"
    r"|(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_]*)"
    r"|(?P<symbol>->|<=|>=|[-+*/<>()\[\],:!&|])"
)
_WORDS = {"!": "not", "&": "and", "|": "or", "->": "implies", "always": "G", "eventually": "F", "until": "U"}


class Token(NamedTuple):
    kind: str  # "number", "name", "end", or the operator, keyword or bracket itself (synonyms made one)
    text: str
    position: int


def tokens(text: Any) -> list[Token]:
    if not isinstance(text, str):
        raise FormulaError("a formula is text", got=type(text).__name__, expected="a string", position=0)
    if len(text) > MAX_LENGTH:
        expected = f"at most {MAX_LENGTH} characters"
        raise FormulaError(
            f"the formula has {len(text)} characters; expected {expected}",
            got=len(text),
            expected=expected,
            position=MAX_LENGTH,
        )
    found: list[Token] = []
    position = 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None:
            problem, expected = f"unexpected {text[position]!r}", "an operator, a name or a number"
            raise FormulaError(
                f"{problem} at position {position}; expected {expected}",
                got=text[position],
                expected=expected,
                position=position,
            )
        word = match.group()
        if match.lastgroup in ("number", "name") and word not in KEYWORDS:
            found.append(Token(match.lastgroup, word, position))
        elif match.lastgroup != "space":
            found.append(Token(_WORDS.get(word, word), word, position))
        position = match.end()
    found.append(Token("end", "", len(text)))
    return found
