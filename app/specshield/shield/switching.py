"""Whether another rule, on another map or for another robot, can begin to hold in mid-episode."""

from __future__ import annotations

from specshield.arrays import Floats
from specshield.errors import InfeasibleSwitch
from specshield.shield.decision import Carry, Shield
from specshield.shield.episode import Signals, check_place, decide


def switch(
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
