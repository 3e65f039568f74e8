"""What a formula asks of signals alone, and the values of signals that ask the most of a robot.

A rule such as `G[0,100] (event > 0.5 -> F[0,60] Dock)` asks for the most if there is an event at every step.
In general, each part of a formula that reads signals alone helps the formula either by being true or by being
false. At the worst values no such part helps. Then a trajectory that satisfies the formula does so by its
poses and its past alone, and so it satisfies it whatever the signals do: rho is made of minima and maxima of
the parts, and no part at or below 0 makes it positive.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice, pairwise, product

import numpy as np

from specshield.arrays import Floats
from specshield.caution.residual import all_of
from specshield.errors import SampleError
from specshield.stl import SATISFIED_ABOVE, Always, Comparison, Formula, Not, Number, conjuncts, robustness
from specshield.stl.formula import Implies, Node
from specshield.task import Task, kept_with_task

MOST_TRIED = 4096  # combinations of values, for signals that are read together. Chosen by hand
FAR = 1e12  # beyond every number that a multiple of a signal, such as 0.1 * battery, is compared with


def alone(task: Task, part: Node) -> bool:
    """Whether a part of a formula reads signals alone, so that no motion changes it."""
    return set(part.names) <= task.signals.keys()


@kept_with_task
def moved(task: Task) -> tuple[Formula, Formula | None]:
    """The part of the task's formula that motions change, and the part that reads signals alone: the formula
    is their conjunction. The formula itself and None if it has no such two parts.
    """
    parts = apart(task.formula)
    fixed = [part for part in parts if alone(task, part)]
    rest = [part for part in parts if part not in fixed]
    return (all_of(rest), all_of(fixed)) if rest and fixed else (task.formula, None)


def apart(formula: Formula) -> list[Formula]:
    """The conjuncts of a formula, those of what a G asks for each under a G of its own."""
    found = list[Formula]()
    for part in conjuncts(formula):
        if isinstance(part, Always):
            found += [Always(part.a, part.b, each) for each in conjuncts(part.child)]
        else:
            found.append(part)
    return found


@kept_with_task
def worst_signals(task: Task, formula: Formula) -> Floats | None:
    """The worst values [1, S] for the task's formula or a part of it, in the order of `task.signals`, each
    held for ever. A signal that it does not read has its initial value.

    None if the task has no signals, or no such values were found: the formula compares signals with the pose,
    or has parts that are not at their worst together.
    """
    found = list(_parts(task, formula, True))
    parts = [part for part in found if part is not None]
    if not task.signals or len(parts) < len(found):
        return None
    held, groups = dict(task.signals), list[set[str]]()
    for part, _ in parts:  # the values of signals that are read together are chosen together
        read = [group for group in groups if group & set(part.names)]
        groups = [*(group for group in groups if group not in read), set(part.names).union(*read)]
    for group in groups:
        asked = [part for part in parts if group & set(part[0].names)]
        worst = next((each for each in _values(asked, sorted(group)) if _at_worst(asked, each)), None)
        if worst is None:
            return None
        held |= worst
    return np.array([[held[name] for name in task.signals]])


def _parts(task: Task, node: Node, helps: bool) -> Iterator[tuple[Formula, bool] | None]:
    """The parts that read signals alone and no other step, each with whether being true helps the formula;
    None for a comparison of signals with the pose.
    """
    if task.signals.keys().isdisjoint(node.names):
        return
    if isinstance(node, Formula) and alone(task, node) and node.horizon == 0:
        yield node, helps
    elif isinstance(node, Comparison):
        yield None
    else:
        for i, part in enumerate(node.parts):
            turned = isinstance(node, Not) or (isinstance(node, Implies) and i == 0)
            yield from _parts(task, part, helps is not turned)


def _values(parts: list[tuple[Formula, bool]], names: list[str]) -> Iterator[dict[str, float]]:
    """Values to try: below, between and above the numbers that the parts compare with, and far from them."""
    numbers = sorted({0.0}.union(*(_numbers(part) for part, _ in parts)))
    between = [0.5 * (low + high) for low, high in pairwise(numbers)]
    tried = [numbers[-1] + 1.0, numbers[0] - 1.0, *between, FAR, -FAR]
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
