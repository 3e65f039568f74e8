"""Does with the wheel what a newcomer does: installs it in a new environment and runs it in an empty folder.

    make wheel-check     # prints how long the first start and a later one take, and the demo

Raises CalledProcessError or AssertionError where something does not work.
"""

from __future__ import annotations

import os
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


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="specshield-wheel-") as name:
        folder = Path(name)
        run([sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", name, str(REPOSITORY)])
        (wheel,) = folder.glob("*.whl")
        run([sys.executable, "-m", "venv", str(folder / "venv")])
        python = folder / "venv" / "bin" / "python"
        install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        run([*install, f"specshield[server] @ {wheel.as_uri()}"])
        empty = folder / "empty"
        empty.mkdir()
        kept = {n: v for n, v in os.environ.items() if not n.startswith(("SPECSHIELD_", "REDIS_", "PYTHON"))}
        environment = {**kept, "NUMBA_CACHE_DIR": str(folder / "kernels")}
        for start in ("first", "second"):
            print(f"{start} start: ready after {ready_after(python, empty, environment):.1f} s", flush=True)
        print(f"kernels: {sum(1 for _ in (folder / 'kernels').rglob('*.nbi'))}", flush=True)
        began = time.monotonic()
        run([str(python.with_name("specshield")), "demo"], cwd=empty, env=environment)
        assert sorted(path.name for path in (empty / "out").iterdir()) == ["case1.png", "case2.png"]
        print(f"demo: {time.monotonic() - began:.1f} s")


def ready_after(python: Path, empty: Path, environment: dict[str, str]) -> float:
    """Seconds from the start of `specshield serve` until it can decide; the shipped policies are there."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    began = time.monotonic()
    command = [str(python.with_name("specshield")), "serve", "--port", str(port)]
    server = subprocess.Popen(command, cwd=empty, env=environment)
    try:
        wait = [str(python), "-c", WAIT, f"http://127.0.0.1:{port}", *POLICIES]
        told = subprocess.run(wait, check=True, cwd=empty, env=environment, capture_output=True, text=True)
        seconds = time.monotonic() - began
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(60.0)
    assert told.stdout.strip() == "{'ready'}", told.stdout
    return seconds


def run(command: list[str], **options: object) -> None:
    subprocess.run(command, check=True, **options)  # type: ignore[call-overload]


if __name__ == "__main__":
    main()
