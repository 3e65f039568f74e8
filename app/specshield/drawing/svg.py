"""A floor plan as SVG: walls, a heat map, regions, ways, robots, text. Points are in metres, map frame.

The picture's coordinates count from the map's lower left corner, since viewers of SVG keep about seven digits
of a number, and a map may be millions of metres from its frame's origin. The picture needs no script, font or
image from elsewhere. It has dark colours on a screen with a dark theme.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np
from PIL import Image

from specshield.arrays import Floats
from specshield.drawing.outline import outlines
from specshield.drawing.rules import is_avoided
from specshield.task import Task
from specshield.world.learned import NONE, LearnedMap
from specshield.world.regions import Circle, Region, Union

# Widths are in thousandths of the map's longer side, so that all maps look alike.
STYLE = """
.paper{fill:#faf9f6}.ink{fill:#282b32}.faint{fill:#6d7078}
.visit{fill:#2b8a5a;stroke:#2b8a5a}.avoid{fill:#c63c3c;stroke:#c63c3c}
.region{fill-opacity:.16}
polyline{fill:none;stroke-linejoin:round;stroke-linecap:round}
.way,.next{stroke:#2563c8}.beside{stroke:#e27d22}.after{stroke:#b4b4b4}
.robot{fill:#2563c8;fill-opacity:.25;stroke:#2563c8}.body{fill-opacity:0}
.mark{fill:#2563c8;stroke:#faf9f6}.target{fill:#f6be28;stroke:#282b32}
text{font-family:system-ui,sans-serif}.formula{font-family:ui-monospace,monospace}
@media (prefers-color-scheme:dark){.paper{fill:#16181d}.ink{fill:#e8e9ec}.faint{fill:#9a9da6}
.walls{filter:brightness(1.75)}.visit{fill:#57c48f;stroke:#57c48f}.avoid{fill:#f07a72;stroke:#f07a72}
.way,.next{stroke:#78a8ff}.robot,.mark{fill:#78a8ff;stroke:#78a8ff}}
text,.name{stroke:#faf9f6;stroke-width:.2em;paint-order:stroke}.name{font-weight:600}
@media (prefers-color-scheme:dark){text,.name{stroke:#16181d}}
"""

# For text below the map: height and width of a letter, height of a line [1/1000 of the map's longer side].
SIZE, LETTER, LINE = 24, 0.62 * 24, 36
FOUND = 0x70, 0x40, 0xA8  # the colour of cells that were found occupied; cells found free have a third of it
WIDTHS = {"way": 6, "beside": 4, "after": 4, "next": 3}  # of ways, by kind
FEWEST = 30  # letters in a line, for which the picture of a narrow map becomes wider


class Plan:
    """Collects the parts of a picture, which `svg` returns. title: for people who cannot see the picture."""

    def __init__(self, task: Task, title: str) -> None:
        self._task, self._title = task, title
        self._xmin, self._ymin, self._xmax, self._ymax = task.grid.bounds
        self._wide, self._high = self._xmax - self._xmin, self._ymax - self._ymin
        self._unit = max(self._wide, self._high) / 1000
        self._parts: list[str] = []
        self._lines: list[tuple[str, str]] = []  # (kind, text)

    def walls(self, known: LearnedMap = NONE) -> None:
        """Draws one pixel for each cell, turned by the map's yaw. known: cells that a session has learned."""
        grid = self._task.grid
        kind = grid.occupied.astype(np.uint8)
        kind.ravel()[known.cell] = np.where(known.occupied, 2, 3)
        image = Image.fromarray(kind[::-1])  # 16 million cells take 0.6 s, with one bit each
        image.putpalette([0, 0, 0, 0x34, 0x38, 0x40, *FOUND, *FOUND])
        x, y, yaw = grid.origin
        right, down = self._at(x, y)
        wide, high = grid.width * grid.resolution, grid.height * grid.resolution
        box = (0.0, -high, wide, high)
        how = f'class="walls" transform="translate({right:g} {down:g}) rotate({-math.degrees(yaw):g})"'
        self._image(image, box, how, bits=2 if len(known) else 1, transparency=b"\0\xff\xff\x55")

    def heat(self, share: Floats) -> None:
        """Draws share [rows, columns], the first row at the highest y: 0 to 1, NaN where it is unknown."""
        known = np.isfinite(share)
        value = np.where(known, share, 0.0)[..., None]
        none, all_ = np.array([214.0, 84, 66]), np.array([43.0, 138, 90])
        pixels = np.dstack([none + (all_ - none) * value, 105 * known]).astype(np.uint8)
        box = (0.0, -self._high, self._wide, self._high)
        self._image(Image.fromarray(pixels), box, 'preserveAspectRatio="none"')

    def regions(self) -> None:
        """Draws the regions that the rule names, each with its name."""
        for name, region in self._task.regions.items():
            kind = "avoid" if is_avoided(self._task.formula, name) else "visit"
            self._parts.append(f'<g class="region {kind}" stroke-width="{2 * self._unit:g}">')
            members = region.members if isinstance(region, Union) else (region,)
            self._parts += [self._shape(member) for member in members]
            (left, low), (right, _) = (end(outlines(region)[0], axis=0) for end in (np.min, np.max))
            x, y = self._at(float(left + right) / 2, float(low))  # below its first part
            self._parts.append(
                f"</g>{self._text(x, y + 26 * self._unit, name, 22, f'name {kind}', 'middle')}"
            )

    def way(self, poses: Floats, kind: str = "way") -> None:
        """Draws poses [n, 3] as a line. kind: `way` for the way driven, `beside` for another one, `after` for
        the part after the rule's end, `next` for the certified continuation.
        """
        points = self._points(np.asarray(poses)[:, :2].tolist(), ".3f")
        dashes = f' stroke-dasharray="{6 * self._unit:g} {6 * self._unit:g}"' if kind == "next" else ""
        wide = WIDTHS[kind] * self._unit
        self._parts.append(f'<polyline class="{kind}" points="{points}" stroke-width="{wide:g}"{dashes}/>')

    def robot(self, pose: Sequence[float], kind: str = "robot") -> None:
        """Draws the robot's footprint, and a line from its origin along its heading. kind: `robot body` draws
        only outlines, of which there may be many.
        """
        theta, robot = pose[2], self._task.robot
        cos, sin, (ahead, left) = math.cos(theta), math.sin(theta), robot.offset
        x, y = self._at(pose[0], pose[1])
        cx, cy = x + cos * ahead - sin * left, y - sin * ahead - cos * left
        self._parts.append(
            f'<g class="{kind}" stroke-width="{(3 if kind == "robot" else 1) * self._unit:g}">'
            f'<circle cx="{cx:.3f}" cy="{cy:.3f}" r="{robot.radius:g}"/><line x1="{x:.3f}" y1="{y:.3f}" '
            f'x2="{x + cos * robot.radius:.3f}" y2="{y - sin * robot.radius:.3f}"/></g>'
        )

    def mark(self, point: Sequence[float], said: str, kind: str = "mark", above: bool = False) -> None:
        """Draws a dot, with a text below or `above` it. kind: `mark`, or `target` for a larger dot."""
        x, y = self._at(point[0], point[1])
        dot, edge = (12 if kind == "target" else 8) * self._unit, 2 * self._unit
        self._parts.append(
            f'<circle class="{kind}" cx="{x:.3f}" cy="{y:.3f}" r="{dot:g}" stroke-width="{edge:g}"/>'
            + self._text(x, y + (-16 if above else 30) * self._unit, said, 20, "ink", "middle")
        )

    def words(self, point: Sequence[float], said: str) -> None:
        """Writes a text at a point of the map."""
        self._parts.append(self._text(*self._at(point[0], point[1]), said, 20, "faint", "middle"))

    def line(self, said: str, kind: str = "ink") -> None:
        """Writes a line of text below the map; a long text is continued in further lines."""
        most = max(int(self._wide / self._unit / LETTER), FEWEST)
        while said:
            cut = len(said) if len(said) <= most else said.rfind(" ", 0, most)
            cut = cut if cut > 0 else most
            self._lines.append((kind, said[:cut]))
            said = said[cut:].lstrip()

    def svg(self) -> bytes:
        unit, edge = self._unit, 20 * self._unit
        text = LETTER * unit * max((len(said) for _, said in self._lines), default=0)
        wide = max(self._wide, text) + 2 * edge
        foot = self._high + 2 * edge + LINE * unit * len(self._lines)
        left, top = -edge, -self._high - edge
        box = f"{left:g} {top:g} {wide:g} {foot:g}"
        told = []
        for i, (kind, said) in enumerate(self._lines):
            told.append(self._text(0.0, edge / 2 + LINE * unit * (i + 0.8), said, SIZE, kind, "start"))
        size = f'width="800" height="{800 * foot / wide:.0f}"'
        return "\n".join(
            [
                f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}" {size} role="img">',
                f"<title>{escape(self._title)}</title><style>{STYLE}</style>",
                f'<rect class="paper" x="{left:g}" y="{top:g}" width="{wide:g}" height="{foot:g}"/>',
                *self._parts,
                *told,
                "</svg>\n",
            ]
        ).encode()

    def _at(self, x: float, y: float) -> tuple[float, float]:
        """The picture's coordinates of a point of the map: the picture's y points down."""
        return x - self._xmin, self._ymin - y

    def _points(self, points: Iterable[Sequence[float]], digits: str) -> str:
        return " ".join("{:{d}},{:{d}}".format(*self._at(x, y), d=digits) for x, y in points)

    def _shape(self, region: Region) -> str:
        if isinstance(region, Circle):
            x, y = self._at(*region.center)
            return f'<circle cx="{x:g}" cy="{y:g}" r="{region.radius:g}"/>'
        return f'<polygon points="{self._points(outlines(region)[0][:-1].tolist(), "g")}"/>'

    def _text(self, x: float, y: float, said: str, size: float, kind: str, anchor: str) -> str:
        return (
            f'<text class="{kind}" x="{x:.3f}" y="{y:.3f}" font-size="{size * self._unit:g}" '
            f'text-anchor="{anchor}">{escape(said)}</text>'
        )

    def _image(self, image: Image.Image, box: Sequence[float], more: str, **png: int | bytes) -> None:
        buffer = io.BytesIO()
        image.save(buffer, "PNG", optimize=True, **png)
        data = base64.b64encode(buffer.getvalue()).decode()
        x, y, wide, high = box
        self._parts.append(
            f'<image x="{x:g}" y="{y:g}" width="{wide:g}" height="{high:g}" {more} '
            f'style="image-rendering:pixelated" href="data:image/png;base64,{data}"/>'
        )
