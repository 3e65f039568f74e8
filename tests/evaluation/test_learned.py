"""The learned model: what its network is, and what the weights that are shipped do."""

import json

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from evaluation.model.measure import alone
from evaluation.model.transformer import Transformer, export
from evaluation.models import named
from specshield.errors import NotFound, PolicyError
from specshield.policy.tensors import read_tensors
from specshield.robot import STRETCH
from specshield.shipped import MODELS
from specshield.sim.learned.model import CARD, FOLDER, WEIGHTS, load_learned, target_of
from specshield.sim.learned.network import (
    FEATURES,
    FLOOR,
    KINDS,
    NOTHING,
    SHAPES,
    WINDOW,
    Network,
    check,
    decoded,
    features,
)
from specshield.sim.learned.reckoning import Reckoning
from specshield.sim.model import softmax
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
    x = random.normal(size=(STEPS, FEATURES)).astype(np.float32)
    place = np.cumsum(random.normal(scale=0.2, size=(STEPS, 3)), axis=0).astype(np.float32)
    return x, place, random.integers(0, NOTHING + 1, STEPS)


def full_pass(network, *steps, kind):
    with torch.no_grad():
        return network(*(torch.from_numpy(each)[None] for each in steps), torch.tensor([kind]))[0].numpy()


def test_step_by_step_is_the_full_pass(random_network, inputs):
    """Beyond the window too, where old keys are written over; and again after a reset."""
    x, place, last = inputs
    expected, network = full_pass(random_network, *inputs, kind=2), Network(export(random_network))
    for _ in range(2):
        network.reset()
        steps = np.array([network.step(x[t], place[t], int(last[t]), 2) for t in range(STEPS)])
        assert np.abs(steps - expected).max() < 2e-4


def test_practising_takes_the_same_steps(random_network, inputs):
    expected = full_pass(random_network, *inputs, kind=2)
    random_network.begin(1, STEPS)
    kind = np.array([2])
    steps = [random_network.logits(t, *(each[t : t + 1] for each in inputs), kind)[0] for t in range(STEPS)]
    assert np.abs(np.array(steps) - expected).max() < 2e-4


def test_what_comes_later_changes_nothing(random_network, inputs):
    x, place, last = inputs
    before, later = full_pass(random_network, *inputs, kind=0), x.copy()
    later[200:] += 1.0
    after = full_pass(random_network, later, place, last, kind=0)
    assert np.array_equal(before[:200], after[:200])
    assert not np.allclose(before[200:], after[200:])


def test_where_it_began_changes_nothing(random_network, inputs):
    """Only the way between two places counts: the same episode moved and turned as a whole."""
    x, place, last = inputs
    c, s = np.cos(0.7), np.sin(0.7)
    moved = place @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + (3.0, -2.0, 0.7)
    assert full_pass(random_network, x, moved.astype(np.float32), last, kind=1) == pytest.approx(
        full_pass(random_network, *inputs, kind=1), abs=1e-3
    )


def test_it_counts_where_it_has_come_from_its_actions_alone():
    reckoning, ranges = Reckoning(1), np.full((1, 36), 2.0)
    forward, right, left = (STRETCH.action_names.index(name) for name in ("m", "r", "l"))
    for k, action in enumerate((NOTHING, forward, left, left, left, forward, right)):
        reckoning.count(ranges + 0.1 * k, np.array([action]))
    assert reckoning.place[0] == pytest.approx([0.2, 0.2, np.pi / 3])
    assert not reckoning.futile.any()
    for n in (1, 2):  # nothing changes in the scan: it has not moved
        reckoning.count(ranges + 0.6, np.array([forward]))
        assert reckoning.place[0] == pytest.approx([0.2, 0.2, np.pi / 3])
        assert reckoning.futile[0, forward] == reckoning.futile.sum() == n
    tired = decoded(np.zeros((1, 20), np.float32), np.array([forward]), reckoning.futile, 0.5)[0]
    assert (tired[forward], tired[left], tired[STRETCH.action_names.index("b")]) == (-8.0, 0.0, -4.0)
    reckoning.count(ranges, np.array([left]))
    assert not reckoning.futile.any()


def test_a_scan_is_as_from_the_heading_it_began_with():
    senses = np.concatenate([np.random.default_rng(0).uniform(0.1, 6.0, 36), np.zeros(3)])
    ahead, turned = features(senses, np.array(0.0)), features(senses, np.array(np.radians(30.0)))
    assert turned[41:77] == pytest.approx(np.roll(ahead[:36], 3), abs=1e-5)  # to the left, three rays on
    assert np.array_equal(ahead[:41], turned[:41])


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


@pytest.mark.parametrize("name", ["learned", "unsteered"])
def test_alone_it_finds_its_target(case, name):
    model = named(name).make(case)
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
