"""Draws the pictures of policies and sessions as SVG, in a child process."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing import get_context
from typing import TypeVar

import numpy as np

from specshield.arrays import Floats
from specshield.drawing.outline import way_ahead
from specshield.drawing.svg import Plan
from specshield.errors import PoseError
from specshield.policy.notices import may_begin
from specshield.service.heavy.uploads import policies_of
from specshield.service.sessions import record
from specshield.service.sessions.rules import Rule
from specshield.service.settings import Settings
from specshield.service.storage.keeper import follow_parent
from specshield.shield.decision import Shield, make_shield
from specshield.world.learned import LearnedMap, applied

V = TypeVar("V")
FORK = get_context("fork")
# Chosen by hand. A start takes 0.4 ms with tables, and any time with a planner.
HEADINGS = 4  # tried at each place if places are at most NEAR apart, else one
FINEST, NEAR = 0.1, 1.0  # [m] between two places
FINER = math.sqrt(2.0)  # ratio of the distances of one grid of places and the next
# Shares of `heavy_timeout` (20 s by default): when no finer grid is begun any more, and when one is given up.
SOON, LATEST = 0.4, 0.7


def draw_policy(settings: Settings, key: str, owner: str) -> tuple[bytes, bool]:
    """The map, the regions, and the starts from which the rule can be kept. Also whether these are known, so
    that the picture need not be drawn again. Raises NotFound, PolicyError.
    """
    policies, began, most = policies_of(settings), time.monotonic(), LATEST * settings.heavy_timeout
    found = policies.find(key, owner)
    task = policies.task(found.about)
    plan = Plan(task, f"policy {found.name or found.id[:8]}: from where {task.formula} can be kept")
    heat, said = None, "The policy is not ready yet, so the starts that can keep the rule are not known."
    if found.card is not None:
        shield = make_shield([policies.policy(found)])
        heats = kept_from(shield, began + SOON * settings.heavy_timeout)
        heat = latest(heats, began + most - time.monotonic())
        said = f"The starts that can keep the rule are not known: none was decided within {most:g} s."
    if heat is not None:
        share, pitch, headings = heat
        plan.heat(share)
        known = share[np.isfinite(share)]
        kept = f"{100 * known.mean():.0f} %" if len(known) else "none"
        looked = f"every {pitch:.2f} m, {headings} heading{'s' * (headings > 1)} each"
        said = f"Green: from here the rule can be kept ({kept} of the starts, {looked}); red: not."
    plan.walls()
    plan.regions()
    plan.line(str(task.formula), "ink formula")
    plan.line(said, "faint")
    return plan.svg(), heat is not None


def draw_session(
    settings: Settings, rule: Rule, t: int, rows: Floats, last: bytes, known: LearnedMap
) -> bytes:
    """The map, the regions, the way driven on this map, and the certified continuation of the last decision.

    rows: the session's rows on this map, none before the first step there. last: the record of step t, which
    is that of the last row, or b"". known: what the session has learned of the map.
    """
    task = policies_of(settings).task(rule.about)
    plan = Plan(task, f"session {rule.id} at step {t}")
    plan.walls(known)
    plan.regions()
    decided = record.decode(last) if last else None
    witness = None if decided is None else decided.witness
    if decided is not None:
        pose, taken = (*rows[-1, :3].tolist(),), (decided.action, decided.completion_action)
        plan.way(way_ahead(applied(task.grid, known), task.robot, pose, *taken, witness), "next")
    if len(rows):
        plan.way(rows[:, :3])
        plan.robot(rows[-1, :3].tolist())
    plan.line(str(task.formula), "ink formula")
    dashed = "" if witness is None else "; dashed: the certified continuation"
    drawn = f"The line is the way driven{dashed}." if len(rows) else "No pose on this map is known yet."
    plan.line(f"{rule.id}, step {t}. {drawn}", "faint")
    if len(known):
        plan.line("Unlike the map: violet cells were found occupied, faint ones free.", "faint")
    plan.line(f"The rule's last step is {rule.origin + task.horizon}.", "faint")
    return plan.svg()


def latest(values: Iterator[V], seconds: float) -> V | None:
    """The last of the values that come within so many seconds, however long each takes; None if none comes.

    A fork of this process makes them, and the system ends it after that time: a running kernel cannot be
    interrupted in another way. It also ends with this process. Raises MemoryError if it ends otherwise.
    """
    reading, writing = FORK.Pipe(duplex=False)

    def send() -> None:
        follow_parent()
        reading.close()
        signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))  # 0 would mean no timer
        for value in values:
            writing.send(value)

    process, found = FORK.Process(target=send), None
    process.start()
    writing.close()
    with suppress(EOFError, OSError):  # the fork has ended, perhaps in the middle of a value
        while True:
            found = reading.recv()
    process.join()
    if process.exitcode not in (0, -signal.SIGALRM):
        raise MemoryError(f"the fork ended with {process.exitcode}")  # the most likely reason
    return found


def kept_from(shield: Shield, deadline: float) -> Iterator[tuple[Floats, float, int]]:
    """For ever finer grids of places, at first one place for the whole map: the share [rows, columns] of
    headings from which the rule can be kept, NaN where the robot does not fit, the first row at the highest
    y; the distance of two places [m]; and the number of headings tried at each place.

    It ends before a grid that would likely be finished after the deadline [s, of time.monotonic].
    """
    xmin, ymin, xmax, ymax = shield.task.grid.bounds
    wide, high = xmax - xmin, ymax - ymin
    pitch, pace = max(wide, high), 0.0  # pace: seconds a start
    while pitch > FINEST:
        columns, rows = max(1, round(wide / pitch)), max(1, round(high / pitch))
        headings = HEADINGS if pitch <= NEAR else 1
        began, starts = time.monotonic(), rows * columns * headings
        if pace and began + pace * starts > deadline:
            return
        xs = xmin + (np.arange(columns) + 0.5) * wide / columns
        ys = ymax - (np.arange(rows) + 0.5) * high / rows
        thetas = np.arange(headings) * math.tau / headings
        kept = np.array([[[_kept(shield, x, y, theta) for theta in thetas] for x in xs] for y in ys])
        fits = np.isfinite(kept).sum(axis=2)
        yield np.where(fits, np.nansum(kept, axis=2) / np.maximum(fits, 1), math.nan), pitch, headings
        pitch, pace = pitch / FINER, (time.monotonic() - began) / starts


def _kept(shield: Shield, x: float, y: float, theta: float) -> float:
    """1 if an episode may begin there, else 0; NaN if the robot does not fit there."""
    try:
        return float(may_begin(shield, (x, y, theta)))
    except PoseError:
        return math.nan
