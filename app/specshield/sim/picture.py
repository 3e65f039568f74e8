"""A picture of a case: the floor, the named regions, and the two ways from one start."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from specshield.sim.cases import Case
from specshield.sim.episodes import Episode
from specshield.sim.robot import Pose
from specshield.stl import Formula, Not, obligations, robustness
from specshield.world.regions import Region, signed_distance

FINE = 3  # drawn this much larger, then reduced
PIXELS = 110  # a metre
BORDER = 14
LEGEND = 86
PAPER, WALL, INK, FAINT = (250, 249, 246), (52, 56, 64), (40, 43, 50), (158, 160, 165)
GOOD, BAD = (43, 138, 90), (198, 60, 60)
SHIELDED, UNSHIELDED, AFTER, TARGET = (37, 99, 200), (226, 125, 34), (180, 180, 180), (246, 190, 40)

Color = tuple[int, int, int]


def draw(case: Case, shielded: Episode, unshielded: Episode, path: Path) -> None:
    """Writes a PNG."""
    canvas = _Canvas(case)
    canvas.floor()
    for name, region in case.task.regions.items():
        canvas.region(name, region, BAD if name in avoided(case.task.formula) else GOOD)
    asked = case.task.horizon + 1  # states that the rule is about
    for episode, color, thickness in ((unshielded, UNSHIELDED, 2.2), (shielded, SHIELDED, 3.0)):
        canvas.way(episode.poses[asked - 1 :], AFTER, thickness)
        canvas.way(episode.poses[:asked], color, thickness)
    for t, (x, y, _) in _kept_at(case, shielded.poses):
        canvas.dot((x, y), 5.0, SHIELDED, PAPER)
        canvas.text((x, y), f"t={t}", 12, SHIELDED, shift=(9, -9), anchor="ls")
    canvas.start(shielded.start)
    canvas.dot(case.target, 8.0, TARGET, INK)
    canvas.text(case.target, case.instruction.split()[-1], 14, INK, shift=(0, 12), anchor="mt")
    canvas.legend(case, shielded, unshielded)
    canvas.save(path)


def avoided(formula: Formula) -> set[str]:
    """Names that the formula wants not to hold: those below an odd number of `not`s."""
    found: set[str] = set()

    def walk(node: Formula, negated: bool) -> None:
        if isinstance(node, Not):
            walk(node.child, not negated)
        elif hasattr(node, "children"):
            for child in node.children:
                walk(child, negated)
        elif hasattr(node, "child"):
            walk(node.child, negated)
        elif negated:
            found.update(node.names)

    walk(formula, False)
    return found


def _kept_at(case: Case, poses: Sequence[Pose]) -> Iterator[tuple[int, Pose]]:
    """Each visit that the rule asks for: the first step in its window that makes it, and the pose there."""
    for part in obligations(case.task.formula):
        if part.kind != "eventually":
            continue
        for t in range(part.a, min(part.b, len(poses) - 1) + 1):
            samples = case.task.samples(np.array(poses[t : t + 1]))
            if robustness(part.predicate, {name: samples[name] for name in part.predicate.names}) > 0.0:
                yield t, poses[t]
                break


class _Canvas:
    """Draws in metres of the map frame; sizes in pixels of the finished picture."""

    def __init__(self, case: Case) -> None:
        self._case = case
        xmin, ymin, xmax, ymax = case.task.grid.bounds
        self._corner = (xmin, ymax)
        self.width, self.map_height = round((xmax - xmin) * PIXELS), round((ymax - ymin) * PIXELS)
        size = (self.width + 2 * BORDER, self.map_height + 2 * BORDER + LEGEND)
        self._image = Image.new("RGB", (size[0] * FINE, size[1] * FINE), PAPER)
        self._pen = ImageDraw.Draw(self._image)

    def _points(self) -> NDArray[np.float64]:
        """The map-frame point of every pixel of the map. Shape [rows, columns, 2]."""
        columns, rows = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.map_height) + 0.5)
        return np.stack([self._corner[0] + columns / PIXELS, self._corner[1] - rows / PIXELS], axis=-1)

    def _refined(self, values: NDArray[np.float32], how: Image.Resampling) -> NDArray[np.float32]:
        """Values a pixel, as values a fine pixel."""
        size = (self.width * FINE, self.map_height * FINE)
        return np.asarray(Image.fromarray(values).resize(size, how))

    def floor(self) -> None:
        case, grid = self._case, self._case.task.grid
        cells = np.floor(grid.to_grid(self._points()) / grid.resolution).astype(int)
        columns, rows = cells[..., 0].clip(0, grid.width - 1), cells[..., 1].clip(0, grid.height - 1)
        occupied = grid.occupied[rows, columns].astype(np.float32)
        self._paint(self._refined(occupied, Image.Resampling.NEAREST) > 0.5, WALL, 1.0)
        taken = [signed_distance(region, grid.centres) > -0.4 for region in case.task.regions.values()]
        taken.append(np.hypot(*np.moveaxis(grid.centres - case.target, -1, 0)) < 0.8)
        for name, room in case.rooms.items():
            roomy = np.minimum(signed_distance(room, grid.centres), grid.clearance)
            row, column = np.unravel_index(
                np.argmax(np.where(np.any(taken, axis=0), -1.0, roomy)), roomy.shape
            )
            self.text(grid.centres[row, column].tolist(), name, 13, FAINT)

    def region(self, name: str, region: Region, color: Color) -> None:
        coarse = signed_distance(region, self._points()).astype(np.float32)
        depth = self._refined(coarse, Image.Resampling.BILINEAR)
        self._paint(depth > 0.0, color, 0.16)
        self._paint((depth > 0.0) & (depth < 2.0 / PIXELS), color, 1.0)
        rows, columns = np.nonzero(coarse > 0.0)
        lowest = self._points()[rows.max(), int(columns.mean())]
        self.text(lowest.tolist(), name, 13, color, shift=(0, 4), anchor="mt")

    def way(self, poses: Sequence[Pose], color: Color, thickness: float) -> None:
        line = [self._at(pose) for pose in poses]
        if len(line) < 2:
            return
        width = round(thickness * FINE)
        self._pen.line(line, fill=color, width=width, joint="curve")
        for u, v in line:
            self._pen.ellipse((u - width / 2, v - width / 2, u + width / 2, v + width / 2), fill=color)

    def dot(self, point: tuple[float, float], radius: float, fill: Color, edge: Color) -> None:
        u, v = self._at(point)
        r = radius * FINE
        self._pen.ellipse((u - r, v - r, u + r, v + r), fill=fill, outline=edge, width=round(1.5 * FINE))

    def start(self, pose: Pose) -> None:
        """A triangle that points where the robot looks."""
        corners = [(0.17, 0.0), (-0.12, 0.11), (-0.06, 0.0), (-0.12, -0.11)]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        outline = [self._at((pose[0] + c * p - s * q, pose[1] + s * p + c * q)) for p, q in corners]
        self._pen.polygon(outline, fill=INK, outline=PAPER, width=FINE)

    def text(
        self,
        point: Sequence[float],
        said: str,
        size: int,
        color: Color,
        shift: tuple[int, int] = (0, 0),
        anchor: str = "mm",
    ) -> None:
        u, v = self._at(point)
        self._write((u + shift[0] * FINE, v + shift[1] * FINE), said, size, color, anchor)

    def legend(self, case: Case, shielded: Episode, unshielded: Episode) -> None:
        top = (self.map_height + 2 * BORDER) * FINE
        left = BORDER * FINE
        self._write((left, top), str(case.task.formula), 15, INK, "lt")
        for i, (episode, color, said) in enumerate(
            ((shielded, SHIELDED, "with the shield"), (unshielded, UNSHIELDED, "without"))
        ):
            v = top + (32 + 24 * i) * FINE
            self._pen.line((left, v, left + 34 * FINE, v), fill=color, width=4 * FINE)
            self._write((left + 44 * FINE, v), f"{said}: {_outcome(episode)}", 14, INK, "lm")
        right = left + 560 * FINE
        v = top + 32 * FINE
        any_avoided = avoided(case.task.formula)
        for color, said in ((GOOD, "to visit"), (BAD, "to avoid")) if any_avoided else ((GOOD, "to visit"),):
            box = (right, v - 7 * FINE, right + 20 * FINE, v + 7 * FINE)
            tint = tuple(round(0.84 * p + 0.16 * c) for p, c in zip(PAPER, color, strict=True))
            self._pen.rectangle(box, fill=tint, outline=color, width=2 * FINE)
            self._write((right + 30 * FINE, v), said, 14, INK, "lm")
            right += 120 * FINE
        self._pen.line((right, v, right + 34 * FINE, v), fill=AFTER, width=4 * FINE)
        self._write((right + 44 * FINE, v), f"after t={case.task.horizon}, the rule's last", 14, INK, "lm")
        self._write((left + 560 * FINE, top + 56 * FINE), f'"{case.instruction}"', 14, INK, "lm")

    def save(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._image.reduce(FINE).save(path)

    def _at(self, point: Sequence[float]) -> tuple[float, float]:
        scale = FINE * PIXELS
        u, v = (point[0] - self._corner[0]) * scale, (self._corner[1] - point[1]) * scale
        return float(u) + BORDER * FINE, float(v) + BORDER * FINE

    def _write(self, at: tuple[float, float], said: str, size: int, color: Color, anchor: str) -> None:
        font = ImageFont.load_default(size * FINE)
        self._pen.text(at, said, fill=color, font=font, anchor=anchor, stroke_width=FINE, stroke_fill=PAPER)

    def _paint(self, where: NDArray[np.bool_], color: Color, opacity: float) -> None:
        mask = Image.fromarray((where * round(255 * opacity)).astype(np.uint8))
        self._image.paste(color, (BORDER * FINE, BORDER * FINE), mask)


def _outcome(episode: Episode) -> str:
    task = f"ended at t={episode.ended_at}" if episode.main_done else "target not found"
    return f"rule {episode.spec_status}, {task}"
