"""Measures of damage, states and parts in a fight, for comparison with the requested style."""

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
        self._is_damage = torch.tensor([not name.startswith("part_") for name in STYLES])

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        """Return the measures of a step; see `StyleMeasures.step`.

        They are the damage [HP], or units of parts, that counts for each of the 18 styles, all damage, what counts for
        the style with the largest weight ("requested"), the same only if it is damage ("requested_damage"), and the
        outcome.
        """
        components = transition.get(("next", COMPONENTS_KEY))
        counted = components @ self._counts.T.to(components.device)  # (N, 18)
        wanted = transition.get(STYLE) / self._high.to(components.device)
        strongest, index = wanted.max(-1)
        damage = components[:, COMPONENT_SLICES["damage"]][:, 0]
        row = self._rows.to(index.device)[index]
        asked = torch.where(strongest > 0, counted.gather(-1, row.unsqueeze(-1))[:, 0], torch.nan)
        death, outside = (components[:, COMPONENT_SLICES[name]][:, 0] for name in ("death", "out_of_bounds"))
        terminated = transition.get(("next", "terminated"))[:, 0].float()
        return {
            "damage": damage,
            **dict(zip(STYLES, counted.unbind(-1), strict=True)),
            "requested": asked,
            "requested_damage": torch.where(self._is_damage.to(row.device)[row], asked, torch.nan),
            "died": death,
            "out_of_bounds": outside,
            "won": terminated * (death + outside == 0),
        }

    def summarise(self, record: Mapping[str, Tensor], alive: Tensor) -> dict[str, Tensor]:
        """Return sums over the steps that count, and the style score; see `StyleMeasures.summarise`.

        The score is the share of the damage that counts for the style with the largest weight, over the steps in which
        such a style is requested. It is not defined for part styles, for which removals count.

        Args:
            record: Outputs of `step` (T, N), by name.
            alive: Steps that count (T, N) bool.

        Returns:
            Values (N,) by name.
        """
        record = dict(record)
        asked = record.pop("requested_damage")
        sums = {name: torch.where(alive, values, 0.0).sum(0) for name, values in record.items()}
        scored = alive & ~asked.isnan()
        counted, damage = (torch.where(scored, values, 0.0).sum(0) for values in (asked, record["damage"]))
        return {**sums, "style_score": torch.where(damage > 0, counted / damage.clamp(min=1e-6), torch.nan)}

    def complies(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return the steps (T, N) bool in which damage counts for the requested style; see `StyleMeasures.complies`."""
        return record["requested"] > 0

    def judged(self, record: Mapping[str, Tensor]) -> Tensor:
        """Return whether each step has damage while a style is requested, (T, N) bool."""
        return ~torch.isnan(record["requested"]) & ((record["damage"] > 0) | (record["requested"] > 0))
