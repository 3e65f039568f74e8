"""The known dynamics x_{t+1} = f(x_t, a_t): what one has to offer, and which one is used.

Everything outside this folder imports f from here. The robot's motions are numbered from 0 to M - 1, and only
its dynamics knows what each of them does. A dynamics offers:

    Body, make_body                the robot on its map, prepared once: a NamedTuple of arrays and numbers
    step, successors, simulate     f: one motion, every motion, a list of motions, each with its contacts
    around, step_from, unhindered  `step` in parts, to make several motions from a pose; f in the open
    overlap, in_collision          whether a pose is one that the robot may be in
    free_distance, swing_radius    how much room a place has, and how much the robot needs to turn there
    motion_count, displacement,    how many motions there are, where they lead from, and how far
    displacements, longest_motions
    calmest_motion                 what comes nearest to standing still

Which motions turn it on the spot, or take another one back (policy/undo.py), follows from the displacements.

All but `make_body`, `displacements` and `calmest_motion` are compiled, anew for each type of `Body`, together
with their callers: nothing is dispatched while a decision is made.
"""

from specshield.robot.body import (
    Body,
    calmest_motion,
    displacement,
    displacements,
    longest_motions,
    make_body,
    motion_count,
    swing_radius,
    wrap,
)
from specshield.robot.contact import TOUCH, free_distance, in_collision, overlap
from specshield.robot.unicycle import around, simulate, step, step_from, successors, unhindered
