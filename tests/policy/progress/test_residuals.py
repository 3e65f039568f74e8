"""What can still be kept of a broken formula."""

from __future__ import annotations

import numpy as np
import pytest

from specshield.policy.progress import residuals
from specshield.stl import parse


def left(formula, *xs):
    """The residuals as text after samples of x; `y` never moves from 1."""
    tree = parse(formula)
    prefix = {"x": np.array(xs, float), "y": np.ones(len(xs))}
    return [str(f) for f in residuals(tree, {n: prefix[n] for n in tree.names}, len(xs) - 1)]


def texts(*formulas):
    return [str(parse(f)) for f in formulas]


@pytest.mark.parametrize(
    ("formula", "xs", "expected"),
    [
        ("F[0,2] x and F[3,9] x", [-1, -1, -1], ["F[3,9] x"]),
        ("F[0,2] x and F[3,9] x and G[0,9] y", [-1, -1, -1], ["F[3,9] x and G[0,9] y"]),
        ("F[0,2] x", [-1, -1, -1], []),
        ("G[0,9] x and F[0,9] y", [1, 1, -1], ["F[0,9] y and G[3,9] x", "F[0,9] y"]),
        ("G[5,9] x", [1, 1, 1, 1, 1, -1], ["G[6,9] x"]),
        ("G[0,9] not x", [-1, 1], ["G[2,9] not x"]),
        ("not F[0,9] x", [-1, 1], ["G[2,9] not x"]),
        ("not (F[0,9] x or G[0,9] y)", [-1, 1], ["F[0,9] not y and G[2,9] not x", "F[0,9] not y"]),
        ("G[0,1] x and F[0,9] y", [1, -1], ["F[0,9] y"]),  # its window is over
        ("(G[0,9] x and F[1,2] y) and G[0,3] y", [-1],
         ["F[1,2] y and G[0,3] y and G[1,9] x", "F[1,2] y and G[0,3] y"]),
        ("F[0,2] G[0,3] x and G[0,9] y", [1, -1, 1, -1], ["G[0,9] y"]),
        ("G[0,9] x and G[0,9] y > 2", [-1], ["G[1,9] x and G[1,9] y > 2"]),
        ("G[0,5] 0 > 1", [0, 0], []),  # never to be kept
    ],
)  # fmt: skip
def test_by_hand(formula, xs, expected):
    assert left(formula, *xs) == texts(*expected)
