"""What is feasible whatever the signals do.

J takes signals to keep their last value, as the paper does. Here they are taken to be at their worst from
x_{t+1} on (caution/worst.py). An action that is feasible then has a witness that keeps the rule under any
signals. What is left of it after the next step keeps the rule too, whatever the signals were at that step. So
once some action is feasible in this sense, some action is so at every later step of the episode.

No motion changes what a rule asks of signals alone, such as `G battery > 10`. So motions are judged by the
rest of the rule, as long as that part is kept if the signals stay as they are, and also once it is broken.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from specshield.arrays import Floats
from specshield.caution.judgement import Judged, Situation, judge
from specshield.caution.noise import Care
from specshield.caution.surprise.recovery import given_up, recovers
from specshield.caution.worst import moved, worst_signals
from specshield.shield.decision import Shield
from specshield.shield.feasibility import prefix_of, rho_of
from specshield.shield.proposal import adapted
from specshield.stl import SATISFIED_ABOVE
from specshield.stl.robustness import verdict_between


def judged_by_signals(shield: Shield, now: Situation) -> tuple[Shield, Situation, Judged, bool]:
    """Judges the actions with the signals at their worst or, if none is feasible then, at their last values.
    Returns the shield and the situation, what was judged of them, and whether the whole rule is kept whatever
    the signals do.
    """
    whole, (rest, fixed) = now.prefix, moved(shield.task)
    least, sure, broken = np.inf, True, False
    if fixed is not None:
        part, other = whole.of(rest), whole.of(fixed)
        standing = np.broadcast_to(whole.poses[-1], (1, whole.steps, 3))
        held, broken = rho_of(other, standing)[0].item(), other.high <= SATISFIED_ABOVE
        if broken or held > SATISFIED_ABOVE:
            now = now._replace(prefix=part, status=verdict_between(part.low, part.high))
            least, sure = held, other.low > SATISFIED_ABOVE
    found = _judged_at_worst(shield, now)
    shield, now, judged = found or (shield, now, judge(shield, now))
    if broken and recovers(shield.config):
        said = (*judged.tried.warnings, *given_up(other, other.formula))
        judged = judged._replace(tried=judged.tried._replace(warnings=said))
    if least < np.inf:
        values = judged.values if broken else np.minimum(judged.values, least)
        judged = judged._replace(values=values, robustness=np.minimum(judged.robustness, least))
    return shield, now, judged, found is not None and sure


def any_signal(shield: Shield, poses: Floats, signals: Mapping[str, Floats] | None = None) -> bool | None:
    """Whether some action at x_t has a future that keeps the rule whatever the signals are at x_t and after.

    None if the session does not ask that, or the rule reads no signals. poses [t + 1, 3]; signals {name:
    [t]}: those before x_t, since the signals at x_t are sent with its step.
    """
    task = shield.task
    if not shield.config.any_signal or not task.signals:
        return None
    worst = worst_signals(task, task.formula)
    if worst is None:
        return False
    seen = {
        name: np.append(task.signal(name, signals, len(poses))[:-1], value)
        for name, value in zip(task.signals, worst[0], strict=True)
    }
    prefix = prefix_of(task, task.formula, shield.view, poses, seen)
    now = Situation(prefix, None, verdict_between(prefix.low, prefix.high), Care(0.0, 0))
    return now.status == "satisfied" or (prefix.steps > 0 and _judged_at_worst(shield, now) is not None)


def _judged_at_worst(shield: Shield, now: Situation) -> tuple[Shield, Situation, Judged] | None:
    """As `judged_by_signals`, by the formula of the situation's prefix and with the signals at worst alone.
    None if no action is feasible then, or the session does not ask that, or the formula is decided.
    """
    asked = shield.config.any_signal and now.status == "pending"
    held = worst_signals(shield.task, now.prefix.formula) if asked else None
    if held is None:
        return None
    proposers = tuple(adapted(p, "foreseeing", held[0]) for p in shield.proposers)
    shield, now = replace(shield, proposers=proposers), now._replace(prefix=now.prefix._replace(held=held))
    judged = judge(shield, now)
    return (shield, now, judged) if judged.some else None
