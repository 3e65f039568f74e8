"""The tokens of formula text."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

from specshield.errors import FormulaError
from specshield.stl.formula import KEYWORDS

MAX_LENGTH = 10_000  # characters

_WORDS = {"!": "not", "&": "and", "|": "or", "->": "implies", "always": "G", "eventually": "F", "until": "U"}

_NO_EQUALITY = "a comparison: <, <=, > or >=; for equality a tolerance, such as abs(x - 2) < 0.1"
_ELSEWHERE = {  # operators of programming languages and of papers, each with what to write here
    "&&": "'and'", "\N{LOGICAL AND}": "'and'", "||": "'or'", "\N{LOGICAL OR}": "'or'",
    "~": "'not'", "\N{NOT SIGN}": "'not'", "=>": "'->'", "\N{RIGHTWARDS ARROW}": "'->'",
    "==": _NO_EQUALITY, "=": _NO_EQUALITY, "!=": "a comparison, such as abs(x - 2) > 0.1",
    "\N{LESS-THAN OR EQUAL TO}": "'<='", "\N{GREATER-THAN OR EQUAL TO}": "'>='",
    "\N{WHITE SQUARE}": "'G' with a window", "\N{WHITE DIAMOND}": "'F' with a window",
}  # fmt: skip

_TOKEN = re.compile(
    r"(?P<space>[ \t\r\n]+)"
    r"|(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_]*)"
    rf"|(?P<elsewhere>{'|'.join(map(re.escape, _ELSEWHERE))})"
    r"|(?P<symbol>->|<=|>=|[-+*/<>()\[\],:!&|])"
    r"|(?P<other>.)",
    re.DOTALL,
)


class Token(NamedTuple):
    """kind: "number", "name", "end", or the operator, keyword or bracket itself, with one kind for synonyms.

    text: as it was written. position: the offset of its first character.
    """

    kind: str
    text: str
    position: int


def tokens(text: Any) -> list[Token]:
    """The tokens of `text`, the last of kind "end". Raises FormulaError with the position of what is none."""
    if not isinstance(text, str):
        raise FormulaError(
            "a formula has to be text", got=type(text).__name__, expected="a string", position=0
        )
    if len(text) > MAX_LENGTH:
        problem, expected = f"the formula has {len(text)} characters", f"at most {MAX_LENGTH} characters"
        raise FormulaError(
            f"{problem}; expected {expected}", got=len(text), expected=expected, position=MAX_LENGTH
        )
    found: list[Token] = []
    for match in _TOKEN.finditer(text):
        kind, word, position = match.lastgroup, match.group(), match.start()
        if kind in ("elsewhere", "other"):
            problem = f"unexpected {word!r} at position {position}"
            expected = _ELSEWHERE.get(word, "an operator, a name or a number")
            raise FormulaError(
                f"{problem}; expected {expected}", got=word, expected=expected, position=position
            )
        if kind in ("number", "name") and word not in KEYWORDS:
            found.append(Token(kind, word, position))
        elif kind != "space":
            found.append(Token(_WORDS.get(word, word), word, position))
    return [*found, Token("end", "", len(text))]
