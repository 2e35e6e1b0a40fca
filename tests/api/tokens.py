"""Issuers of tokens: key pairs, the JWKS of their public halves, and tokens good and bad."""

import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jwt
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from app.auth import PLAN, SCOPES

HOUR_S = 3600
PrivateKey = ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey


@dataclass(frozen=True)
class Issuer:
    """A key pair under an id."""

    kid: str | None
    private: PrivateKey

    @property
    def algorithm(self) -> str:
        return "ES256" if isinstance(self.private, ec.EllipticCurvePrivateKey) else "RS256"

    @property
    def pem(self) -> bytes:
        return self.private.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)

    @property
    def jwk(self) -> dict[str, Any]:
        public: Any = self.private.public_key()
        algorithms = jwt.algorithms
        kind = algorithms.ECAlgorithm if self.algorithm == "ES256" else algorithms.RSAAlgorithm
        named = {} if self.kid is None else {"kid": self.kid}
        return {**kind.to_jwk(public, as_dict=True), **named}

    def token(self, operator: object = "acme-air", granted: Iterable[str] = SCOPES, /, **claims: object) -> str:
        """Return a token that is good unless the claims say otherwise; a claim that is None is left out."""
        now = int(time.time())
        given = {"sub": operator, "aud": "airmatrix", "exp": now + HOUR_S, "scope": " ".join(granted), **claims}
        return self.signed({name: value for name, value in given.items() if value is not None})

    def signed(self, claims: Mapping[str, object]) -> str:
        """Return a token with exactly these claims."""
        return jwt.encode(dict(claims), self.private, self.algorithm, {} if self.kid is None else {"kid": self.kid})


@cache
def issuer(kid: str | None = "first", kind: str = "EC") -> Issuer:
    """Return the issuer of that name; RSA keys take a while to make."""
    if kind == "EC":
        return Issuer(kid, ec.generate_private_key(ec.SECP256R1()))
    return Issuer(kid, rsa.generate_private_key(65537, int(kind)))


def key_set(*issuers: Issuer) -> str:
    """Return a JWKS."""
    return json.dumps({"keys": [each.jwk for each in issuers]})


def write_keys(folder: Path, *issuers: Issuer) -> Path:
    """Write a JWKS into a folder, all at once, as careful people do."""
    path, new = folder / "jwks.json", folder / "jwks.json.new"
    new.write_text(key_set(*issuers), encoding="utf-8")
    new.replace(path)
    return path


def bearer(token: str) -> dict[str, str]:
    """Return the headers that a token comes in."""
    return {"Authorization": f"Bearer {token}"}


def as_(operator: str = "acme-air", *scopes: str, **claims: object) -> dict[str, Any]:
    """Return the arguments of a request by an operator, by default one that may plan."""
    return {"headers": bearer(issuer().token(operator, scopes or (PLAN,), **claims))}
