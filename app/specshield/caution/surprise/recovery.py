"""What to do if no future keeps the whole rule, and what the answer says of it.

After a surprise, or once a part of the rule is lost, the other parts are kept: first the safest, which are
those of the form G, then those that end soonest. Among futures that keep the same parts, the one is chosen
that comes nearest to the first part given up, since a way to keep that part may still be found later. Only
the steps to come count for that: a robot that has just backed out of something was nearer before.

A future that was begun is tried again at the next step, so what it keeps is not lost because it is not found
anew.
"""

from __future__ import annotations

import numpy as np

from specshield.arrays import Ints
from specshield.caution.residual import again, left_over
from specshield.robot.dynamics import simulate
from specshield.shield.decision import Config, Shield
from specshield.shield.feasibility import Prefix, rho_of
from specshield.stl import SATISFIED_ABOVE, Always, Formula, conjuncts, verdict
from specshield.stl.conjunction import flat

BETTER = 0.01  # [m] what brings the robot nearer by less may be a push against an obstacle; chosen by hand


def recovers(config: Config) -> bool:
    """Whether a session expects that robot or map are not as told. Other sessions do as the paper says."""
    return config.uncertainty is not None or config.learn_map


def most_kept(
    shield: Shield, prefix: Prefix, futures: Ints
) -> tuple[Ints, tuple[Formula, ...], tuple[str, ...], tuple[bool, bool]]:
    """The future that keeps most of `prefix.formula`, its motions [T - t]; the parts that it gives up, the
    safest first; a sentence for each of these; and whether the future comes nearer to keeping the first of
    them than the robot ever was, and than standing for ever.

    futures [N, T - t]: the motions of each.
    """
    whole = np.empty((len(futures) + 1, prefix.steps, 3))
    whole[-1] = prefix.poses[-1]
    for motions, poses in zip(futures, whole[:-1], strict=True):
        simulate(shield.body, prefix.poses[-1], motions, poses)
    left, said, lost = np.ones(len(whole), np.bool_), list[str](), list[Formula]()
    ever = nearest = np.zeros(len(whole))
    safest = sorted(conjuncts(prefix.formula), key=lambda each: (not isinstance(each, Always), each.horizon))
    for part in safest:
        asked = prefix.of(part)
        rho, _ = rho_of(asked, whole)
        keeps = left & (rho > SATISFIED_ABOVE)
        if keeps.any():
            left = keeps
            continue
        if not said:  # what held at a past step holds there, however little, and what did not does not
            past = np.where(asked.known > SATISFIED_ABOVE, np.inf, -np.inf)
            ever, (nearest, _) = rho, rho_of(asked._replace(known=past), whole)
        lost.append(part)
        said.append(f"no way that was tried keeps {part}: the best misses it by {abs(rho[left].max()):.3g}")
    ever, nearest = (np.where(left, each, -np.inf) for each in (ever, nearest))
    best = int(np.argmax(nearest[:-1]))
    better = bool(ever[best] > ever[-1] + BETTER), bool(nearest[best] > nearest[-1] + BETTER)
    return futures[best], tuple(lost), tuple(said), better


def given_up(prefix: Prefix, asked: Formula) -> tuple[str, ...]:
    """A sentence for each part of a violated rule that is lost, or is not among what is `asked` for now."""
    rule, samples = prefix.formula, prefix.task.samples(prefix.poses, prefix.signals)
    kept, broken = left_over(rule, samples, prefix.t)
    done = [verdict(part, samples) == "satisfied" for part in again(broken, prefix.t + 1)]
    wanted, pending = conjuncts(asked), [part for part in kept if verdict(part, samples) == "pending"]
    put_off = [p for p in pending if p not in wanted and not (isinstance(p, Always) and flat(p) in wanted)]
    now = ["what was left of it is kept" if each else "is kept again as soon as it can be" for each in done]
    return (
        *(f"{part} was not kept, and is given up" for part in conjuncts(rule) if part not in kept + broken),
        *(f"{part} was broken, and {then}" for part, then in zip(broken, now, strict=True)),
        *(f"no way that was tried keeps {part} beside that, so it is not asked for now" for part in put_off),
    )
