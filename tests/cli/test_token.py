"""`airmatrix token`: keys for local tries, tokens signed with them, and the commands that send these."""

import json
import stat
from pathlib import Path
from typing import Any

import jwt
import pytest

from app.client import Client, MalformedToken, ProblemAnswer
from app.keys import read_keys
from tests.cli.conftest import Run
from tests.cli.serving import serving

SCOPES = ("airmatrix.plan", "airmatrix.monitor", "airmatrix.surveillance")


@pytest.fixture
def folder(airmatrix: Run, tmp_path: Path) -> Path:
    """Return a folder with a key pair."""
    outcome = airmatrix("token", "--init", "keys")
    assert (outcome.status, outcome.out) == (0, "")
    assert "AIRMATRIX_JWKS=keys/jwks.json" in outcome.err
    return tmp_path / "keys"


def printed(airmatrix: Run, folder: Path, *options: str, scopes: tuple[str, ...] = SCOPES) -> str:
    """Return the token that the command prints."""
    scoped = [part for scope in scopes for part in ("--scope", scope)]
    outcome = airmatrix("token", "--key", folder / "private.pem", "--operator", "acme-air", *scoped, *options)
    assert (outcome.status, outcome.err) == (0, "")
    return outcome.out.removesuffix("\n")


def claims_of(token: str, folder: Path, audience: str = "airmatrix") -> dict[str, Any]:
    key = read_keys((folder / "jwks.json").read_bytes())[jwt.get_unverified_header(token)["kid"]]
    return jwt.decode(token, key.public, ["ES256"], audience=audience)


def test_only_its_owner_can_read_the_private_key(folder: Path) -> None:
    assert stat.S_IMODE((folder / "private.pem").stat().st_mode) == 0o600


def test_the_key_set_has_nothing_of_the_private_key(folder: Path) -> None:
    (key,) = json.loads((folder / "jwks.json").read_text(encoding="utf-8"))["keys"]
    assert set(key) == {"kty", "crv", "x", "y", "kid", "alg", "use"}


def test_keys_are_never_overwritten(airmatrix: Run, folder: Path) -> None:
    before = (folder / "private.pem").read_bytes()
    airmatrix("token", "--init", "keys").assert_refused("private.pem is there already")
    assert (folder / "private.pem").read_bytes() == before


def test_a_token_says_who_may_do_what_for_how_long(airmatrix: Run, folder: Path) -> None:
    token = printed(airmatrix, folder, "--hours", "2", "--max-priority", "7")
    claims = claims_of(token, folder)
    assert claims.pop("exp") - claims.pop("iat") == 7200
    assert claims == {
        "sub": "acme-air", "aud": "airmatrix", "scope": " ".join(SCOPES), "airmatrix_max_priority": 7,
    }  # fmt: skip


def test_a_token_is_for_the_audience_of_the_settings(
    airmatrix: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AIRMATRIX_AUDIENCE", "elsewhere")
    monkeypatch.setenv("AIRMATRIX_ISSUER", "me")
    claims = claims_of(printed(airmatrix, folder), folder, audience="elsewhere")
    assert claims["iss"] == "me"
    assert "airmatrix_max_priority" not in claims


@pytest.mark.parametrize("content", [None, b"", b"-----BEGIN PRIVATE KEY-----\n-----END PRIVATE KEY-----\n"])
def test_what_is_no_private_key_is_refused(airmatrix: Run, tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "key.pem").write_bytes(content)
    outcome = airmatrix("token", "--key", "key.pem", "--operator", "acme-air", "--scope", "airmatrix.plan")
    outcome.assert_refused("cannot sign with key.pem")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--operator", "acme-air", "--scope", "airmatrix.plan"], "--key"),
        (["--key", "x", "--scope", "airmatrix.plan"], "--operator"),
        (["--key", "x", "--operator", "acme-air"], "--scope"),
        (["--key", "x", "--operator", "acme-air", "--scope", "airmatrix.fly"], "airmatrix.fly"),
        (["--init", "keys", "--key", "x"], "--init"),
    ],
)
def test_options_that_make_no_token_are_misuse(airmatrix: Run, options: list[str], named: str) -> None:
    airmatrix("token", *options).assert_misused(named)


@pytest.mark.parametrize("name", ["", " ", "a\nb", "a" * 201])
def test_a_name_that_no_operator_has_is_misuse(airmatrix: Run, name: str) -> None:
    airmatrix("token", "--key", "x", "--operator", name, "--scope", "airmatrix.plan").assert_misused("--operator")


@pytest.mark.parametrize("token", ["", "two words", "a\nb", "é"])
def test_a_client_sends_no_token_that_is_none(token: str) -> None:
    with pytest.raises(MalformedToken) as refusal:
        Client(token=token)
    assert token == "" or token not in str(refusal.value)


def test_commands_send_their_token_which_nobody_logs(
    airmatrix: Run, folder: Path, tmp_path: Path, town_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = str(folder / "jwks.json")
    token = printed(airmatrix, folder)
    with serving(tmp_path, "--airspace", str(town_file), AIRMATRIX_JWKS=keys, AIRMATRIX_LOG_LEVEL="debug") as server:
        url = server.url
        flights = ("--flights", "3", "--window", "600", "--url", url)
        airmatrix("simulate", *flights).assert_refused("401 No valid token")
        assert airmatrix("simulate", *flights, "--token", token).table["accepted"] == "3"
        monkeypatch.setenv("AIRMATRIX_TOKEN", token)
        load = ("--clients", "2", "--duration", "0.5", "--warm-up", "0", "--limit", "2", "--url", url)
        assert airmatrix("load", *load).table["accepted"].startswith("2,")
        assert airmatrix("fly", "--duration", "0.1", "--url", url).status == 0
        with Client(url, token=token) as client:
            assert {intent.operator for intent in client.flight_intents()} == {"acme-air"}
        with Client(url) as client, pytest.raises(ProblemAnswer) as refusal:
            list(client.flight_intents())
        assert refusal.value.reason == "unauthenticated"
        said = server.log.read_text(encoding="utf-8")
    assert not any(part in said for part in token.split("."))
