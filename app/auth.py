"""Who is asking. Until tokens exist: nobody, so the service keeps to loopback."""

import ipaddress

from app.errors import UnsafeListening
from app.settings import Settings


def is_loopback(host: str) -> bool:
    """Tell whether a host name or address is this machine's loopback."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.removeprefix("[").removesuffix("]")).is_loopback
    except ValueError:
        return False


def host_of(header: str) -> str:
    """Return the host of a Host header, without its port."""
    if header.startswith("["):
        return header.partition("]")[0] + "]"
    return header.partition(":")[0]


def check_listening(settings: Settings) -> None:
    """Refuse to listen beyond loopback without authentication, unless that was asked for explicitly.

    Raises
    ------
    UnsafeListening
    """
    if not is_loopback(settings.host) and not settings.allow_unauthenticated:
        raise UnsafeListening(
            f"refusing to listen on {settings.host}: there is no authentication, so anybody who reaches that address "
            "could plan and cancel flights. Listen on 127.0.0.1, or set AIRMATRIX_ALLOW_UNAUTHENTICATED=true where "
            "something else keeps strangers out"
        )
