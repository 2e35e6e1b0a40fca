"""The service keeps to its OpenAPI document, whatever is asked: schemathesis, in short. `make contract` asks more."""

from collections.abc import Iterator
from typing import Any

import pytest
import requests
from hypothesis import HealthCheck, settings
from schemathesis import Case

from tests.api.tokens import bearer, issuer, write_keys
from tests.contract.contract import DOCUMENT, contract, without_security
from tests.contract.running import running

pytestmark = pytest.mark.compiled

BRIEFLY = settings(max_examples=3, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
OPEN = contract(without_security(DOCUMENT))
# What shapes are refused has nothing to do with who asks. Tokens are ours: what it made up instead would not be sent.
GUARDED = contract(
    DOCUMENT,
    phases={"coverage": {"enabled": False}},
    generation={"database": "none", "with-security-parameters": False},
)


@pytest.fixture(scope="module")
def anybody(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Return how to call a service without authentication."""
    with running(tmp_path_factory.mktemp("open")) as url, requests.Session() as session:
        yield {"base_url": url, "session": session}


@pytest.fixture(scope="module")
def somebody(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """Return how to call a service with authentication, with a token of all scopes."""
    folder = tmp_path_factory.mktemp("guarded")
    token = issuer().token(airmatrix_max_priority=1000)
    with running(folder, jwks=str(write_keys(folder, issuer()))) as url, requests.Session() as session:
        yield {"base_url": url, "session": session, "headers": bearer(token)}


@OPEN.parametrize()
@BRIEFLY
def test_answers_are_as_documented(case: Case[Any], anybody: dict[str, Any]) -> None:
    case.call_and_validate(**anybody)


@GUARDED.parametrize()
@BRIEFLY
def test_answers_are_as_documented_to_who_has_a_token(case: Case[Any], somebody: dict[str, Any]) -> None:
    case.call_and_validate(**somebody)


def test_what_answers_lead_to_is_there(anybody: dict[str, Any]) -> None:
    class Links(OPEN.as_state_machine()):  # type: ignore[misc]
        def get_call_kwargs(self, _: Case[Any]) -> dict[str, Any]:
            return anybody

    Links.run(settings=settings(BRIEFLY, max_examples=10, stateful_step_count=5))
