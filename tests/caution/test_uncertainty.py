"""What a session learns of its robot, and the margin and the slack that follow; distributions are scipy's."""

import math

import numpy as np
import pytest
from scipy.stats import betabinom, binom, norm

from specshield.caution.experience import FORMAT, Seen, noise_of, observe, was_stopped
from specshield.caution.noise import HARDER, MENDED, Noise, margin_for, slack_for
from specshield.episode import Carry, Config, decide, make_shield
from specshield.policy.reachability.policy import synthesise
from specshield.robot import STRETCH as ROBOT
from specshield.shield.uncertainty import Uncertainty
from specshield.task import make_task
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.cells import FORWARD, LEFT, RIGHT, WAIT, Cells, Scripted

STRETCH = (0.01, math.radians(0.5), 0.05, True)  # what is assumed
MOVES = np.array([[0.2, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, -0.1], [0.0, 0.0, 0.0]])
HERE = np.zeros(3)


def walked(seen, poses, told=STRETCH):
    for pose in poses:
        seen = Seen(*observe(told, seen, HERE, MOVES, np.asarray(pose, dtype=float)))
    return seen


def test_motions_as_foreseen_let_go():
    noise = noise_of(STRETCH, walked(Seen(), [MOVES[0]] * 3))
    assert (noise.move, noise.turn) == (0.0, 0.0)
    slack = [
        slack_for(noise_of(STRETCH, walked(Seen(), [MOVES[0]] * n)), 0.2, 40, 0.0025, 0) for n in (0, 30, 300)
    ]
    assert slack[0] >= 7 > slack[1] > slack[2]


def test_turns_on_the_spot_say_nothing_of_a_stride():
    """Else the first of a robot's strides that are 5 % short is a contact, of which nothing is learned."""
    noise = noise_of(STRETCH, walked(Seen(), [MOVES[1]] * 10))
    assert noise.move >= 0.005
    noise = noise_of(STRETCH, walked(Seen(), [MOVES[1]] * 10 + [0.95 * MOVES[0]] * 10))
    assert 0.002 < noise.move < 0.01


@pytest.mark.parametrize("times", [0.5, 1.0, 3.0])
def test_noise_is_found_out(times):
    random = np.random.default_rng(0)
    shaken = MOVES[random.integers(3, size=150)] + random.normal(size=(150, 3)) * times * np.array(
        [0.01, 0.01, math.radians(0.5)]
    )
    noise = noise_of(STRETCH, walked(Seen(), shaken))
    assert noise.move == pytest.approx(times * 0.01, rel=0.25)
    assert noise.turn == pytest.approx(times * math.radians(0.5), rel=0.25)
    assert noise.slips * noise.lost / (noise.lost + noise.kept) < 0.02


def test_motions_that_are_not_executed_are_counted_where_the_robot_was_told_to_move():
    random = np.random.default_rng(1)
    poses = np.where(random.random((200, 1)) < 0.15, HERE, MOVES[0])
    noise = noise_of(STRETCH, walked(Seen(), poses))
    assert noise.slips == 1.0
    assert noise.lost / (noise.lost + noise.kept) == pytest.approx(0.13, abs=0.04)
    waits = walked(Seen(standing=1.0), [HERE] * 50)
    assert (waits.moved, waits.lost, waits.odds) == (0.0, 0.0, 1.0)
    assert walked(Seen(), [0.3 * MOVES[0]]).lost == pytest.approx(0.7)  # stopped on its way: no noise
    assert walked(Seen(), [0.3 * MOVES[0]]).noisy == 0.0


def test_a_robot_whose_caller_chooses_to_wait_is_not_taken_to_slip():
    random = np.random.default_rng(2)
    poses = np.where(random.random((300, 1)) < 0.1, HERE, MOVES[0])
    noise = noise_of(STRETCH, walked(Seen(standing=0.1), poses))
    assert noise.slips * noise.lost / (noise.lost + noise.kept) < 0.01


@pytest.mark.parametrize("left", [1, 4, 20, 60, 150])
@pytest.mark.parametrize("slips", [0.0, 0.3, 1.0])
@pytest.mark.parametrize(("lost", "kept"), [(3.0, 57.0), (1e4, 9e4)])
@pytest.mark.parametrize("move", [0.0, 0.01, 0.03])
def test_slack_covers_what_motions_may_cost(left, slips, lost, kept, move):
    """The fewest steps for which motions cost no more of them, but for the chance: summed over all cases."""
    chance, noise = 0.0025, Noise(move, move / 2.0, slips, lost, kept)
    spread = HARDER * math.hypot(move / 0.2, move / 2.0 / MENDED)

    number = betabinom(left, lost, kept) if lost < 100 else binom(left, lost / (lost + kept))
    k = np.arange(left + 1)

    def over(slack):
        tail = norm.sf(slack - k, scale=spread * math.sqrt(left)) if move else (k > slack).astype(float)
        return (1.0 - slips) * tail[0] + slips * float(number.pmf(k) @ tail)

    found = slack_for(noise, 0.2, left, chance, 0)
    fits = [slack for slack in range(left) if over(slack) <= chance * 1.02]
    assert found in (fits[0] if fits else left, next((s for s in fits if over(s) <= chance * 0.98), left))


def test_margin_is_overstepped_as_seldom_as_it_says():
    """By the deviation and what its turn makes of the next stride, over all steps of an episode."""
    random, steps = np.random.default_rng(3), 100
    margin = margin_for(Noise(0.01, 0.01, 0.0, 1.0, 1.0), 0.2, steps)
    moves, turns = random.normal(0.0, 0.01, (4000, steps, 2)), random.normal(0.0, 0.01, (4000, steps))
    over = np.hypot(moves[..., 0], moves[..., 1] + 0.2 * turns) > margin
    assert 0.0 < over.any(axis=1).mean() <= 0.005 * 1.5


def cells(formula):
    return Cells(formula, None, {"A": (1, 0)})


def test_margin_and_slack_begin_cautious_and_let_go_and_what_was_given_is_the_least():
    world = cells("F[8,20] A and F[22,38] A")
    way = [
        FORWARD,
        LEFT,
        LEFT,
        FORWARD,
        RIGHT,
        RIGHT,
        FORWARD,
        WAIT,
    ]  # three moves, of which A is the last's end
    policy = Scripted(world, lambda t, motion: way[t + 1 :] if motion == way[t] else [])
    for config in (
        Config(uncertainty=Uncertainty()),
        Config(uncertainty=Uncertainty(), margin=0.01, slack=1),
    ):
        shield, history, carry, said = make_shield([policy], config), [world.pose(0, 0, 0)], None, []
        for motion in way:
            found = decide(shield, history, np.zeros(5), carry=carry)
            said.append((found.margin, found.slack))
            carry = found.carry
            history.append(world.pose(*world.after(world.state(history[-1]), motion)))
        assert said[0][0] > 0.03
        assert said[-1][0] == pytest.approx(config.margin, abs=1e-9)
        assert said[0][1] >= said[-1][1] >= config.slack


@pytest.mark.parametrize(("loss", "stands", "stopped"), [(0.0, 2, True), (0.15, 2, False), (0.15, 6, True)])
def test_a_robot_that_slips_is_not_taken_to_be_held(loss, stands, stopped):
    """By how often it has slipped: twice in a row is nothing to one that often does."""
    world = cells("F[0,40] A")
    policy = Scripted(world, lambda t, motion: [])
    shield = make_shield([policy], Config(uncertainty=Uncertainty(), learn_map=True))
    seen, lost = Seen(), np.random.default_rng(0).random(60) < loss
    seen = walked(walked(seen, np.where(lost[:, None], HERE, MOVES[0])), [HERE] * (stands - 1))
    pose = world.pose(0, 0, 0)
    nexts = np.array([world.pose(*world.after((0, 0, 0), m)) for m in range(4)])
    carry = Carry(0, nexts, (None,) * 4, residuals=FORMAT.pack(*seen))
    assert was_stopped(shield, carry, np.array([pose, pose])) == stopped


@pytest.mark.parametrize(("width", "counted"), [(3.0, True), (0.5, False)])
def test_slips_are_learned_as_often_as_they_occur(width, counted):
    """Beside the walls of a narrow corridor nothing says whether a motion slipped or met something."""
    free = np.ones((80, 80), bool)
    free[40 - round(10 * width) : 40 + round(10 * width), 2:-2] = False
    task = make_task(OccupancyGrid(free, 0.05), ROBOT, "F[0,400] x > 3.4")
    shield = make_shield([synthesise(task)], Config(uncertainty=Uncertainty(), learn_map=True))
    random, history, carry = np.random.default_rng(0), [(2.0, 2.0, 0.0)], None
    logits = np.where(np.isin(ROBOT.action_names, ["m", "b", "zm"]), 0.0, -np.inf)
    for _ in range(300):
        found = decide(shield, history, logits, carry=carry)
        slips = random.random() < 0.05
        history.append(history[-1] if slips else tuple(found.next_poses[found.action]))
        carry = found.carry
    seen = Seen(*FORMAT.unpack(carry.residuals))
    assert (seen.moved > 100.0) == counted
    assert not counted or 0.02 < seen.lost / seen.moved < 0.09


def test_a_robot_that_slipped_may_go_on_with_the_way_that_it_had_begun():
    """The policy knows ways at the first step alone, and what is left of the way for waiting waits."""
    world = Cells("F[0,5] A", None, {"A": (2, 0)})

    class Once(Scripted):
        def propose(self, history, signals, margin):
            ways = {WAIT: [WAIT, FORWARD, FORWARD], FORWARD: [FORWARD], LEFT: [], RIGHT: []}
            return Scripted(world, lambda t, motion: ways[motion] if len(history) == 1 else []).propose(
                history, signals, margin
            )

    start, logits = world.pose(0, 0, 0), np.array([9.0, -9.0, -9.0, -9.0, -np.inf])
    found = []
    for uncertainty in (Uncertainty(0.0, 0.0, 0.1), None):
        shield = make_shield([Once(world, lambda t, motion: [])], Config(uncertainty=uncertainty))
        first = decide(shield, [start], logits)
        assert first.action == FORWARD
        found.append(decide(shield, [start, start], logits, carry=first.carry))
    assert [each.j_values[FORWARD] for each in found] == [1.0, 0.0]
    assert found[1].j_values[WAIT] == 1.0
