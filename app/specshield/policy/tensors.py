"""The arrays of a safetensors file, from its bytes or mapped from the disk; nothing is unpickled."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import load

from specshield.errors import PolicyError

KINDS = {
    "BOOL": np.bool_, "U8": np.uint8, "U16": np.uint16, "U32": np.uint32, "U64": np.uint64,
    "I8": np.int8, "I16": np.int16, "I32": np.int32, "I64": np.int64, "F32": np.float32, "F64": np.float64,
}  # fmt: skip
MAX_HEADER = 1 << 16  # [bytes], chosen by hand: a policy's has some 500, and to parse one of 60 MB takes a GB


def read_tensors(weights: bytes | Path) -> dict[str, NDArray[Any]]:
    """The arrays by name. A file is mapped: the processes that read it share one copy in memory.

    Raises PolicyError for anything but safetensors.
    """
    try:
        if isinstance(weights, Path):
            return _mapped(weights)
        if int.from_bytes(weights[:8], "little") > MAX_HEADER:
            raise ValueError(f"their header is larger than {MAX_HEADER} bytes")
        return load(weights)
    except Exception as error:  # the parser raises its own types for hostile bytes
        # No path of this machine is told: not as what was got, nor by an error of the system's.
        got = None if isinstance(weights, Path) else f"{len(weights)} bytes"
        reason = "the file cannot be opened" if isinstance(error, OSError) else str(error)
        told = f"the weights cannot be read: {reason}"
        expected = f"a safetensors file with arrays of {', '.join(KINDS)}"
        raise PolicyError(told, path="weights", got=got, expected=expected) from error


def named_arrays(
    tensors: Mapping[str, NDArray[Any]], wanted: Mapping[str, tuple[type, int]]
) -> list[NDArray[Any]]:
    """The arrays of these names, {name: (dtype, rank)}, contiguous and writable.

    Raises PolicyError for one that is missing, of another dtype or rank, or not among these.
    """
    if not tensors.keys() <= wanted.keys():
        extra = sorted(tensors.keys() - wanted.keys())
        raise PolicyError(
            "arrays that no policy of this kind has", path="weights", got=extra, expected=str(sorted(wanted))
        )
    for name, (dtype, rank) in wanted.items():
        array = tensors.get(name)
        if array is None or array.dtype != dtype or array.ndim != rank:
            raise PolicyError(
                f"the array {name!r} is missing or of another kind",
                path=f"weights.{name}",
                got=None if array is None else f"{array.dtype} {list(array.shape)}",
                expected=f"{dtype.__name__}, rank {rank}",
            )
    return [np.require(tensors[name], requirements=["C", "W"]) for name in wanted]


def replace_file(path: Path, content: bytes) -> None:
    """Writes a file that others may have mapped: they keep what they have."""
    draft = path.with_name(f"{path.name}.part")
    draft.write_bytes(content)
    os.replace(draft, path)


def _mapped(path: Path) -> dict[str, NDArray[Any]]:
    with safe_open(path, "numpy"):  # the library checks the header against the file
        pass
    # Copy on write, never written: compiled code knows one kind of array, those that can be written.
    content = np.asarray(np.memmap(path, np.uint8, "c"))
    begin = 8 + int(content[:8].view(np.uint64)[0])
    header = json.loads(content[8:begin].tobytes())
    header.pop("__metadata__", None)
    arrays = {}
    for name, about in header.items():
        first, last = about["data_offsets"]
        array = content[begin + first : begin + last].view(KINDS[about["dtype"]]).reshape(about["shape"])
        arrays[name] = np.require(array, requirements=["C", "ALIGNED"])
    return arrays
