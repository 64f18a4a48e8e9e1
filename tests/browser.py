"""A headless Chromium for tests of the viewer: where it is, how it starts, what a page complains about."""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from playwright.sync_api import Browser, CDPSession, Page

# WebGL2 in software, and a browser that asks nobody for anything
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
LIMIT = 600e3  # milliseconds that anything may take: a busy machine is no failure
SMALL = (320, 200)  # software draws larger canvases too slowly


@dataclass
class Opened:
    """A page, and what it complained about so far."""

    page: "Page"
    errors: list[str] = field(default_factory=list)  # console errors and uncaught exceptions
    violations: list[str] = field(default_factory=list)  # of the Content-Security-Policy
    failed: list[str] = field(default_factory=list)  # requests without an answer, or with an error's status

    @property
    def complaints(self) -> list[str]:
        """All of them; a sound page has none."""
        return self.errors + self.violations + self.failed

    def wait_for(self, expression: str, seconds: float = 600.0) -> Any:
        """The value of an expression as soon as it is true.

        Playwright's `wait_for_function` evaluates text on the page, which the viewer's policy forbids.
        """
        end = time.monotonic() + seconds
        while not (value := self._value(expression)):
            if time.monotonic() > end:
                raise TimeoutError(f"{expression} is not true after {seconds:g} s; {self.complaints}")
            self.page.wait_for_timeout(50)
        return value

    def _value(self, expression: str) -> Any:
        """None while the page loads anew."""
        from playwright.sync_api import Error

        try:
            return self.page.evaluate(expression)
        except Error as error:
            if "Execution context was destroyed" not in str(error):
                raise
            return None

    def cdp(self) -> "CDPSession":
        """A session of the DevTools protocol with the page."""
        return self.page.context.new_cdp_session(self.page)

    def throttle(self, mbit: float, latency_ms: float = 100.0) -> None:
        """Emulate a network of so many Mbit/s, with a latency for each request."""
        rate = mbit * 1e6 / 8
        self.cdp().send(
            "Network.emulateNetworkConditions",
            {"offline": False, "latency": latency_ms, "downloadThroughput": rate, "uploadThroughput": rate},
        )


def find_chromium() -> str | None:
    """$CHROMIUM, or the first on PATH."""
    named = os.environ.get("CHROMIUM")
    return named or next(filter(None, map(shutil.which, _NAMES)), None)


def missing() -> str | None:
    """Why there can be no browser test here, for skips; None: there can."""
    if not find_spec("playwright"):
        return "needs playwright (pip install playwright)"
    return None if find_chromium() else "needs Chromium on PATH, or its path in $CHROMIUM"


@contextmanager
def launch(*flags: str) -> Iterator["Browser"]:
    """A browser with an empty profile."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=find_chromium(), args=[*FLAGS, *flags], timeout=LIMIT
        )
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def open_page(
    url: str,
    size: tuple[int, int] = SMALL,
    *,
    browser: "Browser | None" = None,
    scheme: Literal["light", "dark"] = "light",
    touch: bool = False,
    ratio: float = 1.0,
    script: str = "",
    network: tuple[float, float] | None = None,
    wait: Literal["commit", "load"] = "load",
) -> Iterator[Opened]:
    """Open a page with a cache of its own.

    Args:
        url: what to open.
        size: of the window [px].
        browser: one that runs (default: starts one for this page).
        scheme: the colours that the user prefers.
        touch: a phone: touches instead of a mouse.
        ratio: pixels of the screen per pixel of the window.
        script: JavaScript that runs before the page's own.
        network: Mbit/s and milliseconds to emulate from the first request on.
        wait: for the page's files, or only until it has begun.
    """
    if browser is None:
        with launch() as own, open_page(
            url, size, browser=own, scheme=scheme, touch=touch, ratio=ratio, script=script, network=network,
            wait=wait,
        ) as opened:  # fmt: skip
            yield opened
        return
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]}, device_scale_factor=ratio, color_scheme=scheme,
        has_touch=touch, ignore_https_errors=True,
    )  # fmt: skip
    context.set_default_timeout(LIMIT)
    opened = Opened(context.new_page())
    _listen(opened)
    if script:
        opened.page.add_init_script(script)
    if network:
        opened.throttle(*network)
    try:
        opened.page.goto(url, wait_until=wait)
        yield opened
    finally:
        context.close()


def _listen(opened: Opened) -> None:
    def console(message) -> None:  # type: ignore[no-untyped-def]
        if "Content Security Policy" in message.text:
            opened.violations.append(message.text)
        elif message.type == "error" and not message.text.startswith("Failed to load resource"):
            opened.errors.append(message.text)

    def request_failed(request) -> None:  # type: ignore[no-untyped-def]
        if request.failure != "net::ERR_ABORTED":  # the viewer's own doing: no longer wanted
            opened.failed.append(f"{request.url}: {request.failure}")

    def response(answer) -> None:  # type: ignore[no-untyped-def]
        if answer.status >= 400:
            opened.failed.append(f"{answer.url}: {answer.status}")

    opened.page.on("console", console)
    opened.page.on("pageerror", lambda error: opened.errors.append(str(error)))
    opened.page.on("requestfailed", request_failed)
    opened.page.on("response", response)
