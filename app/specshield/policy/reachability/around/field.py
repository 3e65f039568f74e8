"""How far it is to each goal on the present map, whatever map the tables were made for.

If a passage is blocked, the tables still lead to it, and a search that they alone guide fills all of the
space before it. These distances lead around. They are those of a coarse grid without headings. They say in
which order to search, and which poses to leave out, since even with the grid's errors they come too late.
"""

from __future__ import annotations

import math

import numpy as np

from specshield.arrays import Bools, Floats, Int8s, pooled
from specshield.compiled import inlined, kernel
from specshield.policy.geodesic import geodesic_distance
from specshield.policy.lattice import pose_of
from specshield.policy.progress import ALWAYS, PENDING, Rules
from specshield.policy.reachability.guide import due, make_scratch, predicate_at
from specshield.policy.reachability.tables import Guide
from specshield.robot.body import Body, centre

COARSE = 2  # cells of the map to a side of a field's, at least: 10 cm where the map has 5. By hand.
MOST = 20_000  # cells of a field, which take some 2 ms; on larger maps they are larger
SURE, ERROR = 0.95, 5.0  # a way is at least this share of the grid's distance, less this many cells; by hand
REACH = 0.71  # [sides of a cell] no place in a cell is farther from its centre
NO_FIELDS = np.empty((0, 1, 1))  # for a search that the tables alone lead


def goal_cells(body: Body, rules: Rules) -> Floats:
    """The value of each goal's predicate for heading 0 and the signals' initial values. Shape [K, ny, nx];
    -inf for an `always`.
    """
    coarse = max(COARSE, math.ceil(math.sqrt(body.occupied.size / MOST)))
    ny, nx = (-(-side // coarse) for side in body.occupied.shape)
    values = np.full((len(rules.kind), ny, nx), -np.inf)
    _fill_goals(body, rules, coarse * body.resolution, values)
    return values


@kernel
def _fill_goals(body: Body, rules: Rules, side: float, values: Floats) -> None:
    scratch = make_scratch(rules, 1)
    for k in np.flatnonzero(rules.kind != ALWAYS):
        for j in range(values.shape[1]):
            for i in range(values.shape[2]):
                x, y, theta = pose_of(body, side, 1, j, i, 0.0)
                values[k, j, i] = predicate_at(rules, int(k), x, y, theta, scratch)


def distances(body: Body, goals: Floats) -> Floats:
    """Metres from each cell to the goals [K, ny, nx] through cells that are free for the footprint; inf where
    there is no way, NaN for a goal that the centres of free cells do not show whole. Shape [K, ny, nx].
    """
    h, (ny, nx), (height, width) = body.resolution, goals.shape[1:], body.clearance.shape
    coarse, apart = -(-height // ny), math.hypot(body.offset_x, body.offset_y)
    fine = np.zeros((coarse * ny, coarse * nx), np.bool_)
    fine[:height, :width] = body.clearance > body.radius - REACH * h
    free: Bools = np.any(fine.reshape(ny, coarse, nx, coarse), axis=(1, 3))
    found = np.full(goals.shape, np.nan)
    for k in range(len(goals)):
        far = geodesic_distance(free, goals[k] > 0.0, coarse * h)
        about = far[free & (goals[k] > -REACH * coarse * h - apart)]  # cells with a robot that is in the goal
        if len(about) and about.max() <= (ERROR - 2.0) * coarse * h + apart:
            beside = pooled(pooled(far, np.minimum, 1, 0), np.minimum, 1, 1)
            found[k] = np.where(np.isinf(far), beside + coarse * h, far)  # of a cell whose centre is not free
    return found


@inlined
def spare_on(
    guide: Guide, fields: Floats, stride: float, x: float, y: float, theta: float, t: int, status: Int8s
) -> tuple[float, float]:
    """The steps to spare, over all pending goals at least, if the robot goes straight to one with moves of
    `stride` [m]; inf if no distance is known. And an upper bound on the same that allows for the grid's
    errors: below 0 if some goal cannot be reached in time. fields [K, ny, nx]: of `distances`.
    """
    body, rules, least, most = guide.body, guide.rules, math.inf, math.inf
    u, v = centre(body, x, y, theta)
    side = -(-body.occupied.shape[0] // fields.shape[1]) * body.resolution
    j, i, apart = math.floor(v / side), math.floor(u / side), math.hypot(body.offset_x, body.offset_y)
    if stride == 0.0 or j < 0 or j >= fields.shape[1] or i < 0 or i >= fields.shape[2]:
        return least, most
    for k in range(fields.shape[0]):
        if rules.kind[k] != ALWAYS and status[k] == PENDING:
            far, left = fields[k, j, i], due(rules, k) - t
            least = min(least, left - far / stride) if far < math.inf else least
            surely = SURE * far - ERROR * side - apart
            # A robot that dwells at a goal may be there after it was due to come.
            most = min(most, left - surely / stride) if surely > 0.0 else most
    return least, most
