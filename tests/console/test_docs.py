"""The documentation page works under its policy, and asks nobody but the service."""

from typing import TYPE_CHECKING

import pytest

from tests.console.browser import Watched
from tests.console.quarter import Quarter

pytestmark = pytest.mark.compiled

if TYPE_CHECKING:
    from playwright.sync_api import Browser


def test_the_documentation_page_breaks_no_policy(browser: "Browser", served: Quarter) -> None:
    docs = Watched(browser, f"{served.url}/docs")
    docs.page.locator(".opblock-summary").first.click()
    docs.page.locator(".opblock-body").first.wait_for()
    assert docs.complaints == []
    assert docs.hosts == {served.url.removeprefix("http://")}
    docs.close()
