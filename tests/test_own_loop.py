"""The program of docs/guides/own_loop.md, with fewer env-steps."""

import re

import torch

from tests.test_docs import ROOT


def test_the_loop_of_the_guide_runs():
    text = (ROOT / "docs" / "guides" / "own_loop.md").read_text()
    (program,) = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert "FRAMES = 4, 24_000" in program
    names = {}
    exec(program.replace("FRAMES = 4, 24_000", "FRAMES = 4, 1_280"), names)
    assert len(names["replay"]) >= 1_000 and torch.isfinite(names["critic_loss"])
    assert names["sample"].shape == (128, 3) and names["rollout"].shape == (4, 250)
    torch.testing.assert_close(names["rollout"]["style"][:, -1], names["asked"])
