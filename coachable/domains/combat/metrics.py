"""Measures of damage, states and parts in a fight, for comparison with the requested style."""

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
    """Measures of the damage that counts for each style, the style score, and the outcome of a fight.

    The environment must emit `components` (`CombatEnv(components=True)`).

    Args:
        styles: Names of theta's weights, in order; all 18 by default.
    """

    needs = "damage, under a weight above 0"
    """Condition under which compliance can be judged."""

    def __init__(self, styles: Sequence[str] | None = None, reward_scale: str = "sim") -> None:
        self.styles = check_styles(styles)
        self._high = combat_style_space(self.styles, reward_scale).high
        self._rows = torch.tensor([STYLES.index(name) for name in self.styles])
        self._counts = style_counts(STYLES)  # (18, 44)

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """Return the measures of a step; see `StyleMeasures.step`.

        They are the damage [HP], or units of parts, that counts for each of the 18 styles, all damage, the damage that
        counts for the style with the largest weight ("requested"), and the outcome.
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
        """Return sums over the steps that count, and the style score; see `StyleMeasures.summarise`.

        The score is the share of the damage that counts for the style with the largest weight. It may exceed 1 for part
        styles, for which removals count.

        Args:
            record: Outputs of `step` (T, N), by name.
            alive: Steps that count (T, N) bool.

        Returns:
            Values (N,) by name.
        """
        sums = {name: torch.where(alive, values, 0.0).sum(0) for name, values in record.items()}
        score = sums["requested"] / sums["damage"].clamp(min=1e-6)
        return {**sums, "style_score": torch.where(sums["damage"] > 0, score, torch.nan)}

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return the steps (T, N) bool in which damage counts for the requested style; see `StyleMeasures.complies`."""
        return record["requested"] > 0

    def judged(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return whether each step has damage while a style is requested, (T, N) bool."""
        return ~torch.isnan(record["requested"]) & ((record["damage"] > 0) | (record["requested"] > 0))
