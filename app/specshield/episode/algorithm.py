"""Algorithm 1 as a pure function: history and logits in, a decision out.

Beside these, a decision depends only on what the last decision handed on (its `Carry`). So any process can
make a decision, and make it again with the same result.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from hashlib import blake2b
from itertools import accumulate

import numpy as np
from numpy.typing import ArrayLike

from specshield.arrays import Bools, Floats
from specshield.caution import judgement
from specshield.caution.experience import learn, remember
from specshield.caution.findings import findings
from specshield.caution.surprise.slip import SAME_POSE, with_begun
from specshield.caution.taught import handed_on, on_map, teach, wary
from specshield.caution.threshold import chances, left_of, next_left
from specshield.compiled import leaf
from specshield.errors import InfeasibleStart, InfeasibleSwitch, PoseError
from specshield.robot.dynamics import Body, in_collision, simulate, successors, wrap
from specshield.robot.oddity import oddities
from specshield.shield import shaping
from specshield.shield.answer import all_on, answer_of, unmodified
from specshield.shield.certificate import as_actions, as_numbers, certify, j_values_of
from specshield.shield.decision import Carry, Decision, Explanation, Shield
from specshield.shield.feasibility import Prefix, Signals, futures, prefix_of
from specshield.stl import SATISFIED_ABOVE, Verdict, robustness_bounds
from specshield.stl.robustness import verdict_between

Explainer = Callable[[Shield, Prefix, judgement.Judged | None, Bools], tuple[Explanation | None, ...]]


def start(shield: Shield, pose: Sequence[float], way: bytes | None = None) -> None:
    """Checks that an episode can begin at `pose` (x, y, theta): some first action has a satisfying future.

    way: one more future to try, see `Carry`. Raises PoseError for a pose that is not finite, outside the map
    or in collision, else InfeasibleStart.
    """
    history = _history([pose], "initial_pose")
    check_place(shield, history[0], "initial_pose")
    prefix = prefix_of(shield.task, shield.task.formula, shield.view, history, {})
    rho, warnings = np.array([prefix.low]), tuple[str, ...]()
    if shield.task.horizon > 0:  # else the first state says it all
        tried = futures(prefix, shield.body, shield.proposers, way, (shield.config.margin, 0.0))
        rho, warnings = tried.rho, tried.warnings
    best = float(rho.max(initial=-np.inf))
    if not best > SATISFIED_ABOVE:
        found = f"the best robustness found is {best:.3f}" if len(rho) else "; ".join(warnings)
        told, at = f"no way from here was found that keeps the rule: {found}", [round(v, 3) for v in pose]
        expected = "a pose from which the rule can be kept; or allow_infeasible"
        raise InfeasibleStart(told, path="initial_pose", got=at, expected=expected)


def check_switch(
    shield: Shield, history: Floats, signals: Signals | None, carry: Carry | None, elsewhere: bool
) -> None:
    """Checks that the rule of `shield` can be kept from x_t on, as the next decision will see it.

    history [t + 1, 3], signals {name: [t + 1]}: since the step from which the rule's windows count. carry:
    what the next decision will be given. elsewhere: whether the map or the robot has changed; x_t is then
    checked as an initial pose is. Raises PoseError, InfeasibleSwitch.
    """
    if elsewhere:
        check_place(shield, history[-1], "poses")
    found = decide(shield, history, None, True, signals, carry)
    if found.spec_status == "satisfied" or found.mode == "completion":
        return
    expected = "a rule that can be kept from x_t" + ("; or clock 'restart'" if len(history) > 1 else "")
    raise InfeasibleSwitch("no way keeps the new rule from x_t on", path="policy_id", expected=expected)


def check_place(shield: Shield, pose: Floats, path: str) -> None:
    """Raises PoseError, at `path`, for a pose (3,) that is outside the map or in collision."""
    grid, got = shield.task.grid, pose.tolist()
    if not grid.holds(pose[:2]):
        within = f"within {list(grid.bounds)} (xmin, ymin, xmax, ymax)"
        raise PoseError("the pose is outside the map", path=path, got=got, expected=within)
    if in_collision(shield.body, *pose):
        apart = f"the footprint's centre at least {shield.task.robot.radius:g} m from every obstacle"
        raise PoseError("the footprint touches an obstacle", path=path, got=got, expected=apart)


def close(
    shield: Shield, history: ArrayLike, signals: Signals | None = None
) -> tuple[Verdict, tuple[float, float]]:
    """The verdict on an episode's states [t + 1, 3], and the bounds on its robustness."""
    prefix = shield.task.samples(_history(history), signals)
    low, high = (float(v) for v in robustness_bounds(shield.task.formula, prefix))
    return verdict_between(low, high), (low, high)


def decide(
    shield: Shield,
    history: ArrayLike,
    logits: ArrayLike | None,
    main_task_done: bool = False,
    signals: Signals | None = None,
    carry: Carry | None = None,
    witnesses: bool = False,
    occupied: ArrayLike | None = None,
    free: ArrayLike | None = None,
    explain: Explainer | None = None,
) -> Decision:
    """One decision of Algorithm 1, at t = len(history) - 1.

    history [t + 1, 3]: x_0..x_t; logits [A], -inf where the model rules an action out, None once the main
    task is over; signals {name: [t + 1]}; carry: what the last decision handed on; witnesses: give every
    action's; occupied, free [n, 2]: points where the robot's sensors see an obstacle, or none, now [m];
    explain: says why each forbidden action is forbidden (reasons/explanation.py). Raises LogitsError for
    logits that are missing, NaN, +inf, all -inf or of the wrong number.
    """
    task, robot = shield.task, shield.task.robot
    poses = _history(history)
    t, signals = len(poses) - 1, signals or {}
    log_prior = shaping.log_prior_of(task.robot, logits, main_task_done)
    taught, said = teach(shield, carry, poses, occupied, free)
    said = (*oddities(task.grid, shield.body, np.asarray(history, np.float64)[taught.here :]), *said)
    told, shield = shield, on_map(shield, taught.map, barred=taught.barred)
    places = np.empty((len(robot.motions) + 1, 3))  # where each motion leads; last x_t, where `end` leads
    nexts, places[-1] = places[:-1], poses[-1]
    touches = _look_around(shield.body, poses[-1], nexts)
    tail, residual = _follow(carry, poses, task.horizon - t, shield.body)
    before, shield = shield, with_begun(shield, carry, poses)
    memory, weights = None if carry is None else carry.memory, None
    chance, onward, left = None, None, shield.config.threshold
    seen, care = learn(shield, carry, poses, taught.contact)
    foreseen = residual is not None and max(residual) <= SAME_POSE
    care = wary(shield, care, taught, shield is not before or (foreseen and tail is not None))
    whole = prefix = prefix_of(task, task.formula, shield.view, poses, signals)
    spec_status = verdict_between(prefix.low, prefix.high)
    asked = SATISFIED_ABOVE + care.margin
    margin_decided = prefix.low > asked or prefix.high <= asked  # it is kept, or lost, whatever follows

    withstands, doubts = spec_status == "satisfied", np.zeros(len(robot.motions), np.bool_)
    if t >= task.horizon or (spec_status == "satisfied" and margin_decided):
        judged = certified = None
        answer = unmodified(shield, log_prior)
    else:
        now = judgement.Situation(prefix, tail, spec_status, care)
        found = findings(told, shield, taught, now, nexts)
        if found.shield.body is not shield.body:  # another map is believed
            touches = _look_around(found.shield.body, poses[-1], nexts)
        shield, taught, prefix, judged = found.shield, found.taught, found.now.prefix, found.judged
        doubts, withstands, onward = found.doubts, found.withstands, found.onward
        body = shield.body if len(taught.map) else told.body  # if nothing was learned, the map is as told
        certified = certify(shield, body, judged.part if spec_status == "violated" else whole, judged.claim)
        said = (*said, *found.said, *certified.warnings)
        if shield.preference is not None and log_prior is not None and spec_status == "pending":
            memory, weights = _preferred(shield, memory, poses, signals, log_prior, certified.feasible)
            if weights is None:
                said = (
                    *said,
                    "the preference's weights are not numbers, one for each action: it is left out",
                )
        if shield.config.threshold_over == "episode" and spec_status == "pending":
            chance, onward = chances(shield, care, prefix, judged, doubts, certified.witnesses)
            left = left_of(shield, carry, chance)
        answer = answer_of(shield, log_prior, certified, main_task_done, weights, chance, left)
        if spec_status == "violated":
            answer = answer._replace(mode="violated")

    action = _draw(answer.distribution, shield.config.seed, t)
    moved = certified.completion if certified is not None and robot.terminal[action] else action
    unknown, mass = (None,) * len(robot.actions), None
    ways = (None,) * len(robot.motions) if certified is None else certified.witnesses
    if certified is not None and answer.conditional is not None:
        mass = shaping.feasible_mass(answer.conditional, certified.feasible)
    if chance is not None:
        left = next_left(left, chance, answer.distribution, robot.terminal)
    elif shield.config.threshold_over == "episode":
        left = left_of(shield, carry, None)
    margin, slack = (care.margin, care.least) if judged is None else (judged.aimed.margin, judged.aimed.slack)
    remembered = None
    if seen is not None:
        follows = shield.config.learn_map and taught.followed.surely
        done = all_on(action, len(robot.actions)) if follows else answer.distribution
        remembered = remember(shield, seen, done, moved, nexts, poses[-1])
    return Decision(
        t=t,
        mode=answer.mode,
        distribution=answer.distribution,
        j_values=unknown if certified is None else j_values_of(shield, certified),
        robustness=unknown if certified is None else as_numbers(certified.robustness.tolist()),
        action=action,
        action_name=robot.actions[action].name,
        completion_action=None if certified is None else certified.completion,
        spec_status=spec_status,
        feasible_mass=mass,
        kl=None if log_prior is None else shaping.divergence(answer.distribution, log_prior),
        reason=answer.reason,
        finished=(spec_status != "pending" and main_task_done) or t >= shield.max_steps,
        next_poses=places.take(robot.motion_of, 0),
        residual=residual,
        in_collision=touches,
        witness=as_actions(shield, ways, moved),
        witnesses=tuple(as_actions(shield, ways, a) for a in range(len(robot.actions))) if witnesses else (),
        warnings=said,
        margin=margin,
        slack=slack,
        threshold_left=left,
        map_revision=taught.map.revision,
        any_signal=withstands if shield.config.any_signal and task.signals else None,
        explanations=explain(shield, prefix, judged, doubts) if explain is not None else (),
        carry=Carry(
            t,
            nexts,
            onward or ways,
            memory,
            residuals=remembered,
            threshold_left=left if shield.config.threshold_over == "episode" else None,
            learned=handed_on(shield, taught, moved, answer.distribution, nexts, poses[-1]),
            action=action,
            stuck=taught.stuck,
            here=taught.here,
        ),
    )


def _preferred(
    shield: Shield, memory: bytes | None, poses: Floats, signals: Signals, log_prior: Floats, feasible: Bools
) -> tuple[bytes | None, Floats | None]:
    """What the session's preference remembers, and its weights [A]; None for weights that are not such. It is
    given copies: nothing that it does can make an action feasible.
    """
    assert shield.preference is not None
    known = shield.preference.begin() if memory is None else memory
    memory, weights = shield.preference.step(known, poses.copy(), signals, log_prior.copy(), feasible.copy())
    # NaN is not below infinity either.
    fit = (
        isinstance(weights, np.ndarray) and weights.shape == feasible.shape and bool((weights < np.inf).all())
    )
    return memory, weights if fit else None


def _history(poses: ArrayLike, path: str = "poses") -> Floats:
    """Poses [t + 1, 3] with theta in (-pi, pi], as f has it. Raises PoseError where they are not finite."""
    array = np.array(poses, dtype=np.float64, order="C")
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0 or not _wrapped(array):
        expected = "a list of finite [x, y, theta]"
        raise PoseError("these are not poses", path=path, got=str(poses)[:80], expected=expected)
    return array


@leaf
def _look_around(body: Body, pose: Floats, nexts: Floats) -> bool:
    """Writes where each motion leads from a pose (3,) into nexts (M, 3); True if the pose is in collision."""
    successors(body, pose, nexts)
    return in_collision(body, pose[0], pose[1], pose[2])


@leaf
def _wrapped(poses: Floats) -> bool:
    """Wraps the headings of poses (n, 3) into (-pi, pi], in place. False if a number is not finite."""
    for i in range(poses.shape[0]):
        if not (math.isfinite(poses[i, 0]) and math.isfinite(poses[i, 1]) and math.isfinite(poses[i, 2])):
            return False
        poses[i, 2] = wrap(poses[i, 2])
    return True


def _follow(
    carry: Carry | None, poses: Floats, steps: int, body: Body
) -> tuple[bytes | None, tuple[float, float] | None]:
    """What is left of the witness that the robot follows, or a new rule's `Carry.way`, as motions from x_t;
    and how far x_t is from the nearest pose that the last decision foresaw [m], [rad]. steps: T - t.
    """
    way = None if carry is None else carry.way
    if way is not None and (len(way) != steps or max(way, default=0) >= len(body.translate)):
        way = None
    if carry is None or not 0 <= carry.t <= len(poses) - 2:
        return way, None
    alone = len(poses) - 2 - carry.t  # steps without a decision
    gap = np.empty(len(carry.next_poses))
    off = _gaps(carry.next_poses, poses[carry.t + 1], gap)
    reach, gaps = sum(off) + SAME_POSE, gap.tolist()
    ways = [w for w, far in zip(carry.witnesses, gaps, strict=True) if w and far <= reach]
    ways = [w for w in ways if max(w) < len(body.translate)]
    if alone > 0 and len(ways) > 1:  # a blocked move leads where waiting does
        ends = np.empty((len(ways), alone, 3))
        for w, end in zip(ways, ends, strict=True):
            simulate(body, poses[carry.t + 1], np.frombuffer(w[:alone], np.uint8).astype(np.int64), end)
        _gaps(np.ascontiguousarray(ends[:, -1]), poses[-1], gap)
        ways = [ways[int(np.argmin(gap[: len(ways)]))]]
    return way or (ways[0][alone:] if ways else None), None if alone > 0 else off


@leaf
def _gaps(foreseen: Floats, pose: Floats, gap: Floats) -> tuple[float, float]:
    """Writes how far a pose (3,) is from each of the foreseen poses [M, 3] into gap (M,), metres and radians
    added up; returns the distance to the nearest [m], [rad].
    """
    nearest, off = math.inf, (0.0, 0.0)
    for m in range(len(foreseen)):
        move = math.hypot(foreseen[m, 0] - pose[0], foreseen[m, 1] - pose[1])
        turn = abs((foreseen[m, 2] - pose[2] + math.pi) % (2.0 * math.pi) - math.pi)
        gap[m] = move + turn
        if gap[m] < nearest:
            nearest, off = gap[m], (move, turn)
    return off


def _draw(distribution: Floats, seed: int, t: int) -> int:
    """An action drawn with the session's seed and t, so that a replay draws the same."""
    drawn = blake2b(b"%d %d" % (seed, t), digest_size=8).digest()
    shares = distribution.tolist()
    edges = list(accumulate(shares))
    point = int.from_bytes(drawn, "big") / 2.0**64 * edges[-1]
    found = bisect_right(edges, point)
    return found if found < len(edges) else max(a for a, share in enumerate(shares) if share != 0.0)
