"""The API's documentation for browsers, drawn by Swagger UI, whose files come with `fastapi-offline`."""

import base64
import hashlib
import re
from functools import cache

from fastapi import APIRouter, Request
from fastapi.openapi.docs import get_swagger_ui_html
from starlette.responses import HTMLResponse

router = APIRouter(include_in_schema=False)

_FILES = "/static-offline-docs"
# The page starts Swagger UI by a script of its own.
_INLINE = re.compile(r"<script>(.*?)</script>", re.DOTALL)


@router.get("/docs")
async def read_docs(request: Request) -> HTMLResponse:
    """Return the page."""
    content, policy = _page(request.app.title, request.app.openapi_url)
    return HTMLResponse(content, headers={"Content-Security-Policy": policy})


@cache
def _page(title: str, openapi_url: str) -> tuple[bytes, str]:
    """Return the page and the smallest policy under which it works."""
    content = bytes(
        get_swagger_ui_html(
            title=title,
            openapi_url=openapi_url,
            swagger_js_url=f"{_FILES}/swagger-ui-bundle.js",
            swagger_css_url=f"{_FILES}/swagger-ui.css",
            swagger_favicon_url=f"{_FILES}/favicon.png",
            # Otherwise it tells another server where this one is.
            swagger_ui_parameters={"validatorUrl": None},
        ).body
    )
    digests = [hashlib.sha256(script.encode()).digest() for script in _INLINE.findall(content.decode())]
    scripts = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    policy = (
        f"default-src 'none'; script-src 'self' {scripts}; style-src 'self'; img-src 'self' data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return content, policy
