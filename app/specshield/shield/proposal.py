"""What a policy hands to the shield: motions, and nothing that the shield believes.

A proposer is not trusted (docs/architecture.md, "Who is trusted"). The shield takes only the motions out of a
proposal, checks their number and range, and simulates each of them itself. A proposer that is wrong or lies
makes the shield stricter than it need be; it cannot get an action certified that has no satisfying future.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from specshield.arrays import Floats, Ints
from specshield.compiled import leaf
from specshield.task import Task

MAX_MOTIONS = 1_000_000  # in one proposal, all rows together: 32 MB while they are simulated
log = logging.getLogger("specshield")


class Proposal(NamedTuple):
    """Futures to the horizon, usually one after each first motion.

    motions [N, T - t]: indices into `Robot.motions`; a row is the future of the motion that it begins with.
    preferred: the motion that the policy itself would take at x_t.
    """

    motions: Ints
    preferred: int


class Proposer(Protocol):
    """A policy as the shield sees it."""

    @property
    def id(self) -> str: ...

    @property
    def task(self) -> Task: ...

    def propose(self, history: Floats, signals: Mapping[str, Floats], margin: float) -> Proposal:
        """Futures that may keep the rule, by more than `margin` if possible.

        history [t + 1, 3]: x_0..x_t, with t < T; signals {name: [t + 1]}; margin: of robustness [m].
        """
        ...


def adapted(proposer: Proposer, how: str, *told: object) -> Proposer:
    """The copy of a proposer that its method `how` returns, such as `on_body` (CONTRIBUTING.md lists them).

    A proposer without that method is returned itself. If the method raises, the result is a proposer that
    raises the same error when it is asked, so that the answer says why the policy was not used.
    """
    try:
        found: Proposer = getattr(proposer, how)(*told) if hasattr(proposer, how) else proposer
    except Exception as error:
        return _Failed(proposer.task, error)
    return found


@dataclass(frozen=True)
class _Failed:
    """In place of a proposer that could not be told of something."""

    task: Task
    error: Exception
    id = "failed"

    def propose(self, history: Floats, signals: Mapping[str, Floats], margin: float) -> Proposal:
        raise self.error


def ask(
    proposer: Proposer,
    history: Floats,
    signals: Mapping[str, Floats],
    margin: float,
    count: int,
    steps: int,
    least: int = 1,
) -> tuple[Proposal | None, str | None]:
    """Asks a proposer; returns its proposal and None, or None and a sentence that says why it was not used.

    A proposal needs at least `least` rows of `steps` motions, each motion below `count`. The proposer gets
    copies of the history and the signals, and its motions are copied, so that nothing which it does later
    changes the decision.
    """
    try:
        name = str(proposer.id)[:80]
        given = proposer.propose(history.copy(), {n: v.copy() for n, v in signals.items()}, margin)
        found = _checked(given, count, steps, least)
    except Exception as error:  # whatever a proposer does wrong, the step is still decided
        log.warning("a policy failed to propose", exc_info=True)
        return None, f"a policy was not used at this step: it raised {type(error).__name__}"
    if isinstance(found, str):
        return None, f"policy {name!r} was not used at this step: {found}"
    return found, None


@leaf
def _out_of_range(motions: Ints, count: int) -> int:
    """The index, row by row, of the first motion that is not from 0 to count - 1; -1 if there is none."""
    rows, steps = motions.shape
    for n in range(rows):
        for i in range(steps):
            if not 0 <= motions[n, i] < count:
                return int(n * steps + i)
    return -1


def _checked(given: object, count: int, steps: int, least: int) -> Proposal | str:
    """A copy of a proposal, or what is wrong with it."""
    if not isinstance(given, Proposal):
        return f"it returned {type(given).__name__}; expected a Proposal"
    motions, preferred = given.motions, given.preferred
    if not isinstance(motions, np.ndarray) or motions.dtype.kind not in "iu":
        return "its motions are not an array of integers"
    if motions.ndim != 2 or motions.shape[1] != steps or not least * steps <= motions.size <= MAX_MOTIONS:
        rows = f"N from {least} to {MAX_MOTIONS // steps}"
        return f"its motions have the shape {list(motions.shape)}; expected [N, {steps}], {rows}"
    own = np.array(motions, np.int64, order="C")
    if (wrong := _out_of_range(own, count)) >= 0:
        return f"it names motion {own.flat[wrong]}; the robot has motions 0 to {count - 1}"
    whole = isinstance(preferred, (int, np.integer)) and not isinstance(preferred, bool)
    if not (whole and 0 <= preferred < count):
        return f"it prefers motion {preferred!r:.40}; the robot has motions 0 to {count - 1}"
    return Proposal(own, int(preferred))
