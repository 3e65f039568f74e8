"""Makes vectors.json: what a probabilistic model checker says of the best policy on a few cells.

    python -m venv storm && storm/bin/pip install stormpy==2.0.0
    storm/bin/python tests/oracles/storm/make.py

The robot is that of tests/oracles/cells.py; every motion but waiting is lost with some probability. A rule
is a list of conjuncts (kind, a, b, cell, inside): F or G over "the robot is inside (outside) the cell". The
world is written down here once more, without the package: a state is a cell, a quarter turn, a step, and what
was kept or broken so far. Storm gives Pmax of keeping the rule, from every state; an action is worth what its
successors are expected to be.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import stormpy

WALLS = ["....#", ".#...", ".....", ".#.#.", "....."]  # the first row is y = 0
AHEAD = [(1, 0), (0, 1), (-1, 0), (0, -1)]
RULES = {
    "F[0,6] A": [("F", 0, 6, (2, 0), True)],
    "F[0,4] A and F[4,9] B": [("F", 0, 4, (2, 0), True), ("F", 4, 9, (0, 0), True)],
    "F[2,7] A and G[0,7] not B": [("F", 2, 7, (2, 2), True), ("G", 0, 7, (1, 2), False)],
    "F[0,8] A and G[0,8] not B": [("F", 0, 8, (2, 2), True), ("G", 0, 8, (2, 1), False)],
    "G[4,7] A": [("G", 4, 7, (1, 0), True)],
    "G[3,6] not A and F[0,2] B": [("G", 3, 6, (0, 0), False), ("F", 0, 2, (0, 0), True)],
}
STARTS = [(0, 0, 0), (0, 0, 1), (1, 0, 2), (2, 0, 3), (0, 2, 0), (3, 1, 2)]
LOSSES = [0.0, 0.05, 0.2, 0.5]


def after(state, motion):
    i, j, heading = state
    if motion in (1, 2):
        return i, j, (heading + (1 if motion == 1 else 3)) % 4
    if motion == 0:
        di, dj = AHEAD[heading]
        if 0 <= i + di < 5 and 0 <= j + dj < 5 and WALLS[j + dj][i + di] == ".":
            return i + di, j + dj, heading
    return state


def progress(rule, t, state, settled):
    """0 open, 1 kept, 2 broken, of each conjunct, after the state at step t."""
    found = []
    for (kind, a, b, cell, inside), old in zip(rule, settled, strict=True):
        holds = (state[:2] == cell) == inside
        new = old
        if old == 0 and a <= t <= b:
            new = 1 if kind == "F" and holds else 2 if kind == "G" and not holds else 0
        if new == 0 and t >= b:
            new = 2 if kind == "F" else 1
        found.append(new)
    return tuple(found)


def values(rule, start, loss):
    """Pmax after each of the four motions, at step 0."""
    horizon = max(b for _, _, b, _, _ in rule)
    first = (start, 0, progress(rule, 0, start, (0,) * len(rule)))
    index, order, k = {first: 0}, [first], 0
    choices = []
    while k < len(order):
        state, t, settled = order[k]
        rows = []
        for motion in range(4):
            if t == horizon:
                rows.append([(1.0, order[k])])
                break
            moved = after(state, motion)
            outcomes = {moved: 1.0 - loss}
            outcomes[state] = outcomes.get(state, 0.0) + loss
            rows.append(
                [(p, (s, t + 1, progress(rule, t + 1, s, settled))) for s, p in outcomes.items() if p > 0.0]
            )
        for row in rows:
            for _, successor in row:
                if successor not in index:
                    index[successor] = len(order)
                    order.append(successor)
        choices.append(rows)
        k += 1
    lines = ["@type: MDP", "@parameters", "", "@reward_models", "", "@nr_states", str(len(order))]
    lines += ["@nr_choices", str(sum(map(len, choices))), "@model"]
    for n, (rows, (_, t, settled)) in enumerate(zip(choices, order, strict=True)):
        kept = " kept" if t == horizon and all(each == 1 for each in settled) else ""
        lines.append(f"state {n}{' init' if n == 0 else ''}{kept}")
        for motion, row in enumerate(rows):
            lines.append(f"\taction {motion}")
            lines += [f"\t\t{column} : {p!r}" for column, p in sorted((index[s], p) for p, s in row)]
    if not any(line.endswith(" kept") for line in lines):  # Storm refuses a label that no state has
        return [0.0] * 4
    with tempfile.NamedTemporaryFile("w", suffix=".drn") as file:
        file.write("\n".join(lines) + "\n")
        file.flush()
        model = stormpy.build_model_from_drn(file.name)
    checked = stormpy.model_checking(model, stormpy.parse_properties('Pmax=? [F "kept"]')[0])
    return [sum(p * checked.get_value(index[s]) for p, s in row) for row in choices[0]]


def main():
    vectors = [
        {"formula": formula, "start": start, "slip": loss, "best": values(rule, start, loss)}
        for formula, rule in RULES.items()
        for start in STARTS
        for loss in LOSSES
    ]
    for vector in vectors:
        vector["cells"] = cells(vector["formula"])
    lines = ",\n".join(json.dumps(vector) for vector in vectors)
    Path(__file__).with_name("vectors.json").write_text(f"[\n{lines}\n]\n")


def cells(formula):
    names = [c for c in formula if c in "AB"]
    return {name: rule[3] for name, rule in zip(names, RULES[formula], strict=True)}


if __name__ == "__main__":
    main()
