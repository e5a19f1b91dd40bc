"""A real browser without a screen, and the page of a command that runs in another folder."""

import contextlib
import re
import shutil
import signal
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, sync_playwright

from tests.training.small import command

# Chromium draws WebGL on the processor, and asks nobody on the internet for anything.
FLAGS = [
    *("--no-sandbox", "--headless", "--disable-gpu"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    path = shutil.which("chromium")
    assert path, "these tests need Chromium: apt-get install chromium"
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield opened
        opened.close()


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
