"""What a child process draws: the floor of a policy, and that of a session.

Every function takes the settings first, and gives an SVG.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from specshield.arrays import Floats
from specshield.drawing.svg import Plan
from specshield.errors import InfeasibleStart, PolicyError, PoseError
from specshield.robot.dynamics import make_body, step
from specshield.service.heavy.uploads import policies_of
from specshield.service.library.policies import Description
from specshield.service.sessions import record
from specshield.service.settings import Settings
from specshield.shield.decision import Shield, make_shield
from specshield.shield.episode import start
from specshield.task import Task

# Chosen by hand; a start takes some 0.4 ms.
HEADINGS = 4  # looked at from each place
FINEST, COARSEST = 0.1, 1.0  # [m] between two places
FINER = math.sqrt(2.0)  # from one grid to the next
SECONDS = 8.0  # for a heat map with all that it needs: what a person waits, below `heavy_timeout`


def draw_policy(settings: Settings, key: str, owner: str) -> bytes:
    """Map, regions, and from where the rule can still be kept at t = 0. Raises NotFound, PolicyError."""
    policies, deadline = policies_of(settings), time.monotonic() + SECONDS
    found = policies.find(key, owner)
    task = policies.task(found.about)
    plan = Plan(task, f"policy {found.name or found.id[:8]}: from where {task.formula} can be kept")
    try:
        shield = make_shield([policies.policy(found)])
    except PolicyError as error:
        if found.card is not None:
            raise error
        said = "It is not ready yet: from where the rule can be kept is not known."
    else:
        share, pitch = kept_from(shield, deadline)
        plan.heat(share)
        known = share[np.isfinite(share)]
        kept = f"{100 * known.mean():.0f} %" if len(known) else "none"
        said = f"Green: from here the rule can be kept ({kept} of the starts, every {pitch:.2f} m); red: not."
    plan.walls()
    plan.regions()
    plan.line(str(task.formula), "ink formula")
    plan.line(said, "faint")
    return plan.svg()


def draw_session(settings: Settings, config: dict[str, Any], rows: Floats, last: bytes) -> bytes:
    """Map, regions, the executed way, and the certified continuation of the last decision.

    last: the record of the last row, empty where that was not decided.
    """
    task = policies_of(settings).task(
        Description(config["map_id"], config["robot"], config["spec"], "", 0, {})
    )
    plan = Plan(task, f"session {config['id']} at step {len(rows) - 1}")
    plan.walls()
    plan.regions()
    if last:
        plan.way(_continuation(task, rows[-1], record.decode(last)), "next")
    plan.way(rows[:, :3])
    plan.robot(rows[-1, :3].tolist())
    plan.line(str(task.formula), "ink formula")
    dashed = (
        "; dashed: the certified continuation" if last and record.decode(last).witness is not None else ""
    )
    plan.line(
        f"{config['id']}, step {len(rows) - 1} of {task.horizon}. The line is the way driven{dashed}.",
        "faint",
    )
    return plan.svg()


def kept_from(shield: Shield, deadline: float) -> tuple[Floats, float]:
    """The share of headings [rows, columns] from which some first action has a future that keeps the rule;
    NaN where the robot does not fit. The first row is at the highest y. And the pitch [m] of the places: the
    finest that can be had by the deadline [s, of time.monotonic].
    """
    pitch = COARSEST
    share = _kept_on_grid(shield, pitch, math.inf)
    assert share is not None
    while pitch > FINEST:
        began = time.monotonic()
        finer = _kept_on_grid(shield, pitch / FINER, deadline)
        if finer is None:
            break
        share, pitch = finer, pitch / FINER
        if began + 3 * (time.monotonic() - began) > deadline:  # the next has twice as many places
            break
    return share, pitch


def _kept_on_grid(shield: Shield, pitch: float, deadline: float) -> Floats | None:
    """None where the deadline comes first."""
    xmin, ymin, xmax, ymax = shield.task.grid.bounds
    columns, rows = (max(1, round((high - low) / pitch)) for low, high in ((xmin, xmax), (ymin, ymax)))
    share = np.full((rows, columns), np.nan)
    for row in range(rows):
        for column in range(columns):
            if time.monotonic() > deadline:
                return None
            x, y = xmin + (column + 0.5) * (xmax - xmin) / columns, ymax - (row + 0.5) * (ymax - ymin) / rows
            poses = [np.array([x, y, k * math.tau / HEADINGS]) for k in range(HEADINGS)]
            fits = [kept for pose in poses if (kept := _can_be_kept(shield, pose)) is not None]
            if fits:
                share[row, column] = sum(fits) / len(fits)
    return share


def _can_be_kept(shield: Shield, pose: Floats) -> bool | None:
    """Whether an episode may begin there; None where the robot does not fit."""
    try:
        start(shield, pose.tolist())
    except PoseError:
        return None
    except InfeasibleStart:
        return False
    return True


def _continuation(task: Task, row: Floats, decided: record.StepRecord) -> Floats:
    """x_t, then the poses that `action` and its witness lead to. Shape [N, 3]."""
    body, poses = make_body(task.robot, task.grid), [(float(row[0]), float(row[1]), float(row[2]))]
    chosen = decided.completion_action if task.robot.terminal[decided.action] else decided.action
    following = () if decided.witness is None or chosen is None else (chosen, *decided.witness)
    for action in following:
        if not task.robot.terminal[action]:
            x, y, theta = poses[-1]
            poses.append(step(body, x, y, theta, int(task.robot.motion_of[action])))
    return np.array(poses)
