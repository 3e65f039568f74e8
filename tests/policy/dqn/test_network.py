"""The compiled network: by hand, against numpy and torch, and weights that do not fit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from specshield.errors import PolicyError
from specshield.policy.dqn.network import NAMES, greedy, make_layers, make_network
from specshield.policy.dqn.train import make_q_network, weights_of
from tests.policy.rooms import flat, random_weights, sizes


def arrays(*values):
    return {name: np.array(value, np.float32) for name, value in zip(NAMES, values, strict=True)}


def test_a_tiny_network_by_hand():
    weights = arrays([[1, -1], [2, 0]], [0, 1], [[1, 0.5], [3, 3]], [-1, 0], [[1, 0], [-1, 2]], [0, 0.5])
    net = make_network(weights, 2, 2)
    layers = make_layers(net)
    assert greedy(layers, np.array([2, 1], np.float32)) == 1
    assert layers.h1.tolist() == [4.0, 0.0]  # [2 + 2, -2 + 1], not below 0
    assert layers.h2.tolist() == [3.0, 2.0]  # [4 - 1, 2]
    assert layers.q.tolist() == [1.0, 4.5]  # [3 - 2, 4 + 0.5]
    assert greedy(layers, np.array([-1, 0], np.float32)) == 1
    assert layers.h1.tolist() == [0.0, 2.0]
    assert layers.h2.tolist() == [5.0, 6.0]
    assert layers.q.tolist() == [-1.0, 12.5]


def test_every_sum_is_made_in_the_order_of_its_inputs():
    """To the last bit, for layers that registers hold in part: numpy adds one product after the other."""
    random = np.random.default_rng(0)
    for inputs, first, second, outputs in [*((n, n, 20 - n, n) for n in range(1, 20)), (58, 64, 72, 7)]:
        shapes = ((inputs, first), first, (first, second), second, (second, outputs), outputs)
        weights = arrays(*(random.normal(0, 1, shape) for shape in shapes))
        x = random.normal(0, 1, inputs).astype(np.float32)
        layers = make_layers(make_network(weights, inputs, outputs))
        best, expected = greedy(layers, x), x
        for i, layer in enumerate((layers.h1, layers.h2, layers.q), start=1):
            total = weights[f"b{i}"].copy()
            for value, row in zip(expected, weights[f"w{i}"], strict=True):
                total += value * row
            expected = np.maximum(total, np.float32(0)) if i < 3 else total
            assert layer.tolist() == expected.tolist()
        assert best == np.argmax(expected)


def test_the_lowest_index_wins_ties():
    net = make_network(arrays([[0]], [0], [[0]], [0], [[0, 0, 0]], [1, 2, 2]), 1, 3)
    assert greedy(make_layers(net), np.ones(1, np.float32)) == 1


def forward(weights, x):
    for i in (1, 2, 3):
        x = x @ weights[f"w{i}"] + weights[f"b{i}"]
        x = np.maximum(x, np.float32(0)) if i < 3 else x
    return x


def test_numpy_and_torch_agree():
    inputs, outputs = sizes(flat())
    torch.manual_seed(0)
    module, random = make_q_network(inputs, 12, outputs), np.random.default_rng(0)
    weights = weights_of(module)
    net = make_network(weights, inputs, outputs)
    layers = make_layers(net)
    for _ in range(200):
        x = random.normal(0, 1, inputs).astype(np.float32)
        x[random.random(len(x)) < 0.3] = 0.0
        best, expected = greedy(layers, x), forward(weights, x)
        assert best == np.argmax(expected)
        np.testing.assert_allclose(layers.q, expected, atol=1e-4)
        with torch.no_grad():
            np.testing.assert_allclose(layers.q, module(torch.from_numpy(x)[None])[0].numpy(), atol=1e-4)


def hostile():
    good = random_weights(flat())
    yield {**good, "w1": good["w1"].astype(np.float64)}, "weights.w1"
    yield {**good, "w1": good["w1"][:-1]}, "weights.w1"
    yield {**good, "w1": good["w1"].ravel()}, "weights.w1"
    yield {**good, "w1": np.float32(1)}, "weights.w1"
    yield {**good, "b2": good["b2"][:-1]}, "weights.b2"
    yield {**good, "w3": good["w3"][:, :-1]}, "weights.w3"
    yield {**good, "b3": np.where(np.arange(7) == 2, np.nan, good["b3"]).astype(np.float32)}, "weights.b3"
    yield {**good, "b3": np.int32([1] * 7)}, "weights.b3"
    yield {n: good[n] for n in ("w1", "b1")}, "weights"
    yield {**good, "w4": good["w3"]}, "weights"
    wide = random_weights(flat(), units=(2000, 4))
    yield wide, "weights.w1"


@pytest.mark.parametrize(("weights", "path"), list(hostile()))
def test_tensors_that_do_not_fit_are_named(weights, path):
    with pytest.raises(PolicyError) as caught:
        make_network(weights, *sizes(flat()))
    assert caught.value.path == path
    assert caught.value.expected
