"""What schemathesis found, and what it does not look for."""

from collections.abc import Iterator

import pytest

from app.main import create_app
from tests.api.bodies import SUBMIT, TELEMETRY, intent, problem
from tests.api.serving import Client, served, settings_for
from tests.api.tokens import issuer, write_keys
from tests.contract.contract import DOCUMENT
from tests.ledger.district import OLD_TOWN
from tests.ledger.process import FakeClock

ID = "01a203c5-c4b2-710a-bef9-1873d4c985d1"
OPERATIONS = [
    (method.upper(), template, operation)
    for template, path in DOCUMENT["paths"].items()
    for method, operation in path.items()
]


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """Return a client of a service with authentication."""
    folder = tmp_path_factory.mktemp("guarded")
    settings = settings_for(OLD_TOWN, str(folder / "l.sqlite"), folder, jwks=str(write_keys(folder, issuer())))
    with served(create_app(settings, FakeClock(), elapsed_ms=FakeClock())) as client:
        yield client


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    folder = tmp_path_factory.mktemp("open")
    settings = settings_for(OLD_TOWN, str(folder / "l.sqlite"), folder)
    with served(create_app(settings, FakeClock(), elapsed_ms=FakeClock())) as client:
        yield client


@pytest.mark.parametrize(
    ("method", "template"),
    [(method, template) for method, template, operation in OPERATIONS if "security" in operation],
)
def test_nobody_without_a_token_gets_further_than_the_documented_401(
    guarded: Client, method: str, template: str
) -> None:
    path = template.format(intent_id=ID, constraint_id=ID, webhook_id=ID, i=0, j=0, k=0)
    answer = guarded.request(method, path)
    problem(answer, 401, "unauthenticated")
    assert answer.headers["www-authenticate"] == "Bearer"


@pytest.mark.parametrize("template", [template for _, template, operation in OPERATIONS if "security" not in operation])
def test_what_needs_no_token_is_answered_without(guarded: Client, template: str) -> None:
    assert guarded.get(template.format(slug="not-found")).status_code == 200


@pytest.mark.parametrize(("path", "methods"), [(f"{SUBMIT}/{ID}", "DELETE, GET, PUT"), (SUBMIT, "GET, POST")])
def test_a_wrong_method_is_told_all_right_ones(client: Client, path: str, methods: str) -> None:
    answer = client.request("PATCH", path)
    problem(answer, 405, "method-not-allowed")
    assert answer.headers["allow"] == methods


@pytest.mark.parametrize("method", ["GET", "PUT", "DELETE"])
@pytest.mark.parametrize("name", ["preview", "batch"])
def test_a_path_of_its_own_is_no_flight_intent_s(client: Client, method: str, name: str) -> None:
    answer = client.request(method, f"{SUBMIT}/{name}", json=intent() if method == "PUT" else None)
    problem(answer, 405, "method-not-allowed")
    assert answer.headers["allow"] == "POST"


def test_any_page_may_send_plain_text_so_positions_in_it_are_refused(client: Client) -> None:
    answer = client.post(TELEMETRY, content='{"positions": []}', headers={"Content-Type": "text/plain"})
    problem(answer, 415, "unsupported-media-type")


def test_a_body_where_none_is_read_may_be_empty_and_of_any_type(client: Client) -> None:
    answer = client.post(f"{SUBMIT}/{ID}/end", content=b"", headers={"Content-Type": "text/plain"})
    problem(answer, 404, "unknown-flight-intent")
