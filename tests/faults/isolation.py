"""Wrappers that let a service see other disks than we do, or fewer rights; none needs more than a Linux user has."""

import os
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path

_OWN_MOUNTS = ("unshare", "--user", "--map-root-user", "--mount", "--propagation", "private")


class Unavailable(Exception):
    """This system does not let a fault be made; the text says what is missing."""


def with_small_disk(folder: Path, megabytes: int) -> Sequence[str]:
    """Return a wrapper in which a folder is an empty disk of this size; reach it from outside by `seen_by`."""
    return _mounted('mount -t tmpfs -o size="$2"m small-disk "$1"', folder, str(megabytes))


def with_read_only_disk(folder: Path) -> Sequence[str]:
    """Return a wrapper in which a folder is mounted read-only."""
    return _mounted('mount --bind "$1" "$1" && mount -o remount,ro,bind "$1"', folder, "")


def without_rights() -> Sequence[str]:
    """Return a wrapper in which file modes count for root too."""
    wrapper = () if os.geteuid() else ("setpriv", "--bounding-set=-dac_override,-dac_read_search")
    if not _works(*wrapper, "true"):
        raise Unavailable("root ignores file modes here, and setpriv cannot take that right away")
    return wrapper


def seen_by(process: "subprocess.Popen[bytes]", path: Path) -> Path:
    """Return where we find what a process sees at a path."""
    return Path(f"/proc/{process.pid}/root{path}")


def _mounted(mount: str, *arguments: object) -> Sequence[str]:
    if not _works(*_OWN_MOUNTS, "mount", "-t", "tmpfs", "none", "/mnt"):
        raise Unavailable("this system lets users have no mounts of their own (unshare --user --mount)")
    return (*_OWN_MOUNTS, "sh", "-c", f'{mount} && shift {len(arguments)} && exec "$@"', "sh", *map(str, arguments))


@cache
def _works(*command: str) -> bool:
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False
