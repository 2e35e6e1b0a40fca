"""The OpenAPI document: what FastAPI gathers from the routes, and what is true of all of them."""

from collections.abc import Iterable, Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any

import orjson
from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from app import auth, problems

# What a service answered: JSON, by operation and status.
EXAMPLES = Path(__file__).with_name("openapi_examples.json")

_SCHEME = "bearer"
_BEARER = {
    "type": "http",
    "scheme": "bearer",
    "bearerFormat": "JWT",
    "description": f"""
A JSON Web Token (RS256 or ES256), where authentication is on (`/version` says so). `sub` is the operator. Scopes:

- `{auth.PLAN}`: plan, change and read one's own flights, report their positions, subscribe to what becomes of them
- `{auth.SURVEILLANCE}`: report tracks
- `{auth.MONITOR}`: read everything
- `{auth.ADMIN}`: close volumes, and open them again

`{auth.PRIORITY_CLAIM}` is the highest priority that its flights may have, 0 by default.
""".strip(),
}

# Any request may meet these before a route sees it: it is no HTTP, late, too large, for another host or one too many.
_ANYWHERE = (400, 408, 413, 421, 431, 500, 503)
# A connection answers these itself, and knows no request then.
_WITHOUT_REQUEST_ID = frozenset({"400", "408", "431", "503"})
_BODIES = frozenset({"POST", "PUT"})

_FASTAPI_VALIDATION = {"$ref": "#/components/schemas/HTTPValidationError"}
_PROBLEM = {"$ref": "#/components/schemas/Problem"}

_HEADERS = {
    "X-Request-ID": "Names the request, in the logs too.",
    "Allow": "The methods that there are.",
    "ETag": "The version, to be sent as `If-Match` with a change.",
    "Idempotent-Replayed": "`true`: this is the first answer again.",
    "Location": "Where it can be read.",
    "Retry-After": "Seconds to wait.",
    "Server-Timing": "How long it waited in the queue and how long planning, commit and rendering took, in ms.",
    "WWW-Authenticate": "Which scheme and scope are needed, and what was wrong (RFC 6750).",
}
_VERSIONED = "/v1/flight-intents/{intent_id}"
# Of one operation's answer: the headers that it always has, and those that it may have.
_OWN_HEADERS: Mapping[tuple[str, str, str], tuple[tuple[str, ...], tuple[str, ...]]] = {
    ("POST", "/v1/flight-intents", "201"): (("ETag", "Location", "Server-Timing"), ("Idempotent-Replayed",)),
    ("POST", "/v1/flight-intents", "409"): (("Server-Timing",), ("Idempotent-Replayed",)),
    ("POST", "/v1/flight-intents/batch", "201"): ((), ("Idempotent-Replayed",)),
    ("POST", "/v1/constraints", "201"): (("Location",), ()),
    ("GET", _VERSIONED, "200"): (("ETag",), ()),
    ("PUT", _VERSIONED, "200"): (("ETag",), ()),
    ("DELETE", _VERSIONED, "200"): (("ETag",), ()),
    ("POST", f"{_VERSIONED}/activate", "200"): (("ETag",), ()),
    ("POST", f"{_VERSIONED}/end", "200"): (("ETag",), ()),
}
# What kinds of problems add to their common members: each is there or not, and null only where that says something.
_TEXTS = {"type": "array", "items": {"type": "string"}}
_BLOCK = {"type": "array", "items": {"type": "integer"}, "minItems": 3, "maxItems": 3}
_TIME = {"type": "string", "format": "date-time"}
_ERROR = {
    "type": "object",
    "properties": {
        "loc": {"type": "array", "items": {"type": ["string", "integer"]}},
        "msg": {"type": "string"},
        "type": {"type": "string"},
    },
    "required": ["loc", "msg", "type"],
}
_CONFLICT = {
    "type": "object",
    "properties": {
        "block": _BLOCK,
        "enter": _TIME,
        "exit": _TIME,
        "flight_intent_id": {"type": "string"},
        "constraint_id": {"type": "string"},
    },
    "required": ["block", "enter", "exit"],
}
_MEMBERS: Mapping[str, dict[str, Any]] = {
    "reason": {"type": "string", "description": "Why, for programs."},
    "errors": {"type": "array", "items": _ERROR, "description": "What is wrong, and where."},
    "nearest_free_block": {**_BLOCK, "description": "Where a flight could begin or end."},
    "flight_intent_id": {"type": "string", "description": "The refused intent as recorded, or the one that stands."},
    "sequence": {"type": "integer"},
    "conflicting_intents": _TEXTS,
    "conflicting_constraints": _TEXTS,
    "earliest_feasible_departure": _TIME,
    "entry": {"type": ["integer", "null"], "description": "Which entry of a submitted path; null: no single one."},
    "conflicts": {"type": "array", "items": _CONFLICT, "description": "Who is in the way of a submitted path, where."},
    "conflict_count": {"type": "integer", "description": "How many there are, listed or not."},
    "proposal": {
        "anyOf": [{"$ref": "#/components/schemas/PreviewAnswer"}, {"type": "null"}],
        "description": "A plan that would do instead; null: none was found.",
    },
    "index": {"type": "integer", "description": "Which item of a batch."},
    "cause": {**_PROBLEM, "description": "What is wrong with that item."},
    "needed_scopes": _TEXTS,
    "waiting": {"type": "integer", "description": "How many requests are waiting."},
    "revision": {"type": ["integer", "null"], "description": "The ledger's newest; null: it cannot be read."},
    "error_id": {"type": "string", "description": "Names an unexpected error in the logs."},
}

# Where answers lead: to operations on what they answered, by its id and its version.
_ID = "$response.body#/id"
_FLIGHT_INTENT_LINKS: Mapping[str, tuple[str, str]] = {
    "read": ("GET", _VERSIONED),
    "change": ("PUT", _VERSIONED),
    "cancel": ("DELETE", _VERSIONED),
    "activate": ("POST", f"{_VERSIONED}/activate"),
    "end": ("POST", f"{_VERSIONED}/end"),
}
_LINKS: Mapping[tuple[str, str, str], Mapping[str, tuple[str, str]]] = {
    ("POST", "/v1/flight-intents", "201"): _FLIGHT_INTENT_LINKS,
    ("GET", _VERSIONED, "200"): {"change": _FLIGHT_INTENT_LINKS["change"]},
    ("POST", "/v1/constraints", "201"): {
        "read": ("GET", "/v1/constraints/{constraint_id}"),
        "remove": ("DELETE", "/v1/constraints/{constraint_id}"),
    },
    ("POST", "/v1/webhooks", "201"): {"unsubscribe": ("DELETE", "/v1/webhooks/{webhook_id}")},
}


def document(app: FastAPI) -> dict[str, Any]:
    """Return the document, with problems under their own media type, what any request can meet, and what it needs."""
    described = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
    described["components"]["securitySchemes"] = {_SCHEME: _BEARER}
    examples = orjson.loads(EXAMPLES.read_bytes())
    for template, path in described["paths"].items():
        for method, operation in path.items():
            _describe(operation, method.upper(), template)
            for code, example in examples.get(f"{method.upper()} {template}", {}).items():
                media_type = "application/json" if code < "400" else problems.MEDIA_TYPE
                operation["responses"][code]["content"][media_type]["example"] = example
    for (method, template, code), links in _LINKS.items():
        answer = described["paths"][template][method.lower()]["responses"][code]
        answer["links"] = {name: _link(described, *leads_to) for name, leads_to in links.items()}
    described["components"]["schemas"]["Problem"]["properties"] |= _MEMBERS
    for unused in ("HTTPValidationError", "ValidationError"):
        described["components"]["schemas"].pop(unused, None)
    return described


def _describe(operation: dict[str, Any], method: str, template: str) -> None:
    answers = operation["responses"]
    _refuse(answers, _ANYWHERE)
    if method in _BODIES:
        _refuse(answers, [415])
    _describe_access(operation, method, template)
    for parameter in operation.get("parameters", []):
        # Without it the answer is 428, which says more than that a parameter is missing.
        if parameter["name"] == "if-match":
            parameter["required"] = True
        parameter["schema"] = _never_null(parameter["schema"])
        # What is no UUID is unknown, rather than invalid.
        if parameter["name"].endswith("_id"):
            parameter["schema"]["format"] = "uuid"
    for code, answer in answers.items():
        content = answer.get("content", {})
        if content.get("application/json", {}).get("schema") in (_PROBLEM, _FASTAPI_VALIDATION):
            del content["application/json"]
            content[problems.MEDIA_TYPE] = {"schema": _PROBLEM}
            answer["description"] = f"{HTTPStatus(int(code)).phrase}: a problem (RFC 9457)"
        always, sometimes = _headers_of(method, template, code)
        answer["headers"] = {name: _header(name, required=name in always) for name in sorted({*always, *sometimes})}
    operation["responses"] = dict(sorted(answers.items()))


def _never_null(schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a parameter, which may be left out, but is text: it cannot be null."""
    kinds = [kind for kind in schema.get("anyOf", []) if kind != {"type": "null"}]
    if len(kinds) != 1:
        return schema
    rest = {name: value for name, value in schema.items() if name != "anyOf"}
    return {**kinds[0], **rest}


def _link(described: dict[str, Any], method: str, template: str) -> dict[str, Any]:
    """Return how an answer leads to an operation on what it answered."""
    operation = described["paths"][template][method.lower()]
    taken = {"path": _ID, "header": "$response.header.ETag"}
    return {
        "operationId": operation["operationId"],
        "parameters": {
            parameter["name"]: taken[parameter["in"]] for parameter in operation["parameters"] if parameter["required"]
        },
    }


def _describe_access(operation: dict[str, Any], method: str, template: str) -> None:
    """Say which token an operation needs, and how it refuses others."""
    needed = auth.NEEDED[method, template]
    if not needed:
        return
    scopes = "any of the scopes" if needed == auth.SCOPES else " or ".join(f"`{name}`" for name in sorted(needed))
    operation["description"] += f"\n\nWhere authentication is on, this needs a token with {scopes}."
    operation["security"] = [{_SCHEME: []}]
    _refuse(operation["responses"], (401, 403, 429) if (method, template) in auth.RATED else (401, 403))


def _refuse(answers: dict[str, Any], statuses: Iterable[int]) -> None:
    for status, answer in problems.documented(*statuses).items():
        content = {"application/json": {"schema": _PROBLEM}}
        answers.setdefault(str(status), {"description": answer["description"], "content": content})


def _headers_of(method: str, template: str, code: str) -> tuple[set[str], set[str]]:
    """Return the headers of an answer that it always has, and those that it may have."""
    own, possible = _OWN_HEADERS.get((method, template, code), ((), ()))
    always, sometimes = set(own), set(possible)
    (sometimes if code in _WITHOUT_REQUEST_ID else always).add("X-Request-ID")
    if code == "401":
        always.add("WWW-Authenticate")
    if code == "403":
        sometimes.add("WWW-Authenticate")
    if code in ("429", "503"):
        sometimes.add("Retry-After")
    return always, sometimes


def _header(name: str, *, required: bool) -> dict[str, Any]:
    return {"description": _HEADERS[name], "required": required, "schema": {"type": "string"}}
