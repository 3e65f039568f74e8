"""Signal Temporal Logic over discrete time: text, robustness, bounds on prefixes, conjunctions."""

from specshield.stl.conjunction import conjuncts
from specshield.stl.formula import (
    BODY_WORDS,
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
    Node,
    Not,
    Number,
    Or,
    Term,
    Until,
    body_name,
    is_name,
    region_named,
)
from specshield.stl.parser import parse
from specshield.stl.robustness import SATISFIED_ABOVE, Verdict, robustness, robustness_bounds, verdict
