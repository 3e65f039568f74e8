"""The learned model: what its network is, and what the weights that are shipped do."""

import json

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from specshield.errors import NotFound, PolicyError
from specshield.policy.policy import read_tensors
from specshield.robot import STRETCH
from specshield.sim.cases import MODELS
from specshield.sim.learned.measure import alone
from specshield.sim.learned.model import CARD, FLOOR, FOLDER, WEIGHTS, load_learned, target_of
from specshield.sim.learned.network import FEATURES, KINDS, NOTHING, SHAPES, WINDOW, Network, check
from specshield.sim.learned.transformer import Transformer, export
from specshield.sim.model import make_model, softmax
from specshield.sim.robot import SimulatedRobot

STEPS = WINDOW + 100


@pytest.fixture(scope="module")
def shipped():
    return read_tensors((MODELS / FOLDER / WEIGHTS).read_bytes())


@pytest.fixture(scope="module")
def random_network():
    torch.manual_seed(0)
    return Transformer()


@pytest.fixture(scope="module")
def inputs():
    random = np.random.default_rng(0)
    return random.normal(size=(STEPS, FEATURES)).astype(np.float32), random.integers(0, NOTHING + 1, STEPS)


def full_pass(network, x, last, kind):
    with torch.no_grad():
        return network(torch.from_numpy(x)[None], torch.from_numpy(last)[None], torch.tensor([kind]))[
            0
        ].numpy()


def test_step_by_step_is_the_full_pass(random_network, inputs):
    """Beyond the window too, where old keys are written over; and again after a reset."""
    x, last = inputs
    expected, network = full_pass(random_network, x, last, 2), Network(export(random_network))
    for _ in range(2):
        network.reset()
        steps = np.array([network.step(x[t], int(last[t]), 2) for t in range(STEPS)])
        assert np.abs(steps - expected).max() < 1e-4


def test_what_comes_later_changes_nothing(random_network, inputs):
    x, last = inputs
    before, later = full_pass(random_network, x, last, 0), x.copy()
    later[200:] += 1.0
    after = full_pass(random_network, later, last, 0)
    assert np.array_equal(before[:200], after[:200])
    assert not np.allclose(before[200:], after[200:])


def test_the_last_action_and_the_past_matter(case):
    """Being steered really disturbs it: the same place sensed after another past gives other logits."""
    model, robot = load_learned(case.instruction), SimulatedRobot(case, (5.0, 4.9, 0.0))
    model.reset(np.random.default_rng(0))
    fresh = model.logits(robot)
    for name in ("l", "r") * 4:
        robot.execute(STRETCH.action_names.index(name))
        model.logits(robot)
    assert robot.pose == pytest.approx((5.0, 4.9, 0.0))
    assert np.abs(model.logits(robot) - fresh).max() > 0.1


def test_alone_it_finds_its_target(case):
    model = make_model("learned", case)
    results = [alone(case, model, 1, i) for i in range(10)]
    assert sum(found for found, _ in results) >= 8
    assert alone(case, model, 1, 0) == results[0]


def test_its_distribution_is_spread_and_never_closed(case):
    model, random = load_learned(case.instruction), np.random.default_rng(0)
    model.reset(random)
    robot, entropies = SimulatedRobot(case, (5.0, 4.9, 0.0)), []
    for _ in range(60):
        logits = model.logits(robot)
        assert logits.shape == (20,)
        assert np.all(np.isfinite(logits))
        assert logits.max() - logits.min() <= FLOOR + 1e-9
        p = softmax(logits)
        entropies.append(-np.sum(p * np.log(p)))
        robot.execute(
            int(random.choice(20, p=np.where(STRETCH.terminal, 0.0, p) / p[~STRETCH.terminal].sum()))
        )
    assert 0.05 < np.mean(entropies) < 2.0


def test_instructions_name_one_thing_it_knows():
    assert target_of("Find a PAN") == "pan"
    for instruction in ("find a banana", "find a bowl and a pan", "find a pancake", ""):
        with pytest.raises(NotFound) as error:
            target_of(instruction)
        assert all(kind in error.value.expected for kind in KINDS)


def test_the_shipped_weights_are_a_few_megabytes_with_a_card(shipped):
    assert sum(array.nbytes for array in check(shipped).values()) < 8e6
    card = json.loads((MODELS / FOLDER / CARD).read_text())
    assert card["kinds"] == list(KINDS)
    for name in ("case1", "case2", "unseen_apartments"):
        assert card["metrics"][name]["runs"] == 200


@pytest.mark.parametrize("harm", ["missing", "more", "shape", "float64", "nan"])
def test_hostile_weights_are_refused(shipped, harm):
    tensors = dict(shipped)
    if harm == "missing":
        del tensors["last"]
    elif harm == "more":
        tensors["more"] = np.zeros(1, np.float32)
    elif harm == "shape":
        tensors["head.w"] = np.zeros((1, 20), np.float32)
    elif harm == "float64":
        tensors["head.b"] = tensors["head.b"].astype(np.float64)
    else:
        tensors["0.up.w"] = np.full(SHAPES["0.up.w"], np.nan, np.float32)
    with pytest.raises(PolicyError) as error:
        check(tensors)
    assert error.value.path.startswith("weights")


@pytest.mark.parametrize(
    ("weights", "card"),
    [(b"\x80\x04pickle", {"temperature": 1.0}), (None, {}), (None, {"temperature": "hot"}), (None, [1.0]),
     (None, {"temperature": 0.0})],
)  # fmt: skip
def test_hostile_files_are_refused(shipped, tmp_path, weights, card):
    (tmp_path / WEIGHTS).write_bytes(save(shipped) if weights is None else weights)
    (tmp_path / CARD).write_text(json.dumps(card))
    with pytest.raises(PolicyError):
        load_learned("find a bowl", tmp_path)
    with pytest.raises(NotFound):
        load_learned("find a bowl", tmp_path / "elsewhere")
