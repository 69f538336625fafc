"""The browser of the tests of pages."""

import pytest

from tests.playback.export.pages import CHROMIUM


@pytest.fixture(scope="module", params=[pytest.param("chromium", marks=pytest.mark.slow)])
def browser():
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="install it with pip install 'morgs-mi[browser]'"
    )
    if CHROMIUM is None:
        pytest.skip(
            "no Chromium found; install it with tools/setup_browser.sh (apt-get install chromium)"
        )
    with playwright.sync_playwright() as driver:
        options = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=options)
        yield browser
        browser.close()
