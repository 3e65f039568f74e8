"""What is left of a formula after some steps says the same as the formula, by definition, on booleans."""

from functools import partial

import numpy as np

from specshield.reasons.needs import positive
from specshield.reasons.remainder import after, begun, implies
from specshield.reasons.search import _predicates
from specshield.stl import Formula, parse
from tests.reasons.random_rules import HORIZON, PLACES, draw


def holds(predicate, inside, step):
    """A predicate of names, `not`, `and` and `or` at one step: its text is Python too."""
    return bool(eval(str(predicate), {}, {name: bool(values[step]) for name, values in inside.items()}))


def test_what_is_left_after_every_step_is_whether_the_rule_is_kept():
    random, seen = np.random.default_rng(0), set()
    for _ in range(600):
        rule = draw(random, depth=3)
        inside = {name: random.random(HORIZON + 1) < 0.5 for name in PLACES}
        kept = bool(rule.at(inside, 0))
        formula, left, asked = parse(rule.text), None, set()
        for step in range(HORIZON + 1):

            def held(predicate, inside=inside, step=step, asked=asked):
                asked.add(predicate)
                return holds(predicate, inside, step)

            left = after(left, step, held) if step else begun(formula, held)
            if isinstance(left, bool):
                assert left is kept, rule.text
        assert left is kept, rule.text
        assert asked <= set(_predicates(positive(formula))), rule.text  # a search has no others
        seen.add((kept, formula.horizon))
    assert len(seen) >= 10


def test_what_is_said_to_imply_another_thing_does():
    """Of what is left after the same steps on two trajectories that then go on alike."""
    random, implied = np.random.default_rng(1), 0
    for _ in range(3000):
        rule, steps = draw(random, depth=3), int(random.integers(1, 4))
        pair = [{name: random.random(HORIZON + 1) < 0.5 for name in PLACES} for _ in range(2)]
        lefts = []
        for inside in pair:
            left = begun(parse(rule.text), partial(holds, inside=inside, step=0))
            for step in range(1, steps):
                left = after(left, step, partial(holds, inside=inside, step=step))
            lefts.append(left)
        one, other = lefts
        if one == other or not implies(one, other) or not isinstance(one, Formula):
            continue
        implied += 1
        for _ in range(20):
            onward = {name: random.random(HORIZON + 1) < 0.5 for name in PLACES}
            ends = []
            for left in lefts:
                for step in range(steps, HORIZON + 1):
                    left = after(left, step, partial(holds, inside=onward, step=step))
                ends.append(left)
            assert ends[0] is not True or ends[1] is True, (str(one), str(other))
    assert implied > 30
