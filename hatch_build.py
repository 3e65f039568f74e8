"""Builds a wheel that brings its compiled kernels, where `SPECSHIELD_KERNELS` names their folder.

    make wheels     # compiles them, and builds a wheel with them and one without

Such a wheel is for one version of Python and one kind of processor. Elsewhere pip takes the one without, and
the first start compiles; so it does with another version of numba than the one that compiled them.
"""

from __future__ import annotations

import os
import platform
import sys
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

LIBC = "manylinux_2_28"  # numba's own wheels ask for 2.27 or 2.28


class Kernels(BuildHookInterface):
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        kernels = os.environ.get("SPECSHIELD_KERNELS")
        if kernels and version != "editable":
            if sys.platform != "linux":
                raise RuntimeError("a wheel can bring kernels on Linux alone: unset SPECSHIELD_KERNELS")
            python = f"cp{sys.version_info.major}{sys.version_info.minor}"
            build_data["force_include"][kernels] = "specshield/kernels"
            build_data["pure_python"] = False
            build_data["tag"] = f"{python}-{python}-{LIBC}_{platform.machine()}"
