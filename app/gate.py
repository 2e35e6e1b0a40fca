"""What every request passes first: Host and Origin, who asks, the body's size and time, and how much is going on."""

import asyncio

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app import problems
from app.addresses import host_of, is_loopback
from app.errors import (
    BodyTooLarge,
    CrossSiteRequest,
    HostNotAllowed,
    MalformedRequest,
    RequestError,
    RequestTimedOut,
    TooManyConnections,
    TooManyStreams,
    UnsupportedMediaType,
)
from app.service import Service
from app.settings import Settings

# In a request's state: its connection is one more than there may be.
SURPLUS = "is_surplus"

_STREAM = "/v1/airspace/stream"
# After these nothing more is expected of a connection.
_LAST = (RequestTimedOut, TooManyConnections)
# A name has up to 253, and then there is the port.
_HOST_LENGTH = 260
_WITH_BODY = ("POST", "PUT")
_READS = ("GET", "HEAD", "OPTIONS")
# What browsers say of requests by a site's own pages, and of those that nobody's page makes.
_OWN_SITE = ("same-origin", "none")
# More digits than any length has.
_LENGTH_DIGITS = 15


class Gate:
    """ASGI middleware: without authentication only loopback hosts are served, and bodies are bounded and read whole."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._settings = settings
        self._streams = 0
        # Of the routes with bodies that are larger than others', as the table of scopes names them.
        self._most_bytes = {
            ("POST", "/v1/flight-intents"): settings.max_intent_bytes,
            ("POST", "/v1/flight-intents/preview"): settings.max_intent_bytes,
            ("PUT", "/v1/flight-intents/{intent_id}"): settings.max_intent_bytes,
            ("POST", "/v1/flight-intents/batch"): settings.max_batch_bytes,
            ("POST", "/v1/telemetry"): settings.max_telemetry_bytes,
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it with a problem."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        try:
            if scope["state"].get(SURPLUS, False):
                raise TooManyConnections("this process has as many connections as it may")
            self._check_host(scope)
            self._check_site(scope)
            service: Service = scope["state"]["service"]
            await service.access.admit(scope)
            body = await self._body(scope, receive)
            if body:
                _check_media_type(scope)
            self._check_streams(scope)
        except RequestError as error:
            response = problems.response_to(error)
            if isinstance(error, _LAST):
                response.headers["Connection"] = "close"
            await response(scope, receive, send)
            return
        sent = False

        async def replay() -> Message:
            nonlocal sent
            if sent:
                return await receive()
            sent = True
            return {"type": "http.request", "body": body, "more_body": False}

        if scope["path"] != _STREAM:
            await self._app(scope, replay, send)
            return
        self._streams += 1
        try:
            await self._app(scope, replay, send)
        finally:
            self._streams -= 1

    def _check_streams(self, scope: Scope) -> None:
        limit = self._settings.max_streams
        if scope["path"] == _STREAM and self._streams >= limit:
            raise TooManyStreams(f"{limit} streams of this process are open")

    def _check_host(self, scope: Scope) -> None:
        hosts = Headers(scope=scope).getlist("host")
        # Who stands between may have looked at another one than we would.
        if len(hosts) > 1:
            raise MalformedRequest("a request has one Host header")
        header = hosts[0] if hosts else ""
        if len(header) > _HOST_LENGTH:
            raise MalformedRequest(f"the Host header has more than {_HOST_LENGTH} characters")
        is_open = self._settings.jwks is not None or self._settings.allow_unauthenticated
        if not is_open and not is_loopback(host_of(header)):
            raise HostNotAllowed(f"Host {header!r} is not a loopback host, and there is no authentication")

    def _check_site(self, scope: Scope) -> None:
        """Refuse changes that pages of other sites ask for: what has no body browsers send without asking first."""
        if self._settings.jwks is not None or scope["method"] in _READS:
            return
        headers = Headers(scope=scope)
        sites, origins = headers.getlist("sec-fetch-site"), headers.getlist("origin")
        is_own = all(site in _OWN_SITE for site in sites)
        if not sites:
            # Browsers say it only to whom they trust.
            is_own = all(_is_own(origin, headers.get("host", "")) for origin in origins)
        if not is_own:
            raise CrossSiteRequest("a page of another site asks for a change, and there is no authentication")

    async def _body(self, scope: Scope, receive: Receive) -> bytes:
        within_s = self._settings.body_timeout_s
        try:
            async with asyncio.timeout(within_s):
                body = await self._read(scope, receive)
        except TimeoutError as error:
            raise RequestTimedOut(f"the body did not arrive within {within_s:g} s") from error
        try:
            body.decode()
        except UnicodeDecodeError as error:
            raise MalformedRequest(f"the body is not UTF-8: {error.reason} at byte {error.start}") from error
        return body

    async def _read(self, scope: Scope, receive: Receive) -> bytes:
        limit = self._most_bytes.get(scope["state"]["admitted_to"], self._settings.max_body_bytes)
        announced = Headers(scope=scope).get("content-length", "0")
        chunks: list[bytes] = []
        too_large = len(announced) > _LENGTH_DIGITS or (announced.isdecimal() and int(announced) > limit)
        received = 0
        more = True
        while more and not too_large:
            message = await receive()
            if message["type"] == "http.disconnect":
                raise MalformedRequest("the connection ended within the body")
            chunk = message.get("body", b"")
            received += len(chunk)
            too_large = received > limit
            chunks.append(chunk)
            more = message.get("more_body", False)
        if too_large:
            raise BodyTooLarge(f"bodies may have up to {limit} bytes")
        return b"".join(chunks)


def _is_own(origin: str, host: str) -> bool:
    """Tell whether a page comes from this machine, or from where its request goes to."""
    place = origin.partition("://")[2]
    return is_loopback(host_of(place)) or (place != "" and place.lower() == host.lower())


def _check_media_type(scope: Scope) -> None:
    """Refuse bodies that browsers send to other sites without asking those first: any page could write with them."""
    is_known = scope["state"]["admitted_to"] is not None
    media_type = Headers(scope=scope).get("content-type", "").partition(";")[0].strip().lower()
    is_json = media_type == "application/json" or (
        media_type.startswith("application/") and media_type.endswith("+json")
    )
    if is_known and scope["method"] in _WITH_BODY and not is_json:
        raise UnsupportedMediaType(f"bodies are application/json; this one is {media_type or 'of no media type'}")
