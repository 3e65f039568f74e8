"""The LogitsProcessor, in the `generate` of transformers, with a model of random weights."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from specshield.client import LocalDecision
from specshield.errors import InputError, LogitsError

SEVERAL = [[3, 4, 5], [3, 4, 6], [3, 7], [8], [9, 3], [9]]  # with tokens that begin others'
EOS = 1


def setup_module() -> None:
    """Not at the top, which every process of pytest runs: it takes 4 s."""
    global action_tokens, torch, transformers, ShieldLogitsProcessor, score_actions
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    torch, transformers = pytest.importorskip("torch"), pytest.importorskip("transformers")
    from examples import action_tokens
    from specshield.integrations.transformers import ShieldLogitsProcessor, score_actions


@pytest.fixture(scope="module")
def model() -> Any:
    return action_tokens.tiny_model(vocabulary=32, seed=4)


def drawn(model: Any, prompt: Any, tokens: Any, distribution: np.ndarray, n: int, **more: Any) -> np.ndarray:
    """How often each action is generated, of n."""
    counts = np.zeros(len(tokens))
    torch.manual_seed(0)
    for _ in range(n):
        decision = SimpleNamespace(distribution=tuple(distribution), execute=0)
        shaping = ShieldLogitsProcessor(lambda logits, made=decision: made, tokens, **more)
        text = model.generate(
            prompt, do_sample=True, top_k=0, max_new_tokens=shaping.longest,
            logits_processor=transformers.LogitsProcessorList([shaping]), pad_token_id=EOS, eos_token_id=EOS,
        )  # fmt: skip
        counts[shaping.action(text)] += 1
    return counts


def test_what_is_generated_is_drawn_from_the_decision(model: Any) -> None:
    """Sequences of several tokens that share prefixes, one of them forbidden."""
    prompt = torch.tensor([[0, 12, 13]])
    shaped = np.array([0.3, 0.0, 0.2, 0.1, 0.15, 0.25])
    counts = drawn(model, prompt, SEVERAL, shaped, 300, logits=np.zeros(6), eos=EOS)
    assert counts[1] == 0
    assert np.abs(counts / 300 - shaped).max() < 2.8 * np.sqrt(0.25 / 300)


def test_scores_are_the_models_own(model: Any) -> None:
    """Against one forward pass a token, and a whole tree of sequences sums to one."""
    prompt = torch.tensor([[0, 12, 13]])
    scores = score_actions(model, prompt, SEVERAL, EOS)
    for tokens, score in zip(SEVERAL, scores, strict=True):
        text, total = prompt, 0.0
        for token in [*tokens, EOS]:
            with torch.no_grad():
                total += torch.log_softmax(model(text).logits[0, -1].double(), -1)[token].item()
            text = torch.cat([text, torch.tensor([[token]])], 1)
        assert score == pytest.approx(total, abs=1e-5)
    everything = score_actions(model, prompt, [[a, b] for a in range(32) for b in range(32)])
    assert np.exp(everything).sum() == pytest.approx(1.0, abs=1e-6)


def test_single_tokens_are_shaped_from_the_scores_they_have(model: Any) -> None:
    prompt, tokens = torch.tensor([[0, 5]]), [[3], [8], [9]]
    with torch.no_grad():
        expected = model(prompt).logits[0, -1][[3, 8, 9]].double().numpy()
    asked: list[np.ndarray] = []

    def ask(logits: np.ndarray) -> Any:
        asked.append(logits)
        return SimpleNamespace(distribution=(0.0, 1.0, 0.0), execute=1)

    shaping = ShieldLogitsProcessor(ask, tokens, temperature=0.5)
    text = model.generate(
        prompt, do_sample=True, top_k=0, max_new_tokens=1,
        logits_processor=transformers.LogitsProcessorList([shaping]), pad_token_id=EOS,
    )  # fmt: skip
    assert asked[0] == pytest.approx(expected / 0.5, abs=1e-4)
    assert shaping.action(text) == 1


def test_what_cannot_work_is_refused(model: Any) -> None:
    with pytest.raises(LogitsError):
        ShieldLogitsProcessor(lambda logits: None, [[3, 4], [5]])
    with pytest.raises(InputError, match="begin another's"):
        ShieldLogitsProcessor(lambda logits: None, [[3], [3, 4]], logits=np.zeros(2))
    for temperature in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="expected a number above 0"):
            ShieldLogitsProcessor(lambda logits: None, [[3], [4]], temperature=temperature)
    with pytest.raises(InputError, match="of its own"):
        ShieldLogitsProcessor(lambda logits: None, [[3], [3]])
    shaping = ShieldLogitsProcessor(lambda logits: None, [[3], [4]])
    with pytest.raises(InputError, match="one sequence"):
        shaping(torch.zeros(2, 3, dtype=torch.long), torch.zeros(2, 32))


def test_a_model_that_says_anything_keeps_the_rule_in_every_episode() -> None:
    assert action_tokens.run(8) == 8


@pytest.mark.parametrize(("source", "execute"), [("witness", 2), ("stop", None)])
def test_while_the_service_is_away_the_certified_action_is_generated_or_none(
    model: Any, source: Any, execute: int | None
) -> None:
    prompt, away = torch.tensor([[0, 12, 13]]), LocalDecision(3, source, execute, "away", "pending")
    shaping = ShieldLogitsProcessor(lambda logits: away, SEVERAL, logits=np.zeros(6), eos=EOS)
    text = model.generate(
        prompt, do_sample=True, top_k=0, max_new_tokens=shaping.longest,
        logits_processor=transformers.LogitsProcessorList([shaping]), pad_token_id=EOS, eos_token_id=EOS,
    )  # fmt: skip
    assert shaping.action(text) == execute
    if execute is not None:
        assert text[0, 3:].tolist()[: len(SEVERAL[execute])] == SEVERAL[execute]
