"""The keys of tokens: which are taken, and how a service hears of new ones."""

import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import anyio
import pytest
from structlog.testing import capture_logs

from app import keys
from app.errors import StartupError
from app.keys import Key, KeyStore, UnusableKeys, read_keys
from app.main import create_app
from app.service import prepare
from app.settings import Settings
from tests.api.serving import Client, served, settings_for
from tests.api.tokens import Issuer, bearer, issuer, key_set, write_keys
from tests.ledger.district import OLD_TOWN
from tests.ledger.locations import Ledgers, SqliteLedgers
from tests.ledger.process import FakeClock

FLIGHTS = "/v1/flights"
FIRST, SECOND = issuer("first"), issuer("second")


@pytest.fixture
def ledgers(tmp_path: Path) -> Ledgers:
    """Keep to one kind of database: nothing here has to do with that."""
    return SqliteLedgers(tmp_path)


# Sets of keys


def with_members(**members: object) -> bytes:
    """Return a set of one good key with some members changed, those that are None left out."""
    changed = {**FIRST.jwk, **members}
    return json.dumps({"keys": [{name: value for name, value in changed.items() if value is not None}]}).encode()


@pytest.mark.parametrize(
    "content",
    [b"", b"[]", b'"keys"', b"{}", b'{"keys": {}}', b'{"keys": [1]}', b'{"keys": []}', b"[" * 10_000, b"\xff", b"null"],
)
def test_what_is_no_set_of_keys_is_refused(content: bytes) -> None:
    with pytest.raises(UnusableKeys):
        read_keys(content)


@pytest.mark.parametrize(
    ("members", "reason"),
    [
        ({"kty": "oct", "k": "c2VjcmV0"}, "private or secret"),
        ({"d": "AAAA"}, "private or secret"),
        ({"alg": "ES384"}, "neither for RS256 nor for ES256"),
        ({"alg": "HS256"}, "neither for RS256 nor for ES256"),
        ({"use": "enc"}, "neither for RS256 nor for ES256"),
        ({"crv": "P-384"}, "neither for RS256 nor for ES256"),
        ({"kty": []}, "neither for RS256 nor for ES256"),
        ({"kid": 7}, "not a string"),
        ({"x": None}, "malformed"),
        ({"x": FIRST.jwk["y"]}, "malformed"),
    ],
)
def test_a_key_that_cannot_be_used_is_not_used(members: dict[str, object], reason: str) -> None:
    with pytest.raises(UnusableKeys, match=reason):
        read_keys(with_members(**members))


def test_a_short_rsa_key_is_not_used() -> None:
    with pytest.raises(UnusableKeys, match="1024 bits; RSA keys need 2048"):
        read_keys(key_set(issuer("short", "1024")).encode())


def test_keys_for_something_else_do_not_spoil_a_set() -> None:
    items = [{"kty": "OKP", "crv": "Ed25519", "kid": "other", "x": "AAAA"}, FIRST.jwk]
    assert set(read_keys(json.dumps({"keys": items}).encode())) == {"first"}


def test_two_keys_of_one_id_are_refused() -> None:
    with pytest.raises(UnusableKeys, match="same id, 'first'"):
        read_keys(key_set(FIRST, FIRST).encode())


@pytest.mark.parametrize(("kind", "algorithm"), [("EC", "ES256"), ("2048", "RS256")])
def test_a_key_s_kind_says_which_algorithm_it_is_for(kind: str, algorithm: str) -> None:
    (key,) = read_keys(key_set(issuer("one", kind)).encode()).values()
    assert key.algorithm == algorithm


# In a file


@contextmanager
def guarded_by(place: str | Path, ledger: str, folder: Path) -> Iterator[Client]:
    settings = settings_for(OLD_TOWN, ledger, folder, jwks=str(place))
    with served(create_app(settings, FakeClock())) as client:
        yield client


def status_of(api: Client, token: str) -> int:
    return api.get(FLIGHTS, headers=bearer(token)).status_code


def test_an_rsa_token_is_let_in(ledger: str, tmp_path: Path) -> None:
    rsa = issuer("rsa", "2048")
    with guarded_by(write_keys(tmp_path, FIRST, rsa), ledger, tmp_path) as api:
        assert status_of(api, rsa.token()) == 200


def test_a_token_without_key_id_is_let_in_where_there_is_one_key(ledger: str, tmp_path: Path) -> None:
    token = Issuer(None, FIRST.private).token()
    for kid in ("first", None):
        with guarded_by(write_keys(tmp_path, Issuer(kid, FIRST.private)), ledger, tmp_path) as api:
            assert status_of(api, token) == 200
            write_keys(tmp_path, FIRST, SECOND)
            assert status_of(api, token) == 401


def test_a_file_that_changes_is_read_again(ledger: str, tmp_path: Path) -> None:
    with guarded_by(write_keys(tmp_path, FIRST), ledger, tmp_path) as api:
        assert [status_of(api, each.token()) for each in (FIRST, SECOND)] == [200, 401]
        write_keys(tmp_path, FIRST, SECOND)
        assert [status_of(api, each.token()) for each in (FIRST, SECOND)] == [200, 200]
        write_keys(tmp_path, SECOND)
        assert [status_of(api, each.token()) for each in (FIRST, SECOND)] == [401, 200]


@pytest.mark.parametrize("broken", ["removed", "garbage"])
def test_a_file_that_cannot_be_read_any_more_leaves_the_keys(ledger: str, tmp_path: Path, broken: str) -> None:
    path = write_keys(tmp_path, FIRST)
    with guarded_by(path, ledger, tmp_path) as api:
        path.unlink() if broken == "removed" else path.write_text("{", encoding="utf-8")
        assert status_of(api, FIRST.token()) == 200
        write_keys(tmp_path, SECOND)
        assert status_of(api, FIRST.token()) == 401


@pytest.mark.parametrize("content", [None, b"{}", b"x" * 1_100_000])
def test_a_service_does_not_start_without_keys(ledger: str, tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "keys.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(StartupError, match=r"AIRMATRIX_JWKS, .*keys\.json: "):
        prepare(settings_for(OLD_TOWN, ledger, tmp_path, jwks=str(path)))


@pytest.mark.parametrize(
    "place", ["http://keys.example.com/jwks.json", "ftp://127.0.0.1/jwks.json", "file:///jwks.json", "https://"]
)
def test_keys_come_over_no_network_in_the_clear(place: str) -> None:
    with pytest.raises(StartupError, match="by https, or by http from loopback only"):
        keys.store_of(Settings(jwks=place))


def test_what_is_no_address_is_refused() -> None:
    with pytest.raises(StartupError, match="AIRMATRIX_JWKS, http://"):
        keys.store_of(Settings(jwks="http://[::1"))


@pytest.mark.parametrize(
    ("place", "shown"),
    [
        ("https://user:hidden@keys.example.com/jwks.json?key=hidden", "https://keys.example.com/jwks.json"),
        ("http://keys.example.com/jwks.json?key=hidden#hidden", "http://keys.example.com/jwks.json"),
        ("https://user:hidden@[::1", "https://…"),
        ("https://user:hid/den@keys.example.com", "https://…"),
        ("https://hidden@xn--/", "https://…"),
        ("http://127.0.0.1:9/jwks.json?key=hidden", "http://127.0.0.1:9/jwks.json"),
    ],
)
def test_no_error_shows_a_secret_in_an_address(place: str, shown: str) -> None:
    with pytest.raises(StartupError) as refusal:
        keys.store_of(Settings(jwks=place))
    assert str(refusal.value).startswith(f"AIRMATRIX_JWKS, {shown}: ")
    assert "hid" not in str(refusal.value)


# At an address


@dataclass
class Publisher:
    """Answers requests for keys on loopback, as it is told, and counts them."""

    url: str = ""
    status: int = 200
    content: bytes = b""
    asked: int = 0
    open: threading.Event = field(default_factory=threading.Event)


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    published = Publisher(content=key_set(FIRST).encode())
    published.open.set()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            published.asked += 1
            published.open.wait(10)
            self.send_response(published.status)
            self.send_header("Content-Length", str(len(published.content)))
            if published.status == 302:
                self.send_header("Location", published.url)
            self.end_headers()
            # Who has had enough hangs up.
            try:
                self.wfile.write(published.content)
            except OSError:
                self.close_connection = True

        def log_message(self, *_: Any) -> None:
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server, ThreadPoolExecutor(1) as pool:
        published.url = f"http://127.0.0.1:{server.server_address[1]}/jwks.json"
        pool.submit(server.serve_forever, 0.01)
        yield published
        server.shutdown()


@dataclass
class Monotonic:
    now_s: float = 0.0

    def __call__(self) -> float:
        return self.now_s


def finds(store: KeyStore, *kids: str) -> list[Key | None]:
    """Return what several requests at a time find."""
    found: list[Key | None] = [None] * len(kids)

    async def find(index: int, kid: str) -> None:
        found[index] = await store.find(kid)

    async def all_at_once() -> None:
        async with anyio.create_task_group() as group:
            for index, kid in enumerate(kids):
                group.start_soon(find, index, kid)

    anyio.run(all_at_once)
    return found


def test_a_new_key_at_an_address_is_asked_for_when_it_is_first_used(publisher: Publisher) -> None:
    monotonic = Monotonic()
    store = KeyStore(publisher.url, 300, monotonic)
    publisher.content = key_set(FIRST, SECOND).encode()
    monotonic.now_s = 11
    (key,) = finds(store, "second")
    assert key is not None
    assert key.public.public_numbers() == SECOND.private.public_key().public_numbers()


def test_unknown_keys_are_asked_for_every_ten_seconds_at_most(publisher: Publisher) -> None:
    monotonic = Monotonic()
    store = KeyStore(publisher.url, 300, monotonic)
    for now_s, asked in ((9, 1), (10, 2), (11, 2), (19.9, 2), (20, 3)):
        monotonic.now_s = now_s
        assert finds(store, *(f"invented {number}" for number in range(5))) == [None] * 5
        assert publisher.asked == asked


def test_requests_that_wait_for_a_new_key_wait_for_one_answer(publisher: Publisher) -> None:
    monotonic = Monotonic()
    store = KeyStore(publisher.url, 300, monotonic)
    publisher.content = key_set(SECOND).encode()
    monotonic.now_s = 11
    publisher.open.clear()
    threading.Timer(0.2, publisher.open.set).start()
    assert None not in finds(store, *["second"] * 20)
    assert publisher.asked == 2


@pytest.mark.parametrize(("status", "content"), [(500, b""), (200, b"{"), (302, b""), (200, b" " * 1_100_000)])
def test_a_bad_answer_leaves_the_keys(publisher: Publisher, status: int, content: bytes) -> None:
    monotonic = Monotonic()
    store = KeyStore(publisher.url, 300, monotonic)
    publisher.status, publisher.content = status, content
    monotonic.now_s = 11
    unknown, known = finds(store, "second", "first")
    assert (unknown, publisher.asked) == (None, 2)
    assert known is not None


@pytest.mark.parametrize("content", [b'{"keys": []}', b'{"keys": [{"kty": "OKP", "crv": "Ed25519", "kid": "new"}]}'])
def test_an_issuer_that_has_no_usable_key_any_more_has_taken_back_all(publisher: Publisher, content: bytes) -> None:
    monotonic = Monotonic()
    store = KeyStore(publisher.url, 300, monotonic)
    publisher.content, monotonic.now_s = content, 11
    with capture_logs() as logged:
        assert finds(store, "new") == finds(store, "first") == [None]
    assert [entry["log_level"] for entry in logged] == ["error"]
    # Until it has one again.
    publisher.content, monotonic.now_s = key_set(SECOND).encode(), 22
    assert None not in finds(store, "second")


def test_no_address_has_a_user(publisher: Publisher) -> None:
    with pytest.raises(StartupError, match="give no user or password"):
        keys.store_of(Settings(jwks=publisher.url.replace("://", "://user:pw@")))


def test_no_log_shows_a_query(publisher: Publisher) -> None:
    monotonic = Monotonic()
    store = KeyStore(f"{publisher.url}?key=hidden", 300, monotonic)
    with capture_logs() as logged:
        for now_s, content in ((11, b"{"), (22, key_set(SECOND).encode())):
            publisher.content, monotonic.now_s = content, now_s
            finds(store, "second")
    assert [entry["jwks"] for entry in logged] == [publisher.url] * 2


def test_an_address_is_asked_again_from_time_to_time(publisher: Publisher) -> None:
    store = KeyStore(publisher.url, 0.01)
    store.start()
    try:
        publisher.content = key_set(SECOND).encode()
        before = publisher.asked
        # The second answer after the change was asked for after it.
        while publisher.asked < before + 3:
            threading.Event().wait(0.01)
    finally:
        store.stop()
    # Nobody's id has to be unknown for a key to go.
    assert finds(store, "first") == [None]


def test_a_service_takes_its_keys_from_an_address(publisher: Publisher, ledger: str, tmp_path: Path) -> None:
    with guarded_by(publisher.url, ledger, tmp_path) as api:
        assert [status_of(api, each.token()) for each in (FIRST, SECOND)] == [200, 401]


@pytest.mark.parametrize(("status", "reason"), [(404, "answered with status 404"), (None, "does not answer")])
def test_a_service_does_not_start_while_an_address_has_no_keys(
    publisher: Publisher, ledger: str, tmp_path: Path, status: int | None, reason: str
) -> None:
    place = "http://127.0.0.1:9/jwks.json" if status is None else publisher.url
    publisher.status = status or 200
    with pytest.raises(StartupError, match=reason):
        prepare(settings_for(OLD_TOWN, ledger, tmp_path, jwks=place))
