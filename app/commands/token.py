"""`airmatrix token`: tokens for local tries, from a key pair of one's own. Real ones come from a real issuer."""

import os
import time
from pathlib import Path
from typing import Annotated, Any

import jwt
import orjson
import typer
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from pydantic import TypeAdapter, ValidationError

from app.auth import HIGHEST_PRIORITY, PRIORITY_CLAIM, SCOPES
from app.commands.terminal import remark, write
from app.errors import StartupError
from app.keys import thumbprint
from app.labels import Label
from app.settings import Settings

Token = Annotated[
    str | None, typer.Option(envvar="AIRMATRIX_TOKEN", help="The token to send, where the service asks for one.")
]

_LONGEST_H = 24.0 * 366
_PRIVATE, _PUBLIC = "private.pem", "jwks.json"
_OWNER_ONLY = 0o600


def print_token(
    init: Annotated[
        Path | None, typer.Option(help=f"Make a key pair in this folder: {_PRIVATE}, and {_PUBLIC} for AIRMATRIX_JWKS.")
    ] = None,
    key: Annotated[Path | None, typer.Option(help="The private key to sign with.")] = None,
    operator: Annotated[str | None, typer.Option(help="Who the token is for.")] = None,
    scope: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(sorted(SCOPES))}; repeat it.")] = None,
    hours: Annotated[float, typer.Option(min=0.001, max=_LONGEST_H, help="How long it is valid.")] = 1.0,
    max_priority: Annotated[
        int | None, typer.Option(min=-HIGHEST_PRIORITY, max=HIGHEST_PRIORITY, help="Highest priority.  [default: 0]")
    ] = None,
) -> None:
    """Print a token for an operator, signed with a key of one's own; before that, make the key.

    Audience and issuer are those of the settings, AIRMATRIX_AUDIENCE and AIRMATRIX_ISSUER.
    """
    if init is not None:
        if key is not None or operator is not None or scope:
            raise typer.BadParameter("makes a key and nothing else; print a token with --key then", param_hint="--init")
        _make_keys(init)
        return
    if key is None or operator is None or not scope:
        raise typer.BadParameter("a token needs --key, --operator and --scope", param_hint="--key")
    unknown = [name for name in scope if name not in SCOPES]
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is none of {', '.join(sorted(SCOPES))}", param_hint="--scope")
    try:
        TypeAdapter(Label).validate_python(operator)
    except ValidationError as error:
        raise typer.BadParameter(
            "an operator's name has 1 to 200 characters, not only blanks, and no control characters",
            param_hint="--operator",
        ) from error
    settings = Settings()
    now = time.time()
    claims: dict[str, Any] = {
        "sub": operator,
        "aud": settings.audience,
        "scope": " ".join(scope),
        "iat": int(now),
        "exp": int(now + hours * 3600),
    }
    if settings.issuer is not None:
        claims["iss"] = settings.issuer
    if max_priority is not None:
        claims[PRIORITY_CLAIM] = max_priority
    private = _read(key)
    typer.echo(jwt.encode(claims, private, "ES256", {"kid": thumbprint(private.public_key())}))


def _make_keys(folder: Path) -> None:
    """Write a key pair; raises `StartupError`, also where there is one already."""
    private = ec.generate_private_key(ec.SECP256R1())
    pem = private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Nobody else can read it at any moment, and no other key is overwritten.
        descriptor = os.open(folder / _PRIVATE, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _OWNER_ONLY)
    except FileExistsError as error:
        raise StartupError(f"{error.filename} is there already; remove it, or sign with it") from error
    except (OSError, ValueError) as error:
        raise StartupError(f"cannot write to {folder}: {getattr(error, 'strerror', None) or error}") from error
    with os.fdopen(descriptor, "wb") as file:
        file.write(pem)
    public = private.public_key()
    members = jwt.algorithms.ECAlgorithm.to_jwk(public, as_dict=True)
    jwk = {**members, "kid": thumbprint(public), "alg": "ES256", "use": "sig"}
    write(folder / _PUBLIC, orjson.dumps({"keys": [jwk]}, option=orjson.OPT_INDENT_2) + b"\n")
    remark("keys", "green", f"sign with {folder / _PRIVATE}; serve with AIRMATRIX_JWKS={folder / _PUBLIC}")


def _read(path: Path) -> ec.EllipticCurvePrivateKey:
    try:
        private = load_pem_private_key(path.read_bytes(), password=None)
    except (OSError, ValueError, TypeError, UnsupportedAlgorithm) as error:
        reason = getattr(error, "strerror", None) or "it is no private key without a password, in PEM"
        raise StartupError(f"cannot sign with {path}: {reason}") from error
    if not isinstance(private, ec.EllipticCurvePrivateKey) or not isinstance(private.curve, ec.SECP256R1):
        raise StartupError(f"cannot sign with {path}: it is no P-256 key; make one with --init")
    return private
