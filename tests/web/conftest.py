"""A real browser without a screen, and the page of a command that runs in another folder."""

import contextlib
import re
import shutil
import signal
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Page, sync_playwright

from tests.training.small import command

# Chromium draws WebGL on the processor, and asks nobody on the internet for anything.
FLAGS = [
    *("--no-sandbox", "--headless", "--disable-gpu"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]

# At most five pictures a second: as many as a processor can draw would take the time of what they are pictures of.
FEW_PICTURES = """
window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 200);
window.cancelAnimationFrame = clearTimeout;
"""


@pytest.fixture(scope="module")
def new_page() -> Iterator[Callable[[int, int], Page]]:
    """Open an empty page of a width and a height, in pixels: ``new_page(800, 520)``."""
    path = shutil.which("chromium")
    assert path, "these tests need Chromium: apt-get install chromium"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)

        def new_page(width: int, height: int) -> Page:
            page = browser.new_page(viewport={"width": width, "height": height})
            page.add_init_script(FEW_PICTURES)
            return page

        yield new_page
        browser.close()


@pytest.fixture
def serving(tmp_path):
    """Context in which a command serves a page; it gives the address, and Ctrl-C ends the command without a word."""

    @contextlib.contextmanager
    def serving(module: str, *arguments: str) -> Iterator[str]:
        process = command(module, "render=web", "web.port=0", *arguments, cwd=tmp_path)
        try:
            assert process.stdout is not None
            said = ""
            for line in process.stdout:
                said += line
                if address := re.search(r"http://127\.0\.0\.1:\d+", line):
                    break
            else:
                pytest.fail(said)
            yield address.group()
        finally:
            process.send_signal(signal.SIGINT)
            rest = process.communicate(timeout=30)[0]
        assert process.returncode == 130, rest
        assert rest == ""

    return serving
