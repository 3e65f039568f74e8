"""Random rules on whole cells, each as text and as what it means: by definition, on booleans."""

import numpy as np

from tests.oracles.cells import Cells

HORIZON = 5
PLACES = {"A": (2, 0), "B": (0, 2), "C": (4, 4)}


class Rule:
    """text, and `at(inside, t)`: {place: bool[..., T + 1]} to bool[...], whether it holds at step t."""

    def __init__(self, text, at, horizon):
        self.text, self.at, self.horizon = text, at, horizon


def draw(random, depth=2, room=HORIZON):
    """A rule whose horizon is at most `room`."""
    kind = random.choice(["place", "not", "and", "or", "F", "G", "U", "->"]) if depth else "place"
    if kind == "place":
        name = str(random.choice(list(PLACES)))
        return Rule(name, lambda inside, t: inside[name][..., t], 0)
    if kind == "not":
        child = draw(random, depth - 1, room)
        return Rule(f"not ({child.text})", lambda inside, t: ~child.at(inside, t), child.horizon)
    if kind in ("and", "or", "->"):
        left, right = draw(random, depth - 1, room), draw(random, depth - 1, room)
        join = {"and": np.logical_and, "or": np.logical_or, "->": lambda a, b: ~a | b}[kind]
        return Rule(
            f"({left.text}) {kind} ({right.text})",
            lambda inside, t: join(left.at(inside, t), right.at(inside, t)),
            max(left.horizon, right.horizon),
        )
    b = int(random.integers(0, room + 1))
    a = int(random.integers(0, b + 1))
    if kind in "FG":
        child = draw(random, depth - 1, room - b)
        over = np.any if kind == "F" else np.all
        return Rule(
            f"{kind}[{a},{b}] ({child.text})",
            lambda inside, t: over([child.at(inside, t + k) for k in range(a, b + 1)], axis=0),
            b + child.horizon,
        )
    left, right = draw(random, depth - 1, room - b), draw(random, depth - 1, room - b)

    def until(inside, t):
        ways = [
            np.all([right.at(inside, t + k), *(left.at(inside, t + j) for j in range(k))], axis=0)
            for k in range(a, b + 1)
        ]
        return np.any(ways, axis=0)

    return Rule(f"({left.text}) U[{a},{b}] ({right.text})", until, b + max(left.horizon, right.horizon))


def cells_of(rule):
    return Cells(rule.text, lambda inside: rule.at(inside, 0), PLACES)


def history(cells, random, length):
    """A walk of `length` steps from a random free cell."""
    state = (int(random.integers(0, 4)), int(random.choice([0, 2])), int(random.integers(4)))
    states = [state]
    for _ in range(length):
        states.append(cells.after(states[-1], int(random.integers(4))))
    return np.array([cells.pose(*each) for each in states])
