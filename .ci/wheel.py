"""Builds the wheels, and does with them what a newcomer does: installs them in a new environment, and runs
them in an empty folder.

    make wheels     # into dist/; prints how long starts and demos take, with kernels to compile and without

One wheel fits any processor and Python, and its first start compiles. The other brings the
kernels of a server, of the demo and of a look-ahead. It fits this version of Python, on processors of
this kind.
Raises CalledProcessError or AssertionError where something does not work.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
POLICIES = ("case1", "case1-dqn", "case2", "case2-dqn")  # what came with the wheel
WAIT = """
import sys, httpx
from specshield.client import ShieldClient
with ShieldClient(sys.argv[1]) as client:
    client.wait_until_ready(600.0)
    print({client.policies.get(name).status for name in sys.argv[2:]})
"""
RARE = """
import random, sys
from specshield.client import ShieldClient
RULE = "F[0,60] Charger1 and G[0,80] not Charger2"
CHARGERS = {
    "Charger1": {"type": "circle", "center": [0.9, 5.0], "radius": 0.6},
    "Charger2": {"type": "circle", "center": [9.1, 6.6], "radius": 0.6},
}
with ShieldClient(sys.argv[1], timeout=600.0) as client:
    client.wait_until_ready(600.0)
    planner = client.policies.create("case1", RULE, CHARGERS, method="planner")
    planner = client.policies.wait(planner.id, timeout=600.0)
    assert planner.status == "ready", planner.error
    for policy, shaping in ((planner.id, "projection"), ("case1", "lookahead")):
        pose = (4.5, 5.0, 0.0)
        with client.sessions.create(policy_id=policy, initial_pose=pose, shaping=shaping) as session:
            for _ in range(30):
                decision = session.step(pose, [random.gauss(0.0, 2.0) for _ in session.info.actions])
                pose = decision.next_poses[decision.execute]
print("ok")
"""  # compiles what is left to the first who needs it, such as a look-ahead's kernels


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="specshield-wheel-") as name:
        folder = Path(name)
        kernels, empty = folder / "kernels", folder / "empty"
        empty.mkdir()
        run([sys.executable, "-m", "venv", str(folder / "venv")])
        python = folder / "venv" / "bin" / "python"
        plain = build(folder / "plain", {})
        install(python, f"specshield[server] @ {plain.as_uri()}")
        clean = {
            n: v
            for n, v in os.environ.items()
            if not n.startswith(("SPECSHIELD_", "REDIS_", "PYTHON", "NUMBA_"))
        }
        compiling = {**clean, "NUMBA_CACHE_DIR": str(kernels)}
        for start in ("first", "second"):
            print(f"{start} start: ready after {ready_after(python, empty, compiling):.1f} s", flush=True)
        print(f"kernels: {count(kernels)}", flush=True)
        print(f"demo: {demo(python, empty, compiling):.1f} s", flush=True)

        run([str(python), "-m", "specshield.service.startup"], cwd=empty, env=compiling)
        assert asked(python, empty, compiling, RARE)[0] == "ok"
        for lock in kernels.glob("*.lock"):
            lock.unlink()
        whole = build(folder / "whole", {"SPECSHIELD_KERNELS": str(kernels)})
        install(python, "--force-reinstall", "--no-deps", str(whole))
        print(f"{whole.name}: {whole.stat().st_size / 1e6:.1f} MB, {count(kernels)} kernels", flush=True)
        print(f"first start: ready after {ready_after(python, empty, clean):.1f} s", flush=True)
        print(f"demo: {demo(python, empty, clean):.1f} s")
        (package,) = (folder / "venv").glob("lib/*/site-packages/specshield")
        assert count(package / "kernels") == count(kernels), "the wheel did not bring every kernel"
        (REPOSITORY / "dist").mkdir(exist_ok=True)
        for old in (REPOSITORY / "dist").glob("specshield-*.whl"):
            old.unlink()
        for wheel in (plain, whole):
            shutil.copy(wheel, REPOSITORY / "dist")


def build(folder: Path, settings: dict[str, str]) -> Path:
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "-w",
        str(folder),
        str(REPOSITORY),
    ]
    run(command, env={**os.environ, **settings})
    (wheel,) = folder.glob("*.whl")
    return wheel


def install(python: Path, *what: str) -> None:
    run([str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *what])


def count(kernels: Path) -> int:
    return sum(1 for _ in kernels.rglob("*.nbi"))


def demo(python: Path, empty: Path, environment: dict[str, str], *more: str) -> float:
    """Seconds that the demo took."""
    began = time.monotonic()
    run([str(python.with_name("specshield")), "demo", *more], cwd=empty, env=environment)
    assert sorted(path.name for path in (empty / "out").iterdir()) == ["case1.svg", "case2.svg"]
    shutil.rmtree(empty / "out")
    return time.monotonic() - began


def ready_after(python: Path, empty: Path, environment: dict[str, str]) -> float:
    """Seconds from the start of `specshield serve` until it can decide; the shipped policies are there."""
    told, seconds = asked(python, empty, environment, WAIT, *POLICIES)
    assert told == "{'ready'}", told
    return seconds


def asked(
    python: Path, empty: Path, environment: dict[str, str], script: str, *more: str
) -> tuple[str, float]:
    """What the script prints that asks a server, and the seconds since the server was started."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    began = time.monotonic()
    command = [str(python.with_name("specshield")), "serve", "--port", str(port)]
    server = subprocess.Popen(command, cwd=empty, env=environment)
    try:
        ask = [str(python), "-c", script, f"http://127.0.0.1:{port}", *more]
        told = subprocess.run(ask, check=True, cwd=empty, env=environment, stdout=subprocess.PIPE, text=True)
        seconds = time.monotonic() - began
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(60.0)
    return told.stdout.strip(), seconds


def run(command: list[str], **options: object) -> None:
    subprocess.run(command, check=True, **options)  # type: ignore[call-overload]


if __name__ == "__main__":
    main()
