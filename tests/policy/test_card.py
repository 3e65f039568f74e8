"""The card that is kept beside a policy's weights."""

from __future__ import annotations

import hashlib
import json

from specshield.policy.card import make_card, policy_id
from specshield.robot import robot_from_json
from specshield.task import make_task
from tests.policy.rooms import CUSTOM, REGIONS, flat


def test_an_id_is_the_hash_of_all_that_decides_what_a_policy_does():
    text = '{"method": "dqn", "options": {"units": 8}, "seed": 3, "task": "ab"}'
    name = policy_id("ab", "dqn", {"units": 8}, 3)
    assert name == hashlib.sha256(text.encode()).hexdigest()
    others = [("ac", "dqn", {"units": 8}, 3), ("ab", "planner", {"units": 8}, 3)]
    others += [("ab", "dqn", {"units": 9}, 3), ("ab", "dqn", {"units": 8}, 4)]
    assert len({name, *(policy_id(*other) for other in others)}) == 5


def test_a_card_alone_and_its_map_are_enough_to_make_the_task_again():
    task = make_task(flat().grid, CUSTOM, "F[0,9] West and G[0,9] load < 2", REGIONS, None, {"load": 1})
    card = json.loads(json.dumps(make_card(task, "dqn", {}, 0, {"satisfied": 0.5})))
    spec = card["spec"]
    assert list(spec["regions"]) == ["West"]  # the regions that the formula names, and no others
    again = make_task(
        task.grid, robot_from_json(card["robot"]), spec["formula"], spec["regions"], None, spec["signals"]
    )
    assert again.content_hash == card["task_hash"] == task.content_hash
    assert (card["horizon"], card["map_id"]) == (9, task.grid.content_hash)
    assert make_card(task, "dqn", {}, 0, {}, {"formula": "as given"})["spec"] == {"formula": "as given"}
