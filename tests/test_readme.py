"""The README's blocks, run as they stand against a real server."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
ADDRESS = "http://127.0.0.1:8000"


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def run(server, *command):
    done = subprocess.run(
        [part.replace(ADDRESS, server.url) for part in command],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return done.stdout


def test_the_loop_with_the_sdk(server):
    (loop,) = blocks("python")
    assert re.fullmatch(r"rule satisfied after \d+ steps\n", run(server, sys.executable, "-c", loop))


def test_the_loop_with_curl_alone(server):
    (loop,) = (block for block in blocks("bash") if "while" in block)
    assert re.fullmatch(r"rule satisfied after \d+ steps\n", run(server, "bash", "-c", loop))


@pytest.mark.parametrize(
    ("mentions", "answer"),
    [
        ("/v1/maps", '"id":"'),
        ("/v1/specs/validate", '"horizon":120'),
        ("/v1/policies", "training-unavailable"),  # the tests' server trains nothing: all else was right
    ],
)
def test_bring_your_own(server, mentions, answer):
    (command,) = (block for block in blocks("bash") if mentions in block)
    assert answer in run(server, "bash", "-c", command)


def test_the_table_is_of_both_cases():
    (table,) = (block for block in blocks("") if "rule satisfied" in block)
    assert table.count("20 of 20") >= 2
