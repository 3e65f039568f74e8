"""An episode, step by step: Algorithm 1, and what is handed on where rule, map or robot changes."""

from specshield.episode.algorithm import check_place, check_switch, close, decide, start
from specshield.shield.decision import Carry, Config, Decision, Shield, make_shield

__all__ = [
    "Carry",
    "Config",
    "Decision",
    "Shield",
    "check_place",
    "check_switch",
    "close",
    "decide",
    "make_shield",
    "start",
]
