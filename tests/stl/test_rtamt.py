"""Agreement with rtamt's offline discrete-time monitor on the vectors that rtamt_vectors.py wrote."""

from __future__ import annotations

import gzip
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from specshield import stl
from specshield.stl.formula import Node

DATA = Path(__file__).parent / "data" / "rtamt.json.gz"
VECTORS = json.loads(gzip.decompress(DATA.read_bytes()))["vectors"]


def test_every_vector_agrees() -> None:
    for vector in VECTORS:
        formula = stl.parse(vector["formula"])
        assert formula.horizon == vector["horizon"]
        assert stl.robustness(formula, vector["samples"]) == pytest.approx(
            vector["robustness"], rel=0, abs=1e-9
        ), vector["formula"]


def test_at_least_300_formulas_cover_every_operator() -> None:
    assert len({vector["formula"] for vector in VECTORS}) >= 300
    used = Counter(kind for vector in VECTORS for kind in set(_kinds(stl.parse(vector["formula"]))))
    operators = {"Always", "Eventually", "Until", "And", "Or", "Not", "Implies", "Atom", "Abs", "Neg"}
    for kind in operators | set("+-*/") | {"<", "<=", ">", ">="}:
        assert used[kind] >= 25, (kind, used)


def _kinds(node: Node) -> Iterator[str]:
    yield node.op if isinstance(node, stl.Comparison | stl.Arithmetic) else type(node).__name__
    for part in node.parts:
        yield from _kinds(part)
