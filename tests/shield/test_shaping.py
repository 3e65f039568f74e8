"""The three closed forms against the least that is possible, and at their extremes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from specshield.portable import exp
from specshield.shield.shaping import divergence, feasible_mass, going_on, log_softmax, restrict, soften, tilt

INF = math.inf


def kl(p, q):
    on = p > 0
    return float(np.sum(p[on] * np.log(p[on] / q[on])))


def least(prior, values, threshold):
    """A number that KL(p || prior) is not below for any p with E_p[values] >= threshold, by weak duality.

    That holds of l threshold - log E_prior[exp(l values)] for every l >= 0. This is the largest of them,
    which is the least KL itself.
    """

    def tilted(multiplier):
        logs = np.log(prior) + multiplier * values
        return np.exp(logs - logs.max()), logs.max()

    def short(multiplier):
        weights, _ = tilted(multiplier)
        return threshold - weights @ values / weights.sum()

    multiplier, enough = 0.0, 1.0
    if short(0.0) > 0.0:
        while short(enough) > 0.0:
            enough *= 2.0
        multiplier = brentq(short, 0.0, enough, xtol=1e-14)
    weights, largest = tilted(multiplier)
    return multiplier * threshold - math.log(weights.sum()) - largest


def check_optimal(answer, prior, values, threshold):
    """Within 1e-9 of the least KL, and so, by Pinsker's inequality, in all within 5e-5 of the optimum."""
    assert answer.sum() == pytest.approx(1.0, abs=1e-12)
    assert (answer >= 0.0).all()
    assert answer @ values >= threshold - 1e-9
    assert kl(answer, prior) <= least(prior, values, threshold) + 1e-9


logits = st.lists(st.floats(-4.0, 4.0), min_size=2, max_size=6)


@settings(max_examples=150)
@given(st.data())
def test_closed_forms_are_the_optimum(data):
    log_prior = log_softmax(np.array(data.draw(logits)))
    prior, n = np.exp(log_prior), len(log_prior)
    subset = st.lists(st.booleans(), min_size=n, max_size=n)
    feasible = np.array(data.draw(subset.filter(any)))

    hard = restrict(log_prior, feasible)
    assert (hard[~feasible] == 0.0).all()
    # All mass on S_t: the least KL to the prior, which there is not normalised.
    check_optimal(hard[feasible], prior[feasible], np.zeros(feasible.sum()), -1.0)
    mass = feasible_mass(log_prior, feasible)
    assert divergence(hard, log_prior) == pytest.approx(-math.log(mass), abs=1e-9)

    threshold = data.draw(st.floats(0.05, 0.95))
    soft = soften(log_prior, feasible, threshold)
    check_optimal(soft, prior, feasible.astype(float), threshold)
    if mass >= threshold:
        assert (soft == exp(log_prior)).all()
    else:
        assert soft[feasible].sum() == pytest.approx(threshold, abs=1e-12)

    values = np.array(data.draw(st.lists(st.floats(-3.0, 3.0), min_size=n, max_size=n)))
    low, high = float(prior @ values), float(values.max())
    wanted = low + data.draw(st.floats(-0.5, 0.95)) * (high - low)
    if high - low > 1e-3:
        tilted = tilt(log_prior, values, wanted)
        check_optimal(tilted, prior, values, wanted)
        if wanted <= low:
            np.testing.assert_allclose(tilted, prior, atol=1e-12)
        else:
            assert tilted @ values == pytest.approx(wanted, abs=1e-9)


def test_the_tilt_against_a_root_of_its_dual():
    """A prior that spans ten orders of magnitude, where quadratic programming gives up."""
    prior = np.array([0.9, 0.0999, 1e-4, 1e-10])
    prior /= prior.sum()
    values = np.array([-1.0, 0.0, 0.5, 2.0])
    for threshold in (-0.5, 0.0, 0.4, 1.0, 1.9, 1.999999):

        def mean(multiplier, threshold=threshold):
            weights = prior * np.exp(multiplier * (values - 2.0))
            return weights @ values / weights.sum() - threshold

        multiplier = brentq(mean, 0.0, 200.0, xtol=1e-14)
        weights = prior * np.exp(multiplier * (values - 2.0))
        np.testing.assert_allclose(tilt(np.log(prior), values, threshold), weights / weights.sum(), atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 1e4, 1e6])
def test_enormous_logits(scale):
    log_prior = log_softmax(scale * np.array([0.0, -1.0, 1.0, -1.0]))
    feasible = np.array([True, True, False, False])
    assert np.isfinite(log_prior).all()
    one, half = 1.0 / (1.0 + math.exp(-scale)), 1.0 / (1.0 + math.exp(-min(scale, 700.0)))
    np.testing.assert_allclose(restrict(log_prior, feasible), [one, 1.0 - half, 0.0, 0.0], atol=1e-12)
    soft = soften(log_prior, feasible, 0.9)
    assert soft[:2].sum() == pytest.approx(0.9, abs=1e-12)
    assert soft.sum() == pytest.approx(1.0, abs=1e-12)
    tilted = tilt(log_prior, np.array([1.0, 0.0, -1.0, 0.0]), 0.9)
    assert tilted @ [1.0, 0.0, -1.0, 0.0] == pytest.approx(0.9, abs=1e-9)
    assert tilted.sum() == pytest.approx(1.0, abs=1e-12)
    assert divergence(restrict(log_prior, feasible), log_prior) == pytest.approx(
        -float(np.logaddexp(log_prior[0], log_prior[1])), rel=1e-9
    )


def test_impossible_actions_stay_impossible():
    log_prior = log_softmax(np.array([1.0, -INF, 2.0, -INF]))
    assert np.exp(log_prior)[[1, 3]].tolist() == [0.0, 0.0]
    only = np.array([False, True, False, True])
    assert restrict(log_prior, only) is None
    assert soften(log_prior, only, 0.5) is None
    assert soften(log_prior, ~only, 0.5).tolist() == np.exp(log_prior).tolist()
    assert tilt(log_prior, np.array([0.0, 9.0, 1.0, 9.0]), 1.5) is None  # above max J on the support
    assert tilt(log_prior, np.array([0.0, 9.0, 1.0, 9.0]), 1.0).tolist() == [0.0, 0.0, 1.0, 0.0]
    assert tilt(np.full(3, -INF), np.zeros(3), 0.0) is None
    assert restrict(log_prior, np.zeros(4, bool)) is None
    one = soften(log_prior, np.array([True, False, True, False]), 0.5)
    assert one[[1, 3]].tolist() == [0.0, 0.0]


def test_the_threshold_at_and_about_the_highest_value():
    log_prior = log_softmax(np.array([0.0, 0.0, 1.0]))
    values = np.array([1.0, 1.0, -2.0])
    assert tilt(log_prior, values, 1.0).tolist() == [0.5, 0.5, 0.0]
    assert tilt(log_prior, values, np.nextafter(1.0, 2.0)) is None
    close = tilt(log_prior, values, np.nextafter(1.0, 0.0))
    assert close == pytest.approx([0.5, 0.5, 0.0], abs=1e-12)
    equal = np.full(3, 0.3)
    assert tilt(log_prior, equal, 0.3) == pytest.approx(np.exp(log_prior))
    assert tilt(log_prior, equal, 0.2) == pytest.approx(np.exp(log_prior))
    assert tilt(log_prior, equal, 0.4) is None
    assert tilt(log_prior, np.array([0.0, 1e-300, 0.0]), 5e-301)[1] >= 0.5 - 1e-9


def test_a_model_that_all_but_ends_leaves_no_negative_share():
    """Its four ways to end have shares that add up to 1 + 4e-16."""
    ends = [1.3987996703411758, -5.623324580550751, -4.192031839700517, -1.406456427197903]
    log_prior = log_softmax(np.array([-45.0, -50.0, *ends]))
    conditional, ending = going_on(log_prior, np.array([False, False, True, True, True, True]))
    assert ending == 1.0
    assert np.exp(conditional).sum() == pytest.approx(1.0)


def test_divergence():
    log_prior = log_softmax(np.array([0.0, 0.0, -INF]))
    assert divergence(np.array([0.5, 0.5, 0.0]), log_prior) == 0.0
    assert divergence(np.array([1.0, 0.0, 0.0]), log_prior) == pytest.approx(math.log(2.0))
    assert divergence(np.array([0.5, 0.0, 0.5]), log_prior) is None
