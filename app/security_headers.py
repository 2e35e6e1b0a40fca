"""What every answer tells browsers not to do with it."""

from collections.abc import Mapping

from starlette.types import ASGIApp, Message, Receive, Scope, Send

# Answers are data: should a browser ever take one for a page, that page can do nothing.
_DATA_POLICY = "default-src 'none'; frame-ancestors 'none'"
_YEAR_S = 365 * 24 * 3600

# What answers say themselves, like the console's files and its policy, stands.
_EVERYWHERE: Mapping[bytes, bytes] = {
    b"content-security-policy": _DATA_POLICY.encode(),
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"referrer-policy": b"no-referrer",
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
}
_NOT_KEPT = (b"cache-control", b"no-store")
_SECURE = (b"strict-transport-security", b"max-age=%d" % _YEAR_S)


def headers_of(path: str, scheme: str) -> dict[bytes, bytes]:
    """Return the headers of answers under a path to requests by http or https."""
    headers = dict(_EVERYWHERE)
    if path.startswith("/v1/"):
        headers.update([_NOT_KEPT])
    if scheme == "https":
        headers.update([_SECURE])
    return headers


class SecurityHeaders:
    """ASGI middleware around whatever answers, the answer to an unexpected error included."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and add the headers that its answer has not."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = headers_of(scope["path"], scope["scheme"])

        async def add(message: Message) -> None:
            if message["type"] == "http.response.start":
                for name, _ in message["headers"]:
                    headers.pop(name, None)
                message["headers"] = [*message["headers"], *headers.items()]
            await send(message)

        await self._app(scope, receive, add)
