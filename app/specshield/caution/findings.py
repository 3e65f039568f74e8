"""What is found of the actions at one step, on the session's map, or on a guess at it that leaves a way."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from specshield.arrays import Bools, Floats
from specshield.caution.judgement import Judged, Situation, without
from specshield.caution.signals import judged_by_signals
from specshield.caution.surprise.doubt import recovered, tried_again
from specshield.caution.taught import Taught, doubtful
from specshield.robot.dynamics import successors
from specshield.shield.decision import Shield


class Findings(NamedTuple):
    """shield, taught: on the map that is believed, and what the session has learned if that is so. now: what
    the actions were judged by. doubts [M]: motions that had better not be drawn. withstands: whether the
    whole rule is kept whatever the signals do. onward [M]: if no motion is feasible, the rest of the future
    that is begun, which nothing certifies. said: warnings.
    """

    shield: Shield
    taught: Taught
    now: Situation
    judged: Judged
    doubts: Bools
    withstands: bool
    onward: tuple[bytes | None, ...] | None
    said: tuple[str, ...]


def findings(told: Shield, shield: Shield, taught: Taught, now: Situation, nexts: Floats) -> Findings:
    """Judges the actions at x_t. told: the shield on the policy's map; shield: on the session's own. nexts
    [M, 3]: where f leads from x_t on the latter map.
    """
    said = list[str]()
    shield, now, judged, withstands = judged_by_signals(shield, now)
    believed = tried_again(told, taught, judged, now)
    if believed is not None:
        if believed[0] is not taught:
            said.append("no other way was left, so what was touched, or last seen long ago, is doubted")
        taught, (shield, now, judged, withstands) = believed
        nexts = np.empty_like(nexts)
        successors(shield.body, now.prefix.poses[-1], nexts)
    doubts, risky = doubtful(told, taught, judged.part, nexts, judged.left_out)
    judged = recovered(told, shield, taught, judged, now)
    judged = without(judged, shield, doubts, risky)
    if judged.vain and judged.some:
        said.append("every way left has a motion that led nowhere from here before: it is tried again")
    way, onward = judged.begun, None
    if way is not None:
        onward = tuple(way[1:] if motion == way[0] else None for motion in range(len(nexts)))
    return Findings(shield, taught, now, judged, doubts, withstands, onward, tuple(said))
