"""What a prefix leaves of a formula that it violates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from specshield.arrays import Floats
from specshield.stl import Always, And, Formula, conjuncts, verdict


def left_over(formula: Formula, prefix: Mapping[str, Floats], t: int) -> tuple[list[Formula], list[Always]]:
    """The conjuncts that can still be kept, and the broken G that can be enforced again from step t + 1."""
    kept: list[Formula] = []
    broken: list[Always] = []
    for conjunct in conjuncts(formula):
        if verdict(conjunct, prefix) != "violated":
            kept.append(conjunct)
        elif isinstance(conjunct, Always) and conjunct.horizon > t:
            broken += [conjunct] if verdict(again([conjunct], t + 1)[0], prefix) != "violated" else []
    return kept, broken


def again(broken: Sequence[Always], t: int, early: int = 0) -> list[Formula]:
    """The broken G whose horizon reaches step t, each enforced from step t on, at its last step at least.
    early: begin so many steps sooner, but not where the child looks only at steps before t.
    """
    first = [max(each.a, t - min(early, each.child.horizon)) for each in broken]
    ways = zip(first, broken, strict=True)
    return [Always(min(a, each.b), each.b, each.child) for a, each in ways if each.horizon >= t]


def all_of(parts: Sequence[Formula]) -> Formula:
    """The conjunction of at least one formula."""
    return parts[0] if len(parts) == 1 else And(tuple(parts))
