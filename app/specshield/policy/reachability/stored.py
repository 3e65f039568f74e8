"""The tables as a safetensors file: written, read back, and checked against the task."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save as save_tensors

from specshield.arrays import Bools, Int32s
from specshield.errors import PolicyError
from specshield.policy.extent import COARSEST
from specshield.policy.lattice import MAX_HEADINGS, side_of
from specshield.policy.progress import Rules, goals_of, make_rules
from specshield.policy.reachability.latest import LEAST_LATE, MOST_LATE, phases_of, time_tables
from specshield.policy.reachability.stepwise import state_count, step_tables
from specshield.policy.reachability.tables import Tables
from specshield.policy.tensors import named_arrays, read_tensors
from specshield.task import Task

Tensors = dict[str, NDArray[Any]]
WIDE = "wide_"  # begins the names of the arrays of the tables for ways with room


def stored(tables: Tables, wide: Tables | None, narrow: Bools, asked: float) -> bytes:
    """The file. wide, narrow [K]: of the policy; asked: the pitch that its options ask for [m]."""
    names = ("cell", "bits") if len(tables.bits) else ("cell", "code", "table")
    tensors: Tensors = {name: getattr(tables, name) for name in names}
    if wide is not None:
        tensors |= {WIDE + name: getattr(wide, name) for name in names}
    if not len(tables.bits):
        tensors |= {of + "late": np.array([made.late]) for of, made in (("", tables), (WIDE, wide)) if made}
    if narrow.any():
        tensors["narrow"] = narrow.astype(np.uint8)
    if tables.pitch > asked:
        tensors["pitch"] = np.array([tables.pitch])
    return save_tensors(tensors)


def read_tables(weights: bytes | Path, task: Task, asked: float) -> tuple[Tables, Bools, Tables | None]:
    """What `stored` wrote: tables, narrow and wide; `asked` for the same pitch. Raises PolicyError where it
    does not fit the task.
    """
    rules, tensors = make_rules(task), read_tensors(weights)
    wide = {name: tensors.pop(name) for name in list(tensors) if name.startswith(WIDE)}
    narrow = _narrow_of(tensors.pop("narrow", None), len(rules.kind))
    pitch = _pitch_of(tensors, task, asked)
    tables = _tables_of(tensors, task, rules, pitch)
    return tables, narrow, _tables_of(wide, task, rules, pitch, WIDE) if wide else None


def _tables_of(tensors: Tensors, task: Task, rules: Rules, pitch: float, of: str = "") -> Tables:
    sets = 1 << len(goals_of(rules))
    if task.robot.wait_motion < 0:
        cell, bits = named_arrays(tensors, {f"{of}cell": (np.int32, 2), f"{of}bits": (np.uint8, 4)})
        size = (task.horizon + 1, int(cell.max(initial=-1)) + 1, bits.shape[2], -(-state_count(rules) // 8))
        check_fit(cell, task, pitch, bits, bits.shape == size, f"bits {list(size)}")
        return step_tables(rules, task.horizon, cell, bits, pitch)
    late = _number(tensors, f"{of}late", MOST_LATE, LEAST_LATE)  # versions before 0.2 did not write it
    cell, code, table = named_arrays(
        tensors, {f"{of}cell": (np.int32, 2), f"{of}code": (np.uint16, 3), f"{of}table": (np.int32, 2)}
    )
    phases = phases_of(rules, task.horizon)
    fits = table.shape == (len(phases), sets) and table.min() >= -1 and table.max() < code.shape[0]
    wanted = f"code [tables, cells, {code.shape[2]}], table [{len(phases)}, {sets}]"
    check_fit(cell, task, pitch, code, fits, wanted)
    tables = time_tables(rules, phases, cell, code, table, pitch)
    return tables if late is None else tables._replace(late=late)


def _pitch_of(tensors: Tensors, task: Task, asked: float) -> float:
    """The lattice's pitch [m]: one that had to grow is in the file, the others go by the number of cells."""
    kept, cell, fine = _number(tensors, "pitch", asked, COARSEST * asked), tensors.get("cell"), asked / 3.0
    if kept is not None:
        return kept
    return fine if cell is not None and cell.shape == side_of(task.grid, fine) else asked


def _number(tensors: Tensors, name: str, low: float, high: float) -> float | None:
    """Takes the array `name`, one number from low to high, out of `tensors`; None if it is not there."""
    kept = tensors.pop(name, None)
    if kept is None:
        return None
    found = float(kept[0]) if kept.dtype == np.float64 and kept.shape == (1,) else math.nan
    if not low <= found <= high:
        raise _other_kind(name, found, f"float64, one number from {low:g} to {high:g}")
    return found


def _narrow_of(tensor: NDArray[Any] | None, count: int) -> Bools:
    """The obligations that a file names as narrow. Files of rules without any do not have the tensor."""
    if tensor is None:
        return np.zeros(count, np.bool_)
    if tensor.dtype != np.uint8 or tensor.shape != (count,):
        raise _other_kind("narrow", f"{tensor.dtype} {list(tensor.shape)}", f"uint8 [{count}]")
    narrow: Bools = tensor == 1
    return narrow


def _other_kind(name: str, got: float | str, expected: str) -> PolicyError:
    message = f"the array {name!r} is of another kind"
    return PolicyError(message, path=f"weights.{name}", got=got, expected=expected)


def check_fit(cell: Int32s, task: Task, pitch: float, table: NDArray[Any], fits: bool, wanted: str) -> None:
    """Raises PolicyError unless all `fits`. table [.., cells, headings, ..]: those that `cell` refers to."""
    shape, (rows, headings) = side_of(task.grid, pitch), table.shape[1:3]
    got, expected = f"{headings} headings", f"4 to {MAX_HEADINGS} headings"
    if 4 <= headings <= MAX_HEADINGS:
        if fits and cell.shape == shape and cell.min(initial=-1) >= -1 and cell.max(initial=-1) < rows:
            return
        got, expected = f"cell {list(cell.shape)} and tables of {rows} cells", f"cell {list(shape)}, {wanted}"
    raise PolicyError("the tables do not fit the task", path="weights", got=got, expected=expected)
