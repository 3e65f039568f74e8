"""What is feasible whatever the signals do.

J takes signals to keep their last value, as the paper does. Here the signals are taken to be at their worst
from x_{t+1} on (rule/worst.py). An action that is feasible under the worst signals has a witness that keeps
the rule under any signals. What is left of that witness after the next step keeps the rule too, whatever the
signals were at that step. So once some action is feasible in this sense, some action is so at every later
step of the episode.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from specshield.arrays import Floats
from specshield.rule.worst import worst_signals
from specshield.shield.decision import Shield
from specshield.shield.feasibility import prefix_of
from specshield.shield.judgement import Judged, Situation, judge
from specshield.shield.proposal import adapted
from specshield.shield.uncertainty import Care
from specshield.stl import SATISFIED_ABOVE


def judged_by_signals(shield: Shield, now: Situation) -> tuple[Shield, Situation, Judged, bool]:
    """Judges the actions with the signals at their worst or, if none is feasible then, at their last values.
    Returns the shield and the situation, what was judged of them, and whether the signals were at worst.
    """
    if shield.config.any_signal and now.status == "pending":
        found = _judged_at_worst(shield, now)
        if found is not None:
            return *found, True
    return shield, now, judge(shield, now), False


def any_signal(shield: Shield, poses: Floats, signals: Mapping[str, Floats] | None = None) -> bool | None:
    """Whether some action at x_t has a future that keeps the rule whatever the signals are at x_t and after.

    None if the session does not ask that, or the rule reads no signals. poses [t + 1, 3]; signals {name:
    [t]}: those before x_t, since the signals at x_t are sent with its step.
    """
    task = shield.task
    if not shield.config.any_signal or not task.signals:
        return None
    worst = worst_signals(task)
    if worst is None:
        return False
    seen = {
        name: np.append(task.signal(name, signals, len(poses))[:-1], value)
        for name, value in zip(task.signals, worst[0], strict=True)
    }
    prefix = prefix_of(task, task.formula, shield.view, poses, seen)
    if prefix.low > SATISFIED_ABOVE or prefix.high <= SATISFIED_ABOVE or prefix.steps <= 0:
        return prefix.low > SATISFIED_ABOVE
    return _judged_at_worst(shield, Situation(prefix, None, "pending", Care(0.0, 0))) is not None


def _judged_at_worst(shield: Shield, now: Situation) -> tuple[Shield, Situation, Judged] | None:
    """As `judged_by_signals`, with the signals at worst alone; None if no action is feasible then."""
    held = worst_signals(shield.task)
    if held is None:
        return None
    proposers = tuple(adapted(p, "foreseeing", held[0]) for p in shield.proposers)
    shield, now = replace(shield, proposers=proposers), now._replace(prefix=now.prefix._replace(held=held))
    judged = judge(shield, now)
    return (shield, now, judged) if judged.some else None
