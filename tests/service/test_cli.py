"""The command without its parts."""

import subprocess
import sys

import pytest

WITHOUT = """
import sys
class Without:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {parts}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Without())
sys.argv = ["specshield", *{arguments}]
from specshield.cli import main
main()
"""


@pytest.mark.parametrize(
    ("parts", "arguments", "told"),
    [
        (["typer"], ["serve"], "specshield[server]"),
        (["fastapi"], ["openapi"], "specshield[server]"),
        (["uvicorn"], ["serve"], "specshield[server]"),
    ],
)
def test_what_is_not_installed_is_said(parts, arguments, told):
    code = WITHOUT.format(parts=parts, arguments=arguments)
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert run.returncode == 1
    assert told in run.stderr
    assert "Traceback" not in run.stderr
