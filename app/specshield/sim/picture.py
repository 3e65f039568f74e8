"""The demo's picture of a case: the floor, the named regions, and the two ways from one start."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from specshield.drawing.rules import avoided
from specshield.drawing.svg import Plan
from specshield.policy.progress.obligations import obligations
from specshield.sim.cases import Case
from specshield.sim.episodes import Episode
from specshield.sim.robot import Pose
from specshield.stl import SATISFIED_ABOVE, region_named, robustness
from specshield.world.regions import signed_distance


def draw(case: Case, shielded: Episode, unshielded: Episode, path: Path) -> None:
    """Writes the picture as SVG, and makes its folder."""
    asked = case.task.horizon + 1  # the number of states that the rule is about
    plan = Plan(case.task, f"{case.name} with and without the shield")
    plan.walls()
    _rooms(plan, case)
    plan.regions()
    if any(region_named(name)[0] for name in case.task.formula.names):  # the rule is about the body
        for pose in shielded.poses[:asked]:
            plan.robot(pose, "robot body")
    for episode, kind in ((unshielded, "beside"), (shielded, "way")):
        poses = np.array(episode.poses)
        plan.way(poses[asked - 1 :], "after")
        plan.way(poses[:asked], kind)
    for n, (t, pose) in enumerate(_visits(case, shielded.poses)):
        plan.mark(pose, f"t={t}", above=n % 2 == 0)  # above and below in turn, since two may meet
    plan.robot(shielded.start)
    sought = case.instruction.split()[-1]
    plan.mark(case.target, sought if sought.isalpha() else "target", "target")
    _legend(plan, case, shielded, unshielded)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(plan.svg())


def _rooms(plan: Plan, case: Case) -> None:
    """Writes the names of rooms that are no regions of the rule, away from regions and the target."""
    grid = case.task.grid
    taken = [signed_distance(region, grid.centres) > -0.8 for region in case.task.regions.values()]
    taken.append(np.hypot(*np.moveaxis(grid.centres - case.target, -1, 0)) < 0.8)
    for name, room in case.rooms.items():
        roomy = np.minimum(signed_distance(room, grid.centres), grid.clearance)
        free = np.where(np.any(taken, axis=0), -1.0, roomy)
        if name not in case.task.regions and free.max() > 0.0:
            plan.words(grid.centres[np.unravel_index(np.argmax(free), free.shape)].tolist(), name)


def _visits(case: Case, poses: Sequence[Pose]) -> Iterator[tuple[int, Pose]]:
    """For each visit that the rule asks for, the first step in its window that makes it, and its pose."""
    for part in obligations(case.task.formula):
        if part.kind != "eventually":
            continue
        for t in range(part.a, min(part.b, len(poses) - 1) + 1):
            samples = case.task.samples(np.array(poses[t : t + 1]))
            known = {name: samples[name] for name in part.predicate.names}
            if robustness(part.predicate, known) > SATISFIED_ABOVE:
                yield t, poses[t]
                break


def _legend(plan: Plan, case: Case, shielded: Episode, unshielded: Episode) -> None:
    """Writes below the map what each colour means."""

    def outcome(episode: Episode) -> str:
        found = f"ended at t={episode.ended_at}" if episode.main_done else "target not found"
        return f"rule {episode.spec_status}, {found}"

    plan.line(str(case.task.formula), "ink formula")
    plan.line(f"Blue: with the shield: {outcome(shielded)}.")
    plan.line(f"Orange: without: {outcome(unshielded)}.")
    areas = "Green: to visit; red: to avoid" if avoided(case.task.formula) else "Green: to visit"
    plan.line(f'{areas}; grey: after t={case.task.horizon}, the rule\'s last. "{case.instruction}"', "faint")
