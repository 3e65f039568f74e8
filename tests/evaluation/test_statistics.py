import pytest

from evaluation.runs import Record
from evaluation.statistics import beside, clopper_pearson, compared, costs_beside, mcnemar, mean_of, summary


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
        "decision_ms": [1.0, 2.0, 3.0], "certified": [], "poses": [],
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
    assert figures["extra_steps"] == {"both": 1, "mean": 7.0, "low": 7.0, "high": 7.0, "median": 7.0}
    assert (figures["never_ended"], figures["ended_elsewhere"]) == (1, 0)
    assert figures["broken"] == {"F[0,3] A": 1}
    assert figures["modes"] == {"shaped": 23, "fallback": 1}
    assert figures["reasons"] == {"infeasible": 1}
    assert (figures["kl"], figures["feasible_mass"], figures["residual"]) == (3.0, 0.75, 0.04)
    assert figures["common"] == {"runs": 3, "main_done": 2, "unmodified": 2}
    alone = summary("ours", ours, [])
    assert (alone["extra_steps"]["mean"], alone["common"]["runs"]) == (None, 0)
    assert Record.from_json(ours[1].to_json()) == ours[1]


def test_quantiles_of_times_are_over_all_decisions_of_all_runs():
    """One run with 99 quick decisions and one with a single slow one: 100 decisions, of which one is slow."""
    times = summary("ours", [record(0, decision_ms=[1.0] * 99), record(1, decision_ms=[101.0])], [])
    assert times["decision_ms"] == {"decisions": 100, "p50": 1.0, "p99": 2.0, "max": 101.0}


@pytest.mark.parametrize(
    ("only", "only_other", "p"),
    [
        (0, 0, 1.0),
        (1, 0, 1.0),
        (5, 0, 2 / 2**5),
        (1, 5, 2 * (1 + 6) / 2**6),
        (2, 8, 2 * (1 + 10 + 45) / 2**10),
        (3, 3, 1.0),
    ],
)
def test_mcnemars_test_is_exact(only, only_other, p):
    """The p-values are sums of binomial coefficients; runs in which both agree say nothing."""
    pairs = [(True, False)] * only + [(False, True)] * only_other + [(True, True)] * 7 + [(False, False)] * 2
    found = mcnemar(pairs)
    assert found.pop("p") == pytest.approx(p, rel=1e-3)
    assert found == {"pairs": only + only_other + 9, "only": only, "only_other": only_other}


def test_costs_are_compared_in_whole_pairs():
    n = 20
    plain = [record(i, "unmodified", ended_at=10) for i in range(n)]
    ours = [record(i, kl=4.0, ended_at=10 + 20) for i in range(n + 5)]
    half = [record(i, "lookahead", kl=1.0 + 2.0 * (i % 2), ended_at=10 + 5) for i in range(n)]
    found = costs_beside(half, ours, plain)
    steps = found["extra_steps"]
    assert (steps["share"], steps["low"], steps["high"]) == (0.25, 0.25, 0.25)  # every run alike
    assert (steps["pairs"], steps["mine"], steps["other"], steps["difference"]) == (n, 5.0, 20.0, -15.0)
    assert (found["kl"]["share"], found["kl"]["pairs"]) == (0.5, n)
    spread = 1.96 * 1.0 / n**0.5 / 4.0  # of the mean of values 1 and 3, as a share of 4
    assert found["kl"]["low"] == pytest.approx(0.5 - spread, abs=0.03)
    assert found["kl"]["high"] == pytest.approx(0.5 + spread, abs=0.03)
    assert found["kl"]["difference_low"] == pytest.approx(4.0 * (found["kl"]["low"] - 1.0), abs=1e-3)


def test_a_run_that_one_of_the_two_did_not_finish_is_no_pair_of_steps():
    """Run 0 was slow with ours, and never done with the other: it counts for neither."""
    plain = [record(i, "unmodified", ended_at=10) for i in range(3)]
    ours = [record(0, ended_at=500), record(1, ended_at=20), record(2, ended_at=20)]
    other = [record(0, main_done=False, ended_at=None), record(1, ended_at=15), record(2, ended_at=15)]
    found = beside(other, ours, plain)
    assert (found["extra_steps"]["pairs"], found["extra_steps"]["share"]) == (2, 0.5)
    assert found["kl"]["pairs"] == 3
    assert found["main_done"] == {"pairs": 3, "only": 0, "only_other": 1, "p": 1.0}
    assert found["satisfied"] == {"pairs": 3, "only": 0, "only_other": 0, "p": 1.0}


def test_what_is_unwelcome_is_said_too():
    """A share has no meaning beside a cost of nothing or less; the difference always has one."""
    none = compared([])
    assert (none["pairs"], none["share"], none["difference"]) == (0, None, None)
    few = compared([(30.0, 10.0)])
    assert (few["pairs"], few["share"], few["low"], few["high"], few["difference"]) == (
        1,
        3.0,
        3.0,
        3.0,
        20.0,
    )
    faster = compared([(2.0, -4.0), (0.0, -4.0)])
    assert (faster["share"], faster["low"], faster["difference"]) == (None, None, 5.0)
    dust = compared([(3.0, 1e-13), (1.0, 2e-13)])
    assert (dust["share"], dust["difference"]) == (None, 2.0)
    uncertain = compared([(1.0, -1.0), (1.0, 3.0)])
    assert (uncertain["share"], uncertain["low"], uncertain["high"]) == (1.0, None, None)
    assert mean_of([]) == {"mean": None, "low": None, "high": None}
