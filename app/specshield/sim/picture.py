"""The demo's picture of a case: the floor, the named regions, and two ways from one start."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from specshield.drawing import colors
from specshield.policy.progress.obligations import obligations
from specshield.sim import canvas
from specshield.sim.cases import Case
from specshield.sim.episodes import Episode
from specshield.sim.robot import Pose
from specshield.stl import SATISFIED_ABOVE, region_named, robustness
from specshield.world.regions import signed_distance

SCALE = 110  # pixels a metre
LEGEND = 86  # pixels
SHIELDED, UNSHIELDED = colors.BLUE, colors.ORANGE


def draw(case: Case, shielded: Episode, unshielded: Episode, path: Path) -> None:
    """Writes a PNG, and the folder that it is in."""
    plan = canvas.Canvas(case.task, SCALE, below=LEGEND)
    plan.walls()
    _rooms(plan, case)
    plan.regions(13)
    if any(region_named(name)[0] for name in case.task.formula.names):  # the rule is about the body
        plan.footprints(shielded.poses[: case.task.horizon + 1], SHIELDED)
    plan.way(unshielded.poses, UNSHIELDED, 2.2)
    plan.way(shielded.poses, SHIELDED, 3.0)
    for n, (t, pose) in enumerate(_visits(case, shielded.poses)):
        plan.dot(pose, 5.0, SHIELDED, colors.PAPER)
        plan.text(pose, f"t={t}", 12, SHIELDED, shift=(9, 18 if n % 2 else -9), anchor="ls")  # two may meet
    plan.start(shielded.start)
    plan.dot(case.target, 8.0, colors.TARGET, colors.INK)
    sought = case.instruction.split()[-1]
    plan.text(case.target, sought if sought.isalpha() else "target", 14, shift=(0, 12), anchor="mt")
    _legend(plan, case, shielded, unshielded)
    path.parent.mkdir(parents=True, exist_ok=True)
    plan.picture().save(path)


def _rooms(plan: canvas.Canvas, case: Case) -> None:
    """The names of rooms that are no regions of the rule, where no region and no target takes the space."""
    grid = case.task.grid
    taken = [signed_distance(region, grid.centres) > -0.4 for region in case.task.regions.values()]
    taken.append(np.hypot(*np.moveaxis(grid.centres - case.target, -1, 0)) < 0.8)
    for name, room in case.rooms.items():
        roomy = np.minimum(signed_distance(room, grid.centres), grid.clearance)
        free = np.where(np.any(taken, axis=0), -1.0, roomy)
        if name not in case.task.regions and free.max() > 0.0:
            plan.text(grid.centres[np.unravel_index(np.argmax(free), free.shape)], name, 13, colors.FAINT)


def _visits(case: Case, poses: Sequence[Pose]) -> Iterator[tuple[int, Pose]]:
    """Each visit that the rule asks for: the first step in its window that makes it, and the pose there."""
    for part in obligations(case.task.formula):
        if part.kind != "eventually":
            continue
        for t in range(part.a, min(part.b, len(poses) - 1) + 1):
            samples = case.task.samples(np.array(poses[t : t + 1]))
            known = {name: samples[name] for name in part.predicate.names}
            if robustness(part.predicate, known) > SATISFIED_ABOVE:
                yield t, poses[t]
                break


def _legend(plan: canvas.Canvas, case: Case, shielded: Episode, unshielded: Episode) -> None:
    """Below the map; what is said of a way or of regions has their colour."""

    def write(right: float, down: float, said: str, size: float = 14, color: str = colors.INK) -> None:
        plan.text(plan.bottom, said, size, color, (right, canvas.BORDER + down), anchor="lt")

    def outcome(episode: Episode) -> str:
        found = f"ended at t={episode.ended_at}" if episode.main_done else "target not found"
        return f"rule {episode.spec_status}, {found}"

    write(0, 0, str(case.task.formula), 15)
    write(0, 26, f"with the shield: {outcome(shielded)}", color=SHIELDED)
    write(0, 50, f"without: {outcome(unshielded)}", color=UNSHIELDED)
    write(560, 26, "to visit", color=colors.VISIT)
    if colors.avoided(case.task.formula):
        write(640, 26, "to avoid", color=colors.AVOID)
    write(730, 26, f"after t={case.task.horizon}, the rule's last", color=colors.GREY)
    write(560, 50, f'"{case.instruction}"')
