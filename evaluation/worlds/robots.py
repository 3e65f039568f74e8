"""Robots beside the Stretch with which worlds are tried. None of them can move backwards.

locobot    as in the tasks of Habitat and AI2-THOR: 0.25 m ahead and turns of 30 degrees, a centred footprint
trailing   the same, with its footprint 0.08 m behind its origin, so that its turns need room
arcs       drives arcs as well as it turns on the spot; its footprint lies 0.05 m behind its origin
"""

from __future__ import annotations

import math

from specshield.robot import STRETCH, Action, Robot

TURN, ARC = math.radians(30.0), 0.35  # [rad]
WAIT, END = Action("wait"), Action("end", terminal=True)
TURNS = Action("left", rotate=TURN), Action("right", rotate=-TURN)
ON_ARCS = Action("on left", 0.2, ARC), Action("on right", 0.2, -ARC)
ON_THE_SPOT = Action("left", rotate=ARC), Action("right", rotate=-ARC)
ROBOTS = {
    "stretch": STRETCH,
    "locobot": Robot("locobot", 0.18, (0.0, 0.0), "stay", (Action("on", 0.25), *TURNS, WAIT, END)),
    "trailing": Robot("trailing", 0.18, (-0.08, 0.0), "stop", (Action("on", 0.25), *TURNS, WAIT, END)),
    "arcs": Robot("arcs", 0.2, (-0.05, 0.0), "stop", (Action("on", 0.3), *ON_ARCS, *ON_THE_SPOT, WAIT, END)),
}
