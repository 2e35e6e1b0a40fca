"""Where the service wants to know who asks: the console asks for a token, and keeps it to itself."""

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.cli.serving import AIRMATRIX, environment
from tests.console.browser import Watched
from tests.console.quarter import Quarter, quarter

pytestmark = pytest.mark.compiled

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Request


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    subprocess.run([AIRMATRIX, "token", "--init", folder], env=environment(), check=True, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory, keys: Path) -> Iterator[Quarter]:
    with quarter(tmp_path_factory.mktemp("closed"), AIRMATRIX_JWKS=str(keys / "jwks.json")) as running:
        yield running


def token(keys: Path, operator: str, *scopes: str) -> str:
    """Return a token that is good for an hour."""
    options = [part for scope in scopes for part in ("--scope", scope)]
    made = subprocess.run(
        [AIRMATRIX, "token", "--key", keys / "private.pem", "--operator", operator, *options],
        env=environment(), check=True, capture_output=True, text=True,
    )  # fmt: skip
    return made.stdout.strip()


def sign_in(console: Watched, given: str) -> None:
    console.page.fill("#session-token", given)
    console.page.press("#session-token", "Enter")


def test_a_token_is_asked_for_sent_with_everything_and_forgotten(
    browser: "Browser", closed: Quarter, keys: Path
) -> None:
    console = Watched(browser, closed.url)
    page = console.page
    asked: list[Request] = []

    def note(request: "Request") -> None:
        asked.append(request)

    page.on("request", note)
    dialog, why = page.locator("#session-dialog"), page.locator("#session-why")
    dialog.wait_for()
    assert why.inner_text() == "This service wants to know who you are."
    for _ in range(2):
        page.keyboard.press("Escape")
    dialog.wait_for()
    sign_in(console, "two words")
    page.locator("#session-why", has_text="one line without spaces").wait_for()
    sign_in(console, "no-token")
    page.locator("#session-why", has_text="The token was not accepted: ").wait_for()

    # One that is not for this: it says what is missing, and does not ask for ever.
    sign_in(console, token(keys, "acme-air", "airmatrix.plan"))
    page.wait_for_selector('#link[data-state="refused"]')
    assert "the scope airmatrix.monitor" in page.locator("#stale").inner_text()
    page.click("#sign-out")
    dialog.wait_for()
    assert console.run("() => sessionStorage.length") == 0

    good = token(keys, "control-room", "airmatrix.monitor", "airmatrix.plan")
    sign_in(console, f"Bearer {good}")
    console.live()
    assert dialog.is_hidden()
    asked.clear()
    page.reload()
    console.live()
    page.click("#tab-new")
    assert page.locator("#new-operator").is_hidden()
    api = [request for request in asked if "/v1/" in request.url]
    assert any(request.url.endswith("/v1/airspace/stream") for request in api)
    assert {request.headers.get("authorization") for request in api} == {f"Bearer {good}"}
    assert not [request.url for request in asked if good in request.url]
    assert console.run("() => Object.keys(localStorage)") == []

    page.click("#sign-out")
    dialog.wait_for()
    assert console.run("() => sessionStorage.length") == 0
    # The browser itself reports every answer of an error's status; there must be nothing else.
    assert [text for text in console.complaints if "status of 40" not in text] == []
    console.close()
