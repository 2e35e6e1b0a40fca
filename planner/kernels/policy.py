"""The one place where kernels are compiled.

numba's cache notices a change of the file a kernel stands in, but neither of its callees' files nor of the
bounds-check flag, and then runs stale machine code. So each state of the sources has a cache folder of its own.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

Kernel = TypeVar("Kernel", bound=Callable[..., object])

_config = cast(Any, numba).config


def cache_folder(boundscheck: object) -> Path:
    """Return the folder for machine code compiled from these very sources with this numba and this flag."""
    here = Path(__file__).parent
    digest = hashlib.sha256(f"{numba.__version__} boundscheck={boundscheck}".encode())
    for source in sorted(here.glob("*.py")):
        digest.update(source.read_bytes())
    if _config.CACHE_DIR:
        root = Path(_config.CACHE_DIR)
    elif os.access(here, os.W_OK):
        root = here / "__pycache__"
    else:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "airmatrix"
    return root / digest.hexdigest()[:16]


_CACHE_FOLDER = cache_folder(_config.BOUNDSCHECK)


def is_compiled() -> bool:
    """Tell whether machine code of the present sources is in the cache."""
    return any(_CACHE_FOLDER.rglob("*.nbc"))


def kernel(function: Kernel) -> Kernel:
    """Compile without fastmath, without the GIL, cached. Kernels never divide by zero, so errors follow numpy.

    A kernel makes no arrays, so nothing in it needs numba's reference counting, which took half of a search's time
    (docs/decisions/0010); its callers hold the arrays.
    """
    return _compile(function, _nrt=False)


def allocating_kernel(function: Kernel) -> Kernel:
    """Compile likewise a kernel that makes arrays."""
    return _compile(function)


def _compile(function: Kernel, **options: Any) -> Kernel:
    before = _config.CACHE_DIR
    _config.CACHE_DIR = str(_CACHE_FOLDER)
    try:
        return cast(Kernel, cast(Any, numba).njit(cache=True, nogil=True, error_model="numpy", **options)(function))
    finally:
        _config.CACHE_DIR = before
