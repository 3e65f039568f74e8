"""Floor plans as SVG: where things are drawn, whatever the map's shape and wherever it lies."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from specshield.drawing.svg import Plan
from specshield.robot import STRETCH
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid


def drawn(width, height, at=(0.0, 0.0)):
    """A map of `width` x `height` cells of 0.1 m from `at` on, with all that a session's picture shows."""
    grid = OccupancyGrid(np.zeros((height, width), bool), 0.1, (*at, 0.0))
    goals = [
        {"type": "circle", "center": [at[0] + 0.3, at[1] + 1.3], "radius": 0.2},
        {"type": "rectangle", "min": [at[0] + 0.125, at[1] + 2.0], "max": [at[0] + 0.5, at[1] + 2.25]},
    ]
    task = make_task(grid, STRETCH, "F[0,20] Goal", {"Goal": {"type": "union", "members": goals}})
    plan = Plan(task, "a plan")
    plan.heat(np.ones((height, width)))
    plan.walls()
    plan.regions()
    plan.way(np.array([[at[0] + 0.3, at[1] + 0.4 + 0.1 * k, 0.0] for k in range(4)]))
    plan.robot((at[0] + 0.3, at[1] + 0.4, 0.5))
    plan.line("the rule and what the picture shows of it, in more words than a narrow map is wide")
    return plan.svg()


@pytest.mark.parametrize("at", [(448251.25, 5411932.75), (-448251.25, 0.5)])
def test_a_map_far_from_its_frames_origin_is_drawn_as_one_at_it(at):
    assert drawn(30, 40, at) == drawn(30, 40)


def test_below_a_corridor_its_text_is_read_in_whole_words():
    picture = ET.fromstring(drawn(7, 500))
    *_, wide, high = map(float, picture.attrib["viewBox"].split())
    lines = [text for text in picture.iter("{http://www.w3.org/2000/svg}text") if text.text != "Goal"]
    assert " ".join(str(line.text) for line in lines).startswith("the rule and what the picture shows of it,")
    assert all(re.fullmatch(r"\w.{9,}", str(line.text)) for line in lines)
    longest = max(len(str(line.text)) * float(line.attrib["font-size"]) for line in lines)
    assert 0.5 * longest < wide < high
