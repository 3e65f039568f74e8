"""The dynamics by hand, and against a brute-force disc sampled every millimetre."""

from __future__ import annotations

import math

import numpy as np
import pytest

from specshield.robot import STRETCH, Action, Robot
from specshield.robot.dynamics import in_collision, make_body, overlap, simulate, step, successors, wrap
from specshield.sim.cases import case_names, load_case
from specshield.world.occupancy import OccupancyGrid
from tests.oracles.disc import DiscWorld

TOUCH = 2e-6


def grid_of(width, height, resolution=0.05, taken=(), origin=(0.0, 0.0, 0.0)):
    """taken: (column, row) of the occupied cells, or slices."""
    occupied = np.zeros((height, width), bool)
    for column, row in taken:
        occupied[row, column] = True
    return OccupancyGrid(occupied, resolution, origin)


def robot_of(*motions, radius=0.3, offset=(0.0, 0.0), on_contact="stop"):
    return Robot(
        "custom", radius, offset, on_contact, tuple(Action(f"a{i}", *m) for i, m in enumerate(motions))
    )


def follow(robot, grid, pose, *names):
    """The pose after the named actions."""
    body = make_body(robot, grid)
    for name in names:
        pose = step(body, *pose, int(robot.motion_of[robot.action_names.index(name)]))
    return pose


WALLED = grid_of(80, 40, taken=[(slice(60, 80), slice(None))])  # free for x < 3


@pytest.mark.parametrize(
    ("token", "expected"),
    [
        ("m", (1.0 + 0.2 * math.cos(0.5), 1.0 + 0.2 * math.sin(0.5), 0.5)),
        ("b", (1.0 - 0.2 * math.cos(0.5), 1.0 - 0.2 * math.sin(0.5), 0.5)),
        ("r", (1.0, 1.0, 0.5 - math.pi / 6)),
        ("l", (1.0, 1.0, 0.5 + math.pi / 6)),
        ("rs", (1.0, 1.0, 0.5 - math.pi / 30)),
        ("ls", (1.0, 1.0, 0.5 + math.pi / 30)),
        *(
            (name, (1.0, 1.0, 0.5))
            for name in ["sub_done", "p", "zm", "zp", "yp", "ym", "wp", "wm", "yms", "zms", "zps", "yps", "d"]
        ),
    ],
)
def test_every_stretch_token(token, expected):
    assert follow(STRETCH, WALLED, (1.0, 1.0, 0.5), token) == pytest.approx(expected, abs=1e-12)


def test_stretch_stops_at_the_wall_its_off_centre_disc_touches():
    # The disc's centre is 0.109 m behind the origin, so it touches x = 3 when x - 0.109 + 0.1855 = 3.
    assert follow(STRETCH, WALLED, (2.0, 1.0, 0.0), *"mmmmm")[0] == pytest.approx(
        3 - 0.1855 + 0.109, abs=2e-7
    )
    assert follow(STRETCH, WALLED, (2.0, 1.0, math.pi), *"bbbbb")[0] == pytest.approx(
        3 - 0.1855 - 0.109, abs=2e-7
    )
    stopped = follow(STRETCH, WALLED, (2.0, 1.0, 0.0), *"mmmmm")
    assert follow(STRETCH, WALLED, stopped, *"mmm") == pytest.approx(stopped, abs=1e-9)
    assert follow(STRETCH, WALLED, stopped, "b")[0] == pytest.approx(
        stopped[0] - 0.2
    )  # contact does not hold it


def test_the_corner_of_a_square():
    # The corner (1, 1) is 0.24 m beside the way: a disc of 0.3 m touches sqrt(0.09 - 0.0576) = 0.18 m before.
    grid = grid_of(40, 40, taken=[(20, 20)])
    for on_contact, x in (("stop", 1 - 0.18), ("stay", 0.4)):
        robot = robot_of((1.0, 0.0), on_contact=on_contact)
        assert follow(robot, grid, (0.4, 0.76, 0.0), "a0") == pytest.approx((x, 0.76, 0.0), abs=2e-7)
    assert follow(robot_of((1.0, 0.0)), grid, (0.4, 0.7, 0.0), "a0")[0] == pytest.approx(1.4)  # slides by
    assert follow(robot_of((1.0, 0.0)), grid, (0.4, 0.7 + 1e-8, 0.0), "a0")[0] < 1.001


@pytest.mark.parametrize("length", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("heading", [0.0, 0.3, -0.7])
def test_no_move_jumps_a_wall_of_one_cell(length, heading):
    grid = grid_of(300, 300, taken=[(150, slice(None))])
    robot = robot_of((length, 0.0), (-length, 0.0), radius=0.02)
    pose = (7.46, 7.5, heading)
    for action, start in (("a0", pose), ("a1", (7.46, 7.5, heading + math.pi))):
        x, y, _ = follow(robot, grid, start, action)
        assert x == pytest.approx(7.48, abs=1e-6)
        assert (y - 7.5) == pytest.approx(0.02 * math.tan(heading), abs=1e-6)


def test_an_action_that_moves_and_turns():
    robot = robot_of((1.0, 0.5))
    assert follow(robot, WALLED, (1.0, 1.0, 0.0), "a0") == pytest.approx((2.0, 1.0, 0.5))
    assert follow(robot, WALLED, (2.0, 1.0, 0.0), "a0") == pytest.approx(
        (2.7, 1.0, 0.0), abs=2e-7
    )  # contact ends it
    assert follow(robot_of((1.0, 0.5), on_contact="stay"), WALLED, (2.0, 1.0, 0.0), "a0") == (2.0, 1.0, 0.0)


def test_turning_sweeps_an_off_centre_footprint():
    robot = robot_of(
        (0.0, math.pi / 2), (0.0, math.pi / 6), radius=0.2, offset=(-0.3, 0.0), on_contact="stay"
    )
    grid = grid_of(40, 40)  # 2 x 2 m, walls all round
    near_the_top = (1.0, 1.7, math.pi / 2)  # the disc trails below; a quarter turn brings it to the right
    assert follow(robot, grid, near_the_top, "a0") == pytest.approx((1.0, 1.7, math.pi))
    # Heading pi the disc is at (1.3, 1.7); a turn further would put it 0.15 m higher, past 2 - 0.2.
    assert follow(robot, grid, near_the_top, "a0", "a1") == pytest.approx((1.0, 1.7, math.pi))
    assert (
        follow(robot_of((0.0, 1.0), radius=0.29), grid, (1.0, 1.7, 0.0), "a0")[2] == 1.0
    )  # a centred one turns


@pytest.mark.parametrize(
    ("theta", "wrapped"),
    [(math.pi, math.pi), (-math.pi, math.pi), (3 * math.pi, math.pi), (7.0, 7.0 - 2 * math.pi), (-1e6, None)],
)
def test_headings_stay_in_the_half_open_circle(theta, wrapped):
    assert -math.pi < wrap(theta) <= math.pi
    assert wrapped is None or wrap(theta) == pytest.approx(wrapped, abs=1e-12)
    assert math.cos(wrap(theta)) == pytest.approx(math.cos(theta), abs=1e-9)


def test_an_offset_or_turn_next_to_nothing_is_no_division_by_zero():
    robot = robot_of((0.0, 1.0), (0.0, 1e-300), radius=0.2, offset=(1e-300, 0.0))
    assert follow(robot, WALLED, (1.0, 1.0, 0.0), "a0", "a1") == (1.0, 1.0, 1.0)


def test_a_footprint_of_many_cells():
    body = make_body(robot_of((10.0, 0.0), radius=5.0), grid_of(9, 9, resolution=1e-3))
    assert step(body, 0.0045, 0.0045, 0.0, 0) == (0.0045, 0.0045, 0.0)
    assert overlap(body, 0.0045, 0.0045, 0.0) == pytest.approx(5.0 - 0.0045)


@pytest.mark.parametrize("far", [1e3, 1e9, 1e300, -1e300])
def test_far_off_the_map_everything_ends(far):
    body, out = make_body(STRETCH, WALLED), np.empty((7, 3))
    successors(body, np.array([far, 1.0, 0.0]), out)
    assert in_collision(body, far, 1.0, 0.0)
    assert np.isfinite(out).all()


TURNS = 500  # that are sampled


def random_worlds(seed, count):
    random = np.random.default_rng(seed)
    for _ in range(count):
        h, w = random.integers(8, 16, 2)
        occupied = random.random((h, w)) < random.choice([0.03, 0.1])
        resolution = float(random.choice([0.05, 0.1, 0.25]))
        origin = (*random.uniform(-9, 9, 2), random.choice([0.0, random.uniform(-3, 3)]))
        radius, offset = random.uniform(0.5, 2.0) * resolution, tuple(random.uniform(-2, 2, 2) * resolution)
        if random.random() < 0.3:
            offset = (0.0, 0.0)
        lengths = random.choice([-1, 1], 4) * random.uniform(0.2, 6, 4) * resolution
        lengths[0] = random.choice([1.0, 10.0], p=[0.8, 0.2])
        motions = (
            [(d, 0.0) for d in lengths] + [(0.0, a) for a in (0.1, -0.5, 2.0)] + [(resolution, 0.4), (0, 0)]
        )
        grid = OccupancyGrid(occupied, resolution, origin)
        robot = robot_of(*motions, radius=radius, offset=offset, on_contact=random.choice(["stay", "stop"]))
        yield random, grid, robot, DiscWorld(occupied, resolution, origin, radius, offset)


def poses_in(random, grid, n):
    points = grid.to_map(random.random((n, 2)) * np.array([grid.width, grid.height]) * grid.resolution)
    return np.column_stack([points, random.uniform(-math.pi, math.pi, n)])


def test_moves_against_a_disc_sampled_every_millimetre():
    """Wherever it starts with its centre free, it never goes deeper, and stops no earlier than it has to."""
    stopped = whole = 0
    for random, grid, robot, world in random_worlds(seed=1, count=25):
        body = make_body(robot, grid)
        for pose in poses_in(random, grid, 12):
            start = world.centre(pose)
            allowed = min(world.radius, world.gap(start)[0])  # no deeper than it is
            if allowed <= 1e-6:
                continue
            for motion, (translate, rotate) in enumerate(robot.motions):
                if translate == 0.0 or rotate != 0.0:
                    continue
                x, y, theta = step(body, *pose, motion)
                moved = math.hypot(x - pose[0], y - pose[1])
                reached = world.centre((x, y, theta))
                assert theta == pose[2]
                assert world.along(start, reached).min() > allowed - TOUCH
                ahead = np.array([math.cos(theta - grid.origin[2]), math.sin(theta - grid.origin[2])])
                ahead *= math.copysign(1.0, translate)
                np.testing.assert_allclose(reached, start + moved * ahead, atol=1e-9)
                if moved > abs(translate) - 1e-12:
                    whole += 1
                elif robot.on_contact == "stop":
                    assert world.along(reached, reached + 1e-4 * ahead, 1e-6).min() < allowed
                    stopped += 1
                else:
                    assert moved == 0.0
                    assert world.along(start, start + abs(translate) * ahead, 1e-3).min() < allowed + 5e-4
                    stopped += 1
    assert min(stopped, whole) > 200


def test_turns_against_a_disc_sampled_every_millimetre():
    turned = refused = 0
    for random, grid, robot, world in random_worlds(seed=2, count=20):
        body = make_body(robot, grid)
        for pose in poses_in(random, grid, 12):
            allowed = min(world.radius, world.gap(world.centre(pose))[0])
            if allowed <= 1e-6:
                continue
            for motion, (translate, rotate) in enumerate(robot.motions):
                if translate != 0.0 or rotate == 0.0:
                    continue
                x, y, theta = step(body, *pose, motion)
                assert (x, y) == (pose[0], pose[1])
                angles = pose[2] + rotate * np.linspace(0.0, 1.0, 200)
                gaps = world.gap(np.array([world.centre((x, y, a)) for a in angles]))
                between = 0.5 * abs(rotate) / 199 * math.hypot(*robot.offset)  # from any point to a sample
                if theta == pose[2]:
                    refused += 1
                    assert gaps.min() < allowed + between
                else:
                    turned += 1
                    assert theta == pytest.approx(wrap(pose[2] + rotate), abs=1e-12)
                    assert gaps.min() > allowed - 2e-9
    assert min(turned, refused) > 30


def test_no_certified_turn_overlaps_on_its_true_arc_and_no_free_one_is_refused():
    """The Stretch in rooms, next to what it may touch; the arc at points 20 micrometres apart or less."""
    stretch = [math.radians(a) for a in (30, -30, 6, -6)]
    robot = robot_of(*[(0.0, a) for a in stretch], radius=0.1855, offset=(-0.109, 0.0), on_contact="stay")
    random, turned, refused = np.random.default_rng(5), 0, 0
    while turned < TURNS:
        occupied = random.random((30, 30)) < 0.05
        grid = OccupancyGrid(occupied, 0.05, (0.0, 0.0, random.uniform(-3, 3)))
        world, body = (
            DiscWorld(occupied, 0.05, grid.origin, robot.radius, robot.offset),
            make_body(robot, grid),
        )
        for pose in poses_in(random, grid, 300):
            gap = world.gap(world.centre(pose))[0]
            if not world.radius < gap < world.radius + 0.06:  # else it is all the same
                continue
            for motion, angle in enumerate(stretch):
                n = math.ceil(abs(angle) * 0.109 / 2e-5)
                at = pose[2] + angle * np.linspace(0.0, 1.0, n + 1)
                nearest = world.gap(_centres(world, pose, at)).min()
                if step(body, *pose, motion)[2] == pose[2]:
                    refused += 1
                    assert nearest < world.radius + 1e-5
                else:
                    turned += 1
                    assert nearest > world.radius - 2e-9
    assert refused > TURNS // 10


def _centres(world, pose, angles):
    """The footprint's centre at each heading [n, 2], in grid metres."""
    x0, y0, yaw = world.origin
    z = complex(*pose[:2]) + complex(*world.offset) * np.exp(1j * angles) - complex(x0, y0)
    z = z * np.exp(-1j * yaw)
    return np.column_stack([z.real, z.imag])


def test_from_a_free_start_no_chain_of_steps_ends_in_collision():
    steps = 0
    for random, grid, robot, world in random_worlds(seed=3, count=30):
        body, nexts = make_body(robot, grid), np.empty((len(robot.motions), 3))
        free = [p for p in poses_in(random, grid, 40) if world.overlap(p) <= 0.0]
        for pose in free[:3]:
            for motion in random.integers(0, len(robot.motions), 60):
                successors(body, pose, nexts)
                assert not any(in_collision(body, *p) for p in nexts)
                pose = nexts[motion].copy()
                assert world.overlap(pose) < 1e-6
                assert -math.pi < pose[2] <= math.pi
                steps += 1
    assert steps > 3000


def test_the_overlap_is_the_brute_force_one():
    for random, grid, robot, world in random_worlds(seed=4, count=10):
        body = make_body(robot, grid)
        for pose in poses_in(random, grid, 20):
            expected = min(
                max(world.overlap(pose), 0.0), world.radius
            )  # a centre inside counts as the radius
            assert overlap(body, *pose) == pytest.approx(expected, abs=1e-9)
            assert in_collision(body, *pose) == (expected > 1e-6)


def test_from_inside_an_obstacle_it_gets_out_and_never_deeper():
    for on_contact in ("stay", "stop"):
        robot = robot_of(
            (0.1, 0.0),
            (-0.1, 0.0),
            (0.0, math.pi / 4),
            radius=0.2,
            offset=(-0.05, 0.0),
            on_contact=on_contact,
        )
        body = make_body(robot, WALLED)
        assert step(body, 3.2, 1.0, 0.0, 0)[0] < 3.2 + 1e-9  # ahead is deeper
        pose, xs = (3.2, 1.0, 0.0), []
        for _ in range(8):
            pose = step(body, *pose, 1)
            xs.append(pose[0])
        assert xs == pytest.approx([3.1, 3.0, 2.9, 2.8, 2.7, 2.6, 2.5, 2.4])
        assert not in_collision(body, *pose)
    for random, grid, robot, world in random_worlds(seed=5, count=20):
        body = make_body(robot, grid)
        for pose in poses_in(random, grid, 40):
            before = world.gap(world.centre(pose))[0]
            for motion in range(len(robot.motions)) if before < 0.0 else ():
                after = step(body, *pose, motion)
                straight = world.along(world.centre(pose), world.centre(after))
                turned = world.gap(world.centre(after))[0]
                slack = 0.25 * grid.resolution  # looked at every quarter cell
                assert turned > before - 1e-6
                assert robot.motions[motion][1] != 0.0 or straight.min() > before - slack


def test_every_shortcut_is_the_search_for_contact_bit_for_bit():
    """Without its clearance field a body searches for contact always; what motions share is no other pose."""
    free = held = 0
    cases = [(case.task.grid, STRETCH) for case in map(load_case, case_names())]
    worlds = [(grid, robot) for _, grid, robot, _ in random_worlds(seed=6, count=25)]
    random = np.random.default_rng(7)
    for grid, robot in worlds + 12 * cases:
        body = make_body(robot, grid)
        searching = body._replace(clearance=np.zeros_like(body.clearance))
        nexts, searched = np.empty((2, len(robot.motions), 3))
        for pose in poses_in(random, grid, 40):
            successors(body, pose, nexts)
            successors(searching, pose, searched)
            steps = [step(body, *pose, m) for m in range(len(robot.motions))]
            alone = [step(searching, *pose, m) for m in range(len(robot.motions))]
            assert (
                nexts.tobytes()
                == searched.tobytes()
                == np.array(steps).tobytes()
                == np.array(alone).tobytes()
            )
            for (translate, rotate), (x, y, theta) in zip(robot.motions, nexts, strict=True):
                moved = math.hypot(x - pose[0], y - pose[1]) > abs(translate) - 1e-9
                whole = moved and (rotate == 0.0 or theta != pose[2])
                free, held = free + whole, held + (not whole)
    assert min(free, held) > 1000


def test_simulate_is_step_after_step():
    body = make_body(STRETCH, WALLED)
    random = np.random.default_rng(0)
    motions, out = random.integers(0, 7, 200), np.empty((200, 3))
    pose = (2.5, 1.0, 0.3)
    simulate(body, np.array(pose), motions, out)
    for motion, reached in zip(motions, out, strict=True):
        pose = step(body, *pose, motion)
        assert pose == tuple(reached)
