"""Boolean combinations of predicates as postfix stack programs, for compiled rollouts.

A program's value equals `robustness(predicate, ...)` bit for bit, because both do the same float64 operations
in the same order. Where `robustness` raises because arithmetic is not finite, the program's value is NaN.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from specshield.arrays import Floats, Ints
from specshield.compiled import inlined
from specshield.errors import FormulaError, FragmentError
from specshield.stl.formula import (
    Abs,
    And,
    Arithmetic,
    Atom,
    Comparison,
    Implies,
    Name,
    Neg,
    Node,
    Not,
    Number,
    Or,
)
from specshield.stl.parser import MAX_DEPTH
from specshield.stl.robustness import difference

STACK_SIZE = MAX_DEPTH  # numbers; a formula as deep as the parser allows needs no more

NUMBER, VALUE, NEGATE, ABSOLUTE, ADD, SUBTRACT, MULTIPLY, DIVIDE, MINIMUM, MAXIMUM = range(10)
_ARITHMETIC = {"+": ADD, "-": SUBTRACT, "*": MULTIPLY, "/": DIVIDE}


class Programs(NamedTuple):
    """K programs, one after the other: program k is at starts[k] to starts[k + 1]. starts int64[K + 1].

    ops int64[n]; args float64[n]: the number of a NUMBER, the slot of a VALUE, else 0.
    """

    ops: Ints
    args: Floats
    starts: Ints


def compile_predicates(predicates: Iterable[Node], slots: Mapping[str, int]) -> Programs:
    """The programs of `predicates`, which find the value of a name at values[slots[name]].

    Raises FragmentError for a temporal operator, FormulaError for a name without a slot and for a predicate
    deeper than STACK_SIZE.
    """
    code, starts = list[tuple[int, float]](), [0]
    for predicate in predicates:
        if predicate.depth > STACK_SIZE:
            expected = f"at most {STACK_SIZE} levels of nesting"
            problem = f"a predicate is {predicate.depth} levels deep; expected {expected}"
            raise FormulaError(problem, got=predicate.depth, expected=expected)
        code += _code(predicate, slots)
        starts.append(len(code))
    ops, args = np.array([op for op, _ in code], np.int64), np.array([arg for _, arg in code], np.float64)
    return Programs(ops, args, np.array(starts, np.int64))


def _code(node: Node, slots: Mapping[str, int]) -> Iterator[tuple[int, float]]:
    match node:
        case Number(value):
            yield NUMBER, value
        case Name(name) | Atom(name):
            if name not in slots:
                raise FormulaError(f"nothing declares '{name}'", got=name, expected=", ".join(sorted(slots)))
            yield VALUE, slots[name]
        case Neg(child) | Not(child) | Abs(child):
            yield from _code(child, slots)
            yield ABSOLUTE if isinstance(node, Abs) else NEGATE, 0
        case Arithmetic(op, left, right):
            yield from _code(left, slots)
            yield from _code(right, slots)
            yield _ARITHMETIC[op], 0
        case Comparison():
            yield from _code(difference(node), slots)
        case And(children) | Or(children):
            yield from _code(children[0], slots)
            for child in children[1:]:
                yield from _code(child, slots)
                yield MINIMUM if isinstance(node, And) else MAXIMUM, 0
        case Implies(left, right):
            yield from _code(Or((Not(left), right)), slots)
        case _:
            expected = "a boolean combination of predicates"
            problem = f"'{node}' has a temporal operator; expected {expected}"
            raise FragmentError(problem, got=str(node), expected=expected)


@inlined
def evaluate_packed(k: int, programs: Programs, values: Floats, stack: Floats) -> float:
    """The robustness of program k, NaN where arithmetic is not finite. values float64[slots]; stack
    float64[STACK_SIZE] is scratch.
    """
    ops, args, top = programs.ops, programs.args, -1
    for i in range(programs.starts[k], programs.starts[k + 1]):
        op = ops[i]
        if op == VALUE:
            top += 1
            stack[top] = values[int(args[i])]
        elif op == NUMBER:
            top += 1
            stack[top] = args[i]
        elif op == NEGATE:
            stack[top] = -stack[top]
        elif op == ABSOLUTE:
            stack[top] = abs(stack[top])
        else:
            right = stack[top]
            top -= 1
            left = stack[top]
            if op == MINIMUM:
                stack[top] = min(left, right)
            elif op == MAXIMUM:
                stack[top] = max(left, right)
            else:
                if op == ADD:
                    left += right
                elif op == SUBTRACT:
                    left -= right
                elif op == MULTIPLY:
                    left *= right
                else:
                    left /= right
                if not math.isfinite(left):
                    return math.nan
                stack[top] = left
    return float(stack[0] + 0.0)  # -0.0 becomes 0.0, as in `robustness`
