"""A real browser for tests: the machine's Chromium, driven by Playwright. What it complains of is kept."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import pytest

from tests.serving import HUNG

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason=f"none of {', '.join(NAMES)} is on the PATH")
Browse = Callable[..., AbstractContextManager[Any]]
OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]


@contextmanager
def chromium() -> Iterator[Browse]:
    """A browser that pages are opened in: `with browse(**options) as (page, complaints)`.

    options: of the page, as Playwright has them. complaints: the errors on its console.
    """
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)

        @contextmanager
        def browse(**options: Any) -> Iterator[Any]:
            complaints: list[str] = []
            page = browser.new_page(**{"viewport": {"width": 1280, "height": 860}, **options})
            page.set_default_timeout(1e3 * HUNG)
            page.on("console", lambda message: message.type == "error" and complaints.append(message.text))
            page.on("pageerror", lambda error: complaints.append(str(error)))
            try:
                yield page, complaints
            finally:
                page.close()

        try:
            yield browse
        finally:
            browser.close()
