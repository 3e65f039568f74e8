"""How a policy stands against signals: whether what they may call for stays within its reach.

A rule as `G[0,100] (event > 0.5 -> F[0,60] Dock)` asks for nothing while the event stays away, and J takes
signals to hold their last value. So a share of feasible starts that assumes silence says little. Here the
signals rise: at every so many steps of the way that the policy goes in silence.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from specshield.arrays import Floats
from specshield.shield.decision import Shield
from specshield.shield.explanation import driven, samples_of, values_of
from specshield.shield.proposal import Proposer
from specshield.stl import SATISFIED_ABOVE, Formula, Implies, Node, Number, robustness

MOMENTS = 10  # of one way at which the signals are tried to rise. Chosen by hand


def calls(policy: Proposer) -> list[dict[str, float]]:
    """The values of signals at which some antecedent of the formula begins to ask for something."""
    task, found = policy.task, list[dict[str, float]]()
    for part in _nodes(task.formula):
        if not isinstance(part, Implies) or not set(part.left.names) <= set(task.signals):
            continue
        numbers = [node.value for node in _nodes(part.left) if isinstance(node, Number)]
        for value in (shifted for number in numbers or [0.0] for shifted in (number + 1.0, number - 1.0)):
            raised = {**task.signals, **dict.fromkeys(part.left.names, value)}
            if not _holds(part.left, task.signals) and _holds(part.left, raised) and raised not in found:
                found.append(raised)
                break
    return found


def withstands(shield: Shield, policy: Proposer, pose: Floats) -> bool:
    """Whether the way that the policy goes from a pose in silence lets the rule be kept if a call comes."""
    task = policy.task
    silent = {name: np.array([value]) for name, value in task.signals.items()}
    way = _kept(shield, policy, pose[None], silent)
    if way is None:
        return False
    moments = np.unique(np.linspace(0, task.horizon - 1, MOMENTS).astype(int))
    for raised in calls(policy):
        for t in moments.tolist():
            risen = {name: np.append(np.full(t, task.signals[name]), value) for name, value in raised.items()}
            if _kept(shield, policy, way[: t + 1], risen) is None:
                return False
    return True


def _kept(shield: Shield, policy: Proposer, history: Floats, signals: Mapping[str, Floats]) -> Floats | None:
    """The poses of a proposed future that satisfies the formula, from x_0 on; None where there is none."""
    proposed = policy.propose(history.copy(), {n: v.copy() for n, v in signals.items()}, 0.0).motions
    values = values_of(policy.task.formula, samples_of(shield, history, signals, proposed))
    best = int(np.argmax(values))
    if not values[best] > SATISFIED_ABOVE:
        return None
    found: Floats = driven(shield, history, proposed[best : best + 1])[0]
    return found


def _holds(antecedent: Formula, signals: Mapping[str, float]) -> bool:
    samples = {name: np.array([signals[name]]) for name in antecedent.names}
    return antecedent.horizon == 0 and bool(robustness(antecedent, samples) > SATISFIED_ABOVE)


def _nodes(node: Node) -> Iterator[Node]:
    yield node
    for part in node.parts:
        yield from _nodes(part)
