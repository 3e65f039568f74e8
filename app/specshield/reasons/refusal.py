"""What is said of a rule that no policy keeps from here: no way was found, or none exists, and why."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from specshield.arrays import Floats
from specshield.caution.taught import on_map, teach
from specshield.episode import check_switch, start
from specshield.episode.handover import finite
from specshield.errors import InfeasibleStart, InfeasibleSwitch, InputError
from specshield.reasons.bound import proof
from specshield.reasons.lateness import later, when
from specshield.reasons.relaxation import Conjunct, relaxations
from specshield.robot.dynamics import Body
from specshield.shield.decision import Carry, Shield
from specshield.shield.feasibility import Signals
from specshield.task import MAX_HORIZON
from specshield.world.learned import SENT, forget
from specshield.world.regions import region_to_json

MOST_SHOWN = 32  # conjuncts; as many characters of each formula as LONGEST
LONGEST = 400


@dataclass(frozen=True)
class Refusal:
    """message: for people. proved: no future exists, whatever the robot does; else none was found."""

    message: str
    proved: bool
    conjuncts: tuple[Conjunct, ...]
    way: bytes | None = None  # see `Relaxed`

    @property
    def details(self) -> dict[str, Any]:
        """The extra members of the problem document."""
        shown = [
            {
                "formula": str(each.formula)[:LONGEST],
                "feasible_alone": each.feasible_alone,
                "robustness": finite(each.robustness),
                "late_by": each.late and each.late.steps,
                "smaller_by": each.smaller and each.smaller.by,
                "regions": each.smaller and {n: region_to_json(r) for n, r in each.smaller.regions.items()},
            }
            for each in self.conjuncts[:MOST_SHOWN]
        ]
        return {"proved": self.proved, "conjuncts": shown}


def begin(
    shield: Shield, pose: Sequence[float], allow_infeasible: bool, longest: int = MAX_HORIZON
) -> tuple[bool, bytes | None]:
    """Whether a session can begin at `pose` (x, y, theta) with a future that satisfies the rule; and such a
    way (`Carry.way`) if a search found one and no policy did. longest: as of `refusal`.

    Raises InputError for a session that would end before its rule is decided, PoseError, and InfeasibleStart
    unless `allow_infeasible`.
    """
    most, horizon = shield.config.max_steps, shield.task.horizon
    if most is not None and most < horizon:
        said = f"a session of {most} steps ends before its rule is decided"
        expected = f"at least {horizon}, the rule's last step"
        raise InputError(said, path="max_steps", got=most, expected=expected)
    try:
        start(shield, pose)
    except InfeasibleStart as error:
        if allow_infeasible:
            return False, None
        told = refusal(shield, np.array([pose], np.float64), {}, longest=min(longest, most or longest))
        if told.way is not None:
            with suppress(InfeasibleStart):
                start(shield, pose, told.way)
                return True, told.way
        raise error.retold(told.message, **told.details) from None
    return True, None


def switch(
    shield: Shield,
    history: Floats,
    signals: Signals | None,
    carry: Carry,
    elsewhere: bool,
    longest: int = MAX_HORIZON,
) -> bytes | None:
    """`check_switch`, but a way is returned if a search found one and no policy did, as by `begin`; and the
    InfeasibleSwitch says what is wrong with the rule. longest: as of `refusal`.
    """
    try:
        check_switch(shield, history, signals, carry, elsewhere)
        return None
    except InfeasibleSwitch as error:
        taught, _ = teach(shield, carry, history, None, None)
        known = taught.map
        sure = on_map(shield, forget(known, known.occupied & (known.by != SENT)))  # contacts are guesses
        told = refusal(on_map(shield, known), history, signals or {}, sure.body, longest)
        if told.way is not None:
            found = carry._replace(way=told.way)
            with suppress(InfeasibleSwitch):
                check_switch(shield, history, signals, found, elsewhere)
                return told.way
        raise error.retold(f"the new rule was not taken: {told.message}", **told.details) from None


def refusal(
    shield: Shield,
    history: Floats,
    signals: Mapping[str, Floats],
    sure: Body | None = None,
    longest: int = MAX_HORIZON,
) -> Refusal:
    """Why the shield's rule cannot be kept after x_0..x_t, or was not found to be.

    history [t + 1, 3], signals {name: [t + 1]}, which are taken to keep their last values; sure: the robot on
    a map without guesses; what is proved is proved on that map. longest: the longest horizon that a rule may
    have there [steps]; no later end is named that would be beyond it.
    """
    if not shield.task.formula.names:
        said = "the rule reads neither poses nor signals, and its robustness is not above 0"
        return Refusal(f"no way from here keeps the rule: {said}", True, ())
    relaxed = relaxations(shield, history, signals, longest)
    if relaxed.way is not None:
        return Refusal(
            f"the policies found no way from here that keeps the rule, though a search found one "
            f"({relaxed.tried} were tried): policies of another method, or finer options, may find it too",
            False,
            relaxed.conjuncts,
            relaxed.way,
        )
    bound = proof(shield.task, sure or shield.body, history, signals)
    if bound is not None:
        instead = f". A way was found with {ways}" if (ways := _ways(relaxed.conjuncts)) else ""
        return Refusal(f"no way from here keeps the rule: {bound}{instead}", True, relaxed.conjuncts)
    message = (
        "no way from here was found that keeps the rule, which is no proof that there is none. "
        f"{_wrong(relaxed.conjuncts, relaxed.tried).removesuffix('.')}"
    )
    return Refusal(message, False, relaxed.conjuncts)


def _wrong(conjuncts: Sequence[Conjunct], tried: int) -> str:
    """What is wrong with the rule, in words. tried: how many ways were judged."""
    failing = [each for each in conjuncts if not each.feasible_alone]
    if failing:
        alone = "Even with the rest of the rule left out, on" if len(conjuncts) > 1 else "On"
        return " ".join(_fails(each, f"{alone} the best of {tried} ways tried") for each in failing)
    if ways := _ways(conjuncts):
        return f"Each part can be kept alone, and all can with {ways}."
    return "Each part can be kept alone, but no way was found to keep all of them."


def _fails(conjunct: Conjunct, best: str) -> str:
    missed = f" by {abs(conjunct.robustness):.3g}" if math.isfinite(conjunct.robustness) else ""
    told = f"{best} '{_shown(conjunct)}' is missed{missed}."
    if conjunct.late is not None:
        told = f"{best} {when(conjunct.formula, conjunct.late.steps)[: 3 * LONGEST]}."
    if ways := _ways([conjunct]):
        told += f" With {ways} a way for the whole rule was found; a smaller change is not ruled out."
    return told


def _ways(conjuncts: Sequence[Conjunct]) -> str:
    """What would do for the whole rule, in words; "" if nothing was found."""
    return " or with ".join(way for each in conjuncts for way in _eased(each))


def _eased(conjunct: Conjunct) -> Iterator[str]:
    if (late := conjunct.late) and late.only:
        yield f"'{str(later(conjunct.formula, late.steps))[:LONGEST]}' instead"
    if (less := conjunct.smaller) and less.only:
        yield f"{' and '.join(less.regions)[:LONGEST]} smaller by {less.by:.2f} m all round"


def _shown(conjunct: Conjunct) -> str:
    return str(conjunct.formula)[:LONGEST]
