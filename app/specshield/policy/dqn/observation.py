"""What pi_phi sees of a state: time, pose, the formula's progress, and what each motion would lead to."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Int8s, Ints, Singles
from specshield.compiled import inlined, kernel, leaf
from specshield.policy.dqn.scene import Scene, between, blend, current_goal, distance_to
from specshield.policy.progress import (
    ALWAYS,
    BROKEN,
    EVENTUALLY_ALWAYS,
    PENDING,
    SETTLED,
    Rules,
    advance,
    read_predicates,
    value_count,
)
from specshield.robot.dynamics import Body, displacement, motion_count
from specshield.rule.values import fill_pose, fill_region
from specshield.stl.program import STACK_SIZE, evaluate_packed

GLOBAL, PER_GOAL, PER_ALWAYS, PER_MOTION = 5, 10, 2, 3  # entries of an observation

# The networks that are shipped were trained with these, which were chosen by hand; nothing was measured.
TIME_UNIT = 50.0  # [steps] in which times are given, up to 2 of them
DISTANCE_UNIT = 5.0  # [m] in which distances along free space are given, up to 2 of them
HALF_WAY = 0.5  # [m] the distance at which d / (d + HALF_WAY) is a half
PROBE = 0.1  # [m] how far on either side a distance is read to find the way it falls
SAFE = 0.3  # [m] robustness of an `always` beyond which more is no safer
MOST_GAIN = 1.5  # [strides] by which one motion may bring the goal nearer or farther


class State(NamedTuple):
    """A robot at one step, of a task with K obligations and M motions."""

    pose: Floats  # [3]
    status: Int8s  # [K] the progress, as `advance` keeps it
    run: Ints  # [K]
    predicates: Floats  # [K] robustness at `pose`
    nexts: Floats  # [M, 3] the pose after each motion
    observation: Singles  # [observation_size]
    values: Floats  # what predicates read (rule/values.py), filled for some pose
    stack: Floats  # scratch of programs
    after: Floats  # [K] scratch: predicates after a motion
    far: Floats  # [K] the distance to each goal
    seen: Floats  # [5] for which pose, goal and `always` `far` and the observation are, NaN at first


def observation_size(rules: Rules, body: Body) -> int:
    always = int(np.sum(rules.kind == ALWAYS))
    goals = len(rules.kind) - always
    return GLOBAL + PER_GOAL * goals + PER_ALWAYS * always + PER_MOTION * motion_count(body)


@kernel
def make_state(scene: Scene, inputs: int) -> State:
    """A state without content. inputs: the observation's size."""
    count = scene.rules.kind.shape[0]
    return State(
        np.empty(3),
        np.empty(count, np.int8),
        np.empty(count, np.int64),
        np.empty(count),
        np.empty((motion_count(scene.body), 3)),
        np.empty(inputs, np.float32),
        np.empty(value_count(scene.rules)),
        np.empty(STACK_SIZE),
        np.empty(count),
        np.empty(count),
        np.full(5, np.nan),
    )


@inlined
def place(rules: Rules, x: float, y: float, theta: float, state: State) -> None:
    """Puts the robot at a pose; its progress stays as it is."""
    state.pose[0], state.pose[1], state.pose[2] = x, y, theta
    read_predicates(rules, x, y, theta, state.values, state.stack, state.predicates)


@inlined
def arrive(rules: Rules, t: int, x: float, y: float, theta: float, state: State) -> bool:
    """Puts the robot at x_t and takes that into its progress. Returns whether it moved."""
    moved = bool(x != state.pose[0] or y != state.pose[1] or theta != state.pose[2])
    if moved:
        place(rules, x, y, theta, state)
    advance(rules, t, state.predicates, state.status, state.run)
    return moved


@leaf
def outcome(status: Int8s) -> int:
    """BROKEN if any obligation is, SETTLED if all are, else PENDING."""
    if BROKEN in status:
        return BROKEN
    return PENDING if PENDING in status else SETTLED


@inlined
def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@inlined
def observe(scene: Scene, t: int, state: State) -> None:
    """Writes the observation of a state at step t, whose pose, progress, predicates and nexts are filled.

    First five entries on time and pose, then ten for each goal and two for each `always` in the formula's
    order, then three for each motion. What a robot that stands has been told of its place stays as it is.
    """
    rules, out, seen = scene.rules, state.observation, state.seen
    x, y, theta = state.pose[0], state.pose[1], state.pose[2]
    stays = x == seen[0] and y == seen[1] and theta == seen[2]
    if not stays:
        _observe_place(scene, x, y, theta, state)
    out[0] = t / scene.horizon
    at, target = GLOBAL, current_goal(rules, state.status)
    here, guards = 0.0, 0  # the distance to the current goal; as bits, which `always` hold at t + 1
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == ALWAYS:
            guards |= (rules.a[k] <= t + 1 <= rules.b[k]) << k
            out[at] = _clip(state.predicates[k] / SAFE, -1.0, 1.0)
            out[at + 1] = 1.0 if rules.a[k] <= t <= rules.b[k] else 0.0
            at += PER_ALWAYS
            continue
        hold = rules.kind[k] == EVENTUALLY_ALWAYS
        d, left = state.far[k], rules.last[k] - t
        if k == target:
            here = d
        out[at] = 1.0 if state.status[k] == SETTLED else 0.0
        out[at + 1] = _clip((rules.a[k] + rules.c2[k] - t) / TIME_UNIT, 0.0, 2.0)
        out[at + 2] = _clip(left / TIME_UNIT, -0.2, 2.0)
        out[at + 3] = _clip(state.predicates[k], -1.0, 1.0)
        out[at + 8] = _clip((left * scene.stride - d) / DISTANCE_UNIT, -1.0, 1.0)  # metres to spare
        out[at + 9] = state.run[k] / (rules.b[k] - rules.c2[k] + 1.0) if hold else 0.0
        at += PER_GOAL
    if not stays or target != seen[3] or guards != seen[4]:
        _observe_motions(scene, t, state, at, target, here, guards != 0)
        seen[0], seen[1], seen[2], seen[3], seen[4] = x, y, theta, target, guards


@inlined
def _observe_place(scene: Scene, x: float, y: float, theta: float, state: State) -> None:
    """Writes the entries that the pose alone decides, and how far each goal is."""
    out, cos, sin, at = state.observation, math.cos(theta), math.sin(theta), GLOBAL
    out[1], out[2] = cos, sin
    out[3], out[4] = (x - scene.centre[0]) / scene.half[0], (y - scene.centre[1]) / scene.half[1]
    middle = between(scene, x, y)
    west, east = between(scene, x - PROBE, y), between(scene, x + PROBE, y)
    south, north = between(scene, x, y - PROBE), between(scene, x, y + PROBE)
    for k in range(scene.goal.shape[0]):
        if scene.goal[k] < 0:
            at += PER_ALWAYS
            continue
        field = scene.distance[scene.goal[k]]
        state.far[k] = d = blend(field, *middle)
        gx = blend(field, *west) - blend(field, *east)
        gy = blend(field, *south) - blend(field, *north)
        norm = max(math.hypot(gx, gy), 1e-6)
        out[at + 4] = min(d / DISTANCE_UNIT, 2.0)
        out[at + 5] = d / (d + HALF_WAY)
        out[at + 6] = (gx * cos + gy * sin) / norm  # the way to the goal, seen from the robot: ahead
        out[at + 7] = (gy * cos - gx * sin) / norm  # and to the left
        at += PER_GOAL


@inlined
def _observe_motions(
    scene: Scene, t: int, state: State, at: int, target: int, here: float, guarded: bool
) -> None:
    """Writes three entries for each motion: whether it is made in full, how much nearer it brings the goal,
    and how safe the robot is after it.
    """
    body, rules, out = scene.body, scene.rules, state.observation
    x, y, theta = state.pose[0], state.pose[1], state.pose[2]
    still = _safety(rules, t + 1, state.predicates)
    moved, gain, safe, last_x, last_y = 0.0, 0.0, still, x, y
    for m in range(motion_count(body)):
        nx, ny, nth = state.nexts[m, 0], state.nexts[m, 1], state.nexts[m, 2]
        elsewhere = nx != last_x or ny != last_y  # motions that end at one place share what is known of it
        if elsewhere:
            last_x, last_y = nx, ny
            moved, gain, safe = math.hypot(nx - x, ny - y), 0.0, still
            if target >= 0 and moved > 0.0:
                gain = _clip(
                    (here - distance_to(scene, target, nx, ny)) / scene.stride, -MOST_GAIN, MOST_GAIN
                )
        if guarded and (elsewhere or scene.guards_turn):
            safe = _safety_at(scene, t + 1, nx, ny, nth, state)
        move, turn = displacement(body, m)
        full = moved >= abs(move) - 1e-6 and (turn == 0.0 or nth != theta)
        out[at] = 1.0 if full else 0.0
        out[at + 1] = gain
        out[at + 2] = safe
        at += PER_MOTION


@inlined
def _safety(rules: Rules, t: int, predicates: Floats) -> np.float32:
    """How far every `always` that holds at step t is from being broken, in units of SAFE; from -1 to 1."""
    safe = np.float32(1.0)
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == ALWAYS and rules.a[k] <= t <= rules.b[k]:
            safe = min(safe, np.float32(max(predicates[k] / SAFE, -1.0)))
    return safe


@inlined
def _safety_at(scene: Scene, t: int, x: float, y: float, theta: float, state: State) -> np.float32:
    """`_safety` at another pose. Only the regions that an `always` reads are measured there."""
    rules = scene.rules
    fill_pose(x, y, theta, state.values)
    for r in scene.guards:
        fill_region(rules.regions, r, state.values)
    for k in range(rules.kind.shape[0]):
        if rules.kind[k] == ALWAYS:
            state.after[k] = evaluate_packed(k, rules.programs, state.values, state.stack)
    return _safety(rules, t, state.after)
