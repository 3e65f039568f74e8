"""How far it is to each goal on the map that there is, whatever the tables were made for.

Where a passage is blocked, the tables still lead to it, and a search that they alone guide fills all of the
space before it. These distances lead around. They are of a coarse grid and of places without headings: they
say in which order to search, and what is left out since it comes too late, whatever errors the grid has.
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
SURE, ERROR = (
    0.95,
    5.0,
)  # a share of a distance that is surely left, once so many cells are taken off. By hand.
NO_FIELDS = np.empty((0, 1, 1))  # for a search that the tables alone lead


def goal_cells(body: Body, rules: Rules) -> Bools:
    """Where each goal's predicate holds for a robot whose heading is 0, by what signals hold at first. Shape
    [K, ny, nx]; nowhere for an `always`.
    """
    coarse = max(COARSE, math.ceil(math.sqrt(body.occupied.size / MOST)))
    ny, nx = (-(-side // coarse) for side in body.occupied.shape)
    held = np.zeros((len(rules.kind), ny, nx), np.bool_)
    _fill_goals(body, rules, coarse * body.resolution, held)
    return held


@kernel
def _fill_goals(body: Body, rules: Rules, side: float, held: Bools) -> None:
    scratch = make_scratch(rules, 1)
    for k in np.flatnonzero(rules.kind != ALWAYS):
        for j in range(held.shape[1]):
            for i in range(held.shape[2]):
                x, y, theta = pose_of(body, side, 1, j, i, 0.0)
                held[k, j, i] = predicate_at(rules, int(k), x, y, theta, scratch) > 0.0


def distances(body: Body, goals: Bools) -> Floats:
    """Metres from each cell to the goals [K, ny, nx] through what is free for the footprint; inf where there
    is no way, NaN where no cell is known to be a goal. Shape [K, ny, nx].
    """
    h, (ny, nx), (height, width) = body.resolution, goals.shape[1:], body.clearance.shape
    coarse = -(-height // ny)
    fine = np.zeros((coarse * ny, coarse * nx), np.bool_)
    fine[:height, :width] = body.clearance > body.radius - 0.5 * h
    free: Bools = np.any(fine.reshape(ny, coarse, nx, coarse), axis=(1, 3))
    found = np.full(goals.shape, np.nan)
    for k in np.flatnonzero(goals.any(axis=(1, 2))):
        far = geodesic_distance(free, goals[k], coarse * h)
        beside = pooled(pooled(far, np.minimum, 1, 0), np.minimum, 1, 1)
        found[k] = np.where(np.isinf(far), beside + coarse * h, far)  # of a cell whose centre is not free
    return found


@inlined
def spare_on(
    guide: Guide, fields: Floats, stride: float, x: float, y: float, theta: float, t: int, status: Int8s
) -> tuple[float, float]:
    """The steps that moves of `stride` [m] straight to any one pending goal leave, at the least; inf where
    no distance is known. And the same at the most, whatever errors the grid has: below 0 where some goal
    cannot be reached in time. fields [K, ny, nx]: as `distances` gives them.
    """
    body, rules, least, most = guide.body, guide.rules, math.inf, math.inf
    u, v = centre(body, x, y, theta)
    side = -(-body.occupied.shape[0] // fields.shape[1]) * body.resolution
    j, i = math.floor(v / side), math.floor(u / side)
    if stride == 0.0 or j < 0 or j >= fields.shape[1] or i < 0 or i >= fields.shape[2]:
        return least, most
    for k in range(fields.shape[0]):
        if rules.kind[k] != ALWAYS and status[k] == PENDING:
            far, left = fields[k, j, i], due(rules, k) - t
            least = min(least, left - far / stride) if far < math.inf else least
            surely = SURE * far - ERROR * side
            # A robot that dwells at a goal may be there after it was due to come.
            most = min(most, left - surely / stride) if surely > 0.0 else most
    return least, most
