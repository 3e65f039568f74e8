"""Options and methods: what is declared once is what is read, written and described."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass

import pytest

from specshield.errors import PolicyError
from specshield.policy.dqn.method import Settings
from specshield.policy.methods import METHODS, available, missing
from specshield.policy.options import option, options_schema, options_to_json, read_options


@dataclass(frozen=True)
class Some:
    pitch: float = option(0.1, "Side of a cell [m].", low=0.02, high=1.0)
    beam: int = option(12, "Poses kept.", low=1, high=256)
    reward: str = option("progress", "Which one.", choices=("progress", "paper"))
    exploration: tuple[float, float] = option((0.5, 0.01), "Chances.", high=1.0)


@pytest.mark.parametrize(
    ("options", "path", "expected"),
    [
        ({"peam": 64}, "options.peam", "one of beam, exploration, pitch, reward"),
        ({"beam": 64.0}, "options.beam", "a whole number from 1 to 256"),
        ({"beam": True}, "options.beam", "a whole number from 1 to 256"),
        ({"beam": 257}, "options.beam", "a whole number from 1 to 256"),
        ({"pitch": 0.01}, "options.pitch", "a number from 0.02 to 1"),
        ({"pitch": float("nan")}, "options.pitch", "a number from 0.02 to 1"),
        ({"pitch": "fine"}, "options.pitch", "a number from 0.02 to 1"),
        ({"reward": "sparse"}, "options.reward", "one of progress, paper"),
        ({"reward": ["paper"]}, "options.reward", "one of progress, paper"),
        ({"exploration": [0.5]}, "options.exploration", "a list of 2 numbers from 0 to 1"),
        ({"exploration": [0.5, 2.0]}, "options.exploration", "a list of 2 numbers from 0 to 1"),
        ({"exploration": 0.5}, "options.exploration", "a list of 2 numbers from 0 to 1"),
    ],
)
def test_an_option_that_cannot_be_is_named_with_what_is_valid(options, path, expected):
    with pytest.raises(PolicyError) as caught:
        read_options(Some, options)
    assert (caught.value.path, caught.value.expected) == (path, expected)


def test_options_are_read_back_as_they_were():
    assert read_options(Some, {}) == Some()
    chosen = Some(beam=3, pitch=0.5, exploration=(0.9, 0.1))
    assert options_to_json(chosen) == {
        "pitch": 0.5, "beam": 3, "reward": "progress", "exploration": [0.9, 0.1]
    }  # fmt: skip
    assert read_options(Some, options_to_json(chosen)) == chosen
    assert repr(read_options(Some, {"pitch": 1}).pitch) == "1.0"  # 1 and 1.0 are one policy


def test_the_schema_says_what_the_reader_takes():
    described = options_schema(Some)["properties"]
    assert described["beam"] == {
        "type": "integer", "minimum": 1, "maximum": 256, "default": 12, "description": "Poses kept."
    }  # fmt: skip
    assert described["reward"]["enum"] == ["progress", "paper"]
    assert described["exploration"]["items"] == {"type": "number", "minimum": 0.0, "maximum": 1.0}


@pytest.mark.parametrize("name", METHODS.names())
def test_the_defaults_of_every_method_are_options_that_it_takes(name):
    method = METHODS.get(name)
    assert read_options(method.options, options_to_json(method.options())) == method.options()
    assert all(each["description"] for each in options_schema(method.options)["properties"].values())


def test_a_method_is_available_where_its_modules_are():
    assert {"planner", "reachability"} <= set(available())
    assert ("dqn" in available()) == (missing(METHODS.get("dqn")) == [])
    assert METHODS.get("dqn").options is Settings


def test_knowing_the_methods_brings_nothing_heavy():
    """A worker that waits for jobs stays small."""
    heavy = ["torch", "numba", "scipy", "numpy", "pydantic"]
    code = (
        "import sys; from specshield.policy.methods import available; available();"
        f"print([name for name in {heavy} if name in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
