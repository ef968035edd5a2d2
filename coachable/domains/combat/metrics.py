"""Measured style of a fight: which damage, states and parts, beside what was asked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coachable.domains.combat.styles import combat_style_space
from coachable.envs.combat.env import COMPONENTS_KEY
from coachable.envs.combat.rewards import COMPONENT_SLICES, style_counts
from coachable.envs.combat.tables import STYLES, check_styles
from coachable.keys import STYLE


class CombatMeasures:
    """What counts for each style, the style score, victory and how a fight ended.

    Needs an env that emits `components` (`CombatEnv(components=True)`).

    Args:
        styles: names of theta's weights, in order; all 18 by default.
    """

    needs = "damage, under a weight above 0"
    """What it takes to tell whether the agent complies."""

    def __init__(self, styles: Sequence[str] | None = None) -> None:
        self.styles = check_styles(styles)
        self._high = combat_style_space(self.styles).high
        self._rows = torch.tensor([STYLES.index(name) for name in self.styles])
        self._counts = style_counts(STYLES)  # (18, 44)

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """See `StyleMeasures.step`.

        HP of damage that counts for each of the 18 styles (units for parts), all damage, and how much counts for the
        style that theta asks for most.
        """
        components = transition.get(("next", COMPONENTS_KEY))
        counted = components @ self._counts.T.to(components.device)  # (N, 18)
        wanted = transition.get(STYLE) / self._high.to(components.device)
        strongest, index = wanted.max(-1)
        damage = components[:, COMPONENT_SLICES["damage"]][:, 0]
        asked = counted.gather(-1, self._rows.to(index.device)[index].unsqueeze(-1))[:, 0]
        death, outside = (components[:, COMPONENT_SLICES[name]][:, 0] for name in ("death", "out_of_bounds"))
        terminated = transition.get(("next", "terminated"))[:, 0].float()
        return {
            "damage": damage,
            **dict(zip(STYLES, counted.unbind(-1), strict=True)),
            "requested": torch.where(strongest > 0, asked, torch.nan),
            "died": death,
            "out_of_bounds": outside,
            "won": terminated * (death + outside == 0),
        }

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        """See `StyleMeasures.summarise`: sums over the steps that count, and the style score.

        The score is what counted for the style that was asked for most, over all damage; at most 1, except for the part
        styles, whose units are removals.
        """
        sums = {name: torch.where(alive, values, 0.0).sum(0) for name, values in record.items()}
        score = sums["requested"] / sums["damage"].clamp(min=1e-6)
        return {**sums, "style_score": torch.where(sums["damage"] > 0, score, torch.nan)}

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """See `StyleMeasures.complies`: damage was done, and it counted for the style that was asked for."""
        return record["requested"] > 0

    def judged(self, record: Mapping[str, Tensor]) -> Tensor:
        """(T, N) bool: damage was done while a style was asked for."""
        return ~torch.isnan(record["requested"]) & ((record["damage"] > 0) | (record["requested"] > 0))
