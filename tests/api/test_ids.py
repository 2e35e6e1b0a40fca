"""Ids in paths that are nothing's, on both databases."""

import pytest

from tests.api.bodies import SUBMIT, problem
from tests.api.serving import Client


@pytest.mark.parametrize(
    ("path", "slug"),
    [
        (SUBMIT, "unknown-flight-intent"),
        ("/v1/constraints", "unknown-constraint"),
        ("/v1/webhooks", "unknown-webhook"),
    ],
)
def test_what_is_no_uuid_is_the_id_of_nothing(client: Client, path: str, slug: str) -> None:
    for name in ("%00", "one"):
        problem(client.delete(f"{path}/{name}"), 404, slug)
    assert client.service.writer.trouble is None
