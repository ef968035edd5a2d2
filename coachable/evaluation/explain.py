"""`coachable explain`: rank the inputs of a policy, as in the paper's tables (Appendix D)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Unpack

import torch
from matplotlib.patches import Rectangle
from tensordict import TensorDictBase
from torch import Tensor

from coachable.contract.exported_model import OnnxPolicy
from coachable.domain import Domain
from coachable.evaluation.attribution import Ranking, input_groups, rank_groups
from coachable.evaluation.episode_records import RolloutOptions, record_styles
from coachable.evaluation.figures import drawing
from coachable.evaluation.style_grid import markdown_table, write_csv
from coachable.evaluation.wording import readable
from coachable.extras import from_extra
from coachable.networks.plain import ActionOutputs
from coachable.training.weights import LoadedPolicy, domain_of, load_policy

_SHOWN = 30  # rows of the paper's tables
_BARS = 20
_RECORDED = 250  # states kept of an episode, from which `states` are chosen


def explain(
    source: str | Path, out: Path, *, episodes: int = 100, states: int = 16, **options: Unpack[RolloutOptions]
) -> str:
    """Rank the inputs of a policy over states of its own episodes; write `explain.csv`, `explain.md`, `explain.png`.

    Args:
        source: Checkpoint, run folder, weights file, or the name of a domain that ships with weights.
        out: Folder for the results, created if missing.
        episodes: Number of trajectories, each with a style from the training distribution (100 in the paper).
        states: Number of evenly spaced states per trajectory.
        **options: See `RolloutOptions`; the seed is also that of the baselines.

    Returns:
        The tables of both methods side by side, as Markdown.

    Raises:
        ImportError: If the extra `explain` is not installed.
        ValueError: If the source is an exported model, or the domain's groups do not fit its observation.
    """
    with from_extra("explain"):  # before the agent is loaded
        import captum.attr  # noqa: F401
    agent = load_policy(source)
    if isinstance(agent.actor, OnnxPolicy):
        raise ValueError(
            f"{source} is an exported model, which has no gradients: expected a run's folder, a checkpoint, a weights "
            "file, or a domain that ships with weights"
        )
    domain = domain_of(agent)
    outputs = ActionOutputs(agent.actor).eval()
    groups = input_groups(domain, agent.space, outputs.observation_dim)
    trajectories = record_states(domain, agent, episodes=episodes, states=states, **options)
    seed = options.get("seed", 0)
    rankings = rank_groups(outputs, trajectories, groups, seed=seed, progress=options.get("progress", True))
    out.mkdir(parents=True, exist_ok=True)
    write_csv([row for ranking in rankings for row in ranking.rows()], out / "explain.csv")
    table = _side_by_side(rankings)
    count = sum(len(trajectory) for trajectory in trajectories)
    title = f"{domain.name}: what moves the action ({len(trajectories)} trajectories, {count} states, seed {seed})"
    (out / "explain.md").write_text(f"# {title}\n\n{table}", encoding="utf-8")
    _draw(rankings, out / "explain.png", title)
    return table


def record_states(
    domain: Domain, agent: LoadedPolicy, *, episodes: int = 100, states: int = 16, **options: Unpack[RolloutOptions]
) -> list[Tensor]:
    """Record inputs of the network along episodes of the policy, each with a style from the training distribution.

    `episodes`, `states` and the options are those of `explain`.

    Returns:
        Observation and encoded style (S, observation + theta) of each trajectory.

    Raises:
        ValueError: If there are fewer than 2 episodes or no states.
    """
    if episodes < 2 or states < 1:
        raise ValueError(f"expected at least 2 episodes and 1 state of each, got {episodes=}, {states=}")
    theta = agent.space.sample((episodes,), torch.Generator().manual_seed(options.get("seed", 0)))
    recorder = _Observations(max(1, (options.get("steps") or domain.episode_steps) // _RECORDED))
    record = record_styles(
        domain, agent.actor, agent.space, theta, f"{episodes} episodes", measures=recorder, **options
    )
    observed = torch.stack(recorder.observations)  # (T', N, observation)
    lengths = record.alive[:: recorder.every].sum(0).tolist()
    encoded = agent.space.encode(theta)
    trajectories = []
    for row, length in enumerate(lengths):
        chosen = torch.linspace(0, length - 1, min(states, length)).round().long()
        trajectories.append(torch.cat([observed[chosen, row], encoded[row].expand(len(chosen), -1)], -1))
    return trajectories


class _Observations:
    """Stand-in for a domain's measures that keeps the observation of every `every`-th step."""

    def __init__(self, every: int) -> None:
        self.every = every
        self.observations: list[Tensor] = []
        self._step = 0

    def step(self, transition: TensorDictBase) -> dict[str, Tensor]:
        if self._step % self.every == 0:
            self.observations.append(transition.get("observation").clone())
        self._step += 1
        return {}


def _side_by_side(rankings: Sequence[Ranking]) -> str:
    columns: dict[str, str] = {"rank": ""}
    rows: list[dict[str, Any]] = [{"rank": i + 1} for i in range(min(_SHOWN, len(rankings[0].groups)))]
    for ranking in rankings:
        columns |= {ranking.method: "", f"{ranking.method} mean": ".4f", f"{ranking.method} std": ".4f"}
        for row, entry in zip(rows, ranking.rows(), strict=False):
            row[ranking.method] = readable(entry["group"])
            row[f"{ranking.method} mean"], row[f"{ranking.method} std"] = entry["mean"], entry["std"]
    return markdown_table(rows, columns)


def _draw(rankings: Sequence[Ranking], path: Path, title: str) -> None:
    shown = min(_BARS, len(rankings[0].groups))
    labels = {"SHAP": "mean |contribution| to the action", "saliency": "mean |d action / d input|"}
    with drawing(path, 1, len(rankings), size=(11, 1.2 + 0.26 * shown), grid=False) as panels:
        for panel, ranking in zip(panels[0], rankings, strict=True):
            groups, means = ranking.groups[:shown], ranking.means[:shown]
            colours = ["C1" if group.is_style else "C0" for group in groups]
            panel.barh(range(shown), means, xerr=ranking.deviations[:shown], color=colours, ecolor="0.4", capsize=2)
            panel.set_yticks(range(shown), [readable(group.name) for group in groups])
            panel.invert_yaxis()
            panel.set_xlim(left=0)
            panel.set_xlabel(labels[ranking.method])
            panel.set_title(ranking.method, fontsize=10)
            panel.set_axisbelow(True)
            panel.grid(axis="x", alpha=0.3)
        handles = [Rectangle((0, 0), 1, 1, color=colour) for colour in ("C1", "C0")]
        panels[0, -1].legend(handles, ["style", "observation"], loc="lower right", fontsize=9)
        panels[0, 0].figure.suptitle(title, fontsize=10)
