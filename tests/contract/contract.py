"""The OpenAPI document as schemathesis is to read it, with and without authentication."""

import copy
import tomllib
from pathlib import Path
from typing import Any

import schemathesis
from schemathesis.config import SchemathesisConfig
from schemathesis.specs.openapi.schemas import OpenApiSchema

from app.main import create_app
from app.settings import Settings
from tests.contract import checks

CONFIGURATION = Path(__file__).with_name("schemathesis.toml")
DOCUMENT: dict[str, Any] = create_app(Settings()).openapi()


def without_security(document: dict[str, Any]) -> dict[str, Any]:
    """Return what a document says where authentication is off: nobody needs a token, or is refused for want of one."""
    plain = copy.deepcopy(document)
    del plain["components"]["securitySchemes"]
    for path in plain["paths"].values():
        for operation in path.values():
            if operation.pop("security", None) is not None:
                for code in ("401", "403", "429"):
                    operation["responses"].pop(code, None)
    return plain


def contract(document: dict[str, Any], **options: Any) -> OpenApiSchema:
    """Return a document for schemathesis, with options beyond those of the configuration file."""
    configured = tomllib.loads(CONFIGURATION.read_text(encoding="utf-8"))
    assert configured.pop("hooks") == checks.__name__
    return schemathesis.openapi.from_dict(document, config=SchemathesisConfig.from_dict(configured | options))
