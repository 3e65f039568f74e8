"""How kernels are compiled: cached on disk, without the interpreter's lock, never fastmath.

numba keeps what it compiled under the file of the function alone. A kernel made of others would go on with
what they were before they changed, and an upgrade with old code: so each module's kernels have a folder of
their own, named after its source and that of all it imports from here.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from llvmlite.binding import get_host_cpu_features, get_host_cpu_name

njit: Any = numba.njit  # its types leave out the option below
config: Any = numba.config
unliteral: Any = numba.types.unliteral
F = TypeVar("F", bound=Callable[..., Any])
PACKAGE = Path(__file__).parent
IMPORTED = re.compile(
    r"^ *(?:from|import) +(specshield[\w.]*)(?: +import +(\([^)]*\)|[^\n]*))?", re.MULTILINE
)


def _base() -> Path:
    """Where kernels are kept: NUMBA_CACHE_DIR, else the package, else the user's folder of caches."""
    if config.CACHE_DIR:
        return Path(config.CACHE_DIR)
    if os.access(PACKAGE, os.W_OK):
        return PACKAGE / "__pycache__"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "specshield"


BASE = _base()


def kernel(function: F) -> F:
    """A compiled function that may allocate."""
    compiled: F = _cached(function, {"nogil": True})
    return compiled


def leaf(function: F) -> F:
    """A compiled function that allocates nothing: called in inner loops, with structs of arrays.

    numba counts a reference for each array of a struct at each call, with atomic operations: most of
    a rollout's time. What allocates nothing needs no counting. The option is not in numba's manual; where it
    is gone, the kernels are slower and the same.
    """
    return _leaf(function)


def inlined(function: F) -> F:
    """A leaf that becomes part of its callers: a call copies a struct's hundred words, in an inner loop most
    of its time.
    """
    return _leaf(function, forceinline=True)


def merged(function: F) -> F:
    """A kernel that is written into the one that calls it: each that is compiled by itself, with all that it
    calls, costs seconds.
    """
    compiled: F = njit(inline="always")(function)
    return compiled


def mark(name: str) -> Path | None:
    """A file to be made once everything called `name` is compiled: another where the sources, the processor
    or numba are others. None where no kernel can be kept.
    """
    made_of = [hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(PACKAGE.rglob("*.py"))]
    made_of += [numba.__version__, sys.version, get_host_cpu_name(), get_host_cpu_features().flatten()]
    digest = hashlib.sha256("".join(made_of).encode()).hexdigest()[:16]
    try:
        BASE.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return BASE / f"{name}-{digest}" if os.access(BASE, os.W_OK) else None


def on_disk() -> int:
    """How many kernels are kept."""
    return sum(1 for _ in BASE.rglob("*.nbi"))


def _leaf(function: F, **options: bool) -> F:
    fast = {"nogil": True, "error_model": "numpy", **options}
    try:
        compiled: F = _cached(function, {**fast, "_nrt": False})
    except (KeyError, TypeError):
        compiled = _cached(function, fast)
    return compiled


def _cached(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Compiles a function once for each combination of types it is called with.

    A number that is written in a call counts as any other of its type. Left alone, numba compiles the callee
    once more for each such number, which took a sixth of all the time that compiling takes.
    """
    before = config.CACHE_DIR
    if function.__module__.startswith("specshield."):
        config.CACHE_DIR = _folder(function.__module__) or before
    try:
        compiled = njit(cache=True, **options)(function)
    finally:
        config.CACHE_DIR = before
    template = compiled.get_call_template
    compiled.get_call_template = lambda args, kws: template([unliteral(arg) for arg in args], kws)
    return compiled


@cache
def _folder(module: str) -> str | None:
    """Where a module's kernels are kept, None where it cannot be; what was kept of an older source goes."""
    found, to_see = set[Path](), [module]
    while to_see:
        file = _file(to_see.pop())
        if file is not None and file not in found and file.stem != "errors":  # no kernel raises
            found.add(file)
            to_see += _read(file)[1]
    digest = hashlib.sha256(b"".join(_read(file)[0] for file in sorted(found))).hexdigest()[:16]
    own = BASE / module / digest
    if not own.exists():
        for old in own.parent.glob("*"):
            shutil.rmtree(old, ignore_errors=True)
        try:
            own.mkdir(parents=True, exist_ok=True)
        except OSError:
            return None
    return str(own)


@cache
def _read(file: Path) -> tuple[bytes, list[str]]:
    """A file's hash, and the modules (and members of modules) of this package that it imports."""
    content, names = file.read_bytes(), list[str]()
    for module, members in IMPORTED.findall(content.decode()):
        names += [module, *(f"{module}.{member}" for member in re.findall(r"\w+", members))]
    return hashlib.sha256(content).digest(), names


@cache
def _file(module: str) -> Path | None:
    path = PACKAGE.joinpath(*module.split(".")[1:])
    options = (path.with_suffix(".py"), path / "__init__.py")
    return next((file for file in options if file.is_file()), None)
