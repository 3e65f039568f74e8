"""Narrow predicates, which a lattice can hardly see: places between its crossings, ranges of headings between
its headings.

Tables are made on crossings. A dock smaller than a cell, or a heading that no crossing has, holds at none of
them, and the tables would say that nothing leads there. So such a predicate counts as kept wherever it holds
within about half a cell and half a heading: the tables lead near, and the rest of the way is searched for in
exact poses (narrow.py).
"""

from __future__ import annotations

import math

import numpy as np

from specshield.arrays import Bools, Bytes, Floats, pooled
from specshield.compiled import kernel
from specshield.policy.lattice import Lattice, pose_of
from specshield.policy.progress import ALWAYS, Rules, read_predicates, value_count
from specshield.robot.dynamics import Body
from specshield.rule.values import HEADING, REGIONS
from specshield.stl.program import STACK_SIZE, VALUE

# Chosen by hand. A crossing is at most 0.71 cells from any place.
BESIDE = 0.75  # [cells] by which a place may be missed
GRAIN = math.radians(1.5)  # [rad] between the headings that are looked at: ranges of 2 degrees are seen
CELLS_ABOUT, HEADINGS_ABOUT = 3, 2  # the lattice sees a predicate this near to a pose that is well inside it


def look_closely(body: Body, rules: Rules, lattice: Lattice, holds: Bytes) -> tuple[Bytes, Bools]:
    """`holds`, in which narrow predicates also hold near to where they do, and which obligations have such a
    predicate [K].

    holds [K, ny, nx, H]: of `holds_at`. An `always` counts as narrow only if it holds well inside nowhere: a
    gap beside a forbidden place is not a place to lead a robot to. A predicate that reads signals alone is
    never narrow: no motion leads nearer to it.
    """
    narrow = np.zeros(len(rules.kind), np.bool_)
    for k in range(len(rules.kind)):
        outer, inner = _views(body, rules, lattice, k)
        if not any(reads(rules, k)) or (rules.kind[k] == ALWAYS and inner.any()):
            continue
        missed = outer & ~about(inner) & (lattice.valid == 1)
        if missed.any():
            narrow[k] = True
            holds = holds.copy() if not narrow[:k].any() else holds
            holds[k] |= missed
    return holds, narrow


def _views(body: Body, rules: Rules, lattice: Lattice, k: int) -> tuple[Bools, Bools]:
    """Where predicate k holds somewhere about a pose of the lattice, and where it holds well all about it.

    Shape [ny, nx, H]; 1 in place of ny and nx where it does not read the place, in place of H where it does
    not read the heading.
    """
    place, heading, turned = reads(rules, k)
    headings = lattice.headings
    unit = 2.0 * math.pi / headings
    samples = 2 * math.ceil(0.5 * unit / GRAIN) + 1 if heading else 1
    spread = np.linspace(-0.5, 0.5, samples) if heading else np.zeros(1)
    free = np.any(lattice.valid, axis=2) if place else np.ones((1, 1), np.bool_)
    looked = headings if heading or turned else 1
    return look(body, rules, k, lattice.pitch, looked, free, spread, BESIDE * lattice.pitch)


def reads(rules: Rules, k: int) -> tuple[bool, bool, bool]:
    """Whether predicate k reads the place; its heading; areas that turn with the robot."""
    code = slice(int(rules.programs.starts[k]), int(rules.programs.starts[k + 1]))
    read = rules.programs.args[code][rules.programs.ops[code] == VALUE].astype(int)
    areas = [p - REGIONS for p in read if REGIONS <= p < REGIONS + len(rules.regions.plain)]
    place = bool(areas) or bool(np.any(read < HEADING))
    return place, bool(np.any(read == HEADING)), bool(np.any(rules.regions.carried[areas, :2] != 0.0))


@kernel
def look(
    body: Body, rules: Rules, k: int, pitch: float, headings: int, free: Bools, spread: Floats, beside: float
) -> tuple[Bools, Bools]:
    """For each pose of a lattice over the cells `free` [ny, nx], whether predicate k holds somewhere within
    `beside` [m] of it, and whether it holds by as much all about it, [ny, nx, headings].

    spread: the headings that are looked at about each, as shares of the way to the next.
    """
    outer, inner = np.zeros((*free.shape, headings), np.bool_), np.zeros((*free.shape, headings), np.bool_)
    values, stack, out = np.empty(value_count(rules)), np.empty(STACK_SIZE), np.empty(rules.kind.shape[0])
    for j in range(outer.shape[0]):
        for i in range(outer.shape[1]):
            if not free[j, i]:
                continue
            for h in range(outer.shape[2]):
                least, most = np.inf, -np.inf
                for s in range(spread.shape[0]):
                    x, y, theta = pose_of(body, pitch, headings, j, i, h + spread[s])
                    read_predicates(rules, x, y, theta, values, stack, out)
                    least, most = min(least, out[k]), max(most, out[k])
                outer[j, i, h] = most > rules.margin - beside
                inner[j, i, h] = least > rules.margin + beside
    return outer, inner


def about(inner: Bools) -> Bools:
    """Where some pose of `inner` is at most CELLS_ABOUT cells and HEADINGS_ABOUT headings away."""
    return pooled(cells_about(inner, CELLS_ABOUT), np.logical_or, HEADINGS_ABOUT, 2, mode="wrap")


def cells_about(inner: Bools, reach: int) -> Bools:
    """The cells [ny, nx, ...] that have one of `inner` at most `reach` cells away along both axes."""
    return pooled(pooled(inner, np.logical_or, reach, 0), np.logical_or, reach, 1)
