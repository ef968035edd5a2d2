"""`coachable verify`: check an exported model, the runtime and an environment against the model's contract."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from coachable.contract.contract import Contract, Recorded
from coachable.contract.exported_model import OnnxRun, read_model
from coachable.domain import Domain, domain_names, load_domain
from coachable.export.diagnosis import diagnose
from coachable.export.recorder import Rig
from coachable.files import CheckpointError, refusing
from coachable.signals import Signal, entry_names

TOLERANCE = 1e-4  # in float32 torch itself is off by up to 1e-5 on some processors
"""Largest difference of an exported model's actions and probabilities from torch's, at export and when replayed."""


@dataclass(frozen=True)
class Verdict:
    """Result of `verify`.

    Attributes:
        checked: Sentences on what agrees, or could not be checked.
        problems: Sentences on what differs; those that name a cause begin with "wrong".
    """

    checked: tuple[str, ...]
    problems: tuple[str, ...]


def verify(file: str | Path, domain: Domain | str | None = None) -> Verdict:
    """Replay the recorded runs of an exported model, and repeat them in an environment.

    Args:
        file: ONNX file of `coachable export`.
        domain: Domain whose environment is compared with the recording, or its name; by default the domain that the
            contract names, if it is installed.

    Raises:
        CheckpointError: If the file cannot be used; the message says why.
        ImportError: If the extra `export` is not installed.
        ValueError: If there is no domain of that name.
    """
    contract, policy = read_model(file)
    recorded = contract.recorded
    if recorded is None:
        raise CheckpointError(f"{file} has no recording: export the agent where its domain is installed")
    checked, problems = [], _replay(contract, recorded, policy)
    if not problems:
        checked.append(f"onnxruntime reproduces the {len(recorded.action)} recorded actions within {TOLERANCE:g}")
    if domain is None and contract.domain not in domain_names():
        checked.append(f"the environment was not compared: no installed package has the domain {contract.domain!r}")
        return Verdict(tuple(checked), tuple(problems))
    declared = _declared(file, contract, domain)
    found = _declarations(contract, declared) or _environment(contract, recorded, declared)
    if not found:
        runs = 2 + len(recorded.probe)
        checked.append(f"the environment of {declared.name} reproduces the observations of {runs} recorded runs")
    return Verdict(tuple(checked), (*problems, *found))


def _declared(file: str | Path, contract: Contract, domain: Domain | str | None) -> Domain:
    if isinstance(domain, Domain):
        return domain
    name = domain or contract.domain
    load_domain(name)  # an unknown name is not the fault of the file
    with refusing(file, "a configuration of its environment"):
        return load_domain(name, {"env": contract.environment})


def _replay(contract: Contract, recorded: Recorded, policy: OnnxRun) -> list[str]:
    """Compare the recorded actions with those that the graph gives now; report the first step that differs."""
    given = policy.act(recorded.observation[:-1], recorded.style)
    wrong = ~(np.abs(given - recorded.action) <= TOLERANCE)
    if not wrong.any():
        return []
    step = int(wrong.any(1).argmax())
    column = int(np.abs(given - recorded.action)[step].argmax())
    name = entry_names(contract.action)[column]
    return [
        f"the graph gives other actions: step {step}, {name} is {given[step, column]:.6g}, recorded was "
        f"{recorded.action[step, column]:.6g}; {int(wrong.any(1).sum())} of {len(given)} steps differ"
    ]


def _declarations(contract: Contract, domain: Domain) -> list[str]:
    """Compare what the domain declares with the contract."""
    problems = []
    step = domain.control_step
    if contract.control_step is not None and abs(step - contract.control_step) > 1e-9:
        problems.append(
            f"wrong control rate: a step of {domain.name} lasts {step:g} s, expected {contract.control_step:g} s"
        )
    problems += _blocks_differ("observation", contract.observation, domain.observation_groups)
    problems += _blocks_differ("action", contract.action, domain.action_groups)
    here, there = domain.make_space().names, contract.space.names
    if here != there:
        problems.append(f"{domain.name} has the styles {', '.join(here)}: expected {', '.join(there)}")
    return problems


def _blocks_differ(what: str, expected: Sequence[Signal], declared: Sequence[Signal]) -> list[str]:
    """Return the first difference in the blocks' names, widths, entries or units, if both sides named any."""
    if len(expected) == 1 and not expected[0].entries:
        return []
    for position, (ours, theirs) in enumerate(zip(declared, expected, strict=False)):
        if (ours.name, ours.width) != (theirs.name, theirs.width):
            return [
                f"wrong order of the {what}: block {position + 1} is {ours.name!r} with {ours.width} entries, "
                f"expected {theirs.name!r} with {theirs.width}"
            ]
        for k in range(ours.width):
            here, there = ours.label(k), theirs.label(k)
            if here != there:
                return [f"wrong order of the {what}: entry {k + 1} of {ours.name} is {here!r}, expected {there!r}"]
            units = ours.unit_of(k), theirs.unit_of(k)
            if units[0] != units[1]:
                return [f"wrong scale of the {what}: 1 of {here} stands for {units[0]!r}, expected {units[1]!r}"]
    return []


def _environment(contract: Contract, recorded: Recorded, domain: Domain) -> list[str]:
    """Repeat the recorded runs in the domain's environment."""
    with closing(Rig(domain, contract.space)) as rig:
        if rig.widths != contract.widths:
            return [
                f"the environment of {domain.name} has {rig.widths[0]} observations and {rig.widths[1]} actions: "
                f"expected {contract.widths[0]} and {contract.widths[1]}"
            ]
        found = diagnose(contract, recorded, partial(rig.repeat, recorded.seed))
    return [f"wrong {d.cause}: {d.text}" if d.cause else f"the environment differs: {d.text}" for d in found]
