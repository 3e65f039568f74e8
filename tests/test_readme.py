"""The blocks of README.md and docs/http.md, run as they stand against a real server."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from specshield.sim import demo
from specshield.sim.campaign import Campaign
from specshield.sim.cases import load_case
from specshield.sim.episodes import Episode
from tests.serving import HUNG, serving

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "README.md", ROOT / "docs" / "http.md")
ADDRESS = "http://127.0.0.1:8000"


def blocks(language):
    pages = "\n".join(page.read_text() for page in PAGES)
    return re.findall(rf"^```{language}\n(.*?)^```$", pages, re.MULTILINE | re.DOTALL)


def run(server, *command):
    done = subprocess.run(
        [part.replace(ADDRESS, server.url) for part in command],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=HUNG,
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


def test_bring_your_own(tmp_path):
    """Map, rule and robot to a policy and a session, on a server that makes policies."""
    (commands,) = (block for block in blocks("bash") if "policies" in block)
    with serving(tmp_path, SPECSHIELD_WORKER="true") as own:
        *_, validated, made, session = run(own, "bash", "-c", commands).splitlines()
    assert '"horizon":120' in validated
    assert '"status":"ready"' in made
    assert '"spec_status":"pending"' in session


def test_the_table_is_what_the_demo_prints():
    (printed,) = blocks("text")
    episode = Episode("case1", 0, True, (0.0, 0.0, 0.0), round_trip_ms=[0.0], server_ms=[0.0])
    table = demo.table([Campaign(load_case("case1"), [episode], [episode], 0)])
    rows = [line[:26].rstrip() for line in table.splitlines()[2:]]
    assert [line[:26].rstrip() for line in printed.splitlines()[-len(rows) :]] == rows
    (kept,) = re.findall("^rule satisfied.*$", printed, re.MULTILINE)
    assert kept.count("20 of 20") == 2


LINKED = sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("docs/results/*.md")})


@pytest.mark.parametrize("page", LINKED, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    """Files that are linked are there, and the headings in them that are named."""
    text = page.read_text()
    links = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    for link in links:
        if re.match(r"[a-z]+://", link):
            continue
        name, _, heading = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), f"{page.name}: {link}"
        headings = re.findall(r"^#+ (.+)$", target.read_text(), re.MULTILINE) if heading else []
        anchors = {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in headings}
        assert not heading or heading in anchors, f"{page.name}: {link}"
