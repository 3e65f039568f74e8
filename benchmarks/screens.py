"""The pictures of the page and of `image.svg` that README and docs show, made by the service itself.

    python -m benchmarks.screens [--out docs]

Needs Chromium on the machine, and Playwright. An episode of case 2 is driven as `specshield demo` does it.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import httpx
from playwright.sync_api import sync_playwright

from specshield.sim.campaign import robots, run
from specshield.sim.service import own_server

CASE, SEED, STEP = "case2", 0, 42  # the step that is shown: on its way to the second region


def main() -> None:
    parser = argparse.ArgumentParser(description="The pictures that README and docs show.")
    parser.add_argument("--out", type=Path, default=Path("docs"))
    out = parser.parse_args().out
    with own_server() as url, robots(url) as several:
        campaign = run(several, CASE, 1, SEED)
        session = campaign.shielded[0].session
        with httpx.Client(base_url=url, timeout=60.0) as asked:
            drawn = asked.get(f"/v1/policies/{CASE}/image.svg").raise_for_status().content
            (out / f"{CASE}-policy.svg").write_bytes(drawn)
        page(f"{url}/#/sessions/{session}", out / "page.png")


def page(url: str, path: Path) -> None:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        shown = browser.new_page(viewport={"width": 1280, "height": 900}, device_scale_factor=1.25)
        shown.goto(url)
        shown.get_by_text("over, the rule is").wait_for()
        shown.get_by_label("Step", exact=True).fill(str(STEP))
        shown.get_by_role("heading", name=f"Step {STEP}").wait_for()
        shown.mouse.click(5, 5)  # nothing has the focus
        shown.screenshot(path=path)
        browser.close()


if __name__ == "__main__":
    main()
