"""The values of signals that ask the most of a robot, so that what is kept under them is kept under any.

A rule such as `G[0,100] (event > 0.5 -> F[0,60] Dock)` asks for nothing while there is no event. It asks for
the most if there is one at every step. In general, each part of a formula that reads signals alone helps the
formula either by being true or by being false. At the worst values no such part helps. Then a trajectory that
satisfies the formula does so by its poses and its past alone, and therefore satisfies it whatever the signals
do: rho is made of minima and maxima of the parts, and no part at or below 0 makes it positive.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice, pairwise, product

import numpy as np

from specshield.arrays import Floats
from specshield.errors import SampleError
from specshield.stl import SATISFIED_ABOVE, Comparison, Formula, Implies, Node, Not, Number, robustness
from specshield.task import Task, kept_with_task

MOST_TRIED = 4096  # combinations of values, for signals that are read together. Chosen by hand


@kept_with_task
def worst_signals(task: Task) -> Floats | None:
    """The worst values [1, S], in the order of `task.signals`, each held for ever.

    None if the formula reads no signals, or no such values were found: it compares signals with the pose, or
    has parts that are not at their worst together.
    """
    found = list(_parts(task.formula, frozenset(task.signals), True))
    parts = [part for part in found if part is not None]
    if not task.signals or len(parts) < len(found):
        return None
    held, left = dict(task.signals), set(task.signals)
    while left:
        group = {left.pop()}
        while True:  # the values of signals that are read together are chosen together
            asked = [part for part in parts if group & set(part[0].names)]
            names = group.union(*(part[0].names for part in asked))
            if names == group:
                break
            group = names
        left -= group
        worst = next((each for each in _values(asked, sorted(group)) if _at_worst(asked, each)), None)
        if worst is None:
            return None
        held |= worst
    return np.array([[held[name] for name in task.signals]])


def _parts(node: Node, signals: frozenset[str], helps: bool) -> Iterator[tuple[Formula, bool] | None]:
    """The parts that read signals alone and no other step, each with whether being true helps the formula;
    None for a comparison of signals with the pose.
    """
    if not signals & set(node.names):
        return
    if isinstance(node, Formula) and signals >= set(node.names) and node.horizon == 0:
        yield node, helps
    elif isinstance(node, Comparison):
        yield None
    else:
        for i, part in enumerate(node.parts):
            turned = isinstance(node, Not) or (isinstance(node, Implies) and i == 0)
            yield from _parts(part, signals, helps is not turned)


def _values(parts: list[tuple[Formula, bool]], names: list[str]) -> Iterator[dict[str, float]]:
    """Values to try: below, between and above the numbers that the parts compare with."""
    numbers = sorted({0.0}.union(*(_numbers(part) for part, _ in parts)))
    between = [0.5 * (low + high) for low, high in pairwise(numbers)]
    tried = [numbers[-1] + 1.0, numbers[0] - 1.0, *between]
    for chosen in islice(product(tried, repeat=len(names)), MOST_TRIED):
        yield dict(zip(names, chosen, strict=True))


def _numbers(node: Node) -> set[float]:
    own = {node.value, -node.value} if isinstance(node, Number) else set[float]()
    return own.union(*(_numbers(part) for part in node.parts))


def _at_worst(parts: list[tuple[Formula, bool]], values: dict[str, float]) -> bool:
    """Whether none of the parts helps at these values."""
    samples = {name: np.array([value]) for name, value in values.items()}
    try:
        helping = (robustness(part, samples) * (1.0 if helps else -1.0) for part, helps in parts)
        return not any(value > SATISFIED_ABOVE for value in helping)
    except SampleError:
        return False
