"""Switches in mid-session, through the service, against an exhaustive search.

    python -m benchmarks.switches [--switches 200] [--seed 0]

Each is drawn in the small worlds of benchmarks/worlds.py: a robot drives for some steps under one rule, its
model being noise; then comes another rule, another map or both, with either clock. From the pose and the
history that there are, `keepable` tries every future, with nothing of the shield but f. Where one keeps the
new rule, the switch has to be taken and the rule has to be kept to its end, by benchmarks/judge.py. Where
none does, it has to be refused, and the session has to be as it was; where the refusal says by how much later
one window would have to end, or how much smaller a region has to be that the rule keeps out of, that rule has
to be taken, and kept.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.judge import Judge, distance
from benchmarks.worlds import KINDS, SHAPES, Kind, World, make_world
from specshield.client import Session, ShieldClient
from specshield.errors import InfeasibleStart, InfeasibleSwitch, PoseError
from specshield.policy.methods import Run
from specshield.policy.reachability.method import Settings
from specshield.policy.reachability.policy import synthesise
from specshield.robot.dynamics import in_collision, make_body, motion_count, successors
from specshield.sim.service import own_server
from specshield.task import make_task

Floats = NDArray[np.float64]
WHAT = ("rule", "map", "both")
CLOCKS = ("keep", "restart")
MOST_STATES = 20_000  # of one step; what has more is drawn anew


def keepable(world: World, history: Floats) -> bool | None:
    """Whether some motions after x_0..x_t keep the rule; None where there is too much to try."""
    body, horizon, t = make_body(world.task.robot, world.task.grid), world.task.horizon, len(history) - 1
    nexts = np.empty((motion_count(body), 3))

    def after(t: int, pose: Floats, progress: tuple[int, ...]) -> tuple[int, ...] | None:
        inside = {name: float(distance(region, pose)) > 0.0 for name, region in world.regions.items()}
        new = list[int]()
        for part, done in zip(world.parts, progress, strict=True):
            holds = any(inside[name] for name in part.regions) is part.inside
            advanced = part.advance(t, holds, done)
            if advanced is None:
                return None
            new.append(advanced)
        return tuple(new)

    progress: tuple[int, ...] | None = (0,) * len(world.parts)
    for k, pose in enumerate(history[: horizon + 1]):
        assert progress is not None
        progress = after(k, pose, progress)
        if progress is None:
            return False
    layer = {_key(history[-1], progress): (history[-1], progress)}
    for k in range(t + 1, horizon + 1):
        following: dict[tuple[Any, ...], tuple[Floats, tuple[int, ...]]] = {}
        for pose, progress in layer.values():
            successors(body, pose, nexts)
            for found in nexts:
                advanced = after(k, found, progress)
                if advanced is not None:
                    following.setdefault(_key(found, advanced), (found.copy(), advanced))
        layer = following
        if len(layer) > MOST_STATES:
            return None
    return bool(layer)


def _key(pose: Floats, progress: tuple[int, ...] | None) -> tuple[Any, ...]:
    x, y, theta = pose.tolist()
    return (*(round(1e6 * v) for v in (x, y, math.cos(theta), math.sin(theta))), progress)


class Service:
    def __init__(self, client: ShieldClient) -> None:
        self.client = client
        self.made = dict[str, str]()

    def policy(self, world: World) -> str:
        """The id of a policy for this world's rule, made here and sent."""
        task = world.task
        if task.content_hash not in self.made:
            grid, spec = task.grid, {"formula": str(task.formula), "regions": world.regions}
            info: dict[str, Any] = {
                "resolution": grid.resolution, "width": grid.width, "height": grid.height,
            }  # fmt: skip
            pose = {
                "position": {"x": 0.0, "y": 0.0, "z": 0.0},
                "orientation": {"x": 0, "y": 0, "z": 0, "w": 1},
            }
            data = (100 * grid.occupied.astype(int)).ravel().tolist()
            self.client.maps.occupancy_grid({**info, "origin": pose}, data)
            policy = synthesise(task, Settings(pitch=world.kind.pitch), Run(spec=spec))
            sent = self.client.policies.upload(policy.weights(), policy.card)
            self.made[task.content_hash] = sent.id
        return self.made[task.content_hash]

    def begun(self, kind: Kind, seed: int, random: np.random.Generator) -> tuple[World, Session]:
        """A world, and a session there whose rule can be kept."""
        while True:
            world = make_world(kind, str(random.choice(list(SHAPES))), int(random.integers(2**31)))
            with contextlib.suppress(InfeasibleStart):
                policy, pose = self.policy(world), world.start
                return world, self.client.sessions.create(policy_id=policy, initial_pose=pose, seed=seed)


def switched(world: World, what: str, random: np.random.Generator) -> World:
    """Another rule, map or both."""
    other = make_world(world.kind, str(random.choice(list(SHAPES))), int(random.integers(2**31)))
    grid = world.task.grid if what == "rule" else other.task.grid
    ruled = world if what == "map" else other
    formula = " and ".join(part.text for part in ruled.parts)
    task = make_task(grid, world.task.robot, formula, ruled.regions)
    return replace(ruled, task=task)


def one(service: Service, number: int, seed: int) -> tuple[str, str]:
    """What was switched, and how it went."""
    random = np.random.default_rng([seed, number])
    kind, what, clock = KINDS[number % 2], WHAT[number // 2 % 3], CLOCKS[number // 6 % 2]
    world, session = service.begun(kind, number, random)
    after = int(random.integers(1, 2 * kind.horizon // 3))
    pose, poses, robot = world.start, [], world.task.robot
    with session:
        for _ in range(after):
            poses.append(pose)
            decision = session.step(pose, random.normal(0.0, 2.0, len(robot.actions)))
            pose = np.array(decision.next_poses[decision.execute])
        since, possible = np.array([pose] if clock == "restart" else [*poses, pose]), None
        while possible is None:
            new = switched(world, what, random)
            free = not in_collision(make_body(robot, new.task.grid), *pose)
            possible = keepable(new, since) if free else False
        before = service.client.sessions.get(session.id).info
        with_pose = {"pose": pose} if random.random() < 0.5 else {}
        how = ""
        try:
            session.switch(service.policy(new), clock=clock, **with_pose)
        except (InfeasibleSwitch, PoseError) as error:
            if service.client.sessions.get(session.id).info != before:
                return what, "REFUSED, and something changed"
            if possible:
                return what, "REFUSED, a way was there"
            change, looser = relaxed(new, error.details.get("conjuncts", ()), random)
            if looser is None:
                session.step(pose, random.normal(0.0, 2.0, len(robot.actions)))
                return what, "refused, no way was there"
            how, new = f"refused, no way was there; with {change}: ", looser
            try:
                session.switch(service.policy(new), clock=clock, **with_pose)
            except InfeasibleSwitch:
                return what, how + "REFUSED"
        else:
            if not possible:
                return what, "TAKEN, no way was there"
        states = [*([] if clock == "restart" else poses), *drive(session, pose, random)]
        horizon = new.task.horizon
        whole = np.vstack([states, np.repeat(states[-1:], horizon, axis=0)])[: horizon + 1]
        kept = bool(Judge(str(new.task.formula), new.regions).keeps(whole[None])[0])
        return what, how + ("kept" if kept else "BROKEN")


def drive(session: Session, pose: Floats, random: np.random.Generator) -> list[Floats]:
    """The poses from x_t until the rule is decided."""
    driven = [pose]
    while session.spec_status == "pending":
        decision = session.step(pose, random.normal(0.0, 2.0, len(session.info.actions)))
        pose = np.array(decision.next_poses[decision.execute])
        driven.append(pose)
    return driven


def relaxed(
    world: World, conjuncts: Sequence[Mapping[str, Any]], random: np.random.Generator
) -> tuple[str, World | None]:
    """One of the changes that a refusal names as enough for the whole rule, and the world with it; None where
    it names none.
    """
    if len(conjuncts) != len(world.parts) or not all(each["feasible_alone"] for each in conjuncts):
        return "", None
    named = [(what, i) for i, each in enumerate(conjuncts) for what in ("late_by", "regions") if each[what]]
    if not named:
        return "", None
    what, i = named[random.integers(len(named))]
    part, parts, regions = world.parts[i], list(world.parts), dict(world.regions)
    if what == "late_by":
        steps = conjuncts[i]["late_by"]
        later = {"FG": {"c1": part.c1 + steps}, "G": {"a": part.a + steps}, "F": {"b": part.b + steps}}
        parts[i] = replace(part, **later[part.kind])
    else:
        regions |= conjuncts[i]["regions"]
    formula = " and ".join(part.text for part in parts)
    task = make_task(world.task.grid, world.task.robot, formula, regions)
    change = "a later end" if what == "late_by" else "a smaller keep-out"
    return change, replace(world, parts=parts, regions=regions, task=task)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.switches")
    parser.add_argument("--switches", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    found = Counter[tuple[str, str]]()
    with own_server() as url, ShieldClient(url, timeout=120.0) as client:
        service = Service(client)
        for number in range(args.switches):
            what, how = one(service, number, args.seed)
            found[what, how] += 1
            print(f"{number}: {what}, {how}", file=sys.stderr)
    print(f"{args.switches} switches, seed {args.seed}\n")
    print("| | " + " | ".join(WHAT) + " | all |\n|---|" + "--:|" * 4)
    for how in sorted({how for _, how in found}):
        counts = [found[what, how] for what in WHAT]
        print(f"| {how} | {' | '.join(map(str, counts))} | {sum(counts)} |")


if __name__ == "__main__":
    main()
