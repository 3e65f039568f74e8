"""Installs the wheel with the oldest version that it allows of each package it names, and uses it.

    make lowest     # an environment in which older packages are pinned has to work, or to be refused by pip

Raises CalledProcessError or AssertionError where something does not work.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from wheel import REPOSITORY, asked, build, demo, install, run

EXTRAS = "server stream minigrid recordings"
MODULES = "client local integrations.gymnasium recordings.foxglove recordings.rerun recordings.tables"
COMMANDS = "check-drive demo doctor export keys openapi policy run serve train verify watch worker"
STREAMED = """
import sys
from specshield.client import ShieldClient
with ShieldClient(sys.argv[1], stream=True) as client:
    client.wait_until_ready(600.0)
    with client.sessions.create(policy_id="case1", initial_pose=(4.5, 5.0, 0.0)) as session:
        decision = session.step((4.5, 5.0, 0.0), [0.0] * len(session.info.actions))
        print(decision.spec_status)
"""


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="specshield-lowest-") as name:
        folder = Path(name)
        tool, environment, empty = folder / "uv" / "bin" / "python", folder / "venv", folder / "empty"
        empty.mkdir()
        run([sys.executable, "-m", "venv", str(folder / "uv")])
        install(tool, "uv")
        uv = str(tool.with_name("uv"))
        run([uv, "venv", "--quiet", "--python", sys.executable, str(environment)])
        python = environment / "bin" / "python"
        wheel = build(folder / "wheel", {})
        extras = [part for extra in EXTRAS.split() for part in ("--extra", extra)]
        named = ["--resolution", "lowest-direct", "-r", str(REPOSITORY / "pyproject.toml"), *extras]
        for packages in (named, ["--no-deps", str(wheel)]):
            run([uv, "pip", "install", "--quiet", "--python", str(python), *packages])
        bound = re.search(r'"numba>=([0-9.]+)', (REPOSITORY / "pyproject.toml").read_text())
        assert bound is not None
        version = "import numba; print(numba.__version__)"
        told = subprocess.run([str(python), "-c", version], check=True, stdout=subprocess.PIPE, text=True)
        assert told.stdout.startswith(bound[1]), f"numba {told.stdout} is not the oldest that is allowed"
        clean = {n: v for n, v in os.environ.items() if not n.startswith(("SPECSHIELD_", "REDIS_", "PYTHON"))}
        imports = "; ".join(f"import specshield.{module}" for module in MODULES.split())
        run([str(python), "-c", imports], cwd=empty, env=clean)
        for command in COMMANDS.split():
            shown = [str(python.with_name("specshield")), command, "--help"]
            run(shown, cwd=empty, env=clean, stdout=subprocess.DEVNULL)
        kernels = {**clean, "NUMBA_CACHE_DIR": str(folder / "kernels")}
        assert asked(python, empty, kernels, STREAMED)[0] == "pending"
        seconds = demo(python, empty, kernels, "--runs", "1")
        print(f"demo with the oldest packages: {seconds:.1f} s")


if __name__ == "__main__":
    main()
