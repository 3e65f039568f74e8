"""What a robot's loop got wrong for good is told in words, and nothing else is taken for it."""

from __future__ import annotations

import asyncio
import inspect
import logging
import math
import re
from functools import cache

import numpy as np
import pytest

from specshield.client import AsyncShieldClient, ShieldClient
from specshield.client.wiring import Motion, between, diagnosed
from specshield.local import LocalShield
from specshield.world.occupancy import OccupancyGrid
from tests.serving import RunningServer

MOTIONS = {
    "forward": (0.25, 0.0),
    "back": (-0.25, 0.0),
    "left": (0.0, 0.5),
    "right": (0.0, -0.5),
    "arc": (0.2, 0.3),
}
START = (5.0, 5.0, 0.4)
OTHERS = {"forward": "left", "left": "back", "back": "right", "right": "forward", "arc": "arc"}


def the_same(name, motion, random):
    return motion


def moved(pose, motion):
    along, turn = motion
    return (pose[0] + along * math.cos(pose[2]), pose[1] + along * math.sin(pose[2]), pose[2] + turn)


@cache
def shield_for(steps):
    """Which sessions do not change, so all tests of as many steps share it: to make it takes 0.1 s."""
    robot = {
        "footprint": {"radius": 0.2},
        "actions": [
            *({"name": name, "translate": along, "rotate": turn} for name, (along, turn) in MOTIONS.items()),
            {"name": "wait"},
            {"name": "end", "terminal": True},
        ],
    }
    grid = OccupancyGrid(np.zeros((50, 50), bool), 0.2)
    return LocalShield.make(grid, f"F[0,{steps + 50}] x > 1", robot=robot, check=False)


def told(caplog, body=the_same, frame=lambda poses: poses[-1], steps=60, seed=0):
    """What is logged of a robot that executes `body` of each motion, and tells `frame` of its poses."""
    shield = shield_for(steps)
    random, poses = np.random.default_rng(seed), [START]
    caplog.clear()
    with caplog.at_level(logging.WARNING), shield.session(initial_pose=frame(poses), seed=seed) as session:
        for _ in range(steps):
            decision = session.step(frame(poses), [0.0] * 6 + [-20.0])
            name = decision.action_names[decision.execute]
            poses.append(moved(poses[-1], body(name, MOTIONS.get(name, (0.0, 0.0)), random)))
    said = [record.getMessage().partition(": ")[2] for record in caplog.records]
    return [each for each in said if not each.startswith("step ")]  # without the decisions' own warnings


@pytest.mark.parametrize(
    ("body", "frame", "words"),
    [
        (the_same, lambda poses: poses[0], "the poses do not change"),
        (the_same, lambda poses: poses[max(len(poses) - 2, 0)], "the poses are a step old"),
        (lambda name, motion, _: (motion[0], -motion[1]), None, "the robot turns the other way"),
        (lambda name, motion, _: (-motion[0], motion[1]), None, "the robot moves backwards"),
        (
            the_same,
            lambda poses: (poses[-1][0], 10.0 - poses[-1][1], poses[-1][2]),
            "the y axis of the poses points",
        ),
        (
            the_same,
            lambda poses: (poses[-1][1], poses[-1][0], poses[-1][2]),
            "x and y of the poses are exchanged",
        ),
        (
            the_same,
            lambda poses: (*poses[-1][:2], poses[-1][2] - math.pi / 2),
            "the robot moves 90 degrees to the left of its heading",
        ),
        (the_same, lambda poses: (*poses[-1][:2], math.degrees(poses[-1][2])), "theta is in degrees"),
        (
            lambda name, motion, _: (2.0 * motion[0], motion[1]),
            None,
            "the robot's strides are 2 times as long",
        ),
        (
            lambda name, motion, random: (0.5 * motion[0] + random.normal(0, 0.01), motion[1]),
            None,
            "the robot's strides are 0.",
        ),
        (
            lambda name, motion, _: (motion[0], 0.5 * motion[1]),
            None,
            "the robot's turns are 0.5 times as wide",
        ),
        (
            lambda name, motion, _: (motion[0], 1.4 * motion[1]),
            None,
            "the robot's turns are 1.4 times as wide",
        ),
        (lambda name, motion, _: (motion[0], -0.01 * motion[1]), None, "the robot does not turn"),
        (
            lambda name, motion, _: MOTIONS.get(OTHERS.get(name, ""), motion),
            None,
            "the actions have another order",
        ),
    ],
)
def test_a_mistake_is_told_in_words_and_once(caplog, body, frame, words):
    for seed in range(3):
        said = told(caplog, body, frame or (lambda poses: poses[-1]), seed=seed)
        assert len(said) == 1, said
        assert said[0].startswith(words), said
        pairs = re.findall(r"'(\w+)' does what '(\w+)' should do", said[0])
        assert all(OTHERS[does] == like for does, like in pairs)
        assert bool(pairs) == ("order" in words)


@pytest.mark.parametrize(
    "body",
    [
        the_same,
        lambda name, motion, random: (motion[0] + random.normal(0, 0.02), motion[1] + random.normal(0, 0.02)),
        lambda name, motion, random: (0.0, 0.0) if random.random() < 0.2 else motion,
        lambda name, motion, random: (0.8 * motion[0], 1.2 * motion[1]),
        lambda name, motion, random: (
            list(MOTIONS.values())[random.integers(5)] if random.random() < 0.2 else motion
        ),
    ],
    ids=["exact", "noise", "slips", "short strides and wide turns", "one motion in five is another one"],
)
def test_what_hinders_single_motions_is_no_mistake(caplog, body):
    assert [told(caplog, body, steps=150, seed=seed) for seed in range(3)] == [[], [], []]


def test_a_robot_that_is_held_before_a_wall_has_no_actions_in_another_order():
    """Its poses differ by the noise of its localisation alone, and its move would lead next to nowhere."""
    before, leads = (0.0, 0.0, 0.0), ((0.03, 0.0, 0.0), (0.0, 0.0, 0.5), (-0.25, 0.0, 0.0))
    motions = []
    for k in range(24):
        after = (0.075 if k % 6 == 1 else 0.055, 0.0, 0.0)
        motions.append(Motion(k % 3, between(before, leads[k % 3]), between(before, after), before, leads))
    assert "something holds the robot" in (diagnosed(motions, ("forward", "left", "back")) or "")


def test_the_client_of_a_server_tells_it_too(caplog, server: RunningServer):
    with caplog.at_level(logging.WARNING), ShieldClient(server.url, timeout=60.0) as client:
        x, y, theta = 4.5, 5.0, 0.0
        with client.sessions.create(policy_id="case1", initial_pose=(x, y, theta), seed=1) as session:
            for _ in range(60):
                decision = session.step((x, y, theta), [0.0] * 4 + [-20.0] + [0.0] * 15)
                x, y, turned = decision.next_poses[decision.execute]
                theta -= turned - theta
    told = [record.getMessage() for record in caplog.records if ": step " not in record.getMessage()]
    assert [each.partition(";")[0] for each in told] == [
        f"session {session.id}: the robot turns the other way: theta and `rotate` grow counter-clockwise, "
        "on a map whose y axis points up"
    ]


def test_a_warning_that_nobody_reads_is_logged_once_in_a_session(caplog, server: RunningServer):
    """How many points lie outside differs from step to step; a switch changes nothing about what was said."""
    outside, logits = [[(-9.0, -9.0)] * 2, [(-9.0, -9.0)] * 3], [0.0] * 20

    async def steps_of(session, local=None):
        for k in range(2):
            asked = session.step((4.5, 5.0, 0.0), logits, occupied=outside[k])
            decision = await asked if inspect.isawaitable(asked) else asked
            switched = session.switch(local or "case1", pose=(4.5, 5.0, 0.0))
            await switched if inspect.isawaitable(switched) else switched
            assert any("points lie outside" in each for each in decision.warnings)
        return session.id

    async def all_clients():
        with ShieldClient(server.url, timeout=60.0) as client:
            yield await steps_of(client.sessions.create(policy_id="case1", initial_pose=(4.5, 5.0, 0.0)))
        async with AsyncShieldClient(server.url, timeout=60.0) as client:
            begun = await client.sessions.create(policy_id="case1", initial_pose=(4.5, 5.0, 0.0))
            yield await steps_of(begun)
        shield = LocalShield.shipped("case1")
        yield await steps_of(shield.session(initial_pose=(4.5, 5.0, 0.0)), shield)

    async def ids():
        return [id async for id in all_clients()]

    with caplog.at_level(logging.WARNING, "specshield"):
        sessions = asyncio.run(ids())
    told = [record.getMessage() for record in caplog.records if "outside the map" in record.getMessage()]
    words = "2 points lie outside the map and were ignored"
    assert told == [f"session {id}: step 0: {words}" for id in sessions]


def test_a_motion_is_seen_from_the_robot():
    ahead, turn = between((1.0, 2.0, math.pi / 2), (0.5, 3.0, -math.pi / 2))
    assert (ahead.real, ahead.imag) == pytest.approx((1.0, 0.5))
    assert abs(turn) == pytest.approx(math.pi)
    assert diagnosed([], ()) is None
