"""A language model whose words are a robot's actions, generating inside a rule.

    pip install -e '.[transformers]'
    python examples/action_tokens.py           # in process: no service is needed

The model is a GPT-2 with random weights, four words and no idea of the room: a stand-in for a
vision-language-action model that says its actions as tokens. Two of the actions take two tokens.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from transformers import GPT2Config, GPT2LMHeadModel, LogitsProcessorList

from specshield.integrations.transformers import ShieldLogitsProcessor, score_actions
from specshield.local import LocalShield
from specshield.world.occupancy import OccupancyGrid

END_OF_TEXT, FORWARD, TURN, LEFT, RIGHT = range(1, 6)  # token ids
TOKENS = [[FORWARD], [TURN, LEFT], [TURN, RIGHT]]
ROBOT = {
    "footprint": {"radius": 0.2},
    "actions": [
        {"name": "forward", "translate": 0.3},
        {"name": "turn left", "rotate": 0.5235987755982988},
        {"name": "turn right", "rotate": -0.5235987755982988},
    ],
}
REGIONS = {
    "Dock": {"type": "circle", "center": [3.5, 3.5], "radius": 0.5},
    "Stairs": {"type": "rectangle", "min": [1.6, 1.6], "max": [2.6, 2.6]},
}
RULE = "F[0,30] Dock and G[0,40] not touches(Stairs)"
START = (0.8, 0.8, 0.0)


def tiny_model(vocabulary: int, seed: int) -> Any:
    torch.manual_seed(seed)
    size = {"n_embd": 16, "n_layer": 1, "n_head": 2, "n_positions": 128}
    config = GPT2Config(vocab_size=vocabulary, bos_token_id=0, eos_token_id=END_OF_TEXT, **size)
    return GPT2LMHeadModel(config).eval()


def say_action(model: Any, prompt: Any, session: Any, pose: Any) -> tuple[int, Any]:
    """One action, generated inside the rule of the session, and the decision that it was drawn from."""
    shaping = ShieldLogitsProcessor(
        lambda logits: session.step(pose, logits, main_task_done=False),
        TOKENS,
        logits=score_actions(model, prompt, TOKENS),
    )
    text = model.generate(
        prompt, do_sample=True, top_k=0, max_new_tokens=shaping.longest, pad_token_id=END_OF_TEXT,
        logits_processor=LogitsProcessorList([shaping]),
    )  # fmt: skip
    return shaping.action(text), shaping.decision


def run(episodes: int) -> int:
    """In how many of them the rule is kept."""
    torch.set_num_threads(1)  # the model is tiny
    shield = LocalShield.make(OccupancyGrid(np.zeros((40, 40), bool), 0.1), RULE, REGIONS, robot=ROBOT)
    kept = 0
    for seed in range(episodes):
        model, pose = tiny_model(vocabulary=8, seed=seed), START
        prompt = torch.tensor([[0]])
        with shield.session(initial_pose=pose, uncertainty="none", learn_map=False) as session:
            while session.spec_status == "pending":
                action, decision = say_action(model, prompt, session, pose)
                pose = decision.next_poses[action]
                prompt = torch.cat([prompt, torch.tensor([TOKENS[action]])], dim=1)  # what it has done so far
        kept += session.spec_status == "satisfied"
    return kept


def main() -> None:
    episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    print(f"the rule was kept in {run(episodes)} of {episodes} episodes")


if __name__ == "__main__":
    main()
