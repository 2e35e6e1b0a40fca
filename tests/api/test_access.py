"""Access: which tokens are let in, which scopes lead where, and whose flights are whose."""

import base64
import hashlib
import hmac
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.routing import APIRoute, iter_route_contexts

from app import auth
from app.auth import ADMIN, MONITOR, NEEDED, PLAN, SCOPES, SURVEILLANCE
from app.main import create_app
from app.settings import Settings
from tests.api.bodies import PREVIEW, SUBMIT, TELEMETRY, intent, position, problem, report
from tests.api.serving import Client, served, settings_for
from tests.api.tokens import HOUR_S, as_, bearer, issuer, write_keys
from tests.ledger.district import OLD_TOWN, START_MS
from tests.ledger.locations import Ledgers, SqliteLedgers
from tests.ledger.process import FakeClock

FLIGHTS = "/v1/flights"
UNKNOWN = "01a203c5-c4b2-710a-bef9-1873d4c985d1"


@pytest.fixture
def ledgers(tmp_path: Path) -> Ledgers:
    """Keep to one kind of database: nothing here has to do with that."""
    return SqliteLedgers(tmp_path)


@pytest.fixture
def guarded(ledger: str, tmp_path: Path) -> Settings:
    """Return settings with authentication on."""
    return settings_for(OLD_TOWN, ledger, tmp_path, jwks=str(write_keys(tmp_path, issuer())), leeway_s=2)


@pytest.fixture
def api(guarded: Settings, clock: FakeClock) -> Iterator[Client]:
    with served(create_app(guarded, clock, elapsed_ms=clock)) as client:
        yield client


def refused(response: httpx.Response, challenge: str = 'Bearer error="invalid_token"') -> str:
    """Return why nobody was let in."""
    assert response.headers["www-authenticate"] == challenge
    return str(problem(response, 401, "unauthenticated")["detail"])


def base64url(content: bytes) -> str:
    return base64.urlsafe_b64encode(content).decode().rstrip("=")


def forged(header: dict[str, object], secret: bytes | None) -> str:
    """Return a token made by hand: unsigned, or with an HMAC."""
    claims = {"sub": "acme-air", "aud": "airmatrix", "exp": time.time() + HOUR_S, "scope": MONITOR}
    content = ".".join(base64url(json.dumps(part).encode()) for part in (header, claims))
    signature = b"" if secret is None else hmac.new(secret, content.encode(), hashlib.sha256).digest()
    return f"{content}.{base64url(signature)}"


# Tokens


def test_who_sends_no_token_is_asked_for_one(api: Client) -> None:
    assert "Authorization: Bearer" in refused(api.get(FLIGHTS), "Bearer")


def test_a_good_token_is_let_in(api: Client) -> None:
    assert api.get(FLIGHTS, **as_("ops", MONITOR)).status_code == 200


@pytest.mark.parametrize("header", ["Bearer", "Bearer ", "Basic YTpi", "Token {token}", "{token}"])
def test_a_header_that_is_not_bearer_and_a_token_is_refused(api: Client, header: str) -> None:
    headers = {"Authorization": header.format(token=issuer().token())}
    assert "not `Bearer` and one token" in refused(api.get(FLIGHTS, headers=headers), "Bearer")


def test_two_authorization_headers_are_refused(api: Client) -> None:
    headers = [("Authorization", f"Bearer {issuer().token()}")] * 2
    refused(api.get(FLIGHTS, headers=headers), "Bearer")


def test_a_scheme_may_be_written_in_any_case(api: Client) -> None:
    headers = {"Authorization": f"bEARER {issuer().token()}"}
    assert api.get(FLIGHTS, headers=headers).status_code == 200


@pytest.mark.parametrize("name", ["access_token", "token", "authorization"])
def test_a_token_in_the_query_counts_for_nothing(api: Client, name: str) -> None:
    refused(api.get(FLIGHTS, params={name: issuer().token()}), "Bearer")


DEEP = base64url(b"[" * 5000)


@pytest.mark.parametrize("token", ["x", "a.b.c", "é", "..", f"{DEEP}.{DEEP}.x", "e30.e30.e30", "\x7f"])
def test_garbage_is_no_token(api: Client, token: str) -> None:
    headers = {"Authorization": b"Bearer " + token.encode()}
    refused(api.get(FLIGHTS, headers=headers))


def test_a_token_of_ten_kilobytes_is_not_looked_at(api: Client) -> None:
    long = issuer().token(note="x" * 10_000)
    assert "up to 8192 bytes" in refused(api.get(FLIGHTS, headers=bearer(long)))


NOW = int(time.time())


REFUSED_CLAIMS = {
    "expired": ({"exp": NOW - 60}, "expired"),
    "without expiry": ({"exp": None}, '"exp"'),
    "expiring at infinity": ({"exp": float("inf")}, "Expiration"),
    "expiring at no number": ({"exp": str(NOW + HOUR_S)}, "`exp` is not a number"),
    "not yet valid": ({"nbf": NOW + HOUR_S}, "not yet valid"),
    "for another audience": ({"aud": "another"}, "Audience"),
    "for no audience": ({"aud": None}, '"aud"'),
    "without subject": ({"sub": None}, '"sub"'),
    "of a number": ({"sub": 7}, "Subject must be a string"),
    "of nobody": ({"sub": ""}, "`sub` is not the name of an operator"),
    "of a control character": ({"sub": "acme\n"}, "`sub` is not the name of an operator"),
    "of half a character": ({"sub": "\ud800"}, "`sub` is not the name of an operator"),
    "of a name too long": ({"sub": "a" * 201}, "`sub` is not the name of an operator"),
    "with scopes that are none": ({"scope": {PLAN: True}}, "scopes"),
    "with a list that is no list of scopes": ({"scope": None, "scp": [MONITOR, 1]}, "scopes"),
    "with a priority that is no number": ({"airmatrix_max_priority": True}, "airmatrix_max_priority"),
    "with a priority too high": ({"airmatrix_max_priority": 1001}, "airmatrix_max_priority"),
}


@pytest.mark.parametrize(("claims", "reason"), REFUSED_CLAIMS.values(), ids=REFUSED_CLAIMS)
def test_a_token_is_refused(api: Client, claims: dict[str, object], reason: str) -> None:
    assert reason in refused(api.get(FLIGHTS, headers=bearer(issuer().token(**claims))))


def test_clocks_of_issuers_may_be_off_by_the_leeway(api: Client) -> None:
    now = time.time()
    late, early = issuer().token(exp=now - 1), issuer().token(nbf=now + 1)
    assert {api.get(FLIGHTS, headers=bearer(token)).status_code for token in (late, early)} == {200}


def test_an_audience_may_be_one_of_several(api: Client) -> None:
    token = issuer().token(aud=["another", "airmatrix"])
    assert api.get(FLIGHTS, headers=bearer(token)).status_code == 200


@pytest.mark.parametrize("claim", ["scope", "scp", "scopes"])
@pytest.mark.parametrize("value", [f"openid {MONITOR}", ["openid", MONITOR]])
def test_scopes_may_be_where_issuers_put_them(api: Client, claim: str, value: object) -> None:
    token = issuer().token(**{"scope": None, claim: value})
    assert api.get(FLIGHTS, headers=bearer(token)).status_code == 200


@pytest.mark.parametrize(("iss", "status"), [("https://issuer.test", 200), ("https://other.test", 401), (None, 401)])
def test_the_issuer_is_checked_where_one_is_set(
    guarded: Settings, clock: FakeClock, iss: str | None, status: int
) -> None:
    strict = Settings.model_validate({**guarded.model_dump(), "issuer": "https://issuer.test"})
    with served(create_app(strict, clock)) as api:
        assert api.get(FLIGHTS, headers=bearer(issuer().token(iss=iss))).status_code == status


def test_an_unsigned_token_is_refused(api: Client) -> None:
    token = forged({"alg": "none", "kid": "first"}, None)
    assert "ES256" in refused(api.get(FLIGHTS, headers=bearer(token)))


@pytest.mark.parametrize(
    ("algorithm", "reason"),
    [("HS256", "not signed with ES256"), ("RS256", "not signed with ES256"), ("ES256", "the signature does not fit")],
)
def test_the_public_key_is_no_secret_to_sign_with(api: Client, algorithm: str, reason: str) -> None:
    token = forged({"alg": algorithm, "kid": "first"}, issuer().pem)
    assert reason in refused(api.get(FLIGHTS, headers=bearer(token)))


def test_a_signature_of_another_key_under_the_same_id_is_refused(api: Client) -> None:
    stranger = issuer("stranger")
    head, _, _ = issuer().token().split(".")
    _, claims, signature = stranger.token().split(".")
    assert "signature" in refused(api.get(FLIGHTS, headers=bearer(f"{head}.{claims}.{signature}")))


def test_a_token_of_an_unknown_key_is_refused(api: Client) -> None:
    assert "not known here" in refused(api.get(FLIGHTS, headers=bearer(issuer("stranger").token())))


def test_a_token_changed_by_one_character_is_refused(api: Client) -> None:
    head, claims, signature = issuer().token("acme-air", (MONITOR,)).split(".")
    decoded = base64.urlsafe_b64decode(claims + "=" * (-len(claims) % 4))
    other = base64url(decoded.replace(b"acme-air", b"acme-aid"))
    assert "signature" in refused(api.get(FLIGHTS, headers=bearer(f"{head}.{other}.{signature}")))


def test_the_body_of_who_is_not_let_in_is_not_read(guarded: Settings, clock: FakeClock) -> None:
    def never() -> Iterator[bytes]:
        raise AssertionError("the body was read")
        yield b""

    async def body() -> Any:
        for chunk in never():
            yield chunk

    with served(create_app(guarded, clock)) as api:
        assert refused(api.post(SUBMIT, content=body()), "Bearer")


def test_a_refusal_says_nothing_of_the_token(api: Client) -> None:
    token = issuer().token(exp=NOW - 60)
    answer = api.get(FLIGHTS, headers=bearer(token)).text
    assert not any(part in answer for part in token.split("."))


# Scopes


ROUTES = {
    (method, str(context.path))
    for context in iter_route_contexts(create_app(Settings()).router.routes)
    if isinstance(context.original_route, APIRoute)
    for method in (context.methods or set()) - {"HEAD"}
}


def test_every_route_is_in_the_table_and_the_table_names_no_other() -> None:
    listed = {route for route in NEEDED if not route[1].startswith(("/docs", "/openapi", "/static-offline-docs"))}
    assert {route for route in ROUTES if not route[1].startswith("/docs")} == listed


def filled(template: str) -> str:
    """Return a path of a route, of things that there are not."""
    path = template.replace("{i}/{j}/{k}", "0/0/0").replace("{slug}", "queue-full").replace("{name}", "index.html")
    return path.replace("{path:path}", "x").replace("{", "").replace("}", "")


@pytest.fixture(scope="module")
def one_api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """Return one service for all routes: nothing is changed here."""
    folder = tmp_path_factory.mktemp("access")
    keys = str(write_keys(folder, issuer()))
    settings = settings_for(OLD_TOWN, str(folder / "ledger.sqlite"), folder, jwks=keys)
    with served(create_app(settings, FakeClock())) as client:
        yield client


@pytest.mark.parametrize(("method", "template"), sorted(NEEDED))
def test_a_route_needs_one_of_its_scopes_and_nothing_else(one_api: Client, method: str, template: str) -> None:
    path, needed = filled(template), NEEDED[method, template]
    if template == "/v1/airspace/stream":
        # Never ends; a refusal does.
        for scope in SCOPES - needed:
            problem(one_api.request(method, path, **as_("ops", scope)), 403, "insufficient-scope")
        return
    anonymous = one_api.request(method, path)
    assert (anonymous.status_code == 401) == bool(needed)
    for scope in SCOPES:
        response = one_api.request(method, path, **as_("ops", scope))
        assert (response.status_code == 403) == bool(needed and scope not in needed), scope


def test_a_refusal_names_the_scope_that_is_missing(api: Client) -> None:
    response = api.get(FLIGHTS, **as_("acme-air", PLAN))
    assert problem(response, 403, "insufficient-scope")["needed_scopes"] == [MONITOR]
    assert response.headers["www-authenticate"] == f'Bearer error="insufficient_scope", scope="{MONITOR}"'


def test_a_token_without_any_of_our_scopes_opens_nothing(api: Client) -> None:
    problem(api.get("/v1/airspace", **as_("acme-air", "openid")), 403, "insufficient-scope")


def test_what_does_not_exist_is_told_only_to_who_has_a_token(api: Client) -> None:
    refused(api.get("/v1/nothing"), "Bearer")
    problem(api.get("/v1/nothing", **as_()), 404, "not-found")
    problem(api.request("PATCH", FLIGHTS, **as_()), 405, "method-not-allowed")


def test_a_route_that_is_missing_in_the_table_is_nobody_s(guarded: Settings, clock: FakeClock) -> None:
    app = create_app(guarded, clock)

    @app.get("/v1/forgotten")
    async def forgotten() -> str:
        return "secret"

    with served(app) as api:
        problem(api.get("/v1/forgotten", **as_("ops", *SCOPES)), 403, "insufficient-scope")


def test_any_host_is_answered(api: Client) -> None:
    headers = {**as_()["headers"], "Host": "airmatrix.example.com"}
    assert api.get("/v1/airspace", headers=headers).status_code == 200


def test_listening_beyond_loopback_is_allowed_with_keys() -> None:
    auth.check_listening(Settings(host="0.0.0.0", jwks="jwks.json"))  # noqa: S104


def test_the_version_says_that_authentication_is_on(api: Client) -> None:
    assert api.get("/version").json()["authentication"] == "jwt"


def test_who_only_reads_asks_for_tokens_too(guarded: Settings, clock: FakeClock, api: Client) -> None:
    api.post(SUBMIT, json=intent(), **as_())
    reader = Settings.model_validate({**guarded.model_dump(), "read_only": True})
    with served(create_app(reader, clock)) as replica:
        refused(replica.get(SUBMIT), "Bearer")
        assert len(replica.get(SUBMIT, **as_()).json()["items"]) == 1
        problem(replica.post(SUBMIT, json=intent(), **as_()), 421, "read-only")


# Operators


def test_a_body_need_not_name_the_token_s_operator(api: Client) -> None:
    body = intent()
    del body["operator"]
    assert api.post(SUBMIT, json=body, **as_("blue-kite")).json()["operator"] == "blue-kite"


@pytest.mark.parametrize("path", [SUBMIT, PREVIEW])
def test_a_body_may_not_name_another_operator(api: Client, path: str) -> None:
    response = api.post(path, json=intent(operator="acme-air"), **as_("blue-kite", PLAN, MONITOR))
    problem(response, 403, "operator-mismatch")


@pytest.mark.parametrize(
    ("members", "cause"),
    [({"operator": "blue-kite"}, "operator-mismatch"), ({"priority": 1}, "priority-not-allowed")],
)
def test_an_item_of_a_batch_that_the_token_does_not_allow_is_named(
    api: Client, members: dict[str, Any], cause: str
) -> None:
    items = [intent(**{"priority": 0, **members, "operator": "acme-air"}), intent(**members)]
    answer = problem(api.post(f"{SUBMIT}/batch", json={"flight_intents": items}, **as_()), 403, "item-not-allowed")
    assert answer["cause"]["type"] == f"/problems/{cause}"
    assert answer["index"] == (1 if "operator" in members else 0)


def test_a_key_s_first_answer_is_found_whether_the_body_names_the_operator_or_not(api: Client) -> None:
    headers = {**as_()["headers"], "Idempotency-Key": "once"}
    unnamed = intent()
    del unnamed["operator"]
    first, again = (api.post(SUBMIT, json=body, headers=headers) for body in (intent(), unnamed))
    assert (first.json(), again.headers["idempotent-replayed"]) == (again.json(), "true")


def test_an_operator_lists_its_own_flight_intents_only(api: Client) -> None:
    mine = api.post(SUBMIT, json=intent(), **as_()).json()["id"]
    later = intent(operator="blue-kite", earliest_ms=START_MS + 600_000)
    other = api.post(SUBMIT, json=later, **as_("blue-kite")).json()["id"]
    assert [item["id"] for item in api.get(SUBMIT, **as_()).json()["items"]] == [mine]
    assert [item["id"] for item in api.get(SUBMIT, params={"operator": "acme-air"}, **as_()).json()["items"]] == [mine]
    problem(api.get(SUBMIT, params={"operator": "blue-kite"}, **as_()), 403, "operator-mismatch")
    everybody_s = api.get(SUBMIT, **as_("ops", MONITOR)).json()["items"]
    assert [item["id"] for item in everybody_s] == [mine, other]


@pytest.mark.parametrize(
    ("method", "suffix"), [("GET", ""), ("DELETE", ""), ("POST", "/activate"), ("POST", "/end"), ("PUT", "")]
)
def test_another_operator_s_flight_intent_is_as_good_as_none(api: Client, method: str, suffix: str) -> None:
    foreign = api.post(SUBMIT, json=intent(), **as_()).json()["id"]
    content = {"json": intent(operator="blue-kite")} if method == "PUT" else {}
    headers = {**as_("blue-kite")["headers"], "If-Match": "*"}
    answers = [api.request(method, f"{SUBMIT}/{id_}{suffix}", headers=headers, **content) for id_ in (foreign, UNKNOWN)]
    details = [problem(answer, 404, "unknown-flight-intent")["detail"] for answer in answers]
    assert details[0].replace(foreign, UNKNOWN) == details[1]
    assert api.get(f"{SUBMIT}/{foreign}", **as_()).json()["state"] == "accepted"


def test_who_may_read_everything_may_still_not_change_others_flights(api: Client) -> None:
    foreign = api.post(SUBMIT, json=intent(), **as_()).json()["id"]
    watcher = as_("blue-kite", PLAN, MONITOR)
    assert api.get(f"{SUBMIT}/{foreign}", **watcher).status_code == 200
    problem(api.delete(f"{SUBMIT}/{foreign}", **watcher), 404, "unknown-flight-intent")


def test_an_operator_changes_its_own_flight_intents(api: Client) -> None:
    path = api.post(SUBMIT, json=intent(), **as_()).headers["location"]
    assert api.post(f"{path}/activate", **as_()).json()["state"] == "activated"
    assert api.post(f"{path}/end", **as_()).json()["state"] == "ended"


@pytest.mark.parametrize(("claim", "priority", "status"), [(None, 0, 201), (None, 1, 403), (5, 5, 201), (5, 6, 403)])
def test_a_token_bounds_the_priority(api: Client, claim: int | None, priority: int, status: int) -> None:
    response = api.post(SUBMIT, json=intent(priority=priority), **as_(airmatrix_max_priority=claim))
    assert response.status_code == status
    if status == 403:
        problem(response, 403, "priority-not-allowed")


# Telemetry


def told(response: httpx.Response) -> list[tuple[int, str]]:
    """Return which positions were refused, and why."""
    assert response.status_code == 202
    return [(entry["index"], entry["type"].rpartition("/")[2]) for entry in response.json()["problems"]]


@pytest.mark.parametrize(
    ("operator", "scopes", "refusals"),
    [
        ("acme-air", [PLAN], [(1, "unknown-flight"), (2, "position-not-allowed")]),
        ("acme-air", [PLAN, SURVEILLANCE], [(1, "unknown-flight")]),
        ("radar", [SURVEILLANCE], [(0, "position-not-allowed"), (1, "position-not-allowed")]),
        ("radar", [PLAN, MONITOR], [(0, "unknown-flight"), (1, "unknown-flight"), (2, "position-not-allowed")]),
    ],
)
def test_operators_report_their_own_flights_and_surveillance_tracks(
    api: Client, clock: FakeClock, operator: str, scopes: list[str], refusals: list[tuple[int, str]]
) -> None:
    own = api.post(SUBMIT, json=intent(), **as_("acme-air")).json()["id"]
    later = intent(operator="blue-kite", earliest_ms=START_MS + 600_000)
    foreign = api.post(SUBMIT, json=later, **as_("blue-kite")).json()["id"]
    body = report(
        position("A", clock(), flight_intent_id=own),
        position("A", clock(), flight_intent_id=foreign),
        position("B", clock(), track_id="radar-1"),
    )
    assert told(api.post(TELEMETRY, json=body, **as_(operator, *scopes))) == refusals


# What goes on for long


def test_a_caller_s_time_is_over_when_the_token_expires() -> None:
    claims = {"sub": "ops", "scope": MONITOR, "exp": time.time() - 1}
    assert auth.caller_of(claims, leeway_s=0).is_expired()
    assert not auth.caller_of(claims, leeway_s=60).is_expired()
    assert not auth.caller_of({**claims, "exp": 10**400}).is_expired()


def test_a_stream_ends_when_the_token_expires(guarded: Settings, clock: FakeClock) -> None:
    brief = Settings.model_validate({**guarded.model_dump(), "leeway_s": 0})
    with served(create_app(brief, clock)) as api:
        token = issuer().token("ops", (MONITOR,), exp=int(time.time()) + 2)
        # httpx's transport without sockets returns when the answer is complete.
        assert api.get("/v1/airspace/stream", headers=bearer(token)).status_code == 200


def test_an_item_of_a_batch_that_names_no_operator_is_named_where_nobody_is_told_from_another(client: Client) -> None:
    nameless = {name: value for name, value in intent().items() if name != "operator"}
    answer = client.post(f"{SUBMIT}/batch", json={"flight_intents": [intent(), nameless]})
    (error,) = problem(answer, 422, "validation-error")["errors"]
    assert error["loc"] == ["body", "flight_intents", 1, "operator"]


def test_without_authentication_anybody_may_do_anything(client: Client) -> None:
    assert client.post(SUBMIT, json=intent(priority=1000)).status_code == 201
    assert client.get(FLIGHTS).status_code == 200
    assert auth.ANYBODY.scopes >= {PLAN, MONITOR, ADMIN, SURVEILLANCE}
