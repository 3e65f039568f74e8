"""Writes a session as a table with one row for each step: as CSV, and by pyarrow as Parquet."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from specshield.recordings.recording import Recording

TOLD = (
    "mode", "action", "action_name", "completion_action", "spec_status", "feasible_mass", "kl", "reason",
    "margin", "slack", "threshold_left", "map_revision", "finished", "in_collision",
)  # fmt: skip
TEXTS = {"mode", "action_name", "spec_status", "reason"}
WHOLE = {"t", "action", "completion_action", "slack", "map_revision"}
FLAGS = {"finished", "in_collision"}  # all other columns are fractions


def rows(recording: Recording) -> list[dict[str, Any]]:
    """The rows: step, time, pose and signals, the members of the answer, and pi* and rho of each action.

    All that belongs to the answer is None for a step without a decision.
    """
    found = []
    for item in recording.items:
        row: dict[str, Any] = {"t": item.t, "seconds": recording.seconds(item.t)}
        row |= zip(("x", "y", "theta"), item.pose, strict=True)
        row |= {f"signal_{name}": value for name, value in item.signals.items()}
        told = item.decision or {}
        row |= {name: told.get(name) for name in TOLD}
        residual = told.get("residual") or {}
        row |= {f"residual_{kind}": residual.get(kind) for kind in ("translation", "rotation")}
        for kind, short in (("distribution", "p"), ("robustness", "rho")):
            values = told.get(kind) or [None] * len(recording.actions)
            row |= {f"{short}_{name}": v for name, v in zip(recording.actions, values, strict=True)}
        found.append(row)
    return found


def write_csv(recording: Recording, path: Path) -> None:
    table = rows(recording)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(table[0]))
        writer.writeheader()
        writer.writerows(table)


def write_parquet(recording: Recording, path: Path) -> None:
    """Writes the table, with the rule and the actions in the file's metadata."""
    import pyarrow as arrow
    from pyarrow import parquet

    found = rows(recording)
    kinds = ((TEXTS, arrow.string()), (WHOLE, arrow.int64()), (FLAGS, arrow.bool_()))
    # By name, since a column may be empty all through: tables of several sessions are to fit together.
    kind = {name: kind for names, kind in kinds for name in names}
    schema = arrow.schema([(name, kind.get(name, arrow.float64())) for name in found[0]])
    table = arrow.Table.from_pylist(found, schema=schema)
    about = {"session": recording.id, "formula": recording.formula, "actions": ",".join(recording.actions)}
    with open(path, "wb") as file:  # pyarrow would remove a file that it cannot write to the end
        parquet.write_table(table.replace_schema_metadata(about), file)
