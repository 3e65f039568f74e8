"""A floor plan to draw on, with Pillow: walls, regions, ways, marks and text.

Points are in metres of the map frame, sizes in pixels of the finished picture. Everything is drawn FINE times
as large and reduced at the end, which smooths the edges.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from specshield.arrays import Bools, Singles
from specshield.drawing.colors import AVOID, GREY, INK, PAPER, TINT, VISIT, WALL, is_avoided
from specshield.sim.robot import Pose
from specshield.task import Task
from specshield.world.regions import signed_distance

FINE = 3
BORDER = 14


class Canvas:
    """Shows the whole map, `scale` pixels a metre, with room for text `above` and `below` it."""

    def __init__(self, task: Task, scale: float, above: int = 0, below: int = 0) -> None:
        xmin, ymin, xmax, ymax = task.grid.bounds
        self.task, self._scale, self._above = task, scale, above
        self.top, self.bottom = (xmin, ymax), (xmin, ymin)  # the left corners of the map
        self.width, self.height = round((xmax - xmin) * scale), round((ymax - ymin) * scale)
        size = self.width + 2 * BORDER, above + self.height + 2 * BORDER + below
        self._image = Image.new("RGB", (size[0] * FINE, size[1] * FINE), PAPER)
        self._pen = ImageDraw.Draw(self._image)
        columns, rows = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        self._points = np.stack([xmin + columns / scale, ymax - rows / scale], axis=-1)  # [rows, columns, 2]

    def picture(self) -> Image.Image:
        return self._image.reduce(FINE)

    def walls(self) -> None:
        grid = self.task.grid
        cells = np.floor(grid.to_grid(self._points) / grid.resolution).astype(int)
        columns, rows = cells[..., 0].clip(0, grid.width - 1), cells[..., 1].clip(0, grid.height - 1)
        occupied = grid.occupied[rows, columns].astype(np.float32)
        self._paint(self._refined(occupied, Image.Resampling.NEAREST) > 0.5, WALL, 1.0)

    def regions(self, size: float) -> None:
        """Every region of the task with its name in letters of `size` below it."""
        for name, region in self.task.regions.items():
            color = AVOID if is_avoided(self.task.formula, name) else VISIT
            coarse = signed_distance(region, self._points).astype(np.float32)
            depth = self._refined(coarse, Image.Resampling.BILINEAR)
            self._paint(depth > 0.0, color, TINT)
            self._paint((depth > 0.0) & (depth < 2.0 / self._scale), color, 1.0)
            rows, columns = np.nonzero(coarse > 0.0)
            if len(rows):  # a small region, or one beside the map, may hold no pixel's centre
                lowest = self._points[rows.max(), int(columns[rows == rows.max()].mean())]
                self.text(lowest, name, size, color, shift=(0, 4), anchor="mt")

    def way(self, poses: Sequence[Sequence[float]], color: str, thickness: float) -> None:
        """The way through the poses of an episode; what is after the rule's horizon in grey."""
        asked = self.task.horizon + 1  # states that the rule is about
        self._line(poses[asked - 1 :], GREY, thickness)
        self._line(poses[:asked], color, thickness)

    def dot(self, point: Sequence[float], radius: float, fill: str, edge: str) -> None:
        u, v = self._at(point)
        r = radius * FINE
        self._pen.ellipse((u - r, v - r, u + r, v + r), fill=fill, outline=edge, width=round(1.5 * FINE))

    def footprints(self, poses: Sequence[Sequence[float]], color: str) -> None:
        """The outline of the footprint at each pose, for rules that are about the body."""
        robot = self.task.robot
        for x, y, theta in poses:
            c, s = np.cos(theta), np.sin(theta)
            ahead, left = robot.offset
            u, v = self._at((x + c * ahead - s * left, y + s * ahead + c * left))
            r = robot.radius * self._scale * FINE
            self._pen.ellipse((u - r, v - r, u + r, v + r), outline=color, width=FINE)

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
        size: float,
        color: str = INK,
        shift: tuple[float, float] = (0, 0),
        anchor: str = "mm",
    ) -> None:
        """Text, `shift` pixels to the right of a point and below it. anchor: as Pillow has it."""
        u, v = self._at(point)
        place, font = (u + shift[0] * FINE, v + shift[1] * FINE), ImageFont.load_default(size * FINE)
        self._pen.text(place, said, color, font, anchor, stroke_width=FINE, stroke_fill=PAPER)

    def _line(self, poses: Sequence[Sequence[float]], color: str, thickness: float) -> None:
        line = [self._at(pose) for pose in poses]
        if len(line) < 2:
            return
        width = round(thickness * FINE)
        self._pen.line(line, fill=color, width=width, joint="curve")
        for u, v in line:
            self._pen.ellipse((u - width / 2, v - width / 2, u + width / 2, v + width / 2), fill=color)

    def _at(self, point: Sequence[float]) -> tuple[float, float]:
        """The fine pixel of a point."""
        u, v = (point[0] - self.top[0]) * self._scale, (self.top[1] - point[1]) * self._scale
        return (float(u) + BORDER) * FINE, (float(v) + BORDER + self._above) * FINE

    def _refined(self, values: Singles, how: Image.Resampling) -> Singles:
        """One value a pixel of the map, as one value a fine pixel."""
        size = (self.width * FINE, self.height * FINE)
        return np.asarray(Image.fromarray(values).resize(size, how))

    def _paint(self, where: Bools, color: str, opacity: float) -> None:
        mask = Image.fromarray((where * round(255 * opacity)).astype(np.uint8))
        place = BORDER * FINE, (BORDER + self._above) * FINE
        self._image.paste(ImageColor.getrgb(color), place, mask)
