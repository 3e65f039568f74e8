"""How fine a lattice is and which part of the map it covers, so that what it costs is bounded.

A lattice of a flat has the pitch that was asked for. On a large floor it covers only the places that a
trajectory which keeps the rule can be at: nowhere farther from a goal than the robot can drive in the steps
that are left for it. Where that is still too much, the pitch grows until it fits.
"""

from __future__ import annotations

import math

import numpy as np
import scipy

from specshield.arrays import Bools
from specshield.policy.lattice import headings_of, side_of
from specshield.policy.progress import ALWAYS, EVENTUALLY_ALWAYS, Rules, goals_of
from specshield.policy.reachability.sight import look, reads
from specshield.robot.dynamics import Body, longest_motions, swing_radius
from specshield.task import Task

# Of a lattice: 3 s to make on one core, and 10 MB a table (python -m benchmarks.floors).
MOST_POSES = 5_000_000
MOST_ENTRIES = 10_000_000  # of the tables of a floor with more poses, as far as the pitch stays below ROUGH
ROUGH = 2.0  # times the pitch that was asked for
MOST_STEPS = 40_000_000  # poses times motions, each of which takes up to 10 bytes while tables are made
COARSEST = 4.0  # times the pitch that was asked for; beyond it doors are missed


def pose_count(task: Task, pitch: float) -> int:
    """The poses of a lattice of the whole map."""
    ny, nx = side_of(task.grid, pitch)
    return ny * nx * headings_of(task)


def fitting_pitch(task: Task, pitch: float, entries: int, most: int, share: float = 1.0) -> float:
    """The smallest pitch, `pitch` or more [m], whose lattice is not too large. entries: of the tables, for
    each pose; most: how many entries there may be; share: of the map that the lattice covers. Callers refuse
    results beyond COARSEST.
    """
    allowed = min(MOST_POSES, MOST_STEPS // len(task.robot.motions), most / entries)
    poses = pose_count(task, pitch) * share
    if poses <= allowed:
        return pitch
    times = poses / allowed
    if poses > MOST_POSES:
        times = max(times, min(poses * entries / MOST_ENTRIES, ROUGH**2))
    return round(pitch * math.sqrt(times) + 5e-4, 3)


def places_that_matter(task: Task, body: Body, rules: Rules, pitch: float) -> Bools:
    """The cells [ny, nx] at which a trajectory that keeps the rule can be, as far as its goals tell.

    Once every goal is settled and no `always` is still to begin or to end, a robot that can wait needs no
    table any more, so later steps do not count.
    """
    ny, nx = side_of(task.grid, pitch)
    kept = np.ones((ny, nx), np.bool_)
    goals = goals_of(rules)
    edges = [t for k in np.flatnonzero(rules.kind == ALWAYS) for t in (rules.a[k], rules.b[k] + 1)]
    over = max([int(rules.last[k]) for k in goals] + [int(t) for t in edges if t <= task.horizon], default=0)
    if task.robot.wait_motion < 0:
        over = task.horizon
    move = longest_motions(body)[0]
    for k in goals:
        _, heading, _ = reads(rules, int(k))
        if heading:
            continue
        near = pitch + 2.0 * swing_radius(body)
        outer, _ = look(body, rules, int(k), pitch, 1, np.full((ny, nx), True), np.zeros(1), near)
        there = outer[..., 0]
        if there.any():
            first = rules.a[k] + (rules.b[k] if rules.kind[k] == EVENTUALLY_ALWAYS else 0)
            steps = max(int(rules.last[k]), over - int(first))
            kept &= scipy.ndimage.distance_transform_edt(~there) * pitch <= steps * move + pitch
    return kept
