"""Writes a session for Rerun's viewer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun

from specshield.drawing.outline import outlines
from specshield.recordings.recording import PIECE, Recording


def write_rrd(recording: Recording, path: Path) -> None:
    """Writes the timelines `step` and `time`, `world` in metres, and scalars below `decision`."""
    stream = rerun.RecordingStream("specshield", recording_id=recording.id)
    held = stream.memory_recording()  # rerun's own files raise no OSError, and wait for ever on a full disk
    if recording.grid is not None:
        rows, columns = np.nonzero(recording.grid.occupied)
        centres = recording.grid.centres[rows, columns]
        half = recording.grid.resolution / 2.0
        boxes = rerun.Boxes2D(
            centers=centres, half_sizes=np.full((len(centres), 2), half), colors=[90, 90, 90]
        )
        stream.log("world/map", boxes, static=True)
    for name, region in recording.regions.items():
        stream.log(f"world/regions/{name}", rerun.LineStrips2D(outlines(region), labels=name), static=True)
    for item in recording.items:
        stream.set_time("step", sequence=item.t)
        stream.set_time("time", timestamp=recording.seconds(item.t))
        x, y, theta = item.pose
        begun = item.t - item.t % PIECE  # a viewer shows the newest line of each piece
        driven = recording.driven(begun - 1, item.t)
        heading = 0.3 * np.array([np.cos(theta), np.sin(theta)])
        stream.log("world/robot", rerun.Arrows2D(origins=[(x, y)], vectors=[heading]))
        stream.log(f"world/driven/from_{begun}", rerun.LineStrips2D([driven]))
        stream.log("world/continuation", rerun.LineStrips2D([recording.ahead(item.t)[:, :2]]))
        told = item.decision or {}
        for name in ("feasible_mass", "kl", "margin", "slack"):
            if told.get(name) is not None:
                stream.log(f"decision/{name}", rerun.Scalars(float(told[name])))
        if told:
            stream.log("decision/distribution", rerun.BarChart(np.array(told["distribution"])))
            said = f"{told['mode']}: {told['action_name']} ({told['spec_status']})"
            stream.log("decision/log", rerun.TextLog(said))
    path.write_bytes(held.drain_as_bytes())
