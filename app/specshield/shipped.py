"""The folders of the maps and models that come with specshield.

In a repository they are beside app/, in a wheel inside the package. SPECSHIELD_MAPS_DIR and
SPECSHIELD_MODELS_DIR name other folders.
"""

from __future__ import annotations

import os
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent


def _folder(name: str) -> Path:
    if chosen := os.environ.get(f"SPECSHIELD_{name.upper()}_DIR"):
        return Path(chosen).resolve()
    installed = PACKAGE / name
    return installed if installed.is_dir() else PACKAGE.parents[1] / name


MAPS = _folder("maps")
MODELS = _folder("models")
