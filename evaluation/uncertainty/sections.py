"""The page's sections: what each campaign is, and its tables."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence

from evaluation.results import markdown
from evaluation.uncertainty.cells import Count, count, interval, intervals, total, where
from evaluation.uncertainty.figures import Measured, Table
from evaluation.uncertainty.plan import CASES, NOISES, ROBOTS, UNTOLD, WORLDS

Found = Mapping[str, Measured]
MOTIONS = {
    "gaussian": "gaussian: off by sigma 0.01 m and 0.5 degrees",
    "slip": "slip: 5 % are not executed",
    "rough": "rough: twice as much noise as gaussian",
    "short": "short: nine tenths of each stride",
}
NOISE = """\
The model is `goal-seeker`. The cases drawn_N are drawn houses (`evaluation/houses.py`), with the rule
`F[0,80] Kitchen and F[80,160] Bedroom and G[0,160] not Bathroom`. In drawn_3 the kitchen is far: some starts
leave next to no time (`python -m benchmarks.spare FOLDER` tells how much). "Exact" is a robot that moves as
told; in the row `"none"` the session is told that it does."""
YARDSTICK = """\
How much of drawn_3 can be kept at all? `rule-first` drives to the kitchen at once and leaves the model alone
only when the rule is decided. It has the same margins and slack, and the same starts and noise."""
WORLDS_TEXT = """\
An oracle is told the true world at the start. Each cell says how many runs the session kept, of those that
the oracle can keep. **obstacle**: a box 0.3 m wide that is on no map stands on the way that was certified at
the start. **shift**: walls and furniture stand 5 cm from where the map has them. **collider**: the footprint
lies behind the origin, and the session was told that it is centred. **person**: someone stands in the way for
20 steps. **scan**: each step tells what a scanner of 180 degrees and 2 m sees. **contact**: only the poses
tell what the robot ran into."""
FORMS_WORLDS = """\
Rules of seventeen forms in the apartment of case 1, by the planner or by reachability, in the worlds above.
Each cell says how many runs were kept of those that the oracle can keep."""
FORMS = """\
The same rules where motions are exact, where 5 % of them slip, and with gaussian noise. Each cell says in how
many of {runs} runs the rule was kept and, in brackets, the mean KL of a run, without its interval."""
THRESHOLDS = """\
Sessions with `threshold_over: "episode"` in 20 small worlds. The model alone keeps the rule in 1 % of the
episodes or so. Some of the worlds leave no time for slips, or no room for noise: how often the rule is kept
where 1 is asked says what can be had. So each row has two shares: of all worlds, and of the worlds in which
that is at least what was asked."""
MUJOCO = """\
A base with two wheels in MuJoCo, with a scanner and the learned model. Nobody tells the session how its
motions differ from `f`. An oracle could keep every run."""
SWITCHES = """\
Sessions that are switched to another rule, map or both while they run, through a server. A search of every
future says whether the switch could be kept. In capitals is what must not happen."""
ROBOTS_TEXT = """\
Robots of `evaluation/worlds/robots.py` with the goal-seeking model, in the same worlds as above.
**locobot** has a centred footprint. **trailing** has its footprint 8 cm behind its origin, and **arcs** 5 cm.
None can drive backwards."""


def sections(found: Found) -> Iterator[tuple[str, str, list[str], Iterator[str]]]:
    """Each section's title, its text, the campaigns that are there for it, and its tables."""
    for title, text, names, made in _SECTIONS:
        there = [name for name in names if name in found]
        if there:
            yield title, text.format(runs=found[there[0]].runs), there, made(found)


def noise(found: Found) -> Iterator[str]:
    heads = ("motions", "rule kept", "main task done", "KL a run [nats]")
    for case in CASES:
        rows = [(said, *_cells(row)) for said, row in noise_rows(found, case)]
        if rows:
            yield f"**{case}**"
            yield markdown(heads, rows)


def noise_rows(found: Found, case: str) -> Iterator[tuple[str, dict[str, str]]]:
    """The rows of a case as they were printed, and what each is."""
    for noise in ("none", *NOISES):
        if f"{case}-{noise}" in found:
            table = found[f"{case}-{noise}"].tables[0]  # with all methods that its folder has runs of
            for row in [*where(table, method="ours"), *where(table, method="ours@default")]:
                exact = 'exact, `"none"`' if row["method"] == "ours" else "exact"
                yield MOTIONS.get(noise, exact), row


def _cells(row: Mapping[str, str]) -> tuple[str, ...]:
    return row["rule satisfied"], row["main task done"], row["KL a run [nats]"]


def yardstick(found: Found) -> Iterator[str]:
    rows = []
    for noise in NOISES:
        if {f"first-{noise}", f"drawn_3-{noise}"} <= found.keys():
            (ours,) = where(found[f"drawn_3-{noise}"].tables[0], method="ours@default")
            (first,) = where(found[f"first-{noise}"].tables[0], method="rule-first@default")
            rows.append((MOTIONS[noise], ours["rule satisfied"], first["rule satisfied"]))
    yield markdown(("motions", "a session's defaults", "rule-first with them"), rows)


def worlds(found: Found) -> Iterator[str]:
    cases = [case for case in WORLDS if any(f"{case}-{world}" in found for world in UNTOLD)]
    rows = []
    for world in UNTOLD:
        for senses in ("scan", "contact"):
            cells = (_world_cell(found.get(f"{case}-{world}"), senses) for case in cases)
            rows.append((f"{world}, {senses}", *cells))
    yield markdown(("world", *cases), rows)
    said = (f"{interval(*total(all_of))} by {senses}" for senses, all_of in world_counts(found).items())
    yield f"In all, these are {' and '.join(said)}."


def _world_cell(measured: Measured | None, senses: str) -> str:
    if measured is None:
        return "not measured"
    (row,) = where(measured.tables[0], senses=senses)
    return interval(*count(row["kept of what the oracle can keep"]))


def world_counts(found: Found) -> dict[str, list[Count]]:
    """What was kept, by what is sensed, of each case and world."""
    there = [found[f"{case}-{world}"] for case in WORLDS for world in UNTOLD if f"{case}-{world}" in found]
    return {
        senses: [
            count(row["kept of what the oracle can keep"])
            for measured in there
            for row in where(measured.tables[0], senses=senses)
        ]
        for senses in ("scan", "contact")
    }


def forms_worlds(found: Found) -> Iterator[str]:
    table = found["forms-worlds"].tables[0]
    heads = [head for head in table[0] if re.fullmatch(r"\w+, (scan|contact)", head)]
    yield markdown(("rule", "method", *heads), [(_rule(row), *_of(row, "method", *heads)) for row in table])
    yield _summed({head: [count(row[head]) for row in table] for head in heads})


def forms(found: Found) -> Iterator[str]:
    measured = found["forms"]
    heads = form_heads(measured.tables[0])
    rows = [(_rule(row), *_of(row, "method", *heads)) for row in measured.tables[0]]
    yield markdown(("rule", "method", *heads.values()), rows)
    table, runs = measured.tables[0], measured.runs
    yield _summed({said: [form_count(row, head, runs) for row in table] for head, said in heads.items()})


def form_heads(table: Table) -> dict[str, str]:
    """The columns of benchmarks/forms.py, and what the page calls them."""
    called = {"none": "exact", "slip": "slips", "gaussian": "noise"}
    return {
        head: f"{'`none`' if config == 'none' else config}, {called[world]}"
        for head in table[0]
        for config, _, world in [head.partition(", ")]
        if world in called
    }


def form_count(row: Mapping[str, str], head: str, runs: int) -> Count:
    """How many runs were kept: a cell is `39 (269)`."""
    return int(row[head].split()[0]), runs


def _rule(row: Mapping[str, str]) -> str:
    return f"{row['what']}: {row['rule']}"


def _of(row: Mapping[str, str], *heads: str) -> list[str]:
    return [row[head] for head in heads]


def _summed(columns: Mapping[str, Sequence[Count]]) -> str:
    """What all rules together have in each column, and the intervals of the cells."""
    sums = "\n".join(f"- {head}: {interval(*total(counts))}" for head, counts in columns.items())
    return f"All rules together:\n\n{sums}\n\n{intervals(each for of in columns.values() for each in of)}"


def thresholds(found: Found) -> Iterator[str]:
    heads = ("motions", "asked", "kept in all worlds", "worlds that can", "kept there")
    rows = []
    for row, everywhere, there in threshold_counts(found["thresholds"]):
        cells = (interval(*everywhere), row["worlds that can"], interval(*there))
        rows.append((row["motions"], row["asked"], *cells))
    yield markdown(heads, rows)


def threshold_counts(measured: Measured) -> Iterator[tuple[dict[str, str], Count, Count]]:
    """Each row of benchmarks/thresholds.py, with what was kept in all its 20 worlds, and in those that can.

    The table has shares of three digits, which of up to 1,000 episodes are counts.
    """
    each = -(-measured.runs // 20)
    for row in measured.tables[0]:
        n, m = 20 * each, int(row["worlds that can"]) * each
        yield row, (round(n * float(row["kept"])), n), (round(m * float(row["kept there"])) if m else 0, m)


def mujoco(found: Found) -> Iterator[str]:
    kept, residuals = found["mujoco"].tables
    heads = ("case", "rule kept", "largest margin", "what was broken")
    yield markdown(
        heads, [(row["case"], interval(*count(row["kept"])), *_of(row, *heads[2:])) for row in kept]
    )
    yield "By how much motions ended off, in 50, 90 and 99 % of cases:"
    yield markdown(list(residuals[0]), [list(row.values()) for row in residuals])


def switches(found: Found) -> Iterator[str]:
    table = found["switches"].tables[0]
    yield markdown(list(table[0]), [list(row.values()) for row in table])
    right = [int(row["all"]) for row in table if not re.search("[A-Z]{3}", row[""])]
    yield f"As it should be: {interval(sum(right), sum(int(row['all']) for row in table))}."


def robots(found: Found) -> Iterator[str]:
    heads = ("robot", "case", "world", "kept by scan", "kept by contact")
    rows = []
    for robot in ROBOTS:
        for case in CASES[:2]:
            if f"{robot}-{case}" in found:
                measured = found[f"{robot}-{case}"]
                for world in dict.fromkeys(row["world"] for row in measured.tables[0]):
                    those = where(measured.tables[0], world=world)
                    by = {row["senses"]: row["kept of what the oracle can keep"] for row in those}
                    cells = (interval(*count(by[senses])) for senses in ("scan", "contact"))
                    rows.append((robot, case, world, *cells))
    yield markdown(heads, rows)


_SECTIONS: tuple[tuple[str, str, list[str], Callable[[Found], Iterator[str]]], ...] = (
    ("Noise, slips and short strides", NOISE, [f"{c}-{n}" for c in CASES for n in ("none", *NOISES)], noise),
    ("Worlds that are not as told", WORLDS_TEXT, [f"{c}-{w}" for c in WORLDS for w in UNTOLD], worlds),
    ("Rules of other forms in these worlds", FORMS_WORLDS, ["forms-worlds"], forms_worlds),
    ("Rules of other forms under noise", FORMS, ["forms"], forms),
    ("A threshold over the episode, asked and kept", THRESHOLDS, ["thresholds"], thresholds),
    ("A simulated base", MUJOCO, ["mujoco"], mujoco),
    ("Switches", SWITCHES, ["switches"], switches),
    (
        "Robots that cannot drive backwards",
        ROBOTS_TEXT,
        [f"{r}-{c}" for r in ROBOTS for c in CASES[:2]],
        robots,
    ),
    ("What can be kept where time is short", YARDSTICK, [f"first-{n}" for n in NOISES], yardstick),
)
