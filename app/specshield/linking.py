"""Kernels as other kernels call them: each is compiled once, however many call it.

numba writes every kernel into each of its callers, optimises it there again, and adds what Python needs to
call it. That was three quarters of LLVM's work. Here a long kernel stays on its own, and its callers name its
symbol. The symbol is the same in every process. A kernel from the disk first loads all kernels that it calls.
"""

from __future__ import annotations

import hashlib
import importlib
import sys
from collections.abc import Callable
from functools import update_wrapper
from itertools import islice
from typing import Any, NamedTuple

import numba
from llvmlite.binding import parse_assembly
from numba.core import compiler, environment
from numba.core.runtime.nrt import rtsys

njit: Any = numba.njit  # its types leave out the options
Base: Any = compiler.Compiler
Function = Callable[..., Any]
# [optimised instructions of LLVM] Shorter kernels are still written into their callers. With 250 the first
# start took as long, and decisions 1.013 times as long (`python -m benchmarks.episodes --against`).
LONG = 700
_callees: dict[tuple[str, str], Any] = {}  # kernels as `callee` returns them, by module and name
_symbols: dict[str, tuple[Any, ...]] = {}  # the argument types that each symbol stands for


def _environment(module: str, constants: list[Any], name: str) -> Any:
    """numba's function, but it does not import numba's own modules: that takes 0.3 s and is not needed."""
    spared = module.startswith("numba.") and module not in sys.modules
    return _rebuild_env("numba" if spared else module, constants, name)


_rebuild_env: Any = environment._rebuild_env
# With the name of numba's function, so that caches which refer to it can be read without this package.
environment._rebuild_env = update_wrapper(_environment, _rebuild_env)


class Entry(Base):  # type: ignore[misc]
    """Compiles what Python calls, without the wrapper for C."""

    def compile_extra(self, function: Function) -> Any:
        self.state.flags.no_cfunc_wrapper = True
        return super().compile_extra(function)


class _Callee(Entry):
    """Compiles what only kernels call, by a name that is the same in every process."""

    def compile_extra(self, function: Function) -> Any:
        self.state.flags.no_cpython_wrapper = True
        place = function.__module__, function.__qualname__
        source = str(_callees[place]._cache._impl.locator.get_source_stamp())
        mangle = self.state.targetctx.mangler

        def name(whole: str, types: Any, *, abi_tags: Any = (), uid: Any = None) -> Any:
            if whole.removeprefix(".NumbaEnv.") == ".".join(place):
                described = " ".join([source, *abi_tags, *map(str, types)])
                symbol = mangle(whole, (), uid=hashlib.sha256(described.encode()).hexdigest()[:32])
                if _symbols.setdefault(symbol, tuple(types)) == tuple(types):
                    return symbol
            return mangle(whole, types, abi_tags=abi_tags, uid=uid)

        self.state.targetctx.mangler = name
        return super().compile_extra(function)


class _GoneError(Exception):
    """A kernel that one from the disk calls cannot be had any more."""


class _Needed(NamedTuple):
    """When called, makes sure that a symbol is loaded which a kernel from the disk calls."""

    module: str
    name: str
    types: tuple[Any, ...]
    symbol: str

    def __call__(self) -> None:
        importlib.import_module(self.module)
        callee = _callees.get((self.module, self.name))
        if callee is not None:
            callee.compile(self.types)  # or loads it
        if callee is None or self != _needed(callee.overloads.get(self.types)):
            raise _GoneError


def callee(function: Function, options: dict[str, Any], kept: Callable[[Any], Any]) -> Any:
    """The function as other kernels call it. kept: prepares the cache of what numba returns."""
    compiled = kept(njit(cache=True, pipeline_class=_Callee, **options)(function))
    _callees[function.__module__, function.__qualname__] = compiled
    cache = compiled._cache
    files, save = cache._cache_file, cache.save_overload
    name = cache._impl.filename_base + ".callee"  # besides what Python calls
    cache._cache_file = type(files)(cache.cache_path, name, str(cache._impl.locator.get_source_stamp()))

    def link_and_save(types: Any, kernel: Any) -> None:
        code = kernel.library._final_module.get_function(kernel.fndesc.mangled_name)
        instructions = (instruction for block in code.blocks for instruction in block.instructions)
        if not options.get("forceinline") and any(True for _ in islice(instructions, LONG, None)):
            kernel.library._shared_module = parse_assembly("")  # what callers are given to write into them
            kernel.library._reload_init.add(_needed(kernel))
        save(types, kernel)

    cache.save_overload = link_and_save
    _load_whole(compiled)
    return compiled


def entry(compiled: Any) -> None:
    """From now on, this is kept on the disk without the code that callers would include, since kernels call
    its `callee` instead. Reading that code took a twelfth of a start with every kernel on the disk.
    """
    save = compiled._cache.save_overload

    def outline_and_save(types: Any, kernel: Any) -> None:
        defined = [
            function.name
            for function in kernel.library._final_module.functions
            if not function.is_declaration
        ]
        outline = "".join(f'define void @"{name}"() {{ ret void }}\n' for name in defined)
        kernel.library._shared_module = parse_assembly(outline)
        save(types, kernel)

    compiled._cache.save_overload = outline_and_save
    _load_whole(compiled)


def _load_whole(compiled: Any) -> None:
    """From now on, a kernel from the disk also loads all kernels that it calls, or is compiled anew."""
    load = compiled._cache._load_overload

    def load_with_callees(types: Any, context: Any) -> Any:
        rtsys.initialize(context)  # of the compiler, whose parts take 0.3 s to import, it needs no more
        try:
            kernel = load(types, context)
        except _GoneError:
            return None
        except (ImportError, AttributeError):  # another version kept it for a type that has moved since
            try:
                compiled._cache.flush()
            except OSError:
                compiled._cache.disable()
            return None
        if kernel is None or kernel.signature.args != getattr(types, "args", types):
            return None  # two processes wrote the same file
        inherited = kernel.library._reload_init
        inherited.update(kernel.reload_init)
        if not any(True for _ in kernel.library._get_module_for_linking().functions):
            inherited.add(_needed(kernel))
        return kernel

    compiled._cache.load_overload = load_with_callees


def _needed(kernel: Any) -> _Needed | None:
    if kernel is None:
        return None
    made = kernel.fndesc
    return _Needed(made.modname, made.qualname, kernel.signature.args, made.mangled_name)
