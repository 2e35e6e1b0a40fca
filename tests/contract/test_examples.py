"""What the OpenAPI document shows works: its requests are answered as it says, and its answers are real ones."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema_rs
import orjson
import pytest

from app.main import create_app
from app.openapi import EXAMPLES
from app.settings import Settings
from tests.api.serving import Client, served
from tests.contract.contract import DOCUMENT
from tests.contract.examples import INTENTS, requests_of, told
from tests.ledger.process import FakeClock

pytestmark = pytest.mark.compiled

OPERATIONS = {
    f"{method.upper()} {template}": operation
    for template, path in DOCUMENT["paths"].items()
    for method, operation in path.items()
}
ANSWERS = [
    pytest.param(content["schema"], content["example"], id=f"{name} {code}")
    for name, operation in OPERATIONS.items()
    for code, answer in operation["responses"].items()
    for content in answer["content"].values()
    if "example" in content
]
# For machines: too long, or not JSON, or no two alike.
NOT_SHOWN = {"/v1/airspace/buildings", "/v1/airspace/static", "/v1/airspace/stream", "/metrics", "/version"}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    settings = Settings(ledger=str(tmp_path_factory.mktemp("examples") / "ledger.sqlite"), monitor_every_s=3600)
    with served(create_app(settings, FakeClock(), elapsed_ms=FakeClock())) as running:
        yield running


def cancel(client: Client, answer: dict[str, Any]) -> None:
    """Leave the air to the next."""
    for flight in answer.get("items", [answer]):
        if "trajectory" in flight and "id" in flight:
            assert client.delete(f"{INTENTS}/{flight['id']}").status_code == 200


@pytest.mark.parametrize("name", [name for name, operation in OPERATIONS.items() if "requestBody" in operation])
def test_requests_that_are_shown_are_answered_with_success(client: Client, name: str) -> None:
    method, template = name.split()
    success = min(OPERATIONS[name]["responses"])
    bodies = requests_of(DOCUMENT, method, template)
    assert bodies
    for body in bodies:
        path, headers = template, {}
        if "{intent_id}" in template:
            flight = client.post(INTENTS, json=requests_of(DOCUMENT, "POST", INTENTS)[0])
            path, headers = flight.headers["Location"], {"If-Match": flight.headers["ETag"]}
        answer = client.request(method, path, json=body, headers=headers)
        assert str(answer.status_code) == success, answer.text
        # A report is answered with success also if nothing of it could be used.
        assert not answer.json().get("problems")
        cancel(client, answer.json())


@pytest.mark.parametrize(("schema", "example"), ANSWERS)
def test_answers_that_are_shown_keep_their_schemas(schema: dict[str, Any], example: Any) -> None:
    whole = {**schema, "components": DOCUMENT["components"]}
    jsonschema_rs.Draft202012Validator(whole, validate_formats=True).validate(example)


@pytest.mark.parametrize("name", [name for name in OPERATIONS if name.split()[1] not in NOT_SHOWN])
def test_every_operation_shows_an_answer(name: str) -> None:
    responses = OPERATIONS[name]["responses"]
    assert "example" in responses[min(responses)]["content"]["application/json"]


def test_answers_that_are_shown_are_the_service_s(tmp_path: Path) -> None:
    told_anew = orjson.loads(orjson.dumps(told(tmp_path)))
    assert told_anew == orjson.loads(EXAMPLES.read_bytes()), "stale; run: python -m tests.contract.examples"
