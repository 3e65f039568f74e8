"""pi_phi by backward dynamic programming over pose and progress: made in a second, without learning."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save as save_tensors

from specshield.errors import FragmentError, PolicyError
from specshield.policy.latest import Phase, latest_times, masks_of, phases_of
from specshield.policy.lattice import heading_count, holds_at, make_lattice
from specshield.policy.policy import Card, Proposal, make_card, read_tensors, wait_motion
from specshield.policy.progress import (
    ALWAYS,
    Rules,
    make_rules,
    signal_rows,
)
from specshield.policy.search import propose_all
from specshield.policy.tables import INVALID, SCALE, Tables
from specshield.policy.walk import Guide
from specshield.robot.unicycle import Body, make_body
from specshield.task import Task

MAX_ENTRIES = 100_000_000  # 400 MB while the tables are made
FINE_ENTRIES = 1_000_000  # a lattice three times finer that needs no more is used instead


@dataclass(frozen=True)
class Settings:
    """pitch: of the lattice [m], a third of it where the map is small. beam: how many poses the search near a
    deadline keeps for each motion.
    """

    pitch: float = 0.1
    beam: int = 12


def read_settings(options: Mapping[str, Any]) -> Settings:
    """Settings from JSON. Raises PolicyError with the path of the option at fault."""
    limits = {"pitch": (0.02, 1.0), "beam": (1, 256)}
    for name, value in options.items():
        if name not in limits:
            raise PolicyError(
                f"unknown option {name!r}",
                path=f"options.{name}",
                got=name,
                expected=f"one of {sorted(limits)}",
            )
        low, high = limits[name]
        whole = name == "beam"
        if (
            isinstance(value, bool)
            or not isinstance(value, int if whole else (int, float))
            or not low <= value <= high
        ):
            raise PolicyError(
                "not in range", path=f"options.{name}", got=value, expected=f"from {low:g} to {high:g}"
            )
    return Settings(**options)


@dataclass(frozen=True, eq=False)
class ReachabilityPolicy:
    """Follows the tables of latest feasible times (policy/tables.py, policy/search.py)."""

    task: Task
    card: Card
    settings: Settings
    tables: Tables

    @property
    def id(self) -> str:
        return str(self.card["id"])

    @cached_property
    def _prepared(self) -> tuple[Body, Rules]:
        return make_body(self.task.robot, self.task.grid), make_rules(self.task)

    def propose(
        self, history: NDArray[np.float64], signals: Mapping[str, NDArray[np.float64]], margin: float
    ) -> Proposal:
        """A continuation after each first motion: greedy, or by a beam near a deadline."""
        body, rules = self._prepared
        rules = rules._replace(signals=rules.signals.copy(), margin=margin)
        motions = np.empty((len(body.translate), self.task.horizon + 1 - len(history)), np.int64)
        poses = np.empty((*motions.shape, 3))
        preferred = propose_all(
            Guide(body, rules, self.tables, wait_motion(self.task.robot)), self.settings.beam, history,
            signal_rows(self.task, signals, len(history)), motions, poses,
        )  # fmt: skip
        return Proposal(motions, poses, int(preferred))

    def weights(self) -> bytes:
        """The safetensors file."""
        return save_tensors({"cell": self.tables.cell, "code": self.tables.code, "table": self.tables.table})


def synthesise(
    task: Task, settings: Settings | None = None, spec: Mapping[str, Any] | None = None
) -> ReachabilityPolicy:
    """Makes the tables. Raises FragmentError for a formula or robot they do not cover, PolicyError for a
    map too large.
    """
    began = time.perf_counter()
    settings = settings or Settings()
    body, rules = make_body(task.robot, task.grid), make_rules(task)
    goals, pitch = _goals(task, rules, settings)
    lattice = make_lattice(body, pitch)
    masks, phases = masks_of(rules, goals), phases_of(rules, task.horizon)
    latest, valid = latest_times(lattice, rules, holds_at(body, rules, lattice), goals, masks, phases)
    tables = _pack(latest, valid, masks, phases, goals, len(rules.kind), pitch)
    start = latest[0, masks.index(0)][valid[0] == 1]
    metrics = {
        "feasible_start": round(float((start >= 0.0).mean()), 4) if len(start) else 0.0,
        "size_bytes": int(tables.code.nbytes + tables.cell.nbytes),
        "wall_time_s": round(time.perf_counter() - began, 3),
    }
    card = make_card(task, "reachability", asdict(settings), 0, metrics, spec)
    return ReachabilityPolicy(task, card, settings, tables)


def load_reachability(weights: bytes, card: Card, task: Task) -> ReachabilityPolicy:
    """A policy from its two files. Raises PolicyError where they do not fit the task."""
    settings = read_settings(card.get("options", {}))
    rules = make_rules(task)
    goals, pitch = _goals(task, rules, settings)
    tensors = read_tensors(weights)
    wanted = {"cell": (np.int32, 2), "code": (np.uint16, 3), "table": (np.int32, 2)}
    for name, (dtype, rank) in wanted.items():
        array = tensors.get(name)
        if array is None or array.dtype != dtype or array.ndim != rank:
            raise PolicyError(
                f"the table {name!r} is missing or of another kind", path=f"weights.{name}",
                got=None if array is None else f"{array.dtype} {list(array.shape)}",
                expected=f"{dtype.__name__}, rank {rank}",
            )  # fmt: skip
    cell, code, table = tensors["cell"], tensors["code"], tensors["table"]
    shape, headings = _shape(task, pitch)
    phases = phases_of(rules, task.horizon)
    fits = (
        cell.shape == shape and code.shape[2] == headings and table.shape == (len(phases), 1 << len(goals))
        and cell.min(initial=-1) >= -1 and cell.max(initial=-1) < code.shape[1]
        and table.min() >= -1 and table.max() < code.shape[0]
    )  # fmt: skip
    if not fits:
        raise PolicyError(
            "the tables do not fit the task", path="weights",
            got=[list(cell.shape), list(code.shape), list(table.shape)],
            expected=f"cell {list(shape)}, code [tables, cells, {headings}], "
            f"table [{len(phases)}, {1 << len(goals)}]",
        )  # fmt: skip
    cell, code, table = (np.ascontiguousarray(array) for array in (cell, code, table))
    tables = Tables(cell, code, table, *_times(phases), _bits(goals, len(rules.kind)), pitch)
    return ReachabilityPolicy(task, card, settings, tables)


def check(task: Task, settings: Settings) -> None:
    """Raises what `synthesise` would for a task it cannot serve, without making anything."""
    _goals(task, make_rules(task), settings)


def _goals(task: Task, rules: Rules, settings: Settings) -> tuple[NDArray[np.int64], float]:
    """The obligations that are not `always`, and the lattice's pitch, where the tables cover the task."""
    if wait_motion(task.robot) < 0:
        raise FragmentError(
            "reachability needs a robot that can wait", path="robot", got=list(task.robot.action_names),
            expected="an action with translate 0 and rotate 0; or method 'dqn'",
        )  # fmt: skip
    goals = np.flatnonzero(rules.kind != ALWAYS)
    tables = len(masks_of(rules, goals)) * len(phases_of(rules, task.horizon))
    for pitch, limit in ((settings.pitch / 3.0, FINE_ENTRIES), (settings.pitch, MAX_ENTRIES)):
        (ny, nx), headings = _shape(task, pitch)
        if ny * nx * headings * tables <= limit:
            return goals, pitch
    raise PolicyError(
        "the tables are too large", path="options.pitch",
        got=f"{tables} tables of {ny} x {nx} x {headings} poses",
        expected=f"at most {MAX_ENTRIES} entries: a larger pitch, or fewer windows that overlap",
    )  # fmt: skip


def _shape(task: Task, pitch: float) -> tuple[tuple[int, int], int]:
    ny, nx = (
        max(int(np.ceil(n * task.grid.resolution / pitch - 1e-9)), 1)
        for n in (task.grid.height, task.grid.width)
    )
    return (ny, nx), heading_count([rotate for _, rotate in task.robot.motions if rotate != 0.0])


def _bits(goals: NDArray[np.int64], obligations: int) -> NDArray[np.int64]:
    bit = np.zeros(obligations, np.int64)
    bit[goals] = 1 << np.arange(len(goals))
    return bit


def _pack(
    latest: NDArray[np.float32],
    valid: NDArray[np.uint8],
    masks: list[int],
    phases: tuple[Phase, ...],
    goals: NDArray[np.int64],
    obligations: int,
    pitch: float,
) -> Tables:
    used = valid.any(axis=(0, 3))
    cell = np.full(used.shape, -1, np.int32)
    cell[used] = np.arange(int(used.sum()))
    table = np.full((len(phases), 1 << len(goals)), -1, np.int32)
    codes: list[NDArray[np.uint16]] = []
    for i in range(len(phases)):
        for n, mask in enumerate(masks):
            values = latest[i, n][used]
            settled = mask == masks[0] and i == len(phases) - 1  # nothing left to do
            if settled or not np.any(values >= 0.0):
                continue
            code = np.where(values >= 0.0, 1.0 + np.floor(SCALE * values), 0.0).astype(np.uint16)
            code[valid[i][used] == 0] = INVALID
            table[i, mask] = len(codes)
            codes.append(code)
    shape = (len(codes), int(used.sum()), valid.shape[3])
    code = np.array(codes, np.uint16).reshape(shape)
    return Tables(cell, code, table, *_times(phases), _bits(goals, obligations), pitch)


def _times(phases: tuple[Phase, ...]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The phase of each step, and each phase's last step."""
    ends = np.array([phase.end for phase in phases], np.int32)
    return np.searchsorted(ends, np.arange(ends[-1] + 1)).astype(np.int32), ends
