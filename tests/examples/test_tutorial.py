"""The notebook goes from a house to a curve, and the page of the docs holds the same steps."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def cells():
    notebook = json.loads((ROOT / "examples" / "house_to_curve.ipynb").read_text())
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


def test_the_page_and_the_notebook_have_the_same_steps():
    page = (ROOT / "docs" / "site" / "tutorial.md").read_text()
    assert [block.rstrip("\n") for block in re.findall(r"```python\n(.*?)```", page, re.S)] == cells()


def test_the_notebook_runs_and_draws_the_curve_of_a_rule_that_is_kept(tmp_path, monkeypatch):
    matplotlib = pytest.importorskip("matplotlib", reason="the extra `docs` is not installed")
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    names = {}
    for cell in cells():
        exec(compile(cell, "house_to_curve.ipynb", "exec"), names)
    assert names["low"][-1] > 0.0
    assert names["low"][-1] == names["high"][-1]
    assert (tmp_path / "curve.png").stat().st_size > 5000
