"""The shield in this process, without a server: its sessions have the interface of the SDK's.

    from specshield.local import LocalShield

    shield = LocalShield.shipped("case1")
    with shield.session(initial_pose=(x, y, theta)) as session:
        while not session.finished:
            decision = session.step(robot.pose(), model.logits())
            robot.execute(decision.execute)

It serves training loops, tests and recordings. Nothing is stored: a session ends with its process.
"""

try:
    from specshield.local.session import LocalSession
    from specshield.local.shield import LocalShield
except ModuleNotFoundError as error:  # the base install is the client
    told = f"specshield.local needs {error.name}: pip install 'specshield[core]'"
    raise ModuleNotFoundError(told, name=error.name) from error

__all__ = ["LocalSession", "LocalShield"]
