"""The real houses that lie beside the project, where they do: ../shared/data/houses, made by ProcTHOR."""

from pathlib import Path

import pytest

HOUSES = Path(__file__).parents[2] / "shared" / "data" / "houses"
needs_houses = pytest.mark.skipif(not HOUSES.is_dir(), reason="there is no folder ../shared/data/houses")
