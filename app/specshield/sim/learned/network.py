"""The learned model's network without torch: a causal transformer, one step at a time, in NumPy.

The input of a step is what the robot senses, what it looks for, the last executed action, and where it is by
its own count of its actions (reckoning.py). The blocks are pre-norm. Attention covers the last WINDOW steps,
with less weight on older steps (ALiBi: Press et al., 2022) and, for some heads, on steps farther away. Its
result has the way to the places of those steps, beside their values. The absolute time and place have no
influence. Keys and values are kept from step to step.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from specshield.arrays import Floats, Ints, Singles
from specshield.errors import PolicyError
from specshield.robot import STRETCH
from specshield.sim.senses import RAYS, REACH, SIGHT

KINDS = ("bowl", "pan", "laptop", "pillow", "remote", "soap")
"""What the model can be told to find."""

ACTIONS = len(STRETCH.actions)
NOTHING = ACTIONS  # the token for the last action of a robot that has not acted yet
INPUTS = RAYS + 3  # ranges, seen, distance, bearing
FEATURES = 2 * RAYS + 7
UNITS, LAYERS, WINDOW = 128, 3, 256
SLOPES = (2.0**-2, 2.0**-4, 2.0**-7, 2.0**-9)  # for each head, subtracted from a score for each step ago
FAR = (0.0, 0.0, 0.25, 2.0)  # for each head, subtracted from a score for each metre away
SPAN = 5.0  # [m] by which ways to remembered places are divided

TEMPERATURE = 0.7  # of training, and of the shipped model
FLOOR = 16.0  # [nats] no logit is further below the best one
RELUCTANCE = 2.0  # [nats] off an action that undoes the last one: an unsure model would turn to and fro
PATIENCE = 2.0  # [nats] off an action for each of the last times, TIRED at most, that it changed nothing
TIRED = 4
OPPOSITE = np.array([3, 2, 1, 0, -1, -1, 7, 6, *[-1] * (ACTIONS - 7)])  # of each last action, -1 for none


def features(senses: NDArray[np.floating], heading: NDArray[np.floating]) -> Singles:
    """The network's input: ranges on a scale from 0 to 1, finest nearby, and where the target is seen.

    The ranges are repeated as seen from the initial heading, with the heading beside them, so that the robot
    sees a place as it saw it before. senses [..., INPUTS]: ranges [m], seen (0 or 1), distance [m], bearing
    [rad]. heading [...]: by its own count [rad]. Result [..., FEATURES].
    """
    seen, distance, bearing = senses[..., RAYS], senses[..., RAYS + 1], senses[..., RAYS + 2]
    ranges = np.log1p(senses[..., :RAYS] / 0.25) / np.log1p(REACH / 0.25)
    target = np.stack(
        [np.ones_like(seen), distance / SIGHT, np.exp(-distance), np.cos(bearing), np.sin(bearing)], -1
    )
    target *= seen[..., None]
    ray = np.arange(RAYS) - heading[..., None] * (RAYS / (2.0 * np.pi))
    low = np.floor(ray)
    share = ray - low
    first = low.astype(np.int64) % RAYS
    turned = (1.0 - share) * np.take_along_axis(ranges, first, -1) + share * np.take_along_axis(
        ranges, (first + 1) % RAYS, -1
    )
    compass = np.stack([np.cos(heading), np.sin(heading)], -1)
    return np.concatenate([ranges, target, turned, compass], axis=-1).astype(np.float32)


def decoded(raw: Singles, last: Ints, futile: Ints, temperature: float) -> Floats:
    """The model's logits [N, A]. raw [N, A]: of the network. last [N]. futile [N, A + 1]: of `Reckoning`."""
    logits = raw - PATIENCE * np.minimum(futile[:, :ACTIONS], TIRED)
    undo = OPPOSITE[last]
    some = np.nonzero(undo >= 0)[0]
    logits[some, undo[some]] -= RELUCTANCE
    logits /= temperature
    floored: Floats = np.maximum(logits, logits.max(axis=1, keepdims=True) - FLOOR)
    return floored


def _shapes() -> dict[str, tuple[int, ...]]:
    linear = {"sense1": (FEATURES, 2 * UNITS), "sense2": (2 * UNITS, UNITS), "head": (UNITS, ACTIONS)}
    norms = ["norm"]
    for i in range(LAYERS):
        linear |= {f"{i}.qkv": (UNITS, 3 * UNITS), f"{i}.out": (UNITS + 2 * len(SLOPES), UNITS)}
        linear |= {f"{i}.up": (UNITS, 4 * UNITS), f"{i}.down": (4 * UNITS, UNITS)}
        norms += [f"{i}.norm1", f"{i}.norm2"]
    shapes: dict[str, tuple[int, ...]] = {"last": (ACTIONS + 1, UNITS), "kind": (len(KINDS), UNITS)}
    for name, (inputs, outputs) in linear.items():
        shapes |= {f"{name}.w": (inputs, outputs), f"{name}.b": (outputs,)}
    return shapes | {f"{name}.{part}": (UNITS,) for name in norms for part in "wb"}


SHAPES = _shapes()
"""The tensors of a weights file: w [inputs, outputs], b [outputs]; last, kind: a row for each token."""


def check(weights: Mapping[str, NDArray[np.generic]]) -> dict[str, Singles]:
    """Checks weights that come from outside. Raises PolicyError, which names the wrong tensor."""
    got, expected = sorted(weights), sorted(SHAPES)
    if got != expected:
        told = "not the tensors of a foundation model"
        raise PolicyError(told, path="weights", got=got, expected=str(expected))
    for name, shape in SHAPES.items():
        array = weights[name]
        if array.dtype != np.float32 or array.shape != shape or not np.isfinite(array).all():
            raise PolicyError(
                "a tensor is not finite float32 of the right shape",
                path=f"weights.{name}",
                got=f"{array.dtype} {list(array.shape)}",
                expected=f"float32 {list(shape)}",
            )
    return {name: np.ascontiguousarray(weights[name], np.float32) for name in SHAPES}


class Network:
    """The network in an episode, with a memory of WINDOW steps; `reset` empties it. weights: checked."""

    def __init__(self, weights: Mapping[str, Singles]) -> None:
        self._w = weights
        heads = len(SLOPES)
        self._keys = np.zeros(
            (LAYERS, heads, WINDOW, UNITS // heads), np.float32
        )  # step t in slot t % WINDOW
        self._values = np.zeros_like(self._keys)
        self._places = np.zeros((WINDOW, 2), np.float32)
        # Of slot s when step t is in slot r: -slope * ((r - s) % WINDOW), as a row to cut from.
        ago = (WINDOW - 1 - np.arange(2 * WINDOW - 1)) % WINDOW
        self._bias = (-np.array(SLOPES)[:, None] * ago).astype(np.float32)
        self.reset()

    def reset(self) -> None:
        self._t = 0

    def step(self, x: Singles, place: NDArray[np.floating], last: int, kind: int) -> Singles:
        """Logits (ACTIONS,) for the next step. x (FEATURES,). place (3,), as counted. last, kind: tokens."""
        w, heads = self._w, len(SLOPES)
        slot, held = self._t % WINDOW, min(self._t + 1, WINDOW)
        bias = self._bias[:, WINDOW - 1 - slot : WINDOW - 1 - slot + held]
        scale = np.float32((UNITS // heads) ** -0.5)
        self._places[slot] = place[:2]
        ways = self._places[:held] - self._places[slot]
        cos, sin = np.cos(place[2]), np.sin(place[2])
        ways = ways @ np.array([[cos, -sin], [sin, cos]], np.float32)  # as from the robot
        bias = bias - np.array(FAR, np.float32)[:, None] * np.hypot(ways[:, 0], ways[:, 1])
        ways /= SPAN
        h = np.maximum(x @ w["sense1.w"] + w["sense1.b"], 0.0) @ w["sense2.w"] + w["sense2.b"]
        h = h + w["last"][last] + w["kind"][kind]
        for i in range(LAYERS):
            n = _norm(h, w[f"{i}.norm1.w"], w[f"{i}.norm1.b"])
            q, k, v = (n @ w[f"{i}.qkv.w"] + w[f"{i}.qkv.b"]).reshape(3, heads, -1)
            self._keys[i, :, slot], self._values[i, :, slot] = k, v
            attention = (self._keys[i, :, :held] @ q[:, :, None])[:, :, 0] * scale + bias
            attention = np.exp(attention - attention.max(axis=1, keepdims=True))
            attention /= attention.sum(axis=1, keepdims=True)
            a = (attention[:, None] @ self._values[i, :, :held]).reshape(UNITS)
            a = np.concatenate([a, (attention @ ways).reshape(-1)])
            h = h + a @ w[f"{i}.out.w"] + w[f"{i}.out.b"]
            n = _norm(h, w[f"{i}.norm2.w"], w[f"{i}.norm2.b"])
            up = np.maximum(n @ w[f"{i}.up.w"] + w[f"{i}.up.b"], 0.0)
            h = h + up @ w[f"{i}.down.w"] + w[f"{i}.down.b"]
        self._t += 1
        logits: Singles = _norm(h, w["norm.w"], w["norm.b"]) @ w["head.w"] + w["head.b"]
        return logits


def _norm(h: Singles, w: Singles, b: Singles) -> Singles:
    centred = h - h.mean()
    out: Singles = centred / np.sqrt(np.mean(centred * centred) + np.float32(1e-5)) * w + b
    return out
