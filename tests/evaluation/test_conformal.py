import math

import numpy as np
import pytest

from evaluation.conformal import conformal_margin, surprise
from specshield.errors import InputError


@pytest.mark.parametrize(
    ("scores", "alpha", "margin"),
    [
        (range(1, 20), 0.05, 19),  # ceil(20 x 0.95) = 19, the largest of 19
        (range(1, 40), 0.05, 38),
        (range(1, 41), 0.05, 39),  # ceil(41 x 0.95)
        ([3.0, 1.0, 2.0], 0.5, 2.0),
    ],
)
def test_the_margin_is_the_rank_that_the_theorem_says(scores, alpha, margin):
    assert conformal_margin(list(scores), alpha) == margin


@pytest.mark.parametrize(("n", "alpha"), [(18, 0.05), (0, 0.5), (30, 0.0), (30, 1.0)])
def test_too_few_scores_or_no_level_are_refused(n, alpha):
    with pytest.raises(InputError):
        conformal_margin([1.0] * n, alpha)


@pytest.mark.parametrize(("n", "alpha"), [(19, 0.05), (60, 0.05), (30, 0.2)])
def test_the_next_score_is_covered_as_often_as_promised(n, alpha):
    """For continuous scores ceil((n + 1)(1 - alpha)) / (n + 1) of the time; here the largest of ten."""
    random, trials = np.random.default_rng(3), 4000
    scores = random.rayleigh(0.01, size=(trials, n + 1, 10)).max(axis=2)
    covered = np.mean([row[-1] <= conformal_margin(row[:-1].tolist(), alpha) for row in scores])
    promised = math.ceil((n + 1) * (1 - alpha)) / (n + 1)
    assert covered == pytest.approx(promised, abs=4 * math.sqrt(promised * (1 - promised) / trials))
    assert promised >= 1 - alpha


def test_a_surprise_is_the_gap_and_what_the_heading_makes_of_a_stride():
    assert surprise((1.0, 2.0, 0.0), (1.03, 2.04, 0.1)) == pytest.approx(0.05 + 0.2 * 0.1)
    assert surprise((0.0, 0.0, math.pi - 0.01), (0.0, 0.0, -math.pi + 0.01)) == pytest.approx(0.2 * 0.02)
