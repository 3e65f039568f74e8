"""Writes a session as MCAP with Foxglove's schemas: map, pose and scene, and each decision as JSON.

Topics: `/map` (foxglove.Grid), `/pose` (foxglove.PoseInFrame), `/decision` (specshield.Decision: the
service's answer), and four of foxglove.SceneUpdate: `/regions`, `/driven` (the way up to the last
ten-thousandth step), `/driven_lately` (from there to the last hundredth) and `/scene` (the way since then,
the certified continuation). All are in the frame `map`.

A viewer that jumps to a time shows the last message of each topic, and nothing of those before it. So each
message shows all that its topic has to show. The way driven is in three topics, of which the longer ones are
written more seldom, so that a file grows with the steps and not with their square.
"""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import foxglove
import numpy as np
from foxglove import messages as fox
from foxglove.channels import GridChannel, PoseInFrameChannel, SceneUpdateChannel

from specshield.arrays import Floats
from specshield.drawing.outline import outlines
from specshield.recordings.recording import PIECE, Recording
from specshield.world.occupancy import OccupancyGrid

FRAME = "map"
REGION = fox.Color(r=0.2, g=0.5, b=0.9, a=0.9)
DRIVEN = fox.Color(r=0.9, g=0.5, b=0.1, a=1.0)
AHEAD = fox.Color(r=0.2, g=0.7, b=0.3, a=0.9)
DECISION = {
    "title": "specshield.Decision",
    "type": "object",
    "properties": {
        "t": {"type": "integer"},
        "mode": {"type": "string"},
        "action_name": {"type": "string"},
        "spec_status": {"type": "string"},
        "feasible_mass": {"type": ["number", "null"]},
        "kl": {"type": ["number", "null"]},
        "distribution": {"type": "array", "items": {"type": "number"}},
    },
}


def write_mcap(recording: Recording, path: Path) -> None:
    context, content = foxglove.Context(), io.BytesIO()  # foxglove raises no OSError for a file of its own
    with foxglove.open_mcap(content, context=context):
        grids, poses = GridChannel("/map", context=context), PoseInFrameChannel("/pose", context=context)
        regions, driven, lately, scenes = (
            SceneUpdateChannel(topic, context=context)
            for topic in ("/regions", "/driven", "/driven_lately", "/scene")
        )
        schema = foxglove.Schema(
            name="specshield.Decision", encoding="jsonschema", data=json.dumps(DECISION).encode()
        )
        decisions = foxglove.Channel("/decision", schema=schema, message_encoding="json", context=context)
        for item in recording.items:
            seconds = recording.seconds(item.t)
            now, at = fox.Timestamp.from_epoch_secs(seconds), round(seconds * 1e9)
            if item.t == 0:
                if recording.grid is not None:
                    grids.log(_grid(recording.grid, now), log_time=at)
                regions.log(fox.SceneUpdate(entities=_regions(recording, now)), log_time=at)
            poses.log(fox.PoseInFrame(timestamp=now, frame_id=FRAME, pose=_pose(*item.pose)), log_time=at)
            long_ago, begun = item.t - item.t % PIECE**2, item.t - item.t % PIECE
            if item.t == long_ago:
                driven.log(_lines(now, driven=(recording.driven(0, long_ago), DRIVEN)), log_time=at)
            if item.t == begun:
                line = recording.driven(long_ago, begun), DRIVEN
                lately.log(_lines(now, lately=line), log_time=at)
            recent, ahead = recording.driven(begun, item.t), recording.ahead(item.t)[:, :2]
            drawn = _lines(now, recent=(recent, DRIVEN), continuation=(ahead, AHEAD))
            scenes.log(drawn, log_time=at)
            if item.decision is not None:
                decisions.log(json.dumps(item.decision).encode(), log_time=at)
    path.write_bytes(content.getvalue())


def _lines(now: fox.Timestamp, **lines: tuple[Floats, fox.Color]) -> fox.SceneUpdate:
    return fox.SceneUpdate(
        entities=[
            fox.SceneEntity(timestamp=now, frame_id=FRAME, id=name, lines=[_line(way, color)])
            for name, (way, color) in lines.items()
        ]
    )


def _regions(recording: Recording, now: fox.Timestamp) -> list[fox.SceneEntity]:
    found = []
    for name, region in recording.regions.items():
        lines = outlines(region)
        x, y = lines[0][:-1].mean(axis=0)
        label = fox.TextPrimitive(
            pose=_pose(x, y, 0.0),
            billboard=True,
            font_size=12.0,
            scale_invariant=True,
            color=REGION,
            text=name,
        )
        drawn, id = [_line(line, REGION) for line in lines], f"region/{name}"
        found.append(fox.SceneEntity(timestamp=now, frame_id=FRAME, id=id, texts=[label], lines=drawn))
    return found


def _grid(grid: OccupancyGrid, now: fox.Timestamp) -> fox.Grid:
    """The map, with one byte for each cell: 1 is occupied."""
    field = fox.PackedElementField(name="occupied", offset=0, type=fox.PackedElementFieldNumericType.Uint8)
    return fox.Grid(
        timestamp=now,
        frame_id=FRAME,
        pose=_pose(*grid.origin),
        column_count=grid.width,
        cell_size=fox.Vector2(x=grid.resolution, y=grid.resolution),
        row_stride=grid.width,
        cell_stride=1,
        fields=[field],
        data=grid.occupied.astype(np.uint8).tobytes(),
    )


def _pose(x: float, y: float, theta: float) -> fox.Pose:
    turned = fox.Quaternion(x=0.0, y=0.0, z=math.sin(theta / 2.0), w=math.cos(theta / 2.0))
    return fox.Pose(position=fox.Vector3(x=float(x), y=float(y), z=0.0), orientation=turned)


def _line(points: Floats, color: fox.Color) -> fox.LinePrimitive:
    return fox.LinePrimitive(
        type=fox.LinePrimitiveLineType.LineStrip,
        pose=_pose(0.0, 0.0, 0.0),
        thickness=2.0,
        scale_invariant=True,
        points=[fox.Point3(x=float(x), y=float(y), z=0.0) for x, y in points],
        color=color,
    )
