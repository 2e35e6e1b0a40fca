"""Who is asking, and what they may: bearer tokens (RFC 6750, 7519), and the table of the scopes that routes need.

Without a JWKS in the settings there is no authentication: then anybody may do anything, and the service keeps to
loopback.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any, cast

import jwt
from fastapi import Depends, Request
from pydantic import TypeAdapter, ValidationError
from starlette.exceptions import HTTPException
from starlette.routing import compile_path
from starlette.types import Scope

from app.addresses import is_loopback
from app.errors import InsufficientScope, Unauthenticated, UnsafeListening
from app.keys import Key, KeyStore, store_of
from app.labels import Label
from app.limits import RateLimit
from app.settings import Settings

PLAN = "airmatrix.plan"
SURVEILLANCE = "airmatrix.surveillance"
MONITOR = "airmatrix.monitor"
ADMIN = "airmatrix.admin"
SCOPES = frozenset({PLAN, SURVEILLANCE, MONITOR, ADMIN})

HIGHEST_PRIORITY = 1000
PRIORITY_CLAIM = "airmatrix_max_priority"

# Where issuers put scopes, as a string of words or a list of them; the first that is there counts.
_SCOPE_CLAIMS = ("scope", "scp", "scopes")
# Later than any clock goes; integers have no bound, and floats do.
_LATEST_S = 2**53
_MOST_TOKEN_BYTES = 8 * 1024
_OPERATOR: TypeAdapter[str] = TypeAdapter(Label)

_PUBLIC: frozenset[str] = frozenset()
_PLANS = frozenset({PLAN})
_READS_PLANS = frozenset({PLAN, MONITOR})
_WATCHES = frozenset({MONITOR})
_ADMINISTERS = frozenset({ADMIN})

# Any one of these scopes is needed; none where everybody may.
NEEDED: Mapping[tuple[str, str], frozenset[str]] = {
    ("POST", "/v1/flight-intents"): _PLANS,
    ("POST", "/v1/flight-intents/preview"): _PLANS,
    ("POST", "/v1/flight-intents/batch"): _PLANS,
    ("GET", "/v1/flight-intents"): _READS_PLANS,
    ("GET", "/v1/flight-intents/{intent_id}"): _READS_PLANS,
    ("PUT", "/v1/flight-intents/{intent_id}"): _PLANS,
    ("DELETE", "/v1/flight-intents/{intent_id}"): _PLANS,
    ("POST", "/v1/flight-intents/{intent_id}/activate"): _PLANS,
    ("POST", "/v1/flight-intents/{intent_id}/end"): _PLANS,
    ("POST", "/v1/telemetry"): frozenset({PLAN, SURVEILLANCE}),
    ("POST", "/v1/webhooks"): _PLANS,
    ("GET", "/v1/webhooks"): _PLANS,
    ("DELETE", "/v1/webhooks/{webhook_id}"): _PLANS,
    ("GET", "/v1/aircraft-types"): SCOPES,
    ("GET", "/v1/airspace"): SCOPES,
    ("GET", "/v1/airspace/buildings"): SCOPES,
    ("GET", "/v1/airspace/static"): SCOPES,
    ("GET", "/v1/constraints"): SCOPES,
    ("GET", "/v1/constraints/{constraint_id}"): SCOPES,
    ("POST", "/v1/constraints"): _ADMINISTERS,
    ("DELETE", "/v1/constraints/{constraint_id}"): _ADMINISTERS,
    ("GET", "/v1/airspace/blocks/{i}/{j}/{k}"): _WATCHES,
    ("GET", "/v1/airspace/occupancy"): _WATCHES,
    ("GET", "/v1/airspace/status"): _WATCHES,
    ("GET", "/v1/airspace/stream"): _WATCHES,
    ("GET", "/v1/airspace/alerts"): _WATCHES,
    ("GET", "/v1/flights"): _WATCHES,
    ("GET", "/v1/events"): _WATCHES,
    ("GET", "/metrics"): _WATCHES,
    ("GET", "/health/live"): _PUBLIC,
    ("GET", "/health/ready"): _PUBLIC,
    ("GET", "/version"): _PUBLIC,
    ("GET", "/problems/{slug}"): _PUBLIC,
    ("GET", "/docs"): _PUBLIC,
    ("GET", "/docs/oauth2-redirect"): _PUBLIC,
    ("GET", "/static-offline-docs/{path:path}"): _PUBLIC,
    ("GET", "/openapi.json"): _PUBLIC,
    ("GET", "/"): _PUBLIC,
    ("GET", "/console/{name}"): _PUBLIC,
    ("GET", "/console/vendor/{name}"): _PUBLIC,
}
# What the writer works for: these count against an operator's rate.
RATED = frozenset(
    (method, path)
    for method, path in NEEDED
    if path.startswith(("/v1/flight-intents", "/v1/telemetry", "/v1/webhooks")) and method != "GET"
)
_PATTERNS = [(method, path, compile_path(path)[0]) for method, path in NEEDED]
_SPELT_OUT = {path: {method for method, other in NEEDED if other == path} for _, path in NEEDED if "{" not in path}


@dataclass(frozen=True)
class Caller:
    """Who asks: an operator, or None where nobody is told from another; and what their token allows until it expires.

    `expires_s` is in seconds since the epoch.
    """

    operator: str | None
    scopes: frozenset[str]
    max_priority: int
    expires_s: float = math.inf

    @property
    def sees_all(self) -> bool:
        """Whether others' flights are theirs to see."""
        return self.operator is None or MONITOR in self.scopes

    def may_see(self, operator: str) -> bool:
        """Tell whether they may know of an operator's flights."""
        return self.sees_all or operator == self.operator

    def may_change(self, operator: str) -> bool:
        """Tell whether they may change an operator's flights, and speak for them."""
        return self.operator in (None, operator)

    @property
    def may_change_all(self) -> bool:
        """Whether others' flights are theirs to change."""
        return self.operator is None

    def is_expired(self) -> bool:
        """Tell whether what was allowed is over: answers that go on for long must end then."""
        return time.time() >= self.expires_s


# Who asks where there is no authentication; and who asks, where there is, for what everybody may read.
ANYBODY = Caller(None, SCOPES, HIGHEST_PRIORITY)
NOBODY = Caller("", frozenset(), -HIGHEST_PRIORITY)


class Access:
    """Tells who asks and whether they may, before anything else of a request is looked at; for one event loop."""

    def __init__(self, settings: Settings, keys: KeyStore | None, elapsed_ms: Callable[[], int]) -> None:
        self._settings = settings
        self._keys = keys
        self._rate: RateLimit | None = None
        if settings.rate_per_s is not None:
            self._rate = RateLimit(settings.rate_per_s, settings.rate_burst, elapsed_ms)

    async def admit(self, scope: Scope) -> Caller:
        """Return who makes a request.

        Raises
        ------
        Unauthenticated, InsufficientScope, TooManyRequests
        """
        route = _route_of(scope["method"], scope["path"])
        needed = None if route is None else NEEDED[route]
        if self._keys is None:
            caller = ANYBODY
        elif needed == _PUBLIC:
            caller = NOBODY
        else:
            caller = await self._bearer(self._keys, _authorizations(scope))
            _check(caller, SCOPES if needed is None else needed)
        scope["state"] |= {"caller": caller, "admitted_to": route}
        if self._rate is not None and route in RATED:
            self._rate.spend(caller.operator)
        return caller

    def overdraw(self, caller: Caller, count: int) -> None:
        """Let a request that was admitted count as so many more; raises `TooManyRequests`."""
        if self._rate is not None:
            self._rate.overdraw(caller.operator, count)

    async def _bearer(self, keys: KeyStore, authorizations: Sequence[bytes]) -> Caller:
        token = _token_in(authorizations)
        try:
            kid = jwt.get_unverified_header(token).get("kid")
        except (jwt.PyJWTError, ValueError, RecursionError):
            raise Unauthenticated("what follows `Bearer` is not a JSON Web Token", is_invalid=True) from None
        key = await keys.find(kid)
        if key is None:
            raise Unauthenticated("the token is signed with a key that is not known here", is_invalid=True)
        return caller_of(_claims(token, key, self._settings), self._settings.leeway_s)


@contextmanager
def access(settings: Settings, elapsed_ms: Callable[[], int]) -> Iterator[Access]:
    """Yield what tells who asks, whose keys are kept up to date meanwhile; raises `StartupError`."""
    keys = store_of(settings)
    if keys is None:
        yield Access(settings, None, elapsed_ms)
        return
    keys.start()
    try:
        yield Access(settings, keys, elapsed_ms)
    finally:
        keys.stop()


def caller_of(claims: Mapping[str, Any], leeway_s: float = 0.0) -> Caller:
    """Return who a verified token is for; raises `Unauthenticated` where a claim makes no sense."""
    try:
        operator = _OPERATOR.validate_python(claims["sub"])
    except ValidationError:
        raise Unauthenticated("`sub` is not the name of an operator", is_invalid=True) from None
    expires_s = claims["exp"]
    if type(expires_s) not in (int, float):
        raise Unauthenticated("`exp` is not a number", is_invalid=True)
    priority = claims.get(PRIORITY_CLAIM, 0)
    if type(priority) is not int or abs(priority) > HIGHEST_PRIORITY:
        raise Unauthenticated(f"`{PRIORITY_CLAIM}` is not a whole number up to {HIGHEST_PRIORITY}", is_invalid=True)
    given = next((claims[name] for name in _SCOPE_CLAIMS if name in claims), "")
    words = given.split() if isinstance(given, str) else given
    if not isinstance(words, list) or not all(isinstance(word, str) for word in words):
        raise Unauthenticated("the scopes are neither a string nor a list of strings", is_invalid=True)
    return Caller(operator, SCOPES.intersection(words), priority, min(expires_s, _LATEST_S) + leeway_s)


def _claims(token: bytes, key: Key, settings: Settings) -> dict[str, Any]:
    """Return a token's claims once it is verified; raises `Unauthenticated`."""
    try:
        return jwt.decode(
            token,
            key.public,
            algorithms=[key.algorithm],
            audience=settings.audience,
            issuer=settings.issuer,
            leeway=settings.leeway_s,
            options={"require": ["exp", "sub", "aud"]},
        )
    except jwt.InvalidAlgorithmError:
        reason = f"the token is not signed with {key.algorithm}, which its key is for"
    except jwt.InvalidSignatureError:
        reason = "the signature does not fit the token"
    except jwt.PyJWTError as error:
        reason = f"the token is not valid: {error}"
    except (ValueError, TypeError, OverflowError, RecursionError):
        reason = "the token's claims make no sense"
    raise Unauthenticated(reason, is_invalid=True)


def _authorizations(scope: Scope) -> list[bytes]:
    return [value for name, value in scope["headers"] if name == b"authorization"]


def _token_in(authorizations: Sequence[bytes]) -> bytes:
    if not authorizations:
        raise Unauthenticated("send a bearer token: `Authorization: Bearer <token>`")
    scheme, _, token = authorizations[0].partition(b" ")
    if len(authorizations) > 1 or scheme.lower() != b"bearer" or not token.strip():
        raise Unauthenticated("the Authorization header is not `Bearer` and one token")
    if len(token) > _MOST_TOKEN_BYTES:
        raise Unauthenticated(f"tokens may have up to {_MOST_TOKEN_BYTES} bytes", is_invalid=True)
    return token.strip()


def _route_of(method: str, path: str) -> tuple[str, str] | None:
    """Return the route that a request is for, as the table names it; None if there is none."""
    wanted = "GET" if method == "HEAD" else method
    for listed, template, pattern in _PATTERNS:
        if listed == wanted and pattern.match(path):
            return listed, template
    return None


def methods_at(path: str) -> set[str]:
    """Return the methods of the routes that a path leads to: of those that spell it out, if some do."""
    if path in _SPELT_OUT:
        return _SPELT_OUT[path]
    return {method for method, _, pattern in _PATTERNS if pattern.match(path)}


def _check(caller: Caller, needed: frozenset[str]) -> None:
    if not needed & caller.scopes:
        names = " or ".join(sorted(needed))
        raise InsufficientScope(f"this needs a token with the scope {names}", sorted(needed))


async def admitted(request: Request) -> None:
    """Refuse a route that is not the one whose scopes were checked: what the table lacks is nobody's."""
    caller = await of_request(request)
    method, path = request.scope["method"], request.scope["route"].path
    # `/v1/flight-intents/preview` is no flight intent's.
    if request.url.path != path and request.url.path in _SPELT_OUT:
        raise HTTPException(405)
    if caller is not ANYBODY and request.state.admitted_to != ("GET" if method == "HEAD" else method, path):
        raise InsufficientScope("no scope leads here")


async def of_request(request: Request) -> Caller:
    """Return who makes a request."""
    return cast(Caller, request.state.caller)


CallerDep = Annotated[Caller, Depends(of_request)]


def check_listening(settings: Settings) -> None:
    """Refuse to listen beyond loopback without authentication, unless that was asked for explicitly.

    Raises
    ------
    UnsafeListening
    """
    if settings.jwks is None and not is_loopback(settings.host) and not settings.allow_unauthenticated:
        raise UnsafeListening(
            f"refusing to listen on {settings.host}: there is no authentication, so anybody who reaches that address "
            "could plan and cancel flights. Listen on 127.0.0.1, give AIRMATRIX_JWKS, the keys of tokens, or set "
            "AIRMATRIX_ALLOW_UNAUTHENTICATED=true where something else keeps strangers out"
        )
