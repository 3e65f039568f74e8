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
SIZE = {"viewport": {"width": 1280, "height": 860}}
OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
OPTIONS += ["--host-resolver-rules=MAP evil.example 127.0.0.1"]  # as who owns a name can make it point here


@contextmanager
def chromium() -> Iterator[Browse]:
    """A browser that pages are opened in: `with browse(**options) as (page, complaints)`.

    options: of the page, as Playwright has them. complaints: the errors on its console. A page that had
    no options is emptied and left to the next test: to open another takes a second of a processor.
    """
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        left: list[Any] = []

        @contextmanager
        def browse(**options: Any) -> Iterator[Any]:
            page = left.pop() if left and not options else browser.new_page(**{**SIZE, **options})
            page.set_default_timeout(1e3 * HUNG)
            complaints: list[str] = []
            told = {
                "console": lambda message: message.type == "error" and complaints.append(message.text),
                "pageerror": lambda error: complaints.append(str(error)),
            }
            for event, keep in told.items():
                page.on(event, keep)
            emptied = False
            try:
                yield page, complaints
                for event, keep in told.items():
                    page.remove_listener(event, keep)
                emptied = not options and _emptied(page)
            finally:
                if emptied:
                    left.append(page)
                else:
                    page.close()

        try:
            yield browse
        finally:
            browser.close()


def _emptied(page: Any) -> bool:
    """Makes it as one that was just opened. False if it has left the site whose storage it holds."""
    if not page.url.startswith("http"):
        return False
    page.unroute_all(behavior="ignoreErrors")
    page.evaluate("""() => {
      sessionStorage.clear();
      localStorage.clear();
      Storage.prototype.setItem = () => {}; // nor does what is on its way keep anything
    }""")
    page.context.clear_cookies()
    page.emulate_media(color_scheme="light")
    page.set_viewport_size(SIZE["viewport"])
    page.goto("about:blank")
    return True
