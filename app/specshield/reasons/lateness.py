"""What a future says of one conjunct: its robustness, how late it comes, and in words what fails and when."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from specshield.arrays import Bools, Floats, Ints
from specshield.errors import SampleError
from specshield.robot.dynamics import simulate
from specshield.shield.decision import Shield
from specshield.stl import SATISFIED_ABOVE, Always, Eventually, Formula, Implies, Until, robustness
from specshield.stl.conjunction import is_predicate


def driven(shield: Shield, history: Floats, motions: Ints) -> Floats:
    """The poses [n, t + 1 + m, 3]: x_0..x_t, then where each row of motions [n, m] leads."""
    poses = np.empty((len(motions), len(history) + motions.shape[1], 3))
    poses[:, : len(history)] = history
    for row, joined in zip(motions, poses, strict=True):
        simulate(shield.body, history[-1], np.ascontiguousarray(row, np.int64), joined[len(history) :])
    return poses


def values_of(formula: Formula, samples: Mapping[str, Floats], unknown: float = -np.inf) -> Floats:
    """rho along each trajectory; `unknown` on all if the formula's arithmetic is not finite on one."""
    some = next(iter(samples.values()))
    try:
        return np.broadcast_to(robustness(formula, {n: samples[n] for n in formula.names}), some.shape[:-1])
    except SampleError:
        return np.full(some.shape[:-1], unknown)


def late_by(part: Formula, samples: Mapping[str, Floats], now: int) -> int | None:
    """By how many steps, at least, the window of an F or U would have to end later for the conjunct to be
    satisfied, or that of a G over a predicate would have to begin later. None if nothing that the samples [m]
    reach is enough, or the G has begun by step `now`.
    """
    if later(part, 1) is None or not may_be_late(part, samples, now):
        return None

    def kept(late: int) -> bool:
        return float(values_of(later(part, late) or part, samples)) > SATISFIED_ABOVE

    low, high = 0, min(len(values) for values in samples.values()) - 1 - part.horizon
    if isinstance(part, Always) and is_predicate(part.child):
        high = part.b - part.a
    if high < 1 or not kept(high):
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if kept(middle) else (middle, high)
    return high


def later(part: Formula, late: int) -> Formula | None:
    """The same conjunct, in which the window of an F or U, alone or below a G as in a patrol, ends so many
    steps later, or that of a G over a predicate begins so many steps later; None for other conjuncts.
    """
    match part:
        case Eventually(a, b) | Until(a, b):
            return replace(part, b=b + late) if -late <= (b - a) // 2 else None
        case Always(a, b, child) if is_predicate(child):
            return replace(part, a=min(a + late, b)) if a < b and -late <= a // 2 else None
        case Always(child=child) if inner := later(child, late):
            return replace(part, child=inner)
        case Implies(right=right) if inner := later(right, late):
            return replace(part, right=inner)
    return None


def may_be_late(part: Formula, samples: Mapping[str, Floats], now: int) -> bool:
    """Whether time may be what a conjunct lacks. It is not for a G over a predicate that has begun, or that
    the robot breaks by leaving as it begins.
    """
    if not isinstance(part, Always) or not is_predicate(part.child):
        return True
    return part.a > now + 1 or (part.a > now and not _holds(part.child, samples)[now])


def in_words(part: Formula, samples: Mapping[str, Floats], now: int, late: int | None) -> str | None:
    """What of an F, or of an U or G over predicates, fails along a trajectory, and when; None for other
    conjuncts, or if nothing fails. samples {name: [m]}; now: the last step that was driven; late: the
    conjunct's `late_by`.
    """
    match part:
        case Eventually() if late is not None:
            return when(part, late)
        case Until(a, b, left, right) if is_predicate(left) and is_predicate(right):
            return _of_until(part, _holds(left, samples), _holds(right, samples))
        case Always(a, b, child) if is_predicate(child):
            holds = _holds(child, samples)
            failing = np.flatnonzero(~holds[: b + 1])
            failing = failing[failing >= max(a, now)]
            if not len(failing):
                return None
            met = failing[0] + np.flatnonzero(holds[failing[0] :])
            if len(met) and failing[0] <= a and met[0] <= b and may_be_late(part, samples, now):
                return when(part, int(met[0]) - a)
            return f"'{child}' does not hold at step {failing[0]}"
    return None


def when(part: Formula, late: int) -> str:
    """When a conjunct that comes `late` steps too late is kept, in words."""
    match part:
        case Eventually(_, b, child):
            does = "is met" if is_predicate(child) else "begins"
            told = f"'{child}' {does} at step {b + late}"
        case Until(_, b, left, right):
            told = f"'{left}' holds all the way there, but '{right}' is met at step {b + late}"
        case Always(a, _, child) if is_predicate(child):
            told = f"'{child}' holds only from step {a + late}"
        case _:
            return f"'{part}' is kept {steps(late)} too late"
    return f"{told}, {steps(late)} too late"


def _of_until(part: Until, left: Bools, right: Bools) -> str | None:
    """left, right [m]: where each side holds."""
    met = np.flatnonzero(right[part.a :])
    broken = np.flatnonzero(~left[: part.a + met[0]] if len(met) else ~left)
    breaks = f"'{part.left}' does not hold at step {broken[0]}" if len(broken) else ""
    if not len(met):
        return f"'{part.right}' is not met" + (f", and {breaks}" if breaks else "")
    first = part.a + int(met[0])
    if first <= part.b:
        return f"{breaks}, before '{part.right}' is met at step {first}" if breaks else None
    if not breaks:
        return when(part, first - part.b)
    return f"{breaks}, and '{part.right}' is met at step {first}, {steps(first - part.b)} too late"


def _holds(predicate: Formula, samples: Mapping[str, Floats]) -> Bools:
    """Whether a predicate holds at each step [m]; False at all if its arithmetic is not finite at one."""
    each = {name: values[:, None] for name, values in samples.items()}  # every step is a trajectory of one
    return np.asarray(values_of(predicate, each) > SATISFIED_ABOVE)


def steps(count: int) -> str:
    return f"{count} step{'s' if count != 1 else ''}"
