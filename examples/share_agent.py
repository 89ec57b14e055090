"""Packs a run's agent for the Hugging Face Hub: weights and config in one file, and a model card.

    python examples/share_agent.py outputs/... shared
    hf upload <user>/<name> shared              # of huggingface_hub, after `hf auth login`

Loading it runs no code of whoever shared it:

    file = huggingface_hub.hf_hub_download("<user>/<name>", "agent.safetensors")
    agent = Agent.load(file, scene="s_turn")
"""

import sys
from collections import defaultdict
from pathlib import Path

import yaml

from flowrep import Agent
from flowrep.experiment.outcomes import outcome_shares
from flowrep.experiment.run import RunFolder

CARD = """---
library_name: flowrep
pipeline_tag: reinforcement-learning
---

# {scene}: {maps}, {frames:,} frames

| scene | its id | policy | people | Hz | episodes | success, % | 95 % |
| --- | --- | --- | --- | --- | --- | --- | --- |
{rows}

```yaml
{config}```
"""


def pack(run: Path, folder: Path) -> None:
    """Writes the agent and its card, with every evaluation after the training, into a folder."""
    agent = Agent.load(run, device="cpu")
    folder.mkdir(parents=True, exist_ok=True)
    agent.save(folder / "agent.safetensors")
    ends = defaultdict(list)
    for row in RunFolder(run).read_episodes():
        if row["evaluation"] != "training":
            cells = (row[key] for key in ("scene", "scene_id", "policy", "speed", "fps"))
            ends[" | ".join(cells)].append(row["outcome"])
    rows = []
    for condition, outcomes in ends.items():
        share, low, high = (100 * each for each in outcome_shares(outcomes)["success"])
        rows.append(f"| {condition} | {len(outcomes)} | {share:.1f} | {low:.0f}–{high:.0f} |")
    scene, maps = agent.config.scene.name, " + ".join(agent.config.representations)
    config = yaml.safe_dump(agent.config.plain(), sort_keys=False)
    facts = {"scene": scene, "maps": maps, "frames": agent.frames, "config": config}
    (folder / "README.md").write_text(CARD.format(**facts, rows="\n".join(rows)), "utf-8")


if __name__ == "__main__":
    pack(*map(Path, sys.argv[1:]))
