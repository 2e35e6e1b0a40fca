"""What must be true of every answer, beyond what schemathesis looks for by itself."""

from http import HTTPStatus
from typing import Any

import schemathesis
from schemathesis import Case, CheckContext, HookContext, Response

from app import problems

# Of validation errors: what models find that have read the whole body, and that JSON Schema takes 5.0 for an integer.
_BEYOND_SCHEMAS = ("value_error", "int_type")
# Bodies that say this can be planned.
_PLANNABLE = {
    "operator": "acme-air",
    "aircraft_type": "dji-matrice-600-pro",
    "origin": {"lon": 71.4202, "lat": 51.1160, "alt_m": 20},
    "destination": {"lon": 71.4251, "lat": 51.1170, "alt_m": 20},
    "earliest_departure": "2026-11-22T08:00:00Z",
    "latest_departure": "2026-11-22T08:30:00Z",
}
_LONGEST_S = 10.0
_EXPLAINED = {
    f"/problems/{kind.slug}": kind.status
    for kind in (
        *problems.KINDS.values(),
        *problems.HTTP_ERRORS.values(),
        problems.VALIDATION,
        problems.INTERNAL,
    )
}


@schemathesis.check
def problem_is_explained(_: CheckContext, response: Response, __: Case[Any]) -> None:
    """Every refusal is a problem document, of a kind that `/problems/` explains, with the answer's own status."""
    if response.status_code < HTTPStatus.BAD_REQUEST:
        return
    document = response.json()
    explained = _EXPLAINED.get(document["type"])
    assert explained == document["status"] == response.status_code, f"not a problem that is explained: {document}"


@schemathesis.check
def refused_for_a_reason(_: CheckContext, response: Response, case: Case[Any]) -> None:
    """What keeps the schema is not refused for its shape."""
    is_positive = case.meta is not None and case.meta.generation.mode.is_positive
    if not is_positive or response.status_code != HTTPStatus.UNPROCESSABLE_ENTITY:
        return
    document = response.json()
    shapeless = [
        error
        for error in document.get("errors", [])
        # Who asks is in the body where no token says so.
        if error["type"] not in _BEYOND_SCHEMAS and (error["type"], error["loc"][-1]) != ("missing", "operator")
    ]
    assert not shapeless, f"refused for its shape, which is the documented one: {shapeless}"


@schemathesis.hook
def map_case(_: HookContext, case: Case[Any]) -> Case[Any]:
    """Make every other flight one that can be planned: by chance none would be. No batch takes its ten seconds."""
    body: Any = case.body
    if not isinstance(body, dict):
        return case
    is_positive = case.meta is not None and case.meta.generation.mode.is_positive
    if is_positive and len(repr(body)) % 2:
        if "earliest_departure" in body:
            body = body | _PLANNABLE
        if "flight_intents" in body:
            body = body | {"flight_intents": [flight | _PLANNABLE for flight in body["flight_intents"]]}
    seconds = body.get("improve_for_s")
    if isinstance(seconds, float) and 0 < seconds <= _LONGEST_S:
        body = body | {"improve_for_s": seconds / 100}
    if body is not case.body:
        case.body = body
    return case
