"""`make contract`: schemathesis at length against a service without authentication, then against one with it."""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from app import logs
from app.settings import Settings
from tests.api.tokens import issuer, write_keys
from tests.contract.contract import CONFIGURATION, DOCUMENT, without_security
from tests.contract.running import running

PRIORITY = 1000


def main() -> int:
    """Run both; 0 if nothing was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--examples", type=int, default=150, help="of each operation")
    parser.add_argument("--seed", type=int, default=6)
    asked = parser.parse_args()
    logs.configure(Settings(log_level="error"))
    failed = 0
    with TemporaryDirectory(prefix="airmatrix-contract-") as name:
        folder = Path(name)
        plain = folder / "plain.json"
        plain.write_text(json.dumps(without_security(DOCUMENT)), encoding="utf-8")
        print("Without authentication", flush=True)
        with running(folder) as url:
            failed += _schemathesis(plain, url, asked)
        guarded = folder / "guarded.json"
        guarded.write_text(json.dumps(DOCUMENT), encoding="utf-8")
        print("\nWith authentication", flush=True)
        token = issuer().token(airmatrix_max_priority=PRIORITY)
        jwks = str(write_keys(folder, issuer()))
        with running(folder, ledger=str(folder / "guarded.sqlite"), jwks=jwks) as url:
            failed += _schemathesis(guarded, url, asked, "--header", f"Authorization: Bearer {token}")
    return min(failed, 1)


def _schemathesis(document: Path, url: str, asked: argparse.Namespace, *options: str) -> int:
    command = [
        str(Path(sys.executable).with_name("schemathesis")), "--config-file", str(CONFIGURATION), "run", str(document),
        "--url", url, "--max-examples", str(asked.examples), "--seed", str(asked.seed), *options,
    ]  # fmt: skip
    # It has nothing to tell anybody, and nothing of it is kept.
    return subprocess.run(command, env={**os.environ, "PYTHONPATH": str(Path.cwd())}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
