"""Action tokens of a Hugging Face model, generated inside a rule.

    tokens = [tokenizer.encode(name, add_special_tokens=False) for name in session.info.actions]
    logits = score_actions(model, prompt, tokens)                       # not needed for single tokens
    shaping = ShieldLogitsProcessor(lambda logits: session.step(pose, logits), tokens, logits=logits)
    text = model.generate(prompt, do_sample=True, top_k=0, max_new_tokens=shaping.longest,
                          logits_processor=LogitsProcessorList([shaping]), pad_token_id=...)
    action = shaping.action(text)

Each action is one token or several. The shield decides once for each generation, at the first token. Then
each token gets the probability that the shaped distribution has for the actions that go on with it, so the
generated action is one draw from that distribution. Masking forbidden tokens one by one would be another
distribution: it renormalises at every token, and prefers actions whose first tokens are shared.

Draw at temperature 1, without top-k and top-p: Hugging Face applies those after this, and they would change
the shaped distribution. The model's own temperature belongs into the shield's logits (`temperature` here).
Generate one sequence at a time, without beams: a robot takes one action.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from transformers import LogitsProcessor

from specshield.arrays import Floats
from specshield.client.models import Decision, LocalDecision
from specshield.errors import InputError, LogitsError


class ShieldLogitsProcessor(LogitsProcessor):
    """The distribution of a decision as scores of tokens. Each generation needs a new object.

    ask: returns the decision for logits [A], usually by session.step with the pose. tokens: of each action,
    in the order of the robot's actions. logits: the model's, one for each action, by `score_actions`; None if
    every action is a single token, whose scores are used. temperature: of the model's distribution, above 0.
    eos: the token that ends an action whose tokens are the beginning of another action's.

    Raises InputError for wrong tokens or a wrong temperature, LogitsError for a wrong number of logits.
    """

    def __init__(
        self,
        ask: Callable[[Floats], Decision | LocalDecision],
        tokens: Sequence[Sequence[int]],
        *,
        logits: Any = None,
        temperature: float = 1.0,
        eos: int | None = None,
    ) -> None:
        self._ask, self._eos, self._temperature = ask, eos, temperature
        if not 0.0 < temperature < np.inf:
            what, expected = "a temperature divides the logits", "a number above 0"
            raise InputError(what, path="temperature", got=temperature, expected=expected)
        self._tokens = check_tokens(tokens, eos)
        self._logits = None if logits is None else np.asarray(logits, dtype=np.float64)
        if self._logits is None and self.longest > 1:
            what = "actions of several tokens need the model's logits of whole actions"
            raise LogitsError(what, path="logits", got=None, expected="what score_actions gives")
        self._prompt = -1  # the length of the prompt, known at the first token
        self.decision: Decision | LocalDecision | None = None

    @property
    def longest(self) -> int:
        """The most tokens that an action has."""
        return max(map(len, self._tokens))

    def __call__(self, input_ids: torch.LongTensor, scores: torch.Tensor) -> torch.Tensor:
        """The scores [1, V] of the next token: minus infinity unless it goes on with an allowed action."""
        if len(scores) != 1:
            what, got = "one sequence at a time", list(input_ids.shape)
            raise InputError(what, path="input_ids", got=got, expected="shape [1, n]")
        if self.decision is None:
            self._prompt = input_ids.shape[1]
            if self._logits is None:
                first = [sequence[0] for sequence in self._tokens]
                self._logits = scores[0, first].double().cpu().numpy()
            self.decision = self._ask(self._logits / self._temperature)
        said = tuple(input_ids[0, self._prompt :].tolist())
        shaped = torch.full_like(scores, -torch.inf)
        taken = [float(i == self.decision.execute) for i in range(len(self._tokens))]
        shares = taken if isinstance(self.decision, LocalDecision) else self.decision.distribution
        for token, mass in self._following(said, shares).items():
            shaped[0, token] = float(np.log(mass))
        return shaped

    def action(self, sequence: torch.Tensor) -> int | None:
        """The index of the generated action. sequence [1, n]: prompt and answer, as `generate` returns them.

        If it is a terminal one, run `decision.completion_action` while the rule is pending. None: the service
        is away and the robot has to stand.
        """
        if isinstance(self.decision, LocalDecision):
            return self.decision.execute
        said = tuple(sequence[0, self._prompt :].tolist())
        found = [i for i, tokens in enumerate(self._tokens) if said[: len(tokens)] == tokens]
        if not found:
            raise InputError("no action was generated", path="sequence", got=list(said), expected="an action")
        return max(found, key=lambda i: len(self._tokens[i]))

    def _following(self, said: tuple[int, ...], distribution: Sequence[float]) -> dict[int, float]:
        """The probability of each token that may come next; after a complete action only that of its end."""
        masses: dict[int, float] = {}
        for tokens, mass in zip(self._tokens, distribution, strict=True):
            if mass > 0.0 and tokens[: len(said)] == said:
                token = tokens[len(said)] if len(tokens) > len(said) else self._eos
                if token is not None:
                    masses[token] = masses.get(token, 0.0) + mass
        return masses or {0 if self._eos is None else self._eos: 1.0}  # nobody reads what follows an action


def check_tokens(tokens: Sequence[Sequence[int]], eos: int | None) -> list[tuple[int, ...]]:
    """The tokens of each action. Raises InputError if two actions cannot be told apart."""
    read = [tuple(int(token) for token in sequence) for sequence in tokens]
    for i, one in enumerate(read):
        if not one or one in read[:i]:
            what = "an action needs tokens of its own"
            raise InputError(what, path=f"tokens[{i}]", got=list(one), expected="a new list")
        if eos is None and any(other[: len(one)] == one and other != one for other in read):
            what, end = "this action's tokens begin another's", "an `eos` that tells where an action ends"
            raise InputError(what, path=f"tokens[{i}]", got=list(one), expected=end)
    return read


@torch.no_grad()
def score_actions(
    model: Any, prompt: torch.Tensor, tokens: Sequence[Sequence[int]], eos: int | None = None
) -> Floats:
    """The log-probabilities [A] of all actions after a prompt [1, n], in one pass of a causal model; with
    `eos` each action includes its end.
    """
    read = check_tokens(tokens, eos)
    ended = [sequence if eos is None else (*sequence, eos) for sequence in read]
    width, start = max(map(len, ended)), prompt.shape[1]
    padded = torch.tensor([[*sequence, *[0] * (width - len(sequence))] for sequence in ended])
    rows = torch.cat([prompt.expand(len(ended), -1), padded.to(prompt.device)], dim=1)
    ahead = torch.log_softmax(model(input_ids=rows).logits[:, start - 1 : -1].double(), dim=-1)
    each = ahead.gather(2, rows[:, start:, None])[:, :, 0].cpu().numpy()
    counted = np.arange(width) < np.array([len(sequence) for sequence in ended])[:, None]
    return np.asarray(np.where(counted, each, 0.0).sum(axis=1), dtype=np.float64)
