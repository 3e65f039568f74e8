import pytest

from evaluation.runs import Record
from evaluation.statistics import FEW, clopper_pearson, costs_beside, summary


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [
        (0, 10, 0.0, 1 - 0.025 ** (1 / 10)),
        (10, 10, 0.025 ** (1 / 10), 1.0),
        (200, 200, 0.025 ** (1 / 200), 1.0),
        (5, 10, 0.18708603, 0.81291397),
        (1, 20, 0.00126509, 0.24873275),
    ],
)
def test_intervals_are_clopper_and_pearsons(k, n, low, high):
    assert clopper_pearson(k, n) == pytest.approx((low, high), abs=1e-7)


def record(run, method="ours", **fields):
    usual = {
        "run": run, "method": method, "seed": run, "start": (0.0, 0.0, 0.0), "refused": 0, "satisfied": True,
        "rho": 0.1, "main_done": True, "ended_at": 10, "broken": [], "steps": 10, "modes": {"shaped": 10},
        "reasons": {}, "kl": 2.0, "asked": 10, "residual": 0.0, "mass": [1.0, None, 0.5],
        "decision_ms": {"p50": 1.0, "p99": 2.0, "max": 3.0}, "certified": [], "poses": [],
    }  # fmt: skip
    return Record(**(usual | fields))


def test_a_summary_pairs_the_runs_with_the_unmodified_ones():
    plain = [
        record(i, "unmodified", ended_at=e, main_done=d) for i, (e, d) in enumerate([(5, 1), (9, 1), (3, 0)])
    ]
    ours = [
        record(0, ended_at=12, modes={"shaped": 3, "fallback": 1}, reasons={"infeasible": 1}),
        record(1, ended_at=None, main_done=False, satisfied=False, broken=["F[0,3] A"], kl=5.0),
        record(2, ended_at=4, residual=0.04),
    ]
    figures = summary("ours", ours, plain)
    assert figures["satisfied"]["count"] == figures["main_done"]["count"] == 2
    assert (figures["satisfied"]["low"], figures["satisfied"]["high"]) == pytest.approx(
        (0.0943, 0.9916), abs=1e-4
    )
    assert figures["extra_steps"] == {"both": 1, "mean": 7.0, "median": 7.0}
    assert (figures["never_ended"], figures["ended_elsewhere"]) == (1, 0)
    assert figures["broken"] == {"F[0,3] A": 1}
    assert figures["modes"] == {"shaped": 23, "fallback": 1}
    assert figures["reasons"] == {"infeasible": 1}
    assert (figures["kl"], figures["feasible_mass"], figures["residual"]) == (3.0, 0.75, 0.04)
    assert figures["common"] == {"runs": 3, "main_done": 2, "unmodified": 2}
    alone = summary("ours", ours, [])
    assert (alone["extra_steps"]["mean"], alone["common"]["runs"]) == (None, 0)
    assert Record.from_json(ours[1].to_json()) == ours[1]


def test_costs_are_shares_over_the_runs_that_both_have():
    plain = [record(i, "unmodified", ended_at=10) for i in range(FEW)]
    ours = [record(i, kl=4.0, ended_at=10 + 20) for i in range(FEW + 5)]
    half = [record(i, "lookahead", kl=1.0 + 2.0 * (i % 2), ended_at=10 + 5) for i in range(FEW)]
    found = costs_beside(half, ours, plain)
    assert found["extra_steps"] == {"share": 0.25, "low": 0.25, "high": 0.25}  # every run alike
    assert found["kl"]["share"] == 0.5
    spread = 1.96 * 1.0 / FEW**0.5 / 4.0  # of the mean of values 1 and 3, as a share of 4
    assert found["kl"]["low"] == pytest.approx(0.5 - spread, abs=0.03)
    assert found["kl"]["high"] == pytest.approx(0.5 + spread, abs=0.03)
    undone = [record(0, "lookahead", main_done=False), *half[1:]]
    assert costs_beside(undone, ours, plain)["extra_steps"] is None  # too few
    assert costs_beside(half, [record(i, kl=0.5) for i in range(FEW)], plain)["kl"] is None
