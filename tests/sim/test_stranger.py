"""A robot that knows the HTTP contract alone: urllib, draws of its own, `next_poses` fed back."""

import contextlib
import json
import random
import urllib.error
import urllib.request

import numpy as np
import pytest

from specshield.policy.dqn.environment import free_poses
from tests.oracles.judge import margin
from tests.serving import HUNG


def post(url, body):
    request = urllib.request.Request(url, json.dumps(body).encode(), {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=HUNG) as response:
        return json.load(response)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_stranger_keeps_the_rule(server, case, seed):
    rng = random.Random(seed)
    for pose in free_poses(case.task, case.body, 20, np.random.default_rng(seed)).tolist():
        with contextlib.suppress(urllib.error.HTTPError):  # infeasible-start
            session = post(f"{server.url}/v1/sessions", {"policy_id": case.name, "initial_pose": pose})
            break
    at = f"{server.url}/v1/sessions/{session['id']}"
    end, done, poses = session["actions"].index("end"), False, [pose]
    while True:
        logits = [rng.gauss(0.0, 1.5) for _ in session["actions"]]
        logits[end] -= 4.0
        body = {"t": len(poses) - 1, "poses": [poses[-1]], "logits": logits, "main_task_done": done}
        answer = post(f"{at}/steps", body)
        if answer["spec_status"] != "pending":
            break
        action = rng.choices(range(len(logits)), answer["distribution"])[0]
        if action == end:
            done, action = True, answer["completion_action"]
        poses.append(answer["next_poses"][action])
    verdict = post(f"{at}/close", {"t": len(poses) - 1, "poses": [poses[-1]]})
    assert verdict["spec_status"] == answer["spec_status"] == "satisfied"
    assert margin(case.spec, poses + [poses[-1]] * (session["horizon"] + 1 - len(poses))) > 0.0
