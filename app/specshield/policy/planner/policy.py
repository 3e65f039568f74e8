"""pi_phi for any formula: no tables of its progress, but a plan at every decision.

For each predicate of the formula, and its negation where that is asked for, a field of the steps to go is
computed once (fields.py). A decision asks the formula which literals are due (due_dates.py), and searches for
a way that serves them (search.py). A way that is not found costs permission, never safety. The planner covers
what reachability does not: reactive rules over signals, patrols (G F), until, disjunctions of temporal parts,
nested mixes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path

import numpy as np
from safetensors.numpy import save as save_tensors

from specshield.arrays import Bools, Floats, Int32s
from specshield.caution.residual import all_of
from specshield.caution.surprise.barred import NOTHING_BARRED
from specshield.caution.worst import moved, worst_signals
from specshield.compiled import box
from specshield.errors import MapError, PolicyError
from specshield.policy.card import Card, Carded, joined, make_card
from specshield.policy.dqn.environment import free_poses
from specshield.policy.extent import COARSEST, fitting_pitch
from specshield.policy.lattice import headings_of, side_of
from specshield.policy.methods import Run
from specshield.policy.options import options_to_json, read_options
from specshield.policy.planner.due_dates import cost_of
from specshield.policy.planner.earlier import earlier_rule
from specshield.policy.planner.fields import OUT_OF_REACH, Fields
from specshield.policy.planner.first_motions import plan_all
from specshield.policy.planner.leads import MAX_ENTRIES, MAX_FIELDS, make_fields
from specshield.policy.planner.literals import leading, literals_of, released
from specshield.policy.planner.method import Settings
from specshield.policy.planner.way import World
from specshield.policy.progress import residuals
from specshield.policy.reachability.stored import check_fit
from specshield.policy.tensors import named_arrays, read_tensors
from specshield.policy.undo import turning_motion
from specshield.reasons.still_open import bounds_after, still_open
from specshield.robot.dynamics import Body, calmest_motion
from specshield.rule.values import signal_rows
from specshield.rule.view import look
from specshield.shield.proposal import Proposal
from specshield.stl import SATISFIED_ABOVE, Formula, conjuncts
from specshield.task import Task
from specshield.world.occupancy import OccupancyGrid

USUAL_HORIZON = 150  # [steps] up to which a plan may cost no more than the effort of the settings
BAND = 6.0  # [steps] by which the fields may err; chosen by hand, nothing measured
# Poses of a search for a way that the fields miss, at a session's first step and later on; chosen by hand.
FIRST, ON = 300_000, 20_000
# Of the effort of a plan: where one decision makes several, and on a map that the session has learned, which
# may be only the first that a decision tries. docs/decisions.md says what they cost and save.
GUESSED, LEARNED = 0.25, 0.5
STARTS = 50  # poses that a new policy is tried from
FIELDS_SHARE = 0.3  # of the time that making a policy takes, about


@dataclass(frozen=True, eq=False)
class PlannerPolicy(Carded):
    """Plans at every decision.

    chosen [L, 2 or 4]: for each literal of the formula the field that leads to it freely, and the one that
    keeps what has to hold for a while; -1 for none. If another part asks for what begins a response, the
    same again, but with fields that lead there to where the answer is nearest. foreseen [S]: the values of
    the signals from x_{t+1} on; None: their last values. share: of the effort that the settings allow. rest:
    the formula that is planned for if parts are given up. early [steps]: by how much deadlines come earlier.
    again: the same with fields for another map, see `remade`.
    """

    settings: Settings
    fields: Fields
    chosen: Int32s
    foreseen: Floats | None = None
    share: float = 1.0
    rest: Formula | None = None
    early: int = 0
    again: PlannerPolicy | None = None

    @cached_property
    def _world(self) -> World:
        return self._world_of(self.task.formula)

    def on_body(self, body: Body, guess: bool = False) -> PlannerPolicy:
        """The policy on another map, on which its ways are simulated: with the newest fields that there are.

        guess: whether the map is one of several that are tried in one decision. It has fewer obstacles than
        what was learned, for which the newest fields are, so its fields are those of the policy's own map.
        """
        policy = self if guess or self.again is None else self.again
        return replace(policy, share=GUESSED if guess else LEARNED)._in(policy._world._replace(body=body))

    def remade(self, grid: OccupancyGrid) -> PlannerPolicy:
        """The policy, which has fields for another map of the same size beside its own from now on."""
        fields, chosen = make_fields(replace(self.task, grid=grid), self.fields.pitch)
        return replace(self, again=replace(self, fields=fields, chosen=chosen, again=None))

    def briefly(self) -> PlannerPolicy:
        """The policy with less effort a plan, for explanations, which ask it often."""
        return self.on_body(self._world.body, guess=True)

    def avoiding(self, barred: Floats) -> PlannerPolicy:
        """The policy without barred motions [n, 6] (caution/surprise/barred.py)."""
        return self._in(self._world._replace(barred=barred))

    def promptly(self) -> PlannerPolicy:
        """The policy that begins responses where their answers are nearest, with less effort a plan; itself
        if it has no such ways.
        """
        if not (chosen := self.chosen[:, 2:]).size:
            return self
        policy = replace(self, chosen=chosen, share=GUESSED * self.share)
        return policy._in(self._world._replace(field=chosen.astype(np.int64)))

    def earlier(self, steps: int, wanted: Bools) -> PlannerPolicy:
        """The policy for deadlines that come so many steps earlier, with less effort a plan; itself unless a
        way after each first motion is `wanted` [M], since a plan for some costs as much.
        """
        return replace(self, share=GUESSED, early=steps)._in(self._world) if wanted.all() else self

    def giving_up(self, lost: tuple[Formula, ...]) -> PlannerPolicy:
        """The policy for its rule without these parts: it proposes one way alone, with less effort."""
        parts = conjuncts(moved(self.task)[0])
        rest = [part for part in parts if part not in lost] or parts
        return replace(self, share=GUESSED, rest=all_of(rest))._in(self._world)

    def foreseeing(self, signals: Floats) -> PlannerPolicy:
        """The policy that takes the signals to have these values [S] from x_{t+1} on."""
        return replace(self, foreseen=signals)._in(self._world)

    def _in(self, world: World) -> PlannerPolicy:
        other = replace(self)
        other.__dict__.update(_body=world.body, _world=world)
        return other

    def _world_of(self, formula: Formula) -> World:
        """The world as a search sees it for the task's formula, or for what is left of it."""
        packed, literals = literals_of(self.task, formula)
        _, all_literals = literals_of(self.task, self.task.formula)
        known = {each[:2]: (*of,) for each, of in zip(all_literals, self.chosen.tolist(), strict=True)}
        leads = [known.get(each[:2], known.get(leading(each), (-1, -1)))[:2] for each in literals]
        pad, stands = calmest_motion(self._body), self.task.robot.wait_motion >= 0
        # For a robot that cannot turn in place the lattice misses many ways, so its fields rule out nothing.
        band = BAND if turning_motion(self._body) >= 0 else 2.0 * OUT_OF_REACH
        columns, cost = np.array(leads, np.int64).reshape(-1, 2), cost_of(packed.formula.tree)
        return World(self._body, self.fields, packed, columns, band, pad, stands, cost, NOTHING_BARRED)

    def propose(self, history: Floats, signals: Mapping[str, Floats], margin: float) -> Proposal:
        """A plan from x_t, and one after each other first motion."""
        ways, _ = self._plan(history, signals, margin, FIRST if len(history) == 1 else ON)
        if self.rest is not None:
            return Proposal(ways.motions[ways.motions[:, 0] == ways.preferred], ways.preferred)
        return ways

    def _plan(
        self, history: Floats, signals: Mapping[str, Floats], margin: float, most: int
    ) -> tuple[Proposal, bool]:
        """The proposal, and whether a plan of it satisfies the formula, or what can still be kept of it.

        most: poses of a search for a way that the fields miss.
        """
        t, rows = len(history) - 1, signal_rows(self.task, signals, len(history))
        formula = self._world.literals.formula
        _, high = look(box(formula), history, rows, np.empty(formula.tree.size))
        whole = self.rest or moved(self.task)[0]
        parts: Iterable[Formula] = (whole,)
        if high <= SATISFIED_ABOVE:
            left = residuals(whole, self.task.samples(history, signals), t)
            parts = chain((part for part in left if part.horizon > t), parts)
        for part in chain.from_iterable(dict.fromkeys((released(each), each)) for each in parts):
            asked = self._asked(part, history, rows, margin) if margin > 0.0 else (part,)
            if self.early:
                asked = tuple(earlier_rule(self.task, each, self.early, history, rows) for each in asked)
            worlds = (self._world if each is self.task.formula else self._world_of(each) for each in asked)
            plans = [self._plan_in(world, history, rows, margin, most) for world in worlds]
            found = any(found for _, found in plans)
            if found:
                break
        return joined(*(proposal for proposal, _ in plans)), found

    def _asked(self, formula: Formula, history: Floats, rows: Floats, margin: float) -> tuple[Formula, ...]:
        """The formulas of which J asks the margin. J asks it of each part as a whole if that can still have
        it, else of what is still open of the part. If a past visit has less than the margin, there is a
        second formula: what is still open of all parts.
        """
        parts = conjuncts(formula)
        bounds = [bounds_after(self.task, part, history, rows) for part in parts]
        lost = [SATISFIED_ABOVE < high <= margin for _, high in bounds]
        again = any(SATISFIED_ABOVE < low <= margin < high for low, high in bounds)
        if not again and not any(lost):
            return (formula,)
        left = still_open(self.task, formula, history, rows)
        if not again:
            return (left,)
        kept = [
            still_open(self.task, part, history, rows) if gone else part
            for part, gone, (low, _) in zip(parts, lost, bounds, strict=True)
            if not (gone and low > SATISFIED_ABOVE)
        ]
        return (formula if not any(lost) else all_of(kept), left)

    def _plan_in(
        self, world: World, history: Floats, rows: Floats, margin: float, most: int
    ) -> tuple[Proposal, bool]:
        t = len(history) - 1
        literals = world.literals._replace(margin=margin)
        known = np.empty(literals.formula.tree.size)
        look(box(literals.formula), history, rows, known)
        motions = np.empty((len(self.task.robot.motions), self.task.horizon - t), np.int64)
        effort = self.share * self.settings.effort * max(1.0, self.task.horizon / USUAL_HORIZON) ** 2
        world = world._replace(literals=literals, barred=self._world.barred)
        held = rows[-1] if self.foreseen is None else self.foreseen
        without_plan = math.inf if self.share == 1.0 else effort
        allowed = effort, without_plan, int(self.share * most)
        first, found = plan_all(world, t, history[-1], held, known, *allowed, motions)
        return Proposal(motions, int(first)), bool(found)

    def feasible_start(
        self,
        signals: Mapping[str, Floats] | None = None,
        on_progress: Callable[[float], None] = lambda done: None,
    ) -> float:
        """The share of poses drawn over free space (the same each time) from which a plan was found.

        signals {name: [1]}: held from x_0 on; else each has its initial value. on_progress: told the share
        of the poses that were tried.
        """
        try:
            poses = free_poses(self.task, self._body, STARTS, np.random.default_rng(0))
        except MapError:  # next to no free space
            return 0.0
        begun = 0
        for tried, pose in enumerate(poses, 1):
            begun += self._plan(pose.reshape(1, 3), signals or {}, 0.0, ON)[1]
            on_progress(tried / STARTS)
        return begun / STARTS

    def weights(self) -> bytes:
        """The safetensors file."""
        return save_tensors({"cell": self.fields.cell, "code": self.fields.code, "chosen": self.chosen})


def synthesise(task: Task, settings: Settings | None = None, run: Run | None = None) -> PlannerPolicy:
    """Computes the fields. Raises PolicyError for a map too large."""
    began = time.perf_counter()
    settings, run = settings or Settings(), run or Run()

    def tell(done: float) -> None:
        run.on_progress(done, (time.perf_counter() - began) * (1.0 - done) / done, "")

    pitch = _pitch(task, settings)
    fields, chosen = make_fields(task, pitch, lambda done: tell(FIELDS_SHARE * done))
    # Trying it also leaves its kernels compiled where a server finds them.
    policy = PlannerPolicy(task, {}, settings, fields, chosen)
    share = policy.feasible_start(on_progress=lambda done: tell(FIELDS_SHARE + (1.0 - FIELDS_SHARE) * done))
    metrics = {"feasible_start": round(share, 4)}
    if task.signals:
        worst = worst_signals(task, task.formula)
        at_worst = {} if worst is None else dict(zip(task.signals, worst.T, strict=True))
        share = policy.feasible_start(at_worst) if at_worst else 0.0
        metrics["feasible_start_any_signal"] = round(share, 4)
    size, took = int(fields.code.nbytes + fields.cell.nbytes), round(time.perf_counter() - began, 3)
    metrics |= {"fields": len(fields.code), "size_bytes": size, "wall_time_s": took}
    return replace(policy, card=make_card(task, "planner", options_to_json(settings), 0, metrics, run.spec))


def load_planner(weights: bytes | Path, card: Card, task: Task) -> PlannerPolicy:
    """A policy from its two files. Raises PolicyError where they do not fit the task."""
    settings = read_options(Settings, card.get("options", {}))
    _, literals = literals_of(task, task.formula)
    cell, code, chosen = named_arrays(
        read_tensors(weights), {"cell": (np.int32, 2), "code": (np.uint16, 3), "chosen": (np.int32, 2)}
    )
    usual = cell.shape == side_of(task.grid, settings.pitch)
    pitch = settings.pitch if usual else _pitch(task, settings)
    shaped = chosen.shape in ((len(literals), 2), (len(literals), 4))  # 4 with ways for `promptly`
    fits = shaped and bool(np.isin(chosen, np.arange(-1, len(code))).all())
    check_fit(cell, task, pitch, code, fits, f"a field for each of {len(literals)} literals")
    return PlannerPolicy(task, card, settings, Fields(cell, code, pitch), chosen)


def check(task: Task, settings: Settings) -> None:
    """Raises what `synthesise` would for a task it cannot serve, without making anything."""
    _pitch(task, settings)


def _pitch(task: Task, settings: Settings) -> float:
    """The pitch of the task's lattice [m]. Raises PolicyError where the fields would be too large."""
    _, literals = literals_of(task, task.formula)
    fields = max(1, min(2 * len(literals), MAX_FIELDS))
    pitch = fitting_pitch(task, settings.pitch, fields, MAX_ENTRIES)
    if pitch > COARSEST * settings.pitch:
        (ny, nx), headings = side_of(task.grid, settings.pitch), headings_of(task)
        got = f"{fields} fields of {ny} x {nx} x {headings} poses"
        least = math.ceil(100.0 * pitch / COARSEST) / 100.0
        would = f"options.pitch {least:.2f} or more, or fewer predicates"
        raise PolicyError("the fields are too large", path="options.pitch", got=got, expected=would)
    return pitch
