"""What every request passes first: the Host header and the size of the body."""

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app import auth, problems
from app.errors import BodyTooLarge, HostNotAllowed, MalformedRequest, RequestError
from app.settings import Settings

_TELEMETRY = "/v1/telemetry"
# More digits than any length has.
_LENGTH_DIGITS = 15


class Gate:
    """ASGI middleware: without authentication only loopback hosts are served, and bodies are bounded and read whole."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._settings = settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it with a problem."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        try:
            self._check_host(Headers(scope=scope).get("host", ""))
            body = await self._body(scope, receive)
        except RequestError as error:
            await problems.response_to(error)(scope, receive, send)
            return
        sent = False

        async def replay() -> Message:
            nonlocal sent
            if sent:
                return await receive()
            sent = True
            return {"type": "http.request", "body": body, "more_body": False}

        await self._app(scope, replay, send)

    def _check_host(self, header: str) -> None:
        if not self._settings.allow_unauthenticated and not auth.is_loopback(auth.host_of(header)):
            raise HostNotAllowed(f"Host {header!r} is not a loopback host, and there is no authentication")

    async def _body(self, scope: Scope, receive: Receive) -> bytes:
        settings = self._settings
        limit = settings.max_telemetry_bytes if scope["path"] == _TELEMETRY else settings.max_body_bytes
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
        body = b"".join(chunks)
        try:
            body.decode()
        except UnicodeDecodeError as error:
            raise MalformedRequest(f"the body is not UTF-8: {error.reason} at byte {error.start}") from error
        return body
