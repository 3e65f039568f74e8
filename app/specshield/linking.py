"""Kernels as other kernels call them: each is compiled once, however many call it.

numba writes every kernel into all that call it, where it is optimised and made machine code again, and gives
it what Python needs to call it. That was three quarters of what LLVM had to do. Here a long kernel stays on
its own: those that call it name its symbol, as with functions of C. So the symbol has to be the same in every
process, and what is taken from the disk first loads all that it calls.
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable
from itertools import islice
from typing import Any, NamedTuple

import numba
from llvmlite.binding import parse_assembly
from numba.core.caching import IndexDataCacheFile
from numba.core.compiler import CompileResult, Compiler
from numba.core.funcdesc import qualifying_prefix
from numba.core.sigutils import normalize_signature

njit: Any = numba.njit  # its types leave out the option below
# [instructions of LLVM, optimised] A kernel of no more is still written into those that call it. With 250 the
# first start took as long, and decisions 1.013 times (`python -m benchmarks.episodes --against`).
LONG = 700
# Whether this numba has what it takes, which its manual does not tell of. Where it is gone, kernels are
# compiled as numba does it: in twice the time, and they are the same.
POSSIBLE = "reload_init" in getattr(CompileResult, "_fields", ())
_callees: dict[tuple[str, str], Any] = {}
_symbols: dict[str, tuple[Any, ...]] = {}  # and the types of arguments that each stands for


class Entry(Compiler):  # type: ignore[misc]
    """Compiles what Python calls. Nothing calls it from C."""

    def compile_extra(self, function: Callable[..., Any]) -> Any:
        self.state.flags.no_cfunc_wrapper = True
        return super().compile_extra(function)


class _Callee(Entry):
    """Compiles what only kernels call, with a symbol that is the same in every process."""

    def compile_extra(self, function: Callable[..., Any]) -> Any:
        self.state.flags.no_cpython_wrapper = True
        own = qualifying_prefix(function.__module__, function.__qualname__)
        stamp = _callees[function.__module__, function.__qualname__]._cache._impl.locator.get_source_stamp()
        mangle = self.state.targetctx.mangler

        def symbol(name: str, types: Any, *, abi_tags: Any = (), uid: Any = None) -> Any:
            if name.removeprefix(".NumbaEnv.") == own:
                described = " ".join([stamp, *abi_tags, *map(str, types)])
                found = mangle(name, (), uid=hashlib.sha256(described.encode()).hexdigest()[:32])
                if _symbols.setdefault(found, tuple(types)) == tuple(types):
                    return found
            return mangle(name, types, abi_tags=abi_tags, uid=uid)

        self.state.targetctx.mangler = symbol
        return super().compile_extra(function)


class _GoneError(Exception):
    """What a kernel on the disk calls is not there any more."""


class _Needed(NamedTuple):
    """Loads or compiles a kernel that another one on the disk calls, so that its symbol is there."""

    module: str
    name: str
    types: tuple[Any, ...]
    symbol: str

    def __call__(self) -> None:
        importlib.import_module(self.module)
        callee = _callees.get((self.module, self.name))
        if callee is None:
            raise _GoneError
        callee.compile(self.types)
        if self.types not in callee.overloads or self.symbol != _symbol(callee.overloads[self.types]):
            raise _GoneError


def callee(function: Callable[..., Any], options: dict[str, Any], kept: Callable[[Any], Any]) -> Any:
    """The function as kernels call it."""
    compiled = kept(njit(cache=True, pipeline_class=_Callee, **options)(function))
    _callees[function.__module__, function.__qualname__] = compiled
    cache = compiled._cache
    cache._cache_file = IndexDataCacheFile(
        cache_path=cache.cache_path,
        filename_base=f"{cache._impl.filename_base}.callee",
        source_stamp=cache._impl.locator.get_source_stamp(),
    )
    save = cache.save_overload

    def link_and_save(types: Any, kernel: Any) -> None:
        code = kernel.library._final_module.get_function(_symbol(kernel))
        if not options.get("forceinline") and _is_long(code):
            kernel.library._shared_module = parse_assembly("")
            kernel.library._reload_init.add(_needed(function, kernel))
        save(types, kernel)

    cache.save_overload = link_and_save
    load_all_that_is_called(compiled)
    return compiled


def load_all_that_is_called(compiled: Any) -> None:
    """What this takes from the disk finds all that it calls, or is compiled anew."""
    load = compiled._cache.load_overload

    def load_whole(types: Any, context: Any) -> Any:
        try:
            kernel = load(types, context)
        except _GoneError:
            return None
        if kernel is None or tuple(kernel.signature.args) != normalize_signature(types)[0]:
            return None  # two processes may have written the same file
        kernel.library._reload_init.update(kernel.reload_init)
        if not any(True for _ in kernel.library._get_module_for_linking().functions):
            kernel.library._reload_init.add(_needed(compiled.py_func, kernel))
        return kernel

    compiled._cache.load_overload = load_whole


def _needed(function: Callable[..., Any], kernel: Any) -> _Needed:
    types = tuple(kernel.signature.args)
    return _Needed(function.__module__, function.__qualname__, types, _symbol(kernel))


def _symbol(kernel: Any) -> str:
    return str(kernel.fndesc.mangled_name)


def _is_long(code: Any) -> bool:
    instructions = (True for block in code.blocks for _ in block.instructions)
    return next(islice(instructions, LONG, None), False)
