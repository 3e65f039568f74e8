"""The example requests of the docs page. They work without changes in the order of the page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

_known: dict[str, dict[str, Any]] = json.loads(Path(__file__).with_suffix(".json").read_text())
SPEC_REQUEST, POLICY, SESSION, STEP, SWITCH, CLOSE = _known.values()
