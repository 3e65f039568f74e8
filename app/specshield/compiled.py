"""How kernels are compiled: cached on disk, without the interpreter's lock, never fastmath.

numba keeps compiled code by the file of the function alone. After a change, or an upgrade, a kernel would go
on with the old code of the kernels that it calls. So each module's kernels have a folder of their own, named
after a hash of its source and that of all modules of this package that it imports. The path and the time of a
file do not count, and the code is for a processor that nearly all machines have. So a wheel can bring its
kernels (`make wheels`), and an image may be built on another machine than it runs on.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Generic, TypeVar

import numba
import numba.experimental.structref
from llvmlite.binding import get_host_cpu_features, get_host_cpu_name
from numba.core.caching import CacheImpl, _CacheLocator
from numba.core.types import StructRef

from specshield import linking

njit: Any = numba.njit  # its types leave out the option below
config: Any = numba.config
unliteral: Any = numba.types.unliteral
structref: Any = numba.experimental.structref
F = TypeVar("F", bound=Callable[..., Any])
S = TypeVar("S")
PACKAGE = Path(__file__).parent
SHIPPED = PACKAGE / "kernels"  # what a wheel brings
# The processor that kernels are compiled for: nearly every x86-64 one with AVX2 has all that this level asks
# for (the x86-64 psABI, section 3.1.1). NUMBA_CPU_NAME names another.
COMMON, HAS = "x86-64-v3", ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
IMPORTED = re.compile(
    r"^ *(?:from|import) +(specshield[\w.]*)(?: +import +(\([^)]*\)|[^\n]*))?", re.MULTILINE
)


def _base() -> Path:
    """Where kernels are kept: NUMBA_CACHE_DIR, else the package, else the user's folder of caches."""
    if config.CACHE_DIR:
        return Path(config.CACHE_DIR)
    if os.access(PACKAGE, os.W_OK):
        return SHIPPED
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "specshield"


BASE = _base()
_found = get_host_cpu_features()
if config.CPU_NAME is None and all(_found.get(feature) for feature in HAS):
    config.CPU_NAME, config.CPU_FEATURES = COMMON, ""


def kernel(function: F) -> F:
    """A compiled function that may allocate."""
    compiled: F = _cached(function, {"nogil": True})
    return compiled


def leaf(function: F) -> F:
    """A compiled function that allocates nothing, to be called in inner loops with structs of arrays.

    At each call numba counts a reference to each array of a struct, with atomic operations that take most of
    a rollout's time. A function that allocates nothing needs no counting. The option for that is not in
    numba's manual; without it, the kernels do the same, more slowly. Such a function must not return a struct
    of arrays, since its caller would give back references that were never counted.
    """
    return _leaf(function)


def inlined(function: F) -> F:
    """A leaf that is compiled into its callers. A call would copy the hundred words of a struct, which takes
    most of the time of an inner loop.
    """
    return _leaf(function, forceinline=True)


def mark(name: str) -> Path | None:
    """The file whose existence says that the kernels called `name` are compiled and kept. Other sources, or
    another processor or numba, have another file. None if no kernel can be kept.
    """
    made_of = [hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(PACKAGE.rglob("*.py"))]
    processor = config.CPU_NAME or get_host_cpu_name() + _found.flatten()
    made_of += [numba.__version__, str(sys.implementation.cache_tag), processor]
    digest = hashlib.sha256("".join(made_of).encode()).hexdigest()[:16]
    if (SHIPPED / f"{name}-{digest}").exists():
        return SHIPPED / f"{name}-{digest}"
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
    """Compiles a function once for each combination of argument types, and once more if both Python and
    kernels call it.

    A literal number in a call counts as any other number of its type. By itself, numba would compile the
    callee once more for each such number, which took a sixth of the whole time.
    """
    compiled = called = _kept(njit(cache=True, pipeline_class=linking.Entry, **options)(function))
    if function.__closure__ is None:
        linking.entry(compiled)
        called = linking.callee(function, options, _kept)
    template = called.get_call_template
    compiled.get_call_template = lambda args, kws: template([unliteral(arg) for arg in args], kws)
    compiled.get_overload = called.get_overload
    return compiled


def _kept(compiled: Any) -> Any:
    save = compiled._cache.save_overload

    def save_where_possible(*kernel: Any) -> None:
        with contextlib.suppress(OSError):  # a full disk, or one that is only read
            save(*kernel)

    compiled._cache.save_overload = save_where_possible
    return compiled


class _BySource(_CacheLocator):
    """Tells numba where this package's kernels are kept, and that they stay valid in a folder of one name."""

    def __init__(self, folder: Path, line: int) -> None:
        self._folder, self._line = folder, line

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _BySource | None:
        ours = py_func.__module__.startswith("specshield.")
        return cls(_folder(py_func.__module__), py_func.__code__.co_firstlineno) if ours else None


CacheImpl._locator_classes.insert(0, _BySource)


@cache
def _folder(module: str) -> Path:
    """The folder of a module's kernels. Folders for older sources are removed. Kernels from a wheel are
    copied into it, or used where they are if nothing can be written.
    """
    found, to_see = set[Path](), [module]
    while to_see:
        file = _file(to_see.pop())
        if file is not None and file not in found and file.stem != "errors":  # no kernel raises
            found.add(file)
            to_see += _read(file)[1]
    digest = hashlib.sha256(b"".join(_read(file)[0] for file in sorted(found))).hexdigest()[:16]
    own, shipped = BASE / module / digest, SHIPPED / module / digest
    try:
        if not own.exists():
            for old in own.parent.glob("*"):
                shutil.rmtree(old, ignore_errors=True)
            own.parent.mkdir(parents=True, exist_ok=True)
            _copy(shipped, own) if shipped.is_dir() else own.mkdir(exist_ok=True)
        return own if own.is_dir() else shipped
    except OSError:
        return shipped


def _copy(folder: Path, to: Path) -> None:
    """Copies a folder whole, or not at all if another process was first."""
    with TemporaryDirectory(dir=BASE) as beside:
        shutil.copytree(folder, Path(beside) / "copy")
        with contextlib.suppress(OSError):
            (Path(beside) / "copy").rename(to)


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


class BoxedType(StructRef):
    """The type of `Boxed` in kernels."""


class Boxed(structref.StructRefProxy, Generic[S]):  # type: ignore[misc]
    """A struct of arrays by reference, for kernels that Python calls often. Python and they read `value`.

    At each call numba takes a struct apart: in 0.15 us for each of its 27 to 43 arrays, by code that each
    kernel has of its own and that takes 0.3 to 0.6 s to compile. A boxed struct is taken apart once, by
    `box`, and then a call takes 0.6 us (docs/decisions.md). The struct never changes. Only a `kernel` may
    read it, since a leaf counts no references.
    """

    __slots__ = ("value",)
    value: S

    def __reduce__(self) -> tuple[Any, ...]:
        return box, (self.value,)


structref.register(BoxedType)
structref.define_proxy(Boxed, BoxedType, ["value"])


def box(struct: S) -> Boxed[S]:
    """The struct by reference. This takes it apart, as a call with the struct itself would."""
    boxed: Boxed[S] = _boxed(struct)
    boxed.value = struct
    return boxed


@kernel
def _boxed(struct: S) -> Boxed[S]:
    return Boxed(struct)
