"""`coachable export`: write a trained policy as one ONNX file that runs without torch."""

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from coachable import __version__
from coachable.contract.contract import Contract
from coachable.contract.exported_model import OnnxRun
from coachable.domain import Domain, domain_names
from coachable.export.graph import forget_sources, import_onnx, quietly
from coachable.export.recorder import Rig, record
from coachable.export.verify import TOLERANCE
from coachable.files import CheckpointError, space_named
from coachable.networks.plain import DeterministicAction
from coachable.outputs import complete_file
from coachable.signals import Signal
from coachable.styles import StyleSpace
from coachable.training.weights import LoadedPolicy, domain_of, load_policy, widths_of

_SAMPLES = 256  # inputs for which they are compared


def export(source: str | Path, out: Path) -> float:
    """Write the deterministic policy as ONNX and compare it with torch.

    The inputs are `observation` (batch, obs_dim) and `style` (batch, d), which is raw theta in natural units, because
    the encoding is part of the graph. The output is `action` (batch, A) in [-1, 1]. The outputs of mixed actions are
    `axes` (batch, axes) in [-1, 1], `choices` (batch, heads), the index of the likeliest value of each head, and
    `probabilities` (batch, all values), from which choices can be sampled. The batch size is dynamic.

    The file also holds the agent's contract, with recorded runs that `coachable verify` repeats.

    Args:
        source: Checkpoint, run folder, weights file, or the name of a domain that ships with weights.
        out: File to write, for example `policy.onnx`.

    Returns:
        Largest difference between the file's actions and torch's, over random inputs.

    Raises:
        ImportError: If the extra `export` is not installed.
        ValueError: If the policy is of a kind that cannot be exported.
        CheckpointError: If the source does not hold a usable policy, or file and torch differ by more than
            `TOLERANCE`; no file is written then.
        OSError: If writing fails; the message says how much space is needed.
    """
    import_onnx()
    agent = load_policy(source)
    domain = domain_of(agent) if agent.metadata["domain"] in domain_names() else None
    return write_onnx(agent, domain, out)


def write_onnx(agent: LoadedPolicy, domain: Domain | None, out: Path) -> float:
    """Write the deterministic policy of a loaded agent as ONNX, with its contract; see `export`.

    Args:
        agent: Agent from `load_policy`.
        domain: Its domain, in which the recording is made; without one the contract has neither a recording nor a
            control step.
        out: File to write.

    Returns:
        Largest difference between the actions of the file and those of torch.

    Raises:
        CheckpointError: If the file differs from torch by more than the tolerance.
    """
    onnx = import_onnx()
    plain = DeterministicAction(agent.actor).eval()
    model = _trace(plain).model_proto
    forget_sources(model)
    contract = contract_of(agent, plain, domain)
    if domain is not None:
        with closing(Rig(domain, agent.space)) as rig:
            policy = OnnxRun(model.SerializeToString(), contract)
            contract = replace(contract, recorded=record(rig, contract, policy))
    onnx.helper.set_model_props(model, {"coachable_version": __version__} | contract.to_metadata())
    onnx.checker.check_model(model)
    content = model.SerializeToString()
    with complete_file(out) as unfinished:
        with space_named(out, len(content)):
            unfinished.write_bytes(content)
        difference = largest_difference(unfinished, plain, agent.space)
        if not difference <= TOLERANCE:
            source = agent.metadata["source"]
            raise CheckpointError(
                f"the exported policy of {source} differs from torch by {difference:.2g}: expected at most {TOLERANCE}"
            )
    return difference


def contract_of(agent: LoadedPolicy, plain: DeterministicAction, domain: Domain | None) -> Contract:
    """Return the contract of an agent with a deterministic policy, without a recording."""
    observed, acted = widths_of(agent)
    signals = domain.observation_groups if domain else (), domain.action_groups if domain else ()
    environment = agent.config.get("env", {})
    return Contract(
        space=agent.space,
        observation=tuple(signals[0]) or (Signal("observation", observed),),
        action=tuple(signals[1]) or (Signal("action", acted),),
        choice_sizes=plain.choice_sizes,
        domain=agent.metadata["domain"],
        control_step=domain.control_step if domain else None,
        environment=dict(environment) if isinstance(environment, Mapping) else {},
        frames=agent.metadata["frames"],
        updates=agent.metadata["updates"],
        recorded=None,
    )


def largest_difference(file: Path, plain: DeterministicAction, space: StyleSpace) -> float:
    """Compare a file, run by onnxruntime, with its policy in torch on random inputs, in batches of 1 and of all.

    Returns:
        Largest absolute difference of actions, axes and probabilities; for choices, by how much the file's choice is
        less likely than the best one. Infinite if a value is not finite.
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(_SAMPLES, plain.observation_dim, generator=generator)
    style = space.sample((_SAMPLES,), generator)
    largest = 0.0
    for rows in (slice(0, 1), slice(None)):
        inputs = {"observation": observation[rows].numpy(), "style": style[rows].numpy()}
        results = dict(zip(plain.output_names, map(torch.from_numpy, session.run(None, inputs)), strict=True))
        with torch.no_grad():
            expected = dict(zip(plain.output_names, plain(observation[rows], style[rows]), strict=True))
            for name, value in results.items():
                if name == "choices":
                    worst = _shortfall(expected["probabilities"].split(plain.choice_sizes, -1), value)
                else:
                    worst = (value - expected[name]).abs().max().item()
                largest = max(largest, worst if math.isfinite(worst) else math.inf)
    return largest


def _shortfall(probabilities: Sequence[Tensor], choices: Tensor) -> float:
    """Return by how much the choices are less likely than the best ones; rounding may break ties differently."""
    chosen = [p.gather(-1, choices[:, i : i + 1]).squeeze(-1) for i, p in enumerate(probabilities)]
    return max((p.amax(-1) - c).max().item() for p, c in zip(probabilities, chosen, strict=True))


def _trace(plain: DeterministicAction) -> Any:
    # The example has two rows, because torch.export would treat a batch of one as a constant.
    example = (torch.zeros(2, plain.observation_dim), torch.zeros(2, plain.style_dim))
    batch = torch.export.Dim("batch")
    names: dict[str, Any] = {"input_names": ["observation", "style"], "output_names": list(plain.output_names)}
    options: dict[str, Any] = {"dynamic_shapes": ({0: batch}, {0: batch}), "external_data": False, "verbose": False}
    with quietly():
        return torch.onnx.export(plain, example, dynamo=True, **names, **options)
