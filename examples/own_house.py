"""A house, a rule and a robot of one's own: from a drawing to a robot that keeps the rule.

    make run                                                            # the service, in one terminal
    .venv/bin/python examples/own_house.py http://127.0.0.1:8000        # this, in another

Needs the SDK alone (`pip install -e .` in a clone).
"""

from __future__ import annotations

import random
import sys

from specshield.client import ShieldClient

CELL = 0.25  # [m] side of a character in the drawing
HOUSE = """
##########################
#...........#............#
#...........#............#
#...........#............#
#...........#............#
#........................#
#........................#
#........................#
#........................#
#...........#............#
#...........#......####..#
#...........#......####..#
#...........#......####..#
#...........#............#
#...........#............#
##########################
"""  # '#' is a wall or furniture; the lower left corner is (0, 0), x to the right, y up

# In words: within 60 steps be at the plant, between steps 60 and 120 be back at the dock, and never be close
# to the stairs. F means "at some step in this window", G "at every step in it"; a step is one decision.
RULE = "F[0,60] Plant and F[60,120] Dock and G[0,120] not NearStairs"
REGIONS = {
    "Plant": {"type": "circle", "center": [5.4, 3.3], "radius": 0.4},
    "Dock": {"type": "rectangle", "min": [0.4, 0.4], "max": [1.2, 1.2]},
    # A region speaks of the robot's origin, here its centre. The stairs go from (3.8, 3.2) to (4.8, 3.8);
    # this region is larger by the robot's radius on every side, so that no part of it comes over them.
    "NearStairs": {"type": "rectangle", "min": [3.6, 3.0], "max": [5.0, 4.0]},
}
ROBOT = {
    "footprint": {"radius": 0.2},  # [m]
    "on_contact": "stop",  # a motion that would touch something stops there
    "actions": [
        {"name": "forward", "translate": 0.25},  # [m]
        {"name": "left", "rotate": 0.5},  # [rad], counter-clockwise
        {"name": "right", "rotate": -0.5},
        {"name": "wait"},
        {"name": "end", "terminal": True},  # the model says it when its own task is done
    ],
}
START = (2.0, 1.5, 0.0)  # x [m], y [m], theta [rad]


def occupancy(drawing: str) -> tuple[dict[str, object], list[int]]:
    """The drawing as a ROS nav_msgs/OccupancyGrid: its info, and its cells row by row from the lowest y."""
    rows = drawing.split()[::-1]
    pose = {
        "position": {"x": 0.0, "y": 0.0, "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    info = {"resolution": CELL, "width": len(rows[0]), "height": len(rows), "origin": pose}
    return info, [100 if cell == "#" else 0 for row in rows for cell in row]


def main() -> None:
    url = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:8000"
    with ShieldClient(url) as client:
        print(f"waiting for the service at {url} ...", flush=True)
        client.wait_until_ready()
        house = client.maps.occupancy_grid(*occupancy(HOUSE))
        spec = client.specs.validate(RULE, REGIONS)
        print(f"{spec.formula}: decided after {spec.horizon} steps")

        policy = client.policies.create(house.id, RULE, REGIONS, robot=ROBOT)
        policy = client.policies.wait(policy.id, interval=0.2)
        if policy.status == "failed":
            sys.exit(f"no policy: {policy.error}")
        share = policy.metrics["feasible_start"]
        print(f"the rule can be kept from {share:.0%} of the places where this robot fits")

        model = random.Random(0)  # it knows neither house nor rule, and likes going forward
        pose = START
        with client.sessions.create(policy_id=policy.id, initial_pose=pose) as session:
            while session.spec_status == "pending":
                decision = session.step(pose, [1.0, model.gauss(0, 1), model.gauss(0, 1), -1.0, -4.0])
                if session.spec_status == "pending":
                    pose = decision.next_poses[decision.execute]  # your robot drives, and says where it is
        print(f"the rule is {session.spec_status} after {session.t - 1} steps")


if __name__ == "__main__":
    main()
