"""What another package adds is found by its entry points; what cannot be loaded says so and harms nothing."""

from __future__ import annotations

import os
from pathlib import Path

import httpx
import numpy as np
import pytest

from specshield import errors
from specshield.client import ShieldClient
from specshield.errors import InputError, Unsupported
from specshield.registry import Registry
from tests.service.world import LOGITS, ROBOT, SPEC, START, cells
from tests.serving import HUNG, serving

EXAMPLE = Path(__file__).parent / "registry_example"


@pytest.fixture
def registry(tmp_path, monkeypatch):
    """A registry of texts: one built in, and a package that adds a good one and three that are broken."""
    (tmp_path / "added.py").write_text("WORD = 'added'\nNUMBER = 3\n")
    (tmp_path / "broken.py").write_text("raise OSError('/secret/path')\n")
    about = tmp_path / "added-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: added\nVersion: 1.0\n")
    points = {"good": "added:WORD", "number": "added:NUMBER", "broken": "broken:WORD", "gone": "added:GONE"}
    lines = [f"{name} = {where}" for name, where in {**points, "digits": "added:WORD"}.items()]
    (about / "entry_points.txt").write_text("\n".join(["[specshield.test_words]", *lines]))
    monkeypatch.syspath_prepend(tmp_path)
    return Registry("word", str, "specshield.test_words", {"digits": "string:digits"})


def test_entries_of_the_project_and_of_packages_are_found_by_name(registry):
    assert registry.names() == ["broken", "digits", "gone", "good", "number"]
    assert registry.get("good") == "added"
    assert registry.get("digits") == "0123456789", "a package takes no name from the project"
    assert dict(registry.usable()) == {"digits": "0123456789", "good": "added"}


def test_an_unknown_name_is_answered_with_those_there_are(registry):
    with pytest.raises(InputError) as caught:
        registry.get("goood")
    told = "unknown word; got 'goood'; expected one of broken, digits, gone, good, number"
    assert str(caught.value) == told


@pytest.mark.parametrize(
    ("name", "cause"), [("broken", "OSError"), ("gone", "AttributeError"), ("number", "TypeError")]
)
def test_what_cannot_be_loaded_says_whose_it_is_and_nothing_of_the_inside(registry, name, cause):
    with pytest.raises(Unsupported, match=f"the word '{name}' of package 'added' .* {cause}") as caught:
        registry.get(name)
    assert "secret" not in str(caught.value)
    assert type(caught.value.__cause__).__name__ == cause


def test_a_method_a_format_and_a_preference_of_another_package_serve(tmp_path):
    """Over HTTP, made by a real worker: a map of its format, a policy of its method, its preference."""
    path = os.pathsep.join([str(EXAMPLE), *filter(None, [os.environ.get("PYTHONPATH")])])
    with (
        serving(tmp_path, PYTHONPATH=path, SPECSHIELD_WORKER="true") as server,
        ShieldClient(server.url, timeout=60.0) as client,
    ):
        rows = ["".join("#" if occupied else "." for occupied in row) for row in cells()[::-1]]
        room = client.maps.create(format="drawing", rows=rows)
        assert (room.width, room.height, list(room.rooms)) == (40, 30, ["Everywhere"])
        with pytest.raises(errors.MapError, match="rows: this is no drawing"):
            client.maps.create(format="drawing", rows=["#", "##"])

        ask = {"regions": SPEC["regions"], "signals": SPEC["signals"], "robot": ROBOT, "method": "ahead"}
        formula = f"({SPEC['formula']}) and G[0,8] Everywhere"
        with pytest.raises(errors.PolicyError, match=r"options\.motion: the robot has no such motion"):
            client.policies.create(room.id, formula, **ask, options={"motion": 9})
        made = client.policies.create(room.id, formula, **ask)
        assert client.policies.wait(made.id, timeout=HUNG, interval=0.2).status == "ready"

        session = client.sessions.create(policy_id=made.id, initial_pose=START, shaping="eager")
        plain = client.sessions.create(policy_id=made.id, initial_pose=START)
        pose = tuple(START)
        for t in range(2):
            eager, told = session.step(pose, LOGITS), plain.step(pose, LOGITS)
            weighed = np.array(told.distribution) * np.where(np.arange(len(LOGITS)) == 0, np.exp(t + 1), 1.0)
            np.testing.assert_allclose(eager.distribution, weighed / weighed.sum(), atol=1e-12)
            pose = eager.next_poses[0]

        described = httpx.get(f"{server.url}/openapi.json", timeout=None, verify=False).text
        for name in ("ahead", "drawing", "eager"):
            assert f'"{name}"' in described
        assert "Repeats one motion, whatever the rule." in described
