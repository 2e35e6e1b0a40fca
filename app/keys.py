"""The public keys that tokens are verified with: a JWKS (RFC 7517), from a file or an address, as it is at present.

Nothing here sees a token.
"""

import asyncio
import base64
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import httpx
import jwt
import orjson
import structlog
from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePublicKey
from cryptography.hazmat.primitives.asymmetric.rsa import RSAPublicKey

from app.addresses import is_loopback
from app.errors import StartupError
from app.settings import Settings

log = structlog.get_logger()

Algorithm = Literal["RS256", "ES256"]

_MOST_BYTES = 1024 * 1024
_MOST_KEYS = 200
_TIMEOUT_S = 5.0
_STOP_S = 1.0
# Who invents key ids must not make us ask more often than this.
_ASK_AGAIN_S = 10.0
_SHORTEST_RSA_BITS = 2048
_ALGORITHMS: Mapping[tuple[object, object], Algorithm] = {("RSA", None): "RS256", ("EC", "P-256"): "ES256"}
_PRIVATE = ("d", "p", "q", "dp", "dq", "qi", "k")


class UnusableKeys(Exception):
    """Not a set of keys, or none that can be used."""


class NoUsableKey(UnusableKeys):
    """A set of keys, none of which can be used."""


@dataclass(frozen=True)
class Key:
    """A public key, and the one algorithm that it is used with."""

    algorithm: Algorithm
    public: RSAPublicKey | EllipticCurvePublicKey


Keys = Mapping[str | None, Key]


def read_keys(content: bytes) -> Keys:
    """Return a set's usable keys by their ids; others, such as those for encryption, are passed over.

    Raises
    ------
    UnusableKeys
        A `NoUsableKey` if this is a set of keys all the same.
    """
    try:
        items = orjson.loads(content)["keys"]
    except (orjson.JSONDecodeError, KeyError, TypeError):
        raise UnusableKeys("not a JSON object with a list of `keys`") from None
    if not isinstance(items, list) or len(items) > _MOST_KEYS or not all(isinstance(item, dict) for item in items):
        raise UnusableKeys(f"`keys` is not a list of up to {_MOST_KEYS} objects")
    keys: dict[str | None, Key] = {}
    flaws = []
    for item in items:
        try:
            kid, key = _key(item)
        except UnusableKeys as flaw:
            flaws.append(str(flaw))
            continue
        if kid in keys:
            raise UnusableKeys(f"two keys have the same id, {kid!r}")
        keys[kid] = key
    if not keys:
        raise NoUsableKey("no usable key" + "".join(f"; {flaw}" for flaw in flaws[:3]))
    return keys


def thumbprint(public: EllipticCurvePublicKey) -> str:
    """Return the id that a P-256 key has by itself (RFC 7638)."""
    members = jwt.algorithms.ECAlgorithm.to_jwk(public, as_dict=True)
    canonical = orjson.dumps({name: members[name] for name in ("crv", "kty", "x", "y")}, option=orjson.OPT_SORT_KEYS)
    return base64.urlsafe_b64encode(sha256(canonical).digest()).decode().rstrip("=")


def _key(item: Mapping[str, Any]) -> tuple[str | None, Key]:
    kid = item.get("kid")
    if kid is not None and not isinstance(kid, str):
        raise UnusableKeys("a key's id is not a string")
    name = "a key without an id" if kid is None else f"key {kid[:100]!r}"
    if any(part in item for part in _PRIVATE):
        raise UnusableKeys(f"{name} is a private or secret key, which belongs nowhere near here")
    kty = item.get("kty")
    algorithm = _ALGORITHMS.get((kty, item.get("crv") if kty == "EC" else None)) if isinstance(kty, str) else None
    if algorithm is None or item.get("alg", algorithm) != algorithm or item.get("use", "sig") != "sig":
        raise UnusableKeys(f"{name} is neither for RS256 nor for ES256")
    try:
        public = jwt.PyJWK(dict(item), algorithm).key
    except (jwt.PyJWTError, ValueError, TypeError, KeyError):
        raise UnusableKeys(f"{name} is malformed") from None
    if isinstance(public, RSAPublicKey) and public.key_size < _SHORTEST_RSA_BITS:
        raise UnusableKeys(f"{name} has {public.key_size} bits; RSA keys need {_SHORTEST_RSA_BITS}")
    return kid, Key(algorithm, public)


class KeyStore:
    """The keys at a place, read again when they may have changed; what cannot be read leaves those that are known.

    A set without usable keys can be read: it takes back all that are known. Raises `StartupError` where there are none
    to begin with.
    """

    def __init__(self, place: str, refresh_s: float, monotonic: Callable[[], float] = time.monotonic) -> None:
        self._place = place
        self._is_address = _is_address(place)
        self._shown = _without_query(place) if self._is_address else place
        self._refresh_s = refresh_s
        self._monotonic = monotonic
        self._tried_s = monotonic()
        self._fetching: asyncio.Task[None] | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._refresh, name="keys", daemon=True)
        self._stamp = self._stamp_now()
        try:
            self._keys = self._read()
        except UnusableKeys as error:
            raise StartupError(f"AIRMATRIX_JWKS, {self._shown}: {error}") from error

    def start(self) -> None:
        """Ask an address again from time to time."""
        if self._is_address:
            self._thread.start()

    def stop(self) -> None:
        """Ask no more."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(_STOP_S)

    async def find(self, kid: str | None) -> Key | None:
        """Return the key of an id; without one, the only key. An unknown id may be a new key's: then ask again."""
        if not self._is_address:
            self._reread_if_changed()
        key = self._known(kid)
        if key is None and self._is_address:
            await self._ask_again()
            key = self._known(kid)
        return key

    def _known(self, kid: str | None) -> Key | None:
        keys = self._keys
        if kid is None and len(keys) == 1:
            return next(iter(keys.values()))
        return keys.get(kid)

    def _reread_if_changed(self) -> None:
        stamp = self._stamp_now()
        if stamp != self._stamp:
            self._stamp = stamp
            self._renew()

    def _stamp_now(self) -> object:
        """Return what changes with a file; None of an address, or where there is no file."""
        if self._is_address:
            return None
        with suppress(OSError, ValueError):
            found = Path(self._place).stat()
            return found.st_mtime_ns, found.st_size, found.st_ino
        return None

    async def _ask_again(self) -> None:
        """Ask for the keys unless that was done a moment ago; who comes meanwhile waits for the same answer."""
        if self._fetching is None:
            if self._monotonic() - self._tried_s < _ASK_AGAIN_S:
                return
            self._tried_s = self._monotonic()
            # Not in the threads of plain routes: strangers can cause this.
            self._fetching = asyncio.create_task(asyncio.to_thread(self._renew))
            self._fetching.add_done_callback(self._fetched)
        await asyncio.shield(self._fetching)

    def _fetched(self, _: "asyncio.Task[None]") -> None:
        self._fetching = None

    def _refresh(self) -> None:
        while not self._stopping.wait(self._refresh_s):
            self._renew()

    def _renew(self) -> None:
        try:
            keys = self._read()
        except NoUsableKey as error:
            with suppress(OSError, ValueError):
                log.error("there are no keys any more; no token is accepted", jwks=self._shown, error=str(error))
            self._keys = {}
            return
        except Exception as error:
            # Whatever is wrong there: with the keys that are known, tokens can be verified.
            with suppress(OSError, ValueError):
                log.warning("keys could not be read again; those known stay in use", jwks=self._shown, error=str(error))
            return
        if keys.keys() != self._keys.keys():
            with suppress(OSError, ValueError):
                log.info("keys have changed", jwks=self._shown, ids=list(keys))
        self._keys = keys

    def _read(self) -> Keys:
        return read_keys(_fetch(self._place) if self._is_address else _read_file(self._place))


def store_of(settings: Settings) -> KeyStore | None:
    """Return the keys that the settings name, None where authentication is off; raises `StartupError`."""
    return None if settings.jwks is None else KeyStore(settings.jwks, settings.jwks_refresh_s)


def _is_address(place: str) -> bool:
    """Tell an address from a file's path; raises `StartupError` for one that strangers could answer for."""
    scheme, is_address, _ = place.partition("://")
    if not is_address:
        return False
    try:
        url = httpx.URL(place)
        host = url.host
    except (httpx.InvalidURL, UnicodeError):
        # Not what it is nor where it is wrong: there may be a password in it.
        raise StartupError(f"AIRMATRIX_JWKS, {scheme}://…: cannot be parsed") from None
    if url.userinfo:
        raise StartupError(f"AIRMATRIX_JWKS, {_without_query(place)}: keys are public; give no user or password")
    if not host or not (url.scheme == "https" or (url.scheme == "http" and is_loopback(host))):
        raise StartupError(
            f"AIRMATRIX_JWKS, {_without_query(place)}: keys are fetched by https, or by http from loopback only"
        )
    return True


def _without_query(address: str) -> str:
    """Return of an address what may be shown: a query, a user or a password may be secret."""
    return str(httpx.URL(address).copy_with(username="", password="", query=None, fragment=None))


def _read_file(path: str) -> bytes:
    try:
        with Path(path).open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise UnusableKeys(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    return _bounded(content)


def _fetch(url: str) -> bytes:
    """Return what an address answers within the time and size that there is for it; redirections are not followed."""
    until = time.monotonic() + _TIMEOUT_S
    content = b""
    try:
        with httpx.stream("GET", url, timeout=_TIMEOUT_S, headers={"Accept-Encoding": "identity"}) as response:
            if response.status_code != httpx.codes.OK:
                raise UnusableKeys(f"answered with status {response.status_code}")
            for chunk in response.iter_raw():
                content = _bounded(content + chunk)
                if time.monotonic() > until:
                    raise UnusableKeys(f"takes longer than {_TIMEOUT_S:g} s to answer")
    except httpx.HTTPError as error:
        raise UnusableKeys(f"does not answer: {str(error) or type(error).__name__}") from error
    return content


def _bounded(content: bytes) -> bytes:
    if len(content) > _MOST_BYTES:
        raise UnusableKeys(f"has more than {_MOST_BYTES} bytes")
    return content
