"""pi_phi by backward dynamic programming over pose and progress: made in about a second, without learning."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from specshield.arrays import Bools, Floats
from specshield.caution.room import widened
from specshield.caution.surprise.barred import NOTHING_BARRED, in_vain
from specshield.caution.worst import apart, moved
from specshield.compiled import Boxed, box
from specshield.errors import MapError, PolicyError, SampleError
from specshield.policy.card import Card, Carded, joined, make_card
from specshield.policy.dqn.environment import free_poses
from specshield.policy.extent import COARSEST, fitting_pitch, places_that_matter, pose_count
from specshield.policy.lattice import INVALID, STEP_CODES, holds_at, make_lattice, number_cells, reads_heading
from specshield.policy.methods import Run
from specshield.policy.options import options_to_json, read_options
from specshield.policy.progress import Rules, make_rules, pasts
from specshield.policy.progress.obligations import obligations
from specshield.policy.reachability.around.field import NO_FIELDS, distances, goal_cells
from specshield.policy.reachability.around.search import FEWER, GAVE_UP, NO_WAY, POSES, go_around, is_known
from specshield.policy.reachability.guide import HURRIED, hurried, share_with_slack
from specshield.policy.reachability.latest import lateness, latest_times, masks_of, pack_times, phases_of
from specshield.policy.reachability.method import Settings
from specshield.policy.reachability.narrow import AFTER, FIRST, ON, Narrow, continue_narrow
from specshield.policy.reachability.search import continue_all
from specshield.policy.reachability.sight import look_closely
from specshield.policy.reachability.stepwise import MAX_BYTES, feasible_steps, state_count, step_tables
from specshield.policy.reachability.stored import read_tables, stored
from specshield.policy.reachability.tables import LATE, Guide, Tables
from specshield.robot.dynamics import Body, calmest_motion, make_body
from specshield.rule.values import signal_rows
from specshield.rule.view import view_of
from specshield.shield.feasibility import prefix_of, simulated
from specshield.shield.proposal import Proposal
from specshield.stl import SATISFIED_ABOVE, Formula, conjuncts
from specshield.task import Task
from specshield.world.occupancy import OccupancyGrid

MAX_ENTRIES = 100_000_000  # of float32: 400 MB while the tables are made
LATE_POSES, FEW_MOTIONS = 500, 16  # poses that `lateness` is measured from, for a robot of so many motions
MANY, FEW = 1000, 64  # poses that a new policy is tried from: by its tables, by what it proposes
MAPS, MAPS_BYTES = 8, 8_000_000  # maps whose distances a policy keeps, and how large their clearances may be
FINE_ENTRIES = 1_000_000  # a lattice three times as fine is used if its tables have no more entries


@dataclass(frozen=True, eq=False)
class ReachabilityPolicy(Carded):
    """Proposes what the tables (tables.py) lead to (search.py).

    narrow [K]: the obligations whose predicates the lattice can hardly see (sight.py). wide: the tables for
    ways with room beside them (caution/room.py), None for a robot that goes back.
    """

    settings: Settings
    tables: Tables
    narrow: Bools
    wide: Tables | None = None
    told: bool = True  # whether the tables were made for the map that the policy is asked about
    guess: bool = False  # whether that is one of several maps that one decision tries
    barred: Floats = field(default_factory=lambda: NOTHING_BARRED)  # see `Guide`
    early: int = 0  # [steps] see `hurried`
    wanted: Bools | None = None  # [M] the first motions after which to propose ways; None: all of them
    brief: bool = False  # whether it looks only for its preferred way, by a short search
    again: ReachabilityPolicy | None = None  # the same with tables for another map, see `remade`

    @cached_property
    def _rules(self) -> Rules:
        return make_rules(self.task)

    def on_body(self, body: Body, guess: bool = False) -> ReachabilityPolicy:
        """The policy on another map, on which its ways are simulated: with the newest tables that there are.

        guess: whether the map is one of several that are tried in one decision. If a short search for a way
        around gives up on such a map, nothing else is tried. A guess has fewer obstacles than what was
        learned, for which the newest tables are, so it has the tables of the policy's own map.
        """
        policy = self if guess or self.again is None else self.again
        return policy._but(body, told=False, guess=guess)

    def avoiding(self, barred: Floats) -> ReachabilityPolicy:
        """The policy without barred motions [n, 6] (caution/surprise/barred.py)."""
        return self._but(self._body, barred=barred)

    def earlier(self, steps: int, wanted: Bools) -> ReachabilityPolicy:
        """The policy for deadlines that come so many steps earlier, and for the first motions `wanted` [M].
        It proposes nothing for a robot that cannot wait, or where its tables say that it would be too late.
        """
        other = self._but(self._body, early=steps, wanted=wanted)
        other.__dict__["_guide"] = self._guide
        return other

    def giving_up(self, lost: tuple[Formula, ...]) -> ReachabilityPolicy:
        """`briefly`, and as if the windows of these parts of the rule were over before it began."""
        other, rules = self._but(self._body, brief=True, guess=False), self._rules
        left = {each for part in conjuncts(moved(self.task)[0]) if part not in lost for each in apart(part)}
        parts = conjuncts(self.task.formula)
        gone = [left.isdisjoint(apart(part)) for part in parts for _ in obligations(part)]
        a, b, c1, c2, last = np.where(gone, [[0], *[[-1]] * 4], rules[1:6])
        other.__dict__["_rules"] = rules._replace(a=a, b=b, c1=c1, c2=c2, last=last)
        return other

    def briefly(self) -> ReachabilityPolicy:
        """The policy with a smaller search and one way alone, for explanations, which ask it often."""
        return self._but(self._body, brief=True)

    def keeping_clear(self) -> ReachabilityPolicy:
        """The policy for ways with room beside them (caution/room.py); itself where it has no such tables."""
        return self if self.wide is None else self._but(widened(self._body), tables=self.wide)

    def _but(self, body: Body, **changed: Any) -> ReachabilityPolicy:
        """The policy with these fields changed, on this map."""
        other = replace(self, **changed)
        other.__dict__.update(_body=body, _rules=self._rules, _goals=self._goals, _far=self._far)
        return other

    @cached_property
    def _goals(self) -> Floats:
        return goal_cells(self._body, self._rules)

    @cached_property
    def _far(self) -> deque[tuple[Body, Floats]]:
        """The distances to the goals on the maps that were last used: a map changes seldom."""
        return deque(maxlen=max(2, min(MAPS, MAPS_BYTES // self._body.clearance.nbytes)))

    @cached_property
    def _guide(self) -> Boxed[Guide]:
        # On another map than the tables were made for, they err by more than was measured.
        tables = self.tables if self.told else self.tables._replace(late=min(self.tables.late, LATE))
        return box(Guide(self._body, self._rules, tables, self.task.robot.wait_motion, self.barred))

    @property
    def _fields(self) -> Floats:
        key = id(self._body.clearance), self._body.radius
        found = next((far for b, far in list(self._far) if (id(b.clearance), b.radius) == key), None)
        if found is None:
            found = distances(self._body, self._goals)
            self._far.append((self._body, found))
        return found

    @cached_property
    def _top(self) -> Floats:
        """The latest feasible time of each table [steps]."""
        highest = np.where(self.tables.code == INVALID, 0, self.tables.code).max(axis=(1, 2), initial=0)
        return np.asarray((highest - 1.0) / STEP_CODES, np.float64)

    def remade(self, grid: OccupancyGrid) -> ReachabilityPolicy:
        """The policy, which has tables for another map of the same size beside its own from now on."""
        made = synthesise(replace(self.task, grid=grid), self.settings)
        again = replace(self, tables=made.tables, narrow=made.narrow, wide=made.wide, again=None)
        return replace(self, again=again)

    def propose(self, history: Floats, signals: Mapping[str, Floats], margin: float) -> Proposal:
        """A continuation after each first motion."""
        return self._proposal(history, signals, margin, FIRST if len(history) == 1 else ON)

    def _proposal(
        self, history: Floats, signals: Mapping[str, Floats], margin: float, effort: tuple[int, int]
    ) -> Proposal:
        """effort: of the search for narrow predicates (narrow.py)."""
        rules = Rules(*self._rules[:-2], self._rules.signals.copy(), margin)
        read = moved(self.task)[0].names  # what the rule asks of other signals, no motion changes
        rows = signal_rows(self.task, {name: signals[name] for name in read if name in signals}, len(history))
        shape = len(self.task.robot.motions), self.task.horizon + 1 - len(history)
        chosen, least = (slice(None), -np.inf) if self.wanted is None else (self.wanted, HURRIED)
        proposals = []
        for past in pasts(rules, history, rows):
            guide, waits = self._guide, self._guide.value.wait >= 0
            if self.wanted is not None:
                earlier, sooner = hurried(guide.value, margin, self.early, past)
                if not sooner:
                    continue
                guide = box(earlier)
            motions, ways, poses = np.empty(shape, np.int64), np.empty(shape, np.int64), np.empty((*shape, 3))
            wanted = np.array([not self.brief] * shape[0] if self.wanted is None else self.wanted)
            around = NO_WAY
            if self.guess:
                fields = NO_FIELDS if waits else self._fields
                around = go_around(guide, margin, past, fields, poses, ways, FEWER)
            if around == GAVE_UP:
                still = calmest_motion(self._body)
                ways[:], ways[:, 0] = still, np.arange(len(ways))
                proposals.append(Proposal(ways, still))
                continue
            if waits and True in self.narrow.tolist():
                about = Narrow(self.narrow, self._top), effort
                preferred = continue_narrow(guide, margin, *about, past, wanted, least, motions, poses)
            else:
                beam = self.settings.beam
                preferred = continue_all(guide, margin, beam, past, wanted, least, motions, poses)
            if self.brief:
                chosen = slice(preferred, preferred + 1)  # nothing was written of the others
            if preferred >= 0:
                proposals.append(Proposal(motions[chosen], int(preferred)))
            if not self.guess and self.wanted is None and (len(self.barred) or not self.told):
                vain = in_vain(self.barred, history[-1], motions[chosen], poses[chosen], True)
                free = poses[chosen][~vain]
                if not is_known(guide, margin, past, free):
                    most = FEWER if self.brief else POSES
                    around = go_around(guide, margin, past, self._fields, poses, ways, most)
            if around >= 0:
                proposals.append(Proposal(ways, int(around)))
        return joined(*proposals or [Proposal(np.empty((0, shape[1]), np.int64), 0)])

    def weights(self) -> bytes:
        """The safetensors file."""
        return stored(self.tables, self.wide, self.narrow, self.settings.pitch)

    def feasible_start(self) -> float:
        """The share of poses drawn over free space (the same each time) from which the rule can be kept.

        As the tables say; where they hardly see what the rule asks for, as what is proposed does.
        """
        body, rules = self._body, self._rules
        exact = bool(self.narrow.any()) or reads_heading(rules.programs, rules.regions)
        try:
            poses = free_poses(self.task, body, FEW if exact else MANY, np.random.default_rng(0))
        except MapError:  # next to no free space
            return 0.0
        if not exact:
            return share_with_slack(self._guide, poses)
        return sum(self._keeps(pose) for pose in poses) / len(poses)

    def _keeps(self, pose: Floats) -> bool:
        """Whether some proposed future from a pose (3,) at the first step keeps the rule."""
        formula, history = self.task.formula, pose.reshape(1, 3)
        try:
            prefix = prefix_of(self.task, formula, view_of(self.task, formula), history, {})
        except SampleError:  # the rule's arithmetic is not finite there
            return False
        if prefix.steps == 0:
            return prefix.low > SATISFIED_ABOVE
        motions = self._proposal(history, {}, 0.0, AFTER).motions
        return bool(simulated(prefix, self._body, [motions], 0).rho.max() > SATISFIED_ABOVE)


def synthesise(task: Task, settings: Settings | None = None, run: Run | None = None) -> ReachabilityPolicy:
    """Makes the tables. Raises FragmentError for a formula that they do not cover, and PolicyError for a map
    that is too large.
    """
    began = time.perf_counter()
    settings, run = settings or Settings(), run or Run()
    body, rules = make_body(task.robot, task.grid), make_rules(task)
    pitch, cells = _extent(task, body, rules, settings)
    shared = rules, pitch, cells, settings.beam
    tables, narrow = _tables(task, body, *shared)
    wide = None if task.robot.goes_back else _tables(task, widened(body), *shared)[0]
    policy = ReachabilityPolicy(task, {}, settings, tables, narrow, wide)
    metrics = {
        "feasible_start": round(policy.feasible_start(), 4),
        "size_bytes": sum(t.code.nbytes + t.bits.nbytes + t.cell.nbytes for t in (tables, wide) if t),
        "wall_time_s": round(time.perf_counter() - began, 3),
    }
    card = make_card(task, "reachability", options_to_json(settings), 0, metrics, run.spec)
    return replace(policy, card=card)


def _tables(
    task: Task, body: Body, rules: Rules, pitch: float, cells: Bools | None, beam: int
) -> tuple[Tables, Bools]:
    """The tables for a body, and the obligations that they hardly see [K]. pitch, cells: see `_extent`."""
    lattice = make_lattice(body, pitch, cells)
    holds, narrow = look_closely(body, rules, lattice, holds_at(body, rules, lattice))
    if task.robot.wait_motion < 0:
        cell = number_cells(np.any(lattice.valid, axis=2))
        bits = feasible_steps(lattice, rules, holds, task.horizon, cell)
        return step_tables(rules, task.horizon, cell, bits, pitch), narrow
    masks, phases = masks_of(rules), phases_of(rules, task.horizon)
    latest, valid = latest_times(lattice, rules, holds, masks, phases)
    tables = pack_times(latest, valid, masks, phases, rules, pitch)
    return tables._replace(late=_late(task, body, rules, tables, beam)), narrow


def _late(task: Task, body: Body, rules: Rules, tables: Tables, beam: int) -> float:
    """`Tables.late` [steps], measured from fewer poses for a robot of many motions: in 10 to 60 ms."""
    many = max(LATE_POSES * FEW_MOTIONS // max(len(task.robot.motions), FEW_MOTIONS), 1)
    try:
        poses = free_poses(task, body, many, np.random.default_rng(0))
    except MapError:  # next to no free space
        return LATE
    guide = Guide(body, rules, tables, task.robot.wait_motion, NOTHING_BARRED)
    return lateness(guide, beam, poses)


def load_reachability(weights: bytes | Path, card: Card, task: Task) -> ReachabilityPolicy:
    """A policy from its two files. Raises PolicyError where they do not fit the task."""
    settings = read_options(Settings, card.get("options", {}))
    return ReachabilityPolicy(task, card, settings, *read_tables(weights, task, settings.pitch))


def check(task: Task, settings: Settings) -> None:
    """Raises what `synthesise` would raise for a task that it cannot serve, without making anything."""
    rules = make_rules(task)
    _extent(task, make_body(task.robot, task.grid), rules, settings)


def _extent(task: Task, body: Body, rules: Rules, settings: Settings) -> tuple[float, Bools | None]:
    """The pitch of the task's lattice [m], and the cells [ny, nx] that it covers, None for all.

    Raises PolicyError where the tables would be too large.
    """
    if task.robot.wait_motion < 0:
        entries, most = (task.horizon + 1) * -(-state_count(rules) // 8), MAX_BYTES
    else:
        entries, most = len(masks_of(rules)) * len(phases_of(rules, task.horizon)), MAX_ENTRIES
    if pose_count(task, settings.pitch / 3.0) * entries <= FINE_ENTRIES:
        return settings.pitch / 3.0, None
    pitch = fitting_pitch(task, settings.pitch, entries, most)
    if pitch == settings.pitch:
        return pitch, None
    cells = places_that_matter(task, body, rules, settings.pitch)
    pitch = fitting_pitch(task, settings.pitch, entries, most, float(cells.mean()))
    if pitch <= COARSEST * settings.pitch:
        return pitch, places_that_matter(task, body, rules, pitch)
    least = math.ceil(100.0 * pitch / COARSEST) / 100.0
    would = f"options.pitch {least:.2f} or more" if least <= 1.0 else "fewer windows that overlap"
    got = f"{entries} entries for each pose at a pitch of {settings.pitch:g} m"
    raise PolicyError("the tables are too large", path="options.pitch", got=got, expected=would)
