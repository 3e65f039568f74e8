"""The tokens of formula text."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

from specshield.errors import FormulaError
from specshield.stl.formula import KEYWORDS

MAX_LENGTH = 10_000  # characters

_WORDS = {"!": "not", "&": "and", "|": "or", "->": "implies", "always": "G", "eventually": "F", "until": "U"}

_NO_EQUALITY = "a comparison: <, <=, > or >=; for equality a tolerance, such as abs(x - 2) < 0.1"
_UNEQUAL = "a comparison, such as abs(x - 2) > 0.1"
_BOTH_WAYS = "'->' for each direction: (a -> b) and (b -> a)"
_ELSEWHERE = {  # operators of programming languages and of papers, each with what to write instead
    "&&": "'and'", "\N{LOGICAL AND}": "'and'", "/\\": "'and'",
    "||": "'or'", "\N{LOGICAL OR}": "'or'", "\\/": "'or'", "~": "'not'", "\N{NOT SIGN}": "'not'",
    "=>": "'->' between formulas, '>=' between numbers", "\N{RIGHTWARDS ARROW}": "'->'",
    "\N{RIGHTWARDS DOUBLE ARROW}": "'->'", "<->": _BOTH_WAYS, "<=>": _BOTH_WAYS,
    "==": _NO_EQUALITY, "=<": "'<='", "=": _NO_EQUALITY, "!=": _UNEQUAL, "\N{NOT EQUAL TO}": _UNEQUAL,
    "\N{LESS-THAN OR EQUAL TO}": "'<='", "\N{GREATER-THAN OR EQUAL TO}": "'>='", "\N{MINUS SIGN}": "'-'",
    "[]": "'G' with a window", "\N{WHITE SQUARE}": "'G' with a window",
    "<>": f"'F' with a window, or {_UNEQUAL}", "\N{WHITE DIAMOND}": "'F' with a window",
    "\N{LOZENGE}": "'F' with a window", "**": "a product, such as x * x",
    "^": "'and' between formulas, a product such as x * x between numbers",
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
    """The tokens of `text`, the last of kind "end". Raises FormulaError with the position of the mistake."""
    if not isinstance(text, str):
        raise wrong("a formula has to be text", type(text).__name__, "a string", 0)
    if len(text) > MAX_LENGTH:
        most = f"at most {MAX_LENGTH} characters"
        raise wrong(f"the formula has {len(text)} characters", len(text), most, MAX_LENGTH)
    found: list[Token] = []
    for match in _TOKEN.finditer(text):
        kind, word, position = match.lastgroup, match.group(), match.start()
        if kind in ("elsewhere", "other"):
            expected = _ELSEWHERE.get(word, "an operator, a name or a number")
            raise wrong(f"unexpected {word!r} at position {position}", word, expected, position)
        if kind in ("number", "name") and word not in KEYWORDS:
            found.append(Token(kind, word, position))
        elif kind != "space":
            found.append(Token(_WORDS.get(word, word), word, position))
    return [*found, Token("end", "", len(text))]


def wrong(
    problem: str, got: Any, expected: str, position: int, error: type[FormulaError] = FormulaError
) -> FormulaError:
    return error(f"{problem}; expected {expected}", got=got, expected=expected, position=position)
