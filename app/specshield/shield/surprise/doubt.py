"""What is believed of contacts where they leave no way: less than is marked, one guess after the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from specshield.shield.decision import Shield
from specshield.shield.feasibility import Prefix
from specshield.shield.judgement import Judged
from specshield.shield.signals import judged_by_signals
from specshield.shield.taught import Taught, on_map
from specshield.shield.uncertainty import Care
from specshield.stl import Verdict
from specshield.world.learned import CONTACT, LEFT, RIGHT, SENT, forget, revised

GUESSES = ((CONTACT, LEFT, RIGHT), (CONTACT,), (LEFT,), (RIGHT,))  # what of a contact is believed, in turn
DOUBTED_AFTER = 4  # [steps] what was run into is tried again where nothing else is left; chosen by hand


def tried_again(
    told: Shield, taught: Taught, prefix: Prefix, tail: bytes | None, spec_status: Verdict, care: Care
) -> tuple[Taught, tuple[Shield, Prefix, Judged, bool]] | None:
    """The first guess that leaves a way without what was tried in vain, else the first that leaves any, and
    how it was judged. None where no guess leaves a way. told: the shield on the policy's map.
    """
    vain = None
    for guess in doubted(taught, prefix.t):
        other = on_map(told, guess.map, True, taught.barred)
        found = judged_by_signals(other, prefix, tail, spec_status, care)
        if found[2].some and not found[2].vain:
            return guess, found
        if found[2].some and vain is None:
            vain = guess, found
    return vain


def doubted(taught: Taught, t: int) -> Iterator[Taught]:
    """What may be believed of contacts where no way is left, in the order in which it is to be tried.

    A motion that stopped short met something, but nobody knows where along its front, nor how large it is. So
    less is believed than is marked: nothing behind what was touched; only what lies straight ahead; only what
    lies to the left; only what lies to the right. Each new contact at the same pose shows that the guess
    before was wrong, and the next one is tried first. Last, contacts that were made DOUBTED_AFTER steps ago
    or earlier are forgotten, since nothing that only runs into things ever sees that one is gone.
    """
    known = taught.map
    young = t - known.step < DOUBTED_AFTER
    seen = ~known.occupied | (known.by == SENT)
    first = max(taught.followed.met - 1, 0) % len(GUESSES)
    for held in GUESSES[first:] + GUESSES[:first]:
        stays = seen | np.isin(known.by, held)
        if not stays.all() and (~seen & stays).any():
            yield replace(taught, map=revised(known, forget(known, ~stays)))
    if not (seen | young).all():
        yield replace(taught, map=revised(known, forget(known, ~(seen | young))))
