"""From text to formula, by precedence climbing.

    formula    = implies
    implies    = or  [ ("->" | "implies") or ]                     not associative: parenthesise a chain
    or         = and { ("or" | "|") and }
    and        = until { ("and" | "&") until }
    until      = prefix [ ("U" | "until") window prefix ]          not associative: parenthesise a chain
    prefix     = ("not" | "!") prefix
               | ("G" | "always" | "F" | "eventually") window prefix
               | comparison
    comparison = sum ("<" | "<=" | ">" | ">=") sum                 not associative: comparisons do not chain
               | name                                              as a truth value: name > 0
               | "(" formula ")"
    sum        = product { ("+" | "-") product }
    product    = factor { ("*" | "/") factor }
    factor     = "-" factor | number | name | "abs" "(" sum ")" | "(" sum ")"
    window     = "[" bound ("," | ":") bound "]"                   whole steps, 0 <= a <= b
    name       = word
               | ("touches" | "inside") "(" word ")"               how the robot's footprint lies to a region
    word       = letter or "_", then letters, digits, "_"; not a keyword

So `F[0,3] a and b` is `(F[0,3] a) and b`, and `not a > 0` is `not (a > 0)`. `-3` is one number.

Text is at most MAX_LENGTH characters long and a formula at most MAX_DEPTH nodes deep, so hostile text is an
error here and never a stack overflow in the code that later walks the formula.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import TypeVar

from specshield.errors import FormulaError, HorizonError
from specshield.stl import formula as nodes
from specshield.stl.formula import BODY_WORDS, KEYWORDS, MAX_BOUND, Formula, Name, Node, Term
from specshield.stl.tokens import Token, tokens, wrong

MAX_DEPTH = 64  # nodes on the longest way down; a hand-written formula has about 6

_BINDING = {
    "implies": nodes.IMPLIES,
    "or": nodes.OR,
    "and": nodes.AND,
    "U": nodes.UNTIL,
    **dict.fromkeys(("<", "<=", ">", ">="), nodes.COMPARISON),
    **dict.fromkeys("+-", nodes.SUM),
    **dict.fromkeys("*/", nodes.PRODUCT),
}
_NO_CHAIN = {
    nodes.IMPLIES: ("implications", "parentheses around one of them"),
    nodes.UNTIL: ("untils", "parentheses around one of them"),
    nodes.COMPARISON: ("comparisons", "'and' between two of them"),
}

_HINTS = {  # for a word that is no operator, by what follows it
    "[": "; with a window there are G, F and U: always, eventually, until",
    "(": "; with parentheses there are abs, touches and inside",
}

_N = TypeVar("_N", bound=Node)


def parse(text: str, names: Collection[str] | None = None, max_horizon: int | None = None) -> Formula:
    """The formula that `text` spells.

    names: what the formula may name; None allows every name. max_horizon: in steps; None sets no limit.
    Raises FormulaError with `position`, the offset of the mistake in the text, and HorizonError (a kind of
    FormulaError) if the horizon exceeds the limit.
    """
    return _Parser(text, names, max_horizon).formula()


class _Parser:
    def __init__(self, text: str, names: Collection[str] | None, max_horizon: int | None) -> None:
        self._names, self._max_horizon = names, max_horizon
        self._tokens = tokens(text)
        self._index = 0
        self._nesting = 0

    def formula(self) -> Formula:
        formula = self._as_formula(self._expression(nodes.IMPLIES))
        if self._token.kind != "end":
            raise self._unexpected("an operator or the end; between formulas there are and, or, -> and U")
        return formula

    @property
    def _token(self) -> Token:
        return self._tokens[self._index]

    def _next(self) -> Token:
        self._index += 1
        return self._tokens[self._index - 1]

    def _take(self, kind: str, expected: str) -> Token:
        if self._token.kind != kind:
            raise self._unexpected(expected)
        return self._next()

    def _expression(self, binding: int) -> Node:
        """The longest expression from here whose operators bind at least as tight as `binding`."""
        self._nesting += 1
        if self._nesting > 2 * MAX_DEPTH + 1:  # a node prints as at most two levels: parentheses and operand
            raise self._too_deep(self._token)
        start = self._token.position
        left = self._operand()
        while (level := _BINDING.get(self._token.kind, 0)) >= binding:
            left = self._infix(left, start, level)
            if level in _NO_CHAIN and _BINDING.get(self._token.kind) == level:
                problem, expected = _NO_CHAIN[level]
                raise self._error(f"{problem} do not chain", self._token, expected)
        self._nesting -= 1
        return left

    def _operand(self) -> Node:
        token = self._next()
        match token.kind:
            case "number":
                return self._number(token, sign=1.0)
            case "name":
                return self._name(token)
            case "(":
                inner = self._expression(nodes.IMPLIES)
                self._take(")", "')' or an operator")
                return inner
            case "-":
                if self._token.kind == "number":
                    return self._number(self._next(), sign=-1.0)
                return self._made(nodes.Neg(self._term(nodes.NEGATION)), token)
            case "abs":
                self._take("(", "'(' after abs")
                child = self._term(nodes.IMPLIES)
                self._take(")", "')' or an operator")
                return self._made(nodes.Abs(child), token)
            case "not":
                return self._made(nodes.Not(self._subformula(nodes.PREFIX)), token)
            case "G" | "F":
                a, b = self._window(token)
                make = nodes.Always if token.kind == "G" else nodes.Eventually
                return self._made(make(a, b, self._subformula(nodes.PREFIX)), token)
            case _:
                self._index -= 1
                raise self._unexpected("a formula, a name or a number")

    def _infix(self, left: Node, start: int, level: int) -> Node:
        token, kind = self._token, self._token.kind
        if level in (nodes.COMPARISON, nodes.SUM, nodes.PRODUCT):
            make: Callable[..., Node] = nodes.Comparison if level == nodes.COMPARISON else nodes.Arithmetic
            term = self._as_term(left, start)
            self._next()
            return self._made(make(kind, term, self._term(level + 1)), token)
        first = self._as_formula(left)
        self._next()
        if kind == "U":
            a, b = self._window(token)
            return self._made(nodes.Until(a, b, first, self._subformula(level + 1)), token)
        parts = [first, self._subformula(level + 1)]
        if kind == "implies":
            return self._made(nodes.Implies(*parts), token)
        while self._token.kind == kind:
            self._next()
            parts.append(self._subformula(level + 1))
        return self._made((nodes.And if kind == "and" else nodes.Or)(tuple(parts)), token)

    def _subformula(self, binding: int) -> Formula:
        return self._as_formula(self._expression(binding))

    def _term(self, binding: int) -> Term:
        start = self._token.position
        return self._as_term(self._expression(binding), start)

    def _as_formula(self, node: Node) -> Formula:
        if isinstance(node, Name):
            return nodes.Atom(node.name)
        if not isinstance(node, Formula):
            problem = f"'{_clip(str(node))}' is a number, not true or false"
            raise self._error(problem, self._token, "a comparison (< <= > >=)")
        return node

    def _as_term(self, node: Node, start: int) -> Term:
        if not isinstance(node, Term):
            problem = f"'{_clip(str(node))}' is true or false, not a number"
            raise self._error(problem, Token("", str(node), start), "arithmetic over names and numbers")
        return node

    def _number(self, token: Token, sign: float) -> nodes.Number:
        value = sign * float(token.text)
        if not math.isfinite(value):
            raise self._error(f"'{_clip(token.text)}' is too large", token, "a number that a float64 holds")
        return nodes.Number(value)

    def _name(self, token: Token) -> Name:
        if self._token.kind == "(" and token.text in BODY_WORDS:
            return self._body_name(token)
        if self._names is not None and token.text not in self._names:
            known = sorted(name for name in self._names if "(" not in name)
            more = f" and {len(known) - 20} more" if len(known) > 20 else ""
            declared = f"one of {', '.join(known[:20])}{more}, or a signal that `signals` declares"
            expected = declared if known else "no names at all"
            expected += _hint(token, self._token)
            raise self._error(f"nothing declares '{_clip(token.text)}'", token, expected)
        return Name(token.text)

    def _body_name(self, word: Token) -> Name:
        """`touches(R)` or `inside(R)`: `names` holds them for every region."""
        self._next()
        region = self._take("name", f"the name of a region after '{word.text}('")
        self._take(")", f"')' after the region of '{word.text}'")
        name = nodes.body_name(word.text, region.text)
        if self._names is not None and name not in self._names:
            raise self._error(f"'{_clip(region.text)}' is not a region", region, self._regions())
        return Name(name)

    def _regions(self) -> str:
        """What is valid where a region is meant, in words."""
        named = (nodes.region_named(name) for name in self._names or ())
        own = sorted({region for how, region in named if how is not None})
        return f"one of {', '.join(own[:20])}" if own else "a region or a room of the map; there are none"

    def _window(self, operator: Token) -> tuple[int, int]:
        opening = self._take("[", f"a window such as [0,10]: '{operator.text}' has to be bounded")
        a = self._bound()
        if self._token.kind not in (",", ":"):
            raise self._unexpected("',' or ':' between the window's bounds")
        self._next()
        b = self._bound()
        self._take("]", "']' after the window's bounds, which are steps without a unit")
        if a > b:
            problem = f"the window [{a},{b}] is empty at position {opening.position}"
            raise wrong(problem, [a, b], "a <= b", opening.position)
        return a, b

    def _bound(self) -> int:
        token = self._take("number", "a window bound, a whole number of steps, not negative")
        if not token.text.isdigit():
            problem = f"'{_clip(token.text)}' is not a window bound"
            raise self._error(problem, token, "a whole number of steps")
        digits = token.text.lstrip("0") or "0"
        if len(digits) > len(str(MAX_BOUND)) or int(digits) > MAX_BOUND:
            problem = f"a window bound of {_clip(digits)} steps"
            raise self._error(problem, token, f"at most {MAX_BOUND} steps", HorizonError)
        return int(digits)

    def _made(self, node: _N, token: Token) -> _N:
        if node.depth > MAX_DEPTH:
            raise self._too_deep(token)
        limit = self._max_horizon
        if limit is not None and isinstance(node, Formula) and node.horizon > limit:
            problem = f"this looks {node.horizon} steps ahead at position {token.position}"
            raise wrong(problem, node.horizon, f"at most {limit} steps", token.position, HorizonError)
        return node

    def _too_deep(self, token: Token) -> FormulaError:
        return self._error("the nesting is too deep", token, f"at most {MAX_DEPTH} levels")

    def _unexpected(self, expected: str) -> FormulaError:
        token = self._token
        if token.kind == "end":
            return self._error("the text ends", token, expected)
        before, after = self._tokens[max(self._index - 1, 0)], self._tokens[self._index + 1]
        hint = _hint(token, after) or _hint(before, token)
        return self._error(f"unexpected '{_clip(token.text)}'", token, expected + hint)

    def _error(
        self, problem: str, token: Token, expected: str, error: type[FormulaError] = FormulaError
    ) -> FormulaError:
        told = f"{problem} at position {token.position}"
        return wrong(told, _clip(token.text), expected, token.position, error)


def _hint(word: Token, following: Token) -> str:
    """What to add to an error about a word such as AND, or an operator of another language."""
    lower = word.text.lower()
    if lower != word.text and lower in KEYWORDS:
        return f"; '{lower}' is written in lower case"
    if word.text in BODY_WORDS:
        return f"; '{word.text}' takes a region in parentheses"
    return _HINTS.get(following.kind, "") if word.kind == "name" else ""


def _clip(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."
