from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from specshield.errors import FormulaError, HorizonError
from specshield.stl import (
    Abs,
    Always,
    And,
    Arithmetic,
    Atom,
    Comparison,
    Eventually,
    Formula,
    Implies,
    Name,
    Neg,
    Not,
    Number,
    Or,
    Until,
    is_name,
    parse,
)
from specshield.stl.parser import MAX_DEPTH
from tests.stl.formulas import finite, formulas, terms

a, b, c = Atom("a"), Atom("b"), Atom("c")
x, y = Name("x"), Name("y")


@pytest.mark.parametrize(
    ("text", "formula"),
    [
        ("a", a),
        ("((a))", a),
        ("F[0,3] a and b", And((Eventually(0, 3, a), b))),
        ("F[0,3] (a and b)", Eventually(0, 3, And((a, b)))),
        ("a and b or c", Or((And((a, b)), c))),
        ("a or b and c", Or((a, And((b, c))))),
        ("a and b and c", And((a, b, c))),
        ("(a and b) and c", And((And((a, b)), c))),
        ("a or b -> c", Implies(Or((a, b)), c)),
        ("a -> (b -> c)", Implies(a, Implies(b, c))),
        ("not a U[0,2] b", Until(0, 2, Not(a), b)),
        ("F[0,1] a U[0,2] b and c", And((Until(0, 2, Eventually(0, 1, a), b), c))),
        ("a U[1,2] (b U[0,0] c)", Until(1, 2, a, Until(0, 0, b, c))),
        ("not F[0,1] not a", Not(Eventually(0, 1, Not(a)))),
        ("not x > 1", Not(Comparison(">", x, Number(1)))),
        ("G[0,5] x + 1 <= y", Always(0, 5, Comparison("<=", Arithmetic("+", x, Number(1)), y))),
        ("a and F[0,1] x < 1 or b", Or((And((a, Eventually(0, 1, Comparison("<", x, Number(1))))), b))),
        ("x - y - 1 > 0", Comparison(">", Arithmetic("-", Arithmetic("-", x, y), Number(1)), Number(0))),
        ("x - (y - 1) > 0", Comparison(">", Arithmetic("-", x, Arithmetic("-", y, Number(1))), Number(0))),
        ("x + y * 2 >= 0", Comparison(">=", Arithmetic("+", x, Arithmetic("*", y, Number(2))), Number(0))),
        ("x / y * 2 > 0", Comparison(">", Arithmetic("*", Arithmetic("/", x, y), Number(2)), Number(0))),
        ("abs(x - y) < .5", Comparison("<", Abs(Arithmetic("-", x, y)), Number(0.5))),
        ("-x * y > -3", Comparison(">", Arithmetic("*", Neg(x), y), Number(-3))),
        ("x--3>1e-3", Comparison(">", Arithmetic("-", x, Number(-3)), Number(0.001))),
        ("-(3) < x", Comparison("<", Neg(Number(3)), x)),
        ("(x) > (1)", Comparison(">", x, Number(1))),
    ],
)
def test_binding(text: str, formula: object) -> None:
    assert parse(text) == formula


def test_symbols_words_and_spaces_mean_the_same() -> None:
    words = "always[0:4] (not a and b or c implies eventually [1 , 2] (a until[0,3] b))"
    symbols = "G[0,4](!a&b|c->F[1:2](a U[0,3]b))"
    assert parse(words) == parse(symbols)
    assert str(parse(words)) == "G[0,4] (not a and b or c -> F[1,2] (a U[0,3] b))"


def test_the_papers_formulas() -> None:
    phi1 = parse("F[0,60](Charger1 or Charger2) and F[80,140](Charger1 or Charger2)")
    assert str(phi1) == "F[0,60] (Charger1 or Charger2) and F[80,140] (Charger1 or Charger2)"
    assert (phi1.horizon, phi1.names) == (140, ("Charger1", "Charger2"))


@pytest.mark.parametrize(
    ("text", "horizon"),
    [
        ("x > 3", 0),
        ("F[2,3] G[1,5] a", 8),
        ("F[0,3] a and G[1,7] b", 7),
        ("(F[0,4] a) U[2,6] b", 10),
        ("G[0,2] (a -> F[0,9] not b)", 11),
    ],
)
def test_horizon(text: str, horizon: int) -> None:
    assert parse(text).horizon == horizon


@settings(max_examples=300)
@given(formulas(terms(finite), max_leaves=8))
def test_print_and_parse_are_inverse(formula: object) -> None:
    assert parse(str(formula)) == formula
    assert str(parse(str(formula))) == str(formula)


@pytest.mark.parametrize(
    ("text", "position", "expected"),
    [
        ("", 0, "a formula"),
        ("a and", 5, "a formula"),
        ("a b", 2, "an operator or the end"),
        ("(a or b", 7, "')'"),
        ("a)", 1, "the end"),
        ("x < y < 3", 6, "'and' between"),
        ("x > 1 >= 0", 6, "'and' between"),
        ("a -> b -> c", 7, "parentheses"),
        ("a implies b implies c", 12, "parentheses"),
        ("a U[0,1] b U[0,1] c", 11, "parentheses"),
        ("F[3,1] a", 1, "a <= b"),
        ("F[-1,3] a", 2, "not negative"),
        ("F[0,2.5] a", 4, "whole number"),
        ("F[0,1e1] a", 4, "whole number"),
        ("F[0,inf] a", 4, "whole number"),
        ("F[0 3] a", 4, "',' or ':'"),
        ("F[0,3 a", 6, "']'"),
        ("b or G a", 7, "a window"),
        ("F (a)", 2, "a window"),
        ("a U b", 4, "a window"),
        ("a and Zone", 6, "one of GF, a, b, c, x, y"),
        ("F", 1, "a window"),
        ("x + 1", 5, "a comparison"),
        ("x + 1 and b", 6, "a comparison"),
        ("F[0,1] 3", 8, "a comparison"),
        ("(a and b) > 2", 0, "arithmetic"),
        ("1 + (a or b) > 2", 4, "arithmetic"),
        ("x > not a", 4, "arithmetic"),
        ("-F[0,1] a > 2", 1, "arithmetic"),
        ("abs x > 1", 4, "'('"),
        ("abs(a and b) > 1", 4, "arithmetic"),
        ("x == 1", 2, "abs(x - 2) < 0.1"),
        ("x = 1", 2, "<, <=, > or >="),
        ("x != 1", 2, "abs(x - 2) > 0.1"),
        ("x \N{LESS-THAN OR EQUAL TO} 1", 2, "'<='"),
        ("\N{WHITE DIAMOND}[0,1] a", 0, "'F'"),
        ("x % 2 > 1", 2, "an operator, a name or a number"),
        ("x > \N{ARABIC-INDIC DIGIT FOUR}", 4, "an operator, a name or a number"),
        ("a && b", 2, "'and'"),
        ("a and (b||c)", 8, "'or'"),
        ("~a", 0, "'not'"),
        ("a => b", 2, "'->'"),
        ("a ! b", 2, "an operator or the end"),
        ("a AND b", 2, "'and' is written in lower case"),
        ("Not a", 0, "'not' is written in lower case"),
        ("3x > 1", 1, "a comparison"),
        ("x > 1e999", 4, "float64"),
        ("a or U", 5, "a formula"),
        ("a <-> b", 2, "(a -> b) and (b -> a)"),
        ("x => 1", 2, "'>=' between numbers"),
        ("x =< 1", 2, "'<='"),
        ("x <> 1", 2, "abs(x - 2) > 0.1"),
        ("a /\\ b", 2, "'and'"),
        ("x ** 2 < 1", 2, "x * x"),
        ("x > \N{MINUS SIGN}3", 4, "'-'"),
        ("[] a", 0, "'G' with a window"),
        ("Globally[0,3] a", 0, "G, F and U: always, eventually, until"),
        ("alw_[0,3] a", 0, "G, F and U: always, eventually, until"),
        ("a S[0,3] b", 2, "G, F and U: always, eventually, until"),
        ("a iff b", 2, "and, or, -> and U"),
        ("sqrt(x) > 1", 0, "abs, touches and inside"),
        ("F[0,3] inside a", 7, "'inside' takes a region in parentheses"),
        ("F[0,3s] a", 5, "steps without a unit"),
    ],
)
def test_refusals_name_the_place_and_what_was_expected(text: str, position: int, expected: str) -> None:
    with pytest.raises(FormulaError) as caught:
        parse(text, names={"a", "b", "c", "x", "y", "GF"})
    assert caught.value.details["position"] == position
    assert expected in (caught.value.expected or "")
    assert f"at position {position}" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "position", "expected"),
    [
        ("Globally[0,3] a", 8, "G, F and U: always, eventually, until"),
        ("Always[0,3] a", 6, "'always' is written in lower case"),
        ("F[0,3] x(t) > 1", 8, "abs, touches and inside"),
        ("F[0,3] inside a", 14, "'inside' takes a region in parentheses"),
    ],
)
def test_a_word_of_another_language_is_told_where_any_name_would_do(
    text: str, position: int, expected: str
) -> None:
    with pytest.raises(FormulaError) as caught:
        parse(text)
    assert caught.value.details["position"] == position
    assert expected in (caught.value.expected or "")


def test_names_are_free_unless_given() -> None:
    assert parse("Anything > 0").names == ("Anything",)
    assert parse("a and Bedroom_2", names=["a", "Bedroom_2"]).names == ("Bedroom_2", "a")
    with pytest.raises(FormulaError, match="nothing declares 'a'"):
        parse("a", names=[])
    with pytest.raises(FormulaError, match="expected one of b, or a signal that `signals` declares"):
        parse("a", names=["b"])


def test_a_horizon_over_the_limit() -> None:
    assert parse("F[0,1000] a", max_horizon=1000).horizon == 1000
    with pytest.raises(HorizonError, match="1001 steps") as caught:
        parse("b and F[0,1] G[0,1000] a", max_horizon=1000)
    assert (caught.value.got, caught.value.details["position"]) == (1001, 6)
    with pytest.raises(HorizonError):
        parse(f"F[0,{'9' * 5000}] a")


@pytest.mark.parametrize(
    "text",
    [
        "(" * 5000,
        "-" * 5000 + "x > 0",
        "!" * 5000 + "a",
        "abs(" * 2000,
        "touches(" * 1100 + "A" + ")" * 1100,
        "G[0,1]" * 1500 + "a",
        "x" + "+x" * 4000 + " > 0",
        "(a->" * 2000 + "a" + ")" * 2000,
        "a and " * 2000 + "a",
        "x" * 20_000,
        "9" * 9_000 + " > x",
    ],
)
def test_hostile_text_is_a_formula_error(text: str) -> None:
    with pytest.raises(FormulaError) as caught:
        parse(text)
    assert len(str(caught.value)) < 300


@settings(max_examples=300)
@given(st.text("abxFGU[]()0123,:.<>=-+*/!&| e", max_size=40) | st.text(max_size=20))
def test_any_text_is_a_formula_or_a_formula_error(text: str) -> None:
    try:
        formula = parse(text)
    except FormulaError as error:
        position = error.details["position"]
    else:
        position = 0
        assert parse(str(formula)) == formula
    assert 0 <= position <= len(text)


def test_the_deepest_formula_there_is_prints_and_parses() -> None:
    deep: Formula = a
    for _ in range(MAX_DEPTH - 1):
        deep = Implies(b, deep)
    assert parse(str(deep)) == deep
    with pytest.raises(FormulaError, match="too deep"):
        parse(str(Not(deep)))


def test_nodes_that_would_not_print_back_are_refused() -> None:
    for make in (
        lambda: Atom("F"),
        lambda: Name("my region"),
        lambda: Number(float("nan")),
        lambda: And((a,)),
        lambda: Always(2, 1, a),
        lambda: Until(-1, 1, a, b),
        lambda: Eventually(0, 1.5, a),  # type: ignore[arg-type]
    ):
        with pytest.raises(FormulaError):
            make()
    assert is_name("Bedroom_2")
    assert not any(map(is_name, ("until", "2nd", "", "a b", "a\n", "é")))
