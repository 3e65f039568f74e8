"""pi_phi by backward dynamic programming over pose and progress: made in about a second, without learning."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save as save_tensors

from specshield.arrays import Bytes, Codes, Floats, Int32s, Ints, Singles
from specshield.errors import PolicyError
from specshield.policy.card import Card, make_card
from specshield.policy.lattice import INVALID, STEP_CODES, holds_at, lattice_shape, make_lattice, number_cells
from specshield.policy.options import options_to_json, read_options
from specshield.policy.reachability.around import go_around
from specshield.policy.reachability.guide import Guide
from specshield.policy.reachability.latest import Phase, latest_times, masks_of, phases_of
from specshield.policy.reachability.method import Settings
from specshield.policy.reachability.search import continue_all
from specshield.policy.reachability.stepwise import MAX_BYTES, digits_of, feasible_steps, state_count
from specshield.policy.reachability.tables import Tables
from specshield.policy.recall import pasts
from specshield.policy.tensors import named_arrays, read_tensors
from specshield.robot.dynamics import Body, make_body
from specshield.rule.progress import ALWAYS, Rules, make_rules, signal_rows
from specshield.shield.proposal import Proposal, joined
from specshield.task import Task

MAX_ENTRIES = 100_000_000  # of float32: 400 MB while the tables are made
FINE_ENTRIES = 1_000_000  # a lattice three times finer is used where it needs no more than this


@dataclass(frozen=True, eq=False)
class ReachabilityPolicy:
    """Proposes what the tables (tables.py) lead to (search.py)."""

    task: Task
    card: Card
    settings: Settings
    tables: Tables
    told: bool = True  # whether the tables were made for the map that the policy goes by

    @property
    def id(self) -> str:
        return str(self.card["id"])

    @cached_property
    def _body(self) -> Body:
        return make_body(self.task.robot, self.task.grid)

    @cached_property
    def _rules(self) -> Rules:
        return make_rules(self.task)

    def on_body(self, body: Body) -> ReachabilityPolicy:
        """The policy on another map: its tables suggest what they did, its ways are those that there are."""
        other = replace(self, told=False)
        other.__dict__.update(_body=body, _rules=self._rules)
        return other

    def propose(self, history: Floats, signals: Mapping[str, Floats], margin: float) -> Proposal:
        """A continuation after each first motion."""
        body, rules = self._body, self._rules
        rules = rules._replace(signals=rules.signals.copy(), margin=margin)
        rows = signal_rows(self.task, signals, len(history))
        guide = Guide(body, rules, self.tables, self.task.robot.wait_motion)
        proposals = []
        for past in pasts(rules, history, rows):
            motions = np.empty((len(self.task.robot.motions), self.task.horizon + 1 - len(history)), np.int64)
            poses = np.empty((*motions.shape, 3))
            preferred = continue_all(guide, self.settings.beam, past, history, rows, motions, poses)
            proposals.append(Proposal(motions, int(preferred)))
            if not self.told:
                ways = np.empty_like(motions)
                first = go_around(guide, past, history, rows, poses, ways)
                if first >= 0:
                    proposals.append(Proposal(ways, int(first)))
        return joined(*proposals)

    def weights(self) -> bytes:
        """The safetensors file."""
        names = ("cell", "bits") if len(self.tables.bits) else ("cell", "code", "table")
        return save_tensors({name: getattr(self.tables, name) for name in names})


def synthesise(
    task: Task, settings: Settings | None = None, spec: Mapping[str, Any] | None = None
) -> ReachabilityPolicy:
    """Makes the tables. Raises FragmentError for a formula that they do not cover, and PolicyError for a map
    that is too large.
    """
    began = time.perf_counter()
    settings = settings or Settings()
    body, rules = make_body(task.robot, task.grid), make_rules(task)
    goals, pitch = _goals(task, rules, settings)
    lattice = make_lattice(body, pitch)
    holds = holds_at(body, rules, lattice)
    if task.robot.wait_motion < 0:
        cell = number_cells(np.any(lattice.valid, axis=2))
        bits, feasible = feasible_steps(lattice, rules, holds, task.horizon, cell)
        tables = _step_tables(rules, task.horizon, cell, bits, pitch)
        size = tables.bits.nbytes + tables.cell.nbytes
    else:
        masks, phases = masks_of(rules, goals), phases_of(rules, task.horizon)
        latest, valid = latest_times(lattice, rules, holds, goals, masks, phases)
        tables = _pack(latest, valid, masks, phases, goals, rules, pitch)
        start = latest[0, masks.index(0)][valid[0] == 1]
        feasible = float((start >= 0.0).mean()) if len(start) else 0.0
        size = tables.code.nbytes + tables.cell.nbytes
    metrics = {
        "feasible_start": round(feasible, 4),
        "size_bytes": int(size),
        "wall_time_s": round(time.perf_counter() - began, 3),
    }
    card = make_card(task, "reachability", options_to_json(settings), 0, metrics, spec)
    return ReachabilityPolicy(task, card, settings, tables)


def load_reachability(weights: bytes | Path, card: Card, task: Task) -> ReachabilityPolicy:
    """A policy from its two files. Raises PolicyError where they do not fit the task."""
    settings = read_options(Settings, card.get("options", {}))
    rules = make_rules(task)
    goals, pitch = _goals(task, rules, settings)
    tensors, (ny, nx, headings) = read_tensors(weights), lattice_shape(task, pitch)
    if task.robot.wait_motion < 0:
        cell, bits = named_arrays(tensors, {"cell": (np.int32, 2), "bits": (np.uint8, 4)})
        size = (task.horizon + 1, int(cell.max(initial=-1)) + 1, headings, -(-state_count(rules) // 8))
        _check_fit(cell, (ny, nx), bits.shape[1], bits.shape == size, f"bits {list(size)}")
        return ReachabilityPolicy(task, card, settings, _step_tables(rules, task.horizon, cell, bits, pitch))
    cell, code, table = named_arrays(
        tensors, {"cell": (np.int32, 2), "code": (np.uint16, 3), "table": (np.int32, 2)}
    )
    phases = phases_of(rules, task.horizon)
    fits = (
        code.shape[2] == headings and table.shape == (len(phases), 1 << len(goals))
        and table.min() >= -1 and table.max() < code.shape[0]
    )  # fmt: skip
    wanted = f"code [tables, cells, {headings}], table [{len(phases)}, {1 << len(goals)}]"
    _check_fit(cell, (ny, nx), code.shape[1], fits, wanted)
    return ReachabilityPolicy(
        task, card, settings, _time_tables(rules, goals, phases, cell, code, table, pitch)
    )


def _check_fit(cell: Int32s, shape: tuple[int, int], rows: int, fits: bool, wanted: str) -> None:
    if not fits or cell.shape != shape or cell.min(initial=-1) < -1 or cell.max(initial=-1) >= rows:
        raise PolicyError(
            "the tables do not fit the task", path="weights",
            got=f"cell {list(cell.shape)} and tables of {rows} cells",
            expected=f"cell {list(shape)}, {wanted}",
        )  # fmt: skip


def check(task: Task, settings: Settings) -> None:
    """Raises what `synthesise` would raise for a task that it cannot serve, without making anything."""
    _goals(task, make_rules(task), settings)


def _goals(task: Task, rules: Rules, settings: Settings) -> tuple[Ints, float]:
    """The goals (indices of the obligations that are not `always`) and the pitch of the task's lattice [m].

    Raises PolicyError where the tables would be too large.
    """
    goals = np.flatnonzero(rules.kind != ALWAYS)
    if task.robot.wait_motion < 0:
        entries, unit = (task.horizon + 1) * -(-state_count(rules) // 8), "bytes"
        limits = FINE_ENTRIES, MAX_BYTES
    else:
        entries = len(masks_of(rules, goals)) * len(phases_of(rules, task.horizon))
        limits, unit = (FINE_ENTRIES, MAX_ENTRIES), "entries"
    for pitch, limit in zip((settings.pitch / 3.0, settings.pitch), limits, strict=True):
        ny, nx, headings = lattice_shape(task, pitch)
        if ny * nx * headings * entries <= limit:
            return goals, pitch
    raise PolicyError(
        "the tables are too large", path="options.pitch",
        got=f"{entries} {unit} for each of {ny} x {nx} x {headings} poses",
        expected=f"at most {limit} {unit}: a larger pitch, or fewer windows that overlap",
    )  # fmt: skip


def _pack(
    latest: Singles, valid: Bytes, masks: list[int], phases: tuple[Phase, ...],
    goals: Ints, rules: Rules, pitch: float,
) -> Tables:  # fmt: skip
    used = np.any(valid, axis=(0, 3))
    table = np.full((len(phases), 1 << len(goals)), -1, np.int32)
    codes: list[Codes] = []
    for i in range(len(phases)):
        for n, mask in enumerate(masks):
            values = latest[i, n][used]
            settled = mask == masks[0] and i == len(phases) - 1  # nothing left to do
            if settled or not np.any(values >= 0.0):
                continue
            code = np.where(values >= 0.0, 1.0 + np.floor(STEP_CODES * values), 0.0).astype(np.uint16)
            code[valid[i][used] == 0] = INVALID
            table[i, mask] = len(codes)
            codes.append(code)
    code = np.array(codes, np.uint16).reshape(len(codes), int(used.sum()), valid.shape[3])
    return _time_tables(rules, goals, phases, number_cells(used), code, table, pitch)


def _time_tables(
    rules: Rules, goals: Ints, phases: tuple[Phase, ...], cell: Int32s, code: Codes,
    table: Int32s, pitch: float,
) -> Tables:  # fmt: skip
    bit = np.zeros(len(rules.kind), np.int64)
    bit[goals] = 1 << np.arange(len(goals))
    ends = np.array([phase.end for phase in phases], np.int32)
    phase = np.searchsorted(ends, np.arange(ends[-1] + 1)).astype(np.int32)
    none = np.empty((0, 0, 0, 0), np.uint8)
    return Tables(cell, code, table, phase, ends, bit, none, np.zeros_like(bit), np.zeros_like(bit), pitch)


def _step_tables(rules: Rules, horizon: int, cell: Int32s, bits: Bytes, pitch: float) -> Tables:
    code = np.empty((0, *bits.shape[1:3]), np.uint16)
    phase, end = np.zeros(horizon + 1, np.int32), np.array([horizon], np.int32)
    bit = np.zeros(len(rules.kind), np.int64)
    return Tables(cell, code, np.full((1, 1), -1, np.int32), phase, end, bit, bits, *digits_of(rules), pitch)
