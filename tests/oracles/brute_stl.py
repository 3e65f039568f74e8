"""Robustness straight from its definition, slowly: what the tests hold specshield's own against.

It shares nothing with `specshield.stl` but the node classes it reads (and `parse`, when given text): plain
Python floats, one step at a time, no arrays, no windows kept.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from specshield import stl


def brute_robustness(formula: str | stl.Formula, samples: Mapping[str, Sequence[float]], t: int = 0) -> float:
    """rho of the formula on one trajectory at step t. samples: a list of floats for each name."""
    return _rho(stl.parse(formula) if isinstance(formula, str) else formula, samples, t)


def _rho(node: stl.Formula, samples: Mapping[str, Sequence[float]], t: int) -> float:
    if isinstance(node, stl.Atom):
        return float(samples[node.name][t])
    if isinstance(node, stl.Comparison):
        left, right = _value(node.left, samples, t), _value(node.right, samples, t)
        return left - right if node.op.startswith(">") else right - left
    if isinstance(node, stl.Not):
        return -_rho(node.child, samples, t)
    if isinstance(node, stl.And):
        return min(_rho(child, samples, t) for child in node.children)
    if isinstance(node, stl.Or):
        return max(_rho(child, samples, t) for child in node.children)
    if isinstance(node, stl.Implies):
        return max(-_rho(node.left, samples, t), _rho(node.right, samples, t))
    if isinstance(node, stl.Always):
        return min(_rho(node.child, samples, t + k) for k in range(node.a, node.b + 1))
    if isinstance(node, stl.Eventually):
        return max(_rho(node.child, samples, t + k) for k in range(node.a, node.b + 1))
    if isinstance(node, stl.Until):
        return max(
            min([_rho(node.right, samples, t + k)] + [_rho(node.left, samples, t + j) for j in range(k)])
            for k in range(node.a, node.b + 1)
        )
    raise TypeError(node)


def _value(node: stl.Term, samples: Mapping[str, Sequence[float]], t: int) -> float:
    if isinstance(node, stl.Number):
        return node.value
    if isinstance(node, stl.Name):
        return float(samples[node.name][t])
    if isinstance(node, stl.Neg):
        return -_value(node.child, samples, t)
    if isinstance(node, stl.Abs):
        return abs(_value(node.child, samples, t))
    if isinstance(node, stl.Arithmetic):
        left, right = _value(node.left, samples, t), _value(node.right, samples, t)
        return {
            "+": lambda: left + right,
            "-": lambda: left - right,
            "*": lambda: left * right,
            "/": lambda: left / right,
        }[node.op]()
    raise TypeError(node)
