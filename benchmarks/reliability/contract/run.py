"""schemathesis against a real server: all checks, links between the operations, several thousand cases.

It is run from .venv-bench (`make reliability` sets it up), the server from this process's environment.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import httpx

from benchmarks.reliability.figures import ROOT, about, write
from benchmarks.reliability.plant import Service
from specshield.service import examples

TOOL = ROOT / ".venv-bench" / "bin" / "schemathesis"
CONFIG = Path(__file__).with_name("contract.toml")
HOOKS = "benchmarks.reliability.contract.hooks"
MOST = 3600.0  # [s] of a whole run


def run(out: Path, examples_each: int, seed: int, command: str) -> int:
    """1 where a check failed. examples_each: cases of each operation and phase."""
    if not TOOL.exists():
        sys.exit(f"there is no {TOOL}: `make .venv-bench/.done` makes it")
    folder = out / "contract"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    scratch = Path(tempfile.mkdtemp(prefix="rel-"))
    try:
        with Service(scratch / "data", SPECSHIELD_WORKER="true") as service:
            _things(service.url)
            status = _test(service.url, folder, examples_each, seed)
            log = service.log.read_text(errors="replace")
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    (folder / "server.log").write_text(log)
    said = (folder / "said.txt").read_text(errors="replace")
    figures: dict[str, Any] = {
        "status": status,
        "seed": seed,
        **counted(folder, said),
        "tracebacks": log.count("Traceback (most recent call last)"),
        "tool": version(),
        **about(command),
    }
    write(out, "contract", figures)
    print(json.dumps(figures, indent=1))
    return status


def _things(url: str) -> None:
    """What the examples name: a session `example` that has decided a step."""
    with httpx.Client(base_url=url, timeout=60.0, trust_env=False) as http:
        http.post("/v1/sessions", json=examples.SESSION).raise_for_status()


def _test(url: str, folder: Path, examples_each: int, seed: int) -> int:
    command = [
        str(TOOL), "--config-file", str(CONFIG), "run", f"{url}/openapi.json", "--url", url,
        "--checks", "all", "--mode", "all", "--max-examples", str(examples_each), "--seed", str(seed),
        "--report", "ndjson", "--report-dir", str(folder), "--continue-on-failure", "--no-color",
        "--request-timeout", "30", "--workers", "1",
    ]  # fmt: skip
    environment = {**os.environ, "SCHEMATHESIS_HOOKS": HOOKS, "PYTHONPATH": f"{ROOT / 'app'}:{ROOT}"}
    with open(folder / "said.txt", "wb") as said:
        done = subprocess.run(command, stdout=said, stderr=said, cwd=folder, timeout=MOST, env=environment)
    return done.returncode


def version() -> str:
    found = subprocess.run([str(TOOL), "--version"], capture_output=True, text=True, check=False)
    return found.stdout.strip()


def counted(folder: Path, said: str) -> dict[str, Any]:
    """Cases, answers by status and failures by check, from the tool's own report and its last words."""
    answers, failures = Counter[str](), Counter[str]()
    for report in folder.glob("*.ndjson"):
        for line in report.open(errors="replace"):
            answers.update(re.findall(r'"status_code":\s*(\d{3})', line))
    for title, count in re.findall(r"^  [❌🚫] (.+): (\d+)$", said, re.MULTILINE):
        failures[title] += int(count)
    cases = re.search(r"([\d,]+) generated", said)
    return {
        "cases": int(cases[1].replace(",", "")) if cases else 0,
        "answers": dict(sorted(answers.items())),
        "failures": dict(failures),
        "last_words": said.splitlines()[-25:],
    }
