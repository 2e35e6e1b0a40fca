"""The OpenAPI document: committed, complete, and true to what its examples say."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, TypeAdapter

from app import problems
from app.main import create_app
from app.routes import (
    aircraft_types,
    airspace,
    answers,
    batches,
    constraints,
    events,
    flights,
    health,
    status,
    submissions,
    telemetry,
    views,
    webhooks,
)
from app.settings import Settings

COMMITTED = Path(__file__).parents[2] / "openapi" / "airmatrix.json"
DOCUMENT: dict[str, Any] = create_app(Settings()).openapi()
MODELS: dict[str, type[BaseModel]] = {
    model.__name__: model
    for module in (
        aircraft_types,
        airspace,
        answers,
        batches,
        constraints,
        events,
        flights,
        health,
        status,
        submissions,
        telemetry,
        views,
        webhooks,
        problems,
    )
    for model in vars(module).values()
    if isinstance(model, type) and issubclass(model, BaseModel)
}
OPERATIONS = [
    pytest.param(operation, id=f"{method.upper()} {path}")
    for path, methods in DOCUMENT["paths"].items()
    for method, operation in methods.items()
]


def values(node: Any, name: str) -> Iterator[Any]:
    """Yield every value of a member anywhere in a document."""
    if isinstance(node, dict):
        for key, value in node.items():
            if key == name:
                yield value
            yield from values(value, name)
    elif isinstance(node, list):
        for item in node:
            yield from values(item, name)


def test_the_committed_document_is_the_application_s() -> None:
    stale = "openapi/airmatrix.json is stale; run: airmatrix openapi --out openapi/airmatrix.json"
    assert COMMITTED.exists(), stale
    assert json.loads(COMMITTED.read_text(encoding="utf-8")) == DOCUMENT, stale


def test_every_reference_leads_somewhere() -> None:
    referred = {reference.removeprefix("#/components/schemas/") for reference in values(DOCUMENT, "$ref")}
    assert referred <= set(DOCUMENT["components"]["schemas"])


def test_every_schema_is_referred_to() -> None:
    referred = {reference.removeprefix("#/components/schemas/") for reference in values(DOCUMENT, "$ref")}
    assert referred >= set(DOCUMENT["components"]["schemas"])


@pytest.mark.parametrize("operation", OPERATIONS)
def test_every_operation_has_a_summary_a_description_and_a_tag(operation: dict[str, Any]) -> None:
    assert operation["summary"]
    assert operation["description"]
    assert len(operation["tags"]) == 1


@pytest.mark.parametrize("operation", OPERATIONS)
def test_every_error_is_documented_as_a_problem(operation: dict[str, Any]) -> None:
    for code, answer in operation["responses"].items():
        if code >= "400":
            assert list(answer["content"]) == [problems.MEDIA_TYPE], code
            assert answer["content"][problems.MEDIA_TYPE]["schema"] == {"$ref": "#/components/schemas/Problem"}


def documented_examples() -> Iterator[Any]:
    """Yield every example in the document: what it is an example of, and its value."""
    for name, schema in DOCUMENT["components"]["schemas"].items():
        for example in schema.get("examples", []):
            yield pytest.param(MODELS[name], example, id=name)
        for member, part in schema.get("properties", {}).items():
            for examples in values(part, "examples"):
                for example in examples:
                    yield pytest.param(annotation_of(MODELS[name], member), example, id=f"{name}.{member}")


def annotation_of(model: type[BaseModel], member: str) -> Any:
    """Return the type of a member, by the name it has in JSON."""
    (field,) = [field for name, field in model.model_fields.items() if member in (name, field.alias)]
    return field.rebuild_annotation()


@pytest.mark.parametrize(("model", "example"), list(documented_examples()))
def test_every_documented_example_is_valid(model: Any, example: Any) -> None:
    TypeAdapter(model).validate_python(example)


def test_the_example_of_a_submission_has_every_member() -> None:
    (example,) = DOCUMENT["components"]["schemas"]["FlightIntentBody"]["examples"]
    assert set(example) == set(DOCUMENT["components"]["schemas"]["FlightIntentBody"]["properties"])
