"""The answers that the OpenAPI document shows: those of a running service, to the requests that the document shows.

`python -m tests.contract.examples` writes them down anew; then `make openapi`.
"""

import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import orjson

from app.main import create_app
from app.openapi import EXAMPLES
from app.settings import Settings
from app.times import format_time, parse_time
from tests.api.serving import Client, served
from tests.contract.running import START
from tests.ledger.process import FakeClock

INTENTS, INTENT = "/v1/flight-intents", "/v1/flight-intents/{intent_id}"
CONSTRAINT, WEBHOOK = "/v1/constraints/{constraint_id}", "/v1/webhooks/{webhook_id}"
NOBODY = "01a203c5-c4b2-710a-bef9-1873d4c985d1"
_UUID = re.compile(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")

Answers = dict[str, dict[str, Any]]


def requests_of(document: Mapping[str, Any], method: str, template: str) -> list[Any]:
    """Return the requests that an operation shows: its own, or those of its body's schemas."""
    content = document["paths"][template][method.lower()]["requestBody"]["content"]["application/json"]
    if "example" in content:
        return [content["example"]]
    schemas = document["components"]["schemas"]
    forms = content["schema"].get("oneOf", [content["schema"]])
    return [example for form in forms for example in schemas[form["$ref"].rpartition("/")[2]]["examples"]]


class _Story:
    """What was answered to whom; of each operation and status the first."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self.answers: defaultdict[str, dict[str, Any]] = defaultdict(dict)

    def tell(
        self, status: int, method: str, template: str, ids: Mapping[str, object] | None = None, **arguments: Any
    ) -> httpx.Response:
        """Send a request, which is to be answered with this status."""
        answer = self._client.request(method, template.format(**(ids or {})), **arguments)
        assert answer.status_code == status, answer.text
        self.answers[f"{method} {template}"].setdefault(str(status), answer.json())
        return answer


def told(folder: Path) -> Answers:
    """Return answers of a service, by operation and status; ids are by their order of appearance."""
    clock = FakeClock(parse_time(START))
    settings = Settings(ledger=str(folder / "ledger.sqlite"), monitor_every_s=3600)
    app = create_app(settings, clock, elapsed_ms=clock)
    document = app.openapi()
    with served(app) as client:
        story = _Story(client)
        _tell_of_flights(story, document)
        _tell_of_the_airspace(story, document)
        _tell_of_flying(story, document, client, clock)
        for template in ("/v1/aircraft-types", "/v1/airspace", "/health/live", "/health/ready"):
            story.tell(200, "GET", template)
        story.tell(200, "GET", "/problems/{slug}", {"slug": "no-conflict-free-plan"})
        story.tell(404, "GET", "/problems/{slug}", {"slug": "none"})
    # No two searches take as long.
    story.answers[f"POST {INTENTS}/batch"]["201"]["improvement"]["elapsed_s"] = 0.002
    return _with_plain_ids(story.answers)


def _tell_of_flights(story: _Story, document: Mapping[str, Any]) -> None:
    body = requests_of(document, "POST", INTENTS)[0]
    at_once = {**body, "latest_departure": body["earliest_departure"]}
    later = {**body, "earliest_departure": "2026-11-22T08:01:00Z", "latest_departure": None}
    in_a_house = {**body, "origin": {"lon": 71.42, "lat": 51.116, "alt_m": 20}}
    story.tell(200, "POST", f"{INTENTS}/preview", json=requests_of(document, "POST", f"{INTENTS}/preview")[0])
    story.tell(422, "POST", f"{INTENTS}/preview", json=in_a_house)
    submitted = story.tell(201, "POST", INTENTS, json=body)
    of_it, etag = {"intent_id": submitted.json()["id"]}, {"If-Match": submitted.headers["ETag"]}
    story.tell(409, "POST", f"{INTENTS}/preview", json=at_once)
    story.tell(409, "POST", INTENTS, json={**at_once, "reference": "ORD-7782"})
    story.tell(422, "POST", INTENTS, json=in_a_house)
    story.tell(400, "POST", INTENTS, content="{", headers={"Content-Type": "application/json"})
    story.tell(415, "POST", INTENTS, content="{}", headers={"Content-Type": "text/plain"})
    together = requests_of(document, "POST", f"{INTENTS}/batch")[0]
    story.tell(201, "POST", f"{INTENTS}/batch", json=together)
    story.tell(200, "GET", INTENT, of_it)
    story.tell(404, "GET", INTENT, {"intent_id": NOBODY})
    story.tell(428, "PUT", INTENT, of_it, json=later)
    story.tell(200, "PUT", INTENT, of_it, json=later, headers=etag)
    story.tell(412, "PUT", INTENT, of_it, json=later, headers=etag)
    story.tell(200, "DELETE", INTENT, of_it)
    story.tell(200, "GET", INTENTS, params={"limit": 1})


def _tell_of_the_airspace(story: _Story, document: Mapping[str, Any]) -> None:
    closed = story.tell(201, "POST", "/v1/constraints", json=requests_of(document, "POST", "/v1/constraints")[0])
    of_it = {"constraint_id": closed.json()["id"]}
    story.tell(200, "GET", "/v1/constraints")
    story.tell(200, "GET", CONSTRAINT, of_it)
    story.tell(200, "DELETE", CONSTRAINT, of_it)
    story.tell(404, "DELETE", CONSTRAINT, {"constraint_id": NOBODY})
    subscribed = story.tell(201, "POST", "/v1/webhooks", json=requests_of(document, "POST", "/v1/webhooks")[0])
    story.tell(200, "GET", "/v1/webhooks")
    story.tell(200, "DELETE", WEBHOOK, {"webhook_id": subscribed.json()["id"]})


def _tell_of_flying(story: _Story, document: Mapping[str, Any], client: Client, clock: FakeClock) -> None:
    """A flight is in the air where it should be, and somebody else has no business there."""
    body = requests_of(document, "POST", INTENTS)[0]
    flight = story.tell(201, "POST", INTENTS, json={**body, "reference": "ORD-7783"}).json()
    of_it = {"intent_id": flight["id"]}
    clock.now_ms = parse_time(flight["departure"])
    story.tell(200, "POST", f"{INTENT}/activate", of_it)
    clock.advance(seconds=2)
    there = {name: flight["trajectory"][0][name] for name in ("lon", "lat", "alt_m")}
    now = {"time": format_time(clock()), "airborne": True}
    positions = [
        {"flight_intent_id": flight["id"], **there, **now},
        {"track_id": "radar-17", "lon": 71.421, "lat": 51.1165, "alt_m": 61.5, **now},
        {"flight_intent_id": NOBODY, **there, **now},
    ]
    story.tell(202, "POST", "/v1/telemetry", json={"positions": positions})
    client.service.monitor.look()
    story.tell(200, "GET", "/v1/flights")
    story.tell(200, "GET", "/v1/airspace/alerts")
    story.tell(200, "GET", "/v1/airspace/status")
    i, j, k = flight["trajectory"][1]["block"]
    story.tell(200, "GET", "/v1/airspace/blocks/{i}/{j}/{k}", {"i": i, "j": j, "k": k})
    story.tell(404, "GET", "/v1/airspace/blocks/{i}/{j}/{k}", {"i": 100, "j": 0, "k": 0})
    story.tell(200, "GET", "/v1/airspace/occupancy")
    story.tell(200, "GET", "/v1/events", params={"after": 1, "limit": 3})
    story.tell(200, "POST", f"{INTENT}/end", of_it)
    story.tell(409, "POST", f"{INTENT}/activate", of_it)
    story.tell(409, "DELETE", INTENT, of_it)


def _with_plain_ids(answers: Answers) -> Answers:
    seen: dict[str, str] = {}

    def plain(found: re.Match[str]) -> str:
        return seen.setdefault(found[0], f"01a203c5-c4b2-7000-8000-{len(seen) + 1:012d}")

    plain_answers: Answers = orjson.loads(_UUID.sub(plain, orjson.dumps(answers).decode()))
    return plain_answers


def main() -> None:
    """Write the answers where the application finds them."""
    with TemporaryDirectory() as folder:
        answers = told(Path(folder))
    EXAMPLES.write_bytes(orjson.dumps(answers, option=orjson.OPT_INDENT_2) + b"\n")


if __name__ == "__main__":
    main()
