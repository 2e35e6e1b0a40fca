"""How the console's files are served."""

import pytest

from tests.api.serving import Client

pytestmark = pytest.mark.compiled

_VENDOR = "/console/vendor/maplibre-gl.js"


@pytest.mark.parametrize(
    ("path", "media_type", "caching"),
    [
        ("/", "text/html; charset=utf-8", "no-cache"),
        ("/console/main.js", "text/javascript; charset=utf-8", "no-cache"),
        ("/console/style.css", "text/css; charset=utf-8", "no-cache"),
        ("/console/icon.svg", "image/svg+xml", "no-cache"),
        (_VENDOR, "text/javascript; charset=utf-8", "public, max-age=86400"),
        ("/console/vendor/maplibre-gl.css", "text/css; charset=utf-8", "public, max-age=86400"),
    ],
)
def test_files_come_with_their_type_caching_and_a_strict_policy(
    client: Client, path: str, media_type: str, caching: str
) -> None:
    response = client.get(path)
    assert response.status_code == 200
    assert response.headers["content-type"] == media_type
    assert response.headers["cache-control"] == caching
    assert response.headers["x-content-type-options"] == "nosniff"
    policy = dict(part.strip().split(" ", 1) for part in response.headers["content-security-policy"].split(";"))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert "unsafe" not in response.headers["content-security-policy"]


def test_a_file_that_has_not_changed_is_not_sent_again(client: Client) -> None:
    tag = client.get(_VENDOR).headers["etag"]
    again = client.get(_VENDOR, headers={"If-None-Match": tag})
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["cache-control"] == "public, max-age=86400"
    assert client.request("HEAD", "/").status_code == 200


@pytest.mark.parametrize(
    "path",
    [
        "/console/nothing.js", "/console/", "/console/%2e%2e", "/console/%2e%2e%2fmain.py", "/console/a%00b",
        f"/console/{'x' * 300}", "/console/vendor/nothing.js", "/console/vendor/%2e%2e%2f__init__.py",
    ],
)  # fmt: skip
def test_nothing_else_is_served(client: Client, path: str) -> None:
    response = client.get(path)
    assert (response.status_code, response.json()["type"]) == (404, "/problems/not-found")
