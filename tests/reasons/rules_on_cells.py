"""Rules on cells, each written as a formula and again on booleans."""

import numpy as np

from tests.oracles.cells import Cells


def until(end):
    """not B U[0,end] A, and no more."""

    def keeps(inside):
        first = np.where(inside["A"].any(axis=-1), inside["A"].argmax(axis=-1), 99)
        broken = np.where(inside["B"].any(axis=-1), inside["B"].argmax(axis=-1), 99)
        return (first <= end) & (broken >= first)

    return Cells(f"not B U[0,{end}] A", keeps, {"A": (2, 0), "B": (1, 0)})


def dwells(begin):
    """G[begin,5] A."""
    return Cells(f"G[{begin},5] A", lambda inside: inside["A"][..., begin:6].all(axis=-1), {"A": (2, 0)})


def visits(parts, places):
    """parts: (operator, from, to, place): F reaches a place, G keeps out of it. places: the cell of each. The
    rule, and its conjuncts as the formula prints them.
    """

    def keeps(inside):
        kept = True
        for op, a, b, place in parts:
            window = inside[place][..., a : b + 1]
            kept = kept & (window.any(axis=-1) if op == "F" else ~window.any(axis=-1))
        return kept

    told = [f"{op}[{a},{b}] {place if op == 'F' else f'not {place}'}" for op, a, b, place in parts]
    return Cells(" and ".join(told), keeps, {place: places[place] for *_, place in parts}), told
