"""Compiles the kernels that decisions need, on a world of a few cells, before the server is ready.

    python -m specshield.service.warmup PART NICENESS    # compiles one part onto the disk, for startup.py

The parts have few kernels in common, so that processes can compile them at the same time. LATER is compiled
once the server is ready, before a decision needs it; look-ahead's kernels when a session with it begins.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from llvmlite.binding import ffi
from numba.core.caching import IndexDataCacheFile
from numba.core.compiler import Flags
from numba.core.lowering import BaseLower

from specshield import episode
from specshield.arrays import Floats
from specshield.caution.experience import was_stopped
from specshield.caution.surprise.barred import NOTHING_BARRED
from specshield.caution.surprise.contact import cells_met
from specshield.compiled import box
from specshield.policy.lattice import Lattice
from specshield.policy.progress import Past, make_rules
from specshield.policy.reachability.around.field import NO_FIELDS, distances, goal_cells
from specshield.policy.reachability.around.search import go_around
from specshield.policy.reachability.latest import sweep
from specshield.policy.reachability.policy import synthesise
from specshield.policy.reachability.tables import Guide
from specshield.reasons.explanation import explanations
from specshield.reasons.refusal import refusal
from specshield.robot import STRETCH
from specshield.robot.dynamics import make_body, motion_count, overlap, step, successors
from specshield.service.sessions import packing, record
from specshield.service.storage.keeper import at_end_of_input
from specshield.shield import shaping
from specshield.shield.decision import Config, make_shield
from specshield.shield.proposal import Proposal
from specshield.shield.uncertainty import Uncertainty
from specshield.task import Task, make_task
from specshield.world.occupancy import OccupancyGrid

FORMULA = "F[0,3] A and F[0,2] G[0,1] B and G[1,4] not C"
REGIONS = {
    "A": {"type": "circle", "center": [1.0, 1.0], "radius": 1.0},
    "B": {"type": "rectangle", "min": [0.0, 0.0], "max": [2.0, 2.0]},
    "C": {"type": "polygon", "vertices": [[1.2, 1.2], [2.0, 1.2], [2.0, 2.0]]},
}
START, AWAY = (1.0, 1.0, 0.0), (0.2, 0.2, 0.8)  # in A and out of it


def warm_up(part: str) -> None:
    """Runs this part's kernels once: compiles them, or takes them from the disk."""
    gc.set_threshold(10_000, 1_000_000)  # objects that the processor still has in its cache; older ones stay
    {**PARTS, **LATER}[part]()


def _propose() -> None:
    """The kernels by which reachability makes its tables and proposes. They take longest to compile."""
    policy = synthesise(task := _task())
    policy.propose(np.array([START]), {}, 0.0)
    policy.on_body(make_body(task.robot, task.grid)).propose(np.array([START]), {}, 0.01)


def _decide() -> None:
    """The kernels by which the shield begins sessions, decides and refuses: with an exact world, and with the
    defaults of a session.
    """
    # First those that need no task, so that the other process compiles those of a task meanwhile. `sweep` is
    # one of the other's, which has more to compile.
    kinds = (np.uint8, 3), (np.float32, 4), (np.float32, 4), (np.int16, 4), (np.uint8, 4), (np.int64, 1)
    nowhere = Lattice._make([1.0, 1, *(np.zeros((0,) * n, kind) for kind, n in kinds), 1])
    sweep(nowhere, nowhere.valid, 0.0, np.zeros((0, 0, 0), np.float32))
    logits = np.zeros(len(STRETCH.actions))
    prior = shaping.log_softmax(logits)
    shaping.going_on(prior, STRETCH.terminal)
    shaping.restrict(prior, ~STRETCH.terminal)
    packing.pack_table(np.zeros((len(logits), packing.COLUMNS)), logits)
    task = _task()
    policy = _Standing(task)
    for config in (Config(), Config(uncertainty=Uncertainty(), learn_map=True)):
        shield = make_shield([policy], config)
        episode.start(shield, START)
        first = episode.decide(shield, [START], logits)
        record.make(first, record.Asked(START, logits, False), np.array(START), (), b"")
        second = [START, first.next_poses[0].tolist()]
        carry = first.carry._replace(stuck=((*START, 0),))
        episode.decide(shield, second, logits, carry=carry, occupied=[[1.9, 0.5]], explain=explanations)
    refusal(shield, np.array([START]), {})
    _in_trouble(policy, logits)
    distances(shield.body, goal_cells(shield.body, make_rules(task)))
    _search(task)


def _search(task: Task) -> None:
    """The search for ways around. It is one of reachability's too, but the other process has more to compile,
    and by now has compiled what the search calls.
    """
    body, rules, wait = make_body(task.robot, task.grid), make_rules(task), task.robot.wait_motion
    guide = box(Guide(body, rules, synthesise(task).tables, wait, NOTHING_BARRED))
    past = Past(0.0, np.array([START]), np.empty((1, 0)))
    ways = np.empty((len(task.robot.motions), task.horizon), np.int64)
    go_around(guide, 0.0, past, NO_FIELDS, np.empty((*ways.shape, 3)), ways, 1)


@dataclass(frozen=True)
class _Standing:
    """A policy that has no kernels: it waits after each motion."""

    task: Task
    id = "standing"

    def propose(self, history: Floats, signals: Mapping[str, Floats], margin: float) -> Proposal:
        robot = self.task.robot
        motions = np.full((len(robot.motions), self.task.horizon + 1 - len(history)), robot.wait_motion)
        motions[:, 0] = np.arange(len(motions))
        return Proposal(motions, robot.wait_motion)


def _in_trouble(policy: _Standing, logits: np.ndarray) -> None:
    """The kernels for a robot that is walled in, in a forbidden place, or stopped by what no map shows."""
    shield = make_shield([policy], Config(uncertainty=Uncertainty(), learn_map=True))
    first = episode.decide(shield, [START], logits)
    around = [[1.0 + 0.4 * np.cos(a), 1.0 + 0.4 * np.sin(a)] for a in np.arange(0.0, 6.3, 0.1)]
    episode.decide(shield, [START, START], logits, carry=first.carry, occupied=around)
    episode.decide(shield, [START, (1.766, 1.434, 0.0)], logits, carry=first.carry)  # in C
    cells_met(shield.body, np.array(START), 0, np.array([START]))
    was_stopped(shield, first.carry, np.array([START, START]))
    successors(shield.body, np.array(START), np.empty((motion_count(shield.body), 3)))
    step(shield.body, *START, 0)
    overlap(shield.body, *START)


def _decide_rarely() -> None:
    """The kernels for late robots, narrow places, robots that only go ahead, and explanations."""
    task, narrow = _task(), _task(A={"type": "circle", "center": [1.0, 1.0], "radius": 0.06})
    ahead = replace(task.robot, actions=tuple(each for each in task.robot.actions if each.translate >= 0.0))
    for each in (task, narrow, replace(task, robot=ahead)):
        policy = synthesise(each)
        policy.earlier(1, np.full(len(each.robot.motions), True)).propose(np.array([AWAY]), {}, 0.0)
        shield = make_shield([policy], Config(uncertainty=Uncertainty(), learn_map=True))
        episode.decide(shield, [AWAY], np.zeros(len(each.robot.actions)), explain=explanations)
        refusal(shield, np.array([AWAY]), {})


def _plan() -> None:
    """The kernels of the planner."""
    from specshield.policy.planner import policy as planner

    planner.synthesise(_task()).propose(np.array([START]), {}, 0.0)


def _take_chances() -> None:
    """The kernels for a threshold over the episode."""
    config = Config(0.5, uncertainty=Uncertainty(), threshold_over="episode")
    episode.decide(make_shield([_Standing(_task())], config), [START], np.zeros(len(STRETCH.actions)))


def _roll_out() -> None:
    """The kernels of a DQN."""
    from specshield.policy.dqn.network import NAMES, make_network
    from specshield.policy.dqn.observation import observation_size
    from specshield.policy.dqn.policy import Policy

    task = _task()
    body = make_body(task.robot, task.grid)
    inputs, outputs = observation_size(make_rules(task), body), motion_count(body)
    shapes = ((inputs, 4), 4, (4, 4), 4, (4, outputs), outputs)
    weights = {name: np.zeros(shape, np.float32) for name, shape in zip(NAMES, shapes, strict=True)}
    network = make_network(weights, inputs, outputs)
    Policy(task, {"id": "warm-up"}, network).propose(np.array([START]), {}, 0.0)


PARTS: dict[str, Callable[[], None]] = {"reachability": _propose, "shield": _decide}
LATER: dict[str, Callable[[], None]] = {
    "dqn": _roll_out,
    "chances": _take_chances,
    "rarer decisions": _decide_rarely,
    "planner": _plan,
}


def _task(**regions: dict[str, Any]) -> Task:
    """A task in which every cell can be reached: other tasks import scipy, which takes 0.2 s."""
    small, empty = replace(STRETCH, radius=0.01), OccupancyGrid(np.zeros((20, 20), bool), 0.1)
    return make_task(empty, small, FORMULA, {**REGIONS, **regions})


def _keep_all() -> None:
    """From now on this process ends if a kernel cannot be written to the disk: it compiles only for that."""
    files: Any = IndexDataCacheFile
    save = files.save

    def save_or_end(*kernel: Any) -> None:
        try:
            save(*kernel)
        except OSError as error:
            sys.exit(f"the kernels cannot be kept: {error}")

    files.save = save_or_end


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which ends this
    at_end_of_input(lambda: os._exit(1))  # the server is gone
    os.nice(int(sys.argv[2]))
    # Left out is what takes time and nobody uses: wrappers by which C calls numba's own functions, events at
    # each call of LLVM, and reading numba's options one by one to compare them at each call of a kernel.
    BaseLower.create_cfunc_wrapper = lambda _: None  # type: ignore[method-assign]
    getattr(getattr(ffi.lib, "_lock", None), "_cblist", []).clear()
    defaults = {name: option.default for name, option in Flags.options.items()}
    Flags.values = lambda flags: defaults | flags._values  # type: ignore[method-assign]
    # Python takes 16 KB from the system whenever a call's frame no longer fits, until the call returns. A
    # frame that needs more than half of 1 MB leaves the rest of it to numba's deep calls.
    warm_up.__code__ = warm_up.__code__.replace(co_stacksize=70_000)
    _keep_all()
    warm_up(sys.argv[1])
    os._exit(0)  # to give back what numba and LLVM hold takes a second, and nobody needs it
