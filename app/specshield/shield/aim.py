"""What J asks for beyond satisfaction, so that noise does not break the rule: a margin [m] and slack [steps].

The margin is asked of the whole trajectory first. Where no future keeps it there, or where slack is asked for
too, it is asked of what the formula still leaves open. Where both cannot be had, the slack is lowered first,
to the most steps with which the margin can be had, and then the margin.
"""

from __future__ import annotations

import numpy as np

from specshield.arrays import Bools, Floats
from specshield.rule.residual import still_open
from specshield.rule.view import view_of
from specshield.shield.decision import Shield
from specshield.shield.feasibility import Best, Futures, Prefix, best_of, prefix_of, rho_of
from specshield.stl import SATISFIED_ABOVE


def aim(shield: Shield, prefix: Prefix, tried: Futures, whole: Floats) -> tuple[Best, Bools, bool]:
    """The best futures, which motions [M] keep as much as can be had, and whether that is less than asked.

    whole [N]: rho of the futures on the whole of `prefix.formula`. A future that does not satisfy it counts
    for nothing, whatever it keeps of a part.
    """
    motions, margin = len(shield.task.robot.motions), SATISFIED_ABOVE + shield.config.margin

    def at(slack: int) -> Best:
        formula = still_open(prefix.task, prefix.formula, prefix.poses, prefix.rows, slack)
        part = prefix_of(prefix.task, formula, view_of(prefix.task, formula), prefix.poses, prefix.signals)
        return best_of(tried, np.where(whole > SATISFIED_ABOVE, rho_of(part, tried), -np.inf), motions)

    best = at(shield.config.slack)
    if (best.robustness > margin).any():
        return best, best.robustness > margin, False
    low, high = 0, shield.config.slack  # slack `high` cannot be had
    best = at(low)
    if not (best.robustness > margin).any():
        highest = max(best.robustness.max(), SATISFIED_ABOVE)
        return best, (best.robustness >= highest) & (best.robustness > SATISFIED_ABOVE), True
    while high - low > 1:
        middle = (low + high) // 2
        tighter = at(middle)
        if (tighter.robustness > margin).any():
            low, best = middle, tighter
        else:
            high = middle
    return best, best.robustness > margin, True
