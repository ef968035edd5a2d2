"""Agents in files: their description, loading their policy, exporting and reusing their weights."""

from collections.abc import Mapping
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import LossModule

from coachable.contract.exported_model import OnnxPolicy, read_model
from coachable.domain import Domain, load_domain
from coachable.files import refusing, save_state, space_named, tensor_bytes
from coachable.networks import make_gaussian_actor, make_mixed_actor
from coachable.networks.mixed import MixedPolicy
from coachable.networks.plain import policy_network
from coachable.networks.residual import with_new_inputs
from coachable.outputs import complete_file
from coachable.shipped import located, shipped_agents
from coachable.styles import Choice, StyleSpace
from coachable.training.checkpoint import SCHEMA_VERSION, CheckpointError, check_fits, find_checkpoint, read_state

_CRITICS = "qvalue_network_params."
_PATHS = ("run_dir", "resume", "init_from")  # describe the machine that trained, not the agent
_AGENT = {"domain": str, "space": dict, "config": dict, "network": dict, "actor": dict, "critics": dict}
_ACTORS = {  # the only functions that a file may name as its network
    f"{module}.{make.__name__}": make
    for make in (make_gaussian_actor, make_mixed_actor)
    for module in ("coachable.networks", make.__module__)
}


class LoadedPolicy(NamedTuple):
    """Trained policy with the description of its training.

    Attributes:
        actor: Policy in evaluation mode, which reads `observation` and `style` and writes `action`.
        space: Style space that it was trained on.
        config: Resolved configuration of its training, in plain containers.
        metadata: `domain`, `source` (the file), and `frames` and `updates`, each None if unknown.
    """

    actor: TensorDictModuleBase
    space: StyleSpace
    config: dict[str, Any]
    metadata: dict[str, Any]


def agent_state(
    *,
    domain: str,
    space: StyleSpace,
    actor: TensorDictModuleBase,
    loss_module: LossModule,
    network: Mapping[str, Any],
    config: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the description and the weights of an agent, for a checkpoint or a weights file.

    Args:
        domain: Name under which its domain is registered.
        space: Its style space.
        actor: Its policy.
        loss_module: Loss that contains its critics.
        network: Description from which the actor can be built again, without its argument `space`:
            `{"actor": {"_target_": "coachable.networks...", **arguments}}`.
        config: Resolved configuration, in plain containers.

    Returns:
        A dictionary of plain containers and tensors, readable with `weights_only=True`.
    """
    return {
        "domain": domain,
        "space": space.to_dict(),
        "config": dict(config),
        "network": dict(network),
        "actor": _tensors(actor.state_dict()),
        "critics": _tensors(loss_module.state_dict(), _CRITICS),
    }


def load_policy(path_or_domain: Path | str, device: torch.device | str = "cpu") -> LoadedPolicy:
    """Load a trained policy.

    Args:
        path_or_domain: A run's folder, a checkpoint, a weights file, an exported model (`.onnx`), or the name of a
            domain that ships with weights, see `coachable.shipped.located`.
        device: Device of the actor; exported models run on the CPU.

    Raises:
        CheckpointError: If there is no such file or domain, or the file does not describe its policy.
        ImportError: If it is an exported model and the extra `export` is not installed.
    """
    file = _locate(path_or_domain)
    if file.suffix == ".onnx":
        return _exported(file)
    state = _read_agent(file, device)
    with refusing(file, "a style space"):
        space = StyleSpace.from_dict(state["space"])
    with refusing(file, "a network"):
        with torch.device("meta"):  # checks the shapes before a file can make this machine allocate memory
            check_fits(state["actor"], _tensors(_build(state["network"], space, file).state_dict()), "actor", file)
        actor = _build(state["network"], space, file).to(device)
        actor.load_state_dict(state["actor"])
        actor.eval().requires_grad_(False)
    with refusing(file, "counters"):
        counters = state.get("loop", {}) | {"updates": state.get("learner", {}).get("updates")}
        counters |= state.get("counters", {})
        known = {name: None if counters.get(name) is None else int(counters[name]) for name in ("frames", "updates")}
    return LoadedPolicy(actor, space, state["config"], {"domain": state["domain"], "source": str(file), **known})


def _exported(file: Path) -> LoadedPolicy:
    contract, run = read_model(file)
    counts = {"frames": contract.frames, "updates": contract.updates}
    metadata = {"domain": contract.domain, "source": str(file), **counts}
    return LoadedPolicy(OnnxPolicy(run, contract), contract.space, {"env": contract.environment}, metadata)


def domain_of(agent: LoadedPolicy) -> Domain:
    """Return the domain of an agent from `load_policy`, configured as in its training.

    The returned domain's `make_env` raises a `CheckpointError` if an environment does not fit the agent.

    Raises:
        ValueError: If there is no such domain.
        CheckpointError: If the agent has other styles, or no environment can be made from its configuration.
    """
    name, source = agent.metadata["domain"], agent.metadata["source"]
    load_domain(name)
    with refusing(source, "a configuration of its environment"):
        domain = load_domain(name, agent.config)
        here, there = _names(domain.make_space()), _names(agent.space)
    if here != there:
        raise CheckpointError(f"{source} has the styles {', '.join(there)}: domain {name} has {', '.join(here)}")
    reads = widths_of(agent)
    groups = sum(signal.width for signal in domain.observation_groups)
    if groups:
        _check_widths(source, reads, (groups, reads[1]), name)

    @wraps(domain.make_env)
    def make_env(*arguments: Any, **options: Any) -> Any:
        with refusing(source, "a configuration of its environment"):
            env = domain.make_env(*arguments, **options)
        _check_widths(source, reads, (env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]), name)
        return env

    return domain.with_fields(make_env=make_env)


def _check_widths(source: str, reads: tuple[int, int], gives: tuple[int, int], domain: str) -> None:
    if reads != gives:
        raise CheckpointError(
            f"{source} reads {reads[0]} observations and gives {reads[1]} actions: expected {gives[0]} and {gives[1]}, "
            f"as domain {domain} has them"
        )


def widths_of(agent: LoadedPolicy) -> tuple[int, int]:
    """Return the widths of an agent's observation and of its action."""
    if isinstance(agent.actor, OnnxPolicy):
        return agent.actor.contract.widths
    policy = policy_network(agent.actor)
    actions = policy.heads.action_dim if isinstance(policy, MixedPolicy) else policy.trunk.out_features // 2
    return policy.trunk.in_features - agent.space.dim, actions


def export_weights(checkpoint: Path | str, out: Path | str) -> Path:
    """Write a weights file: actor, critics and their description, without optimisers and replay buffer.

    Args:
        checkpoint: A run's folder or a checkpoint.
        out: The file to write, for example `weights.pt`.

    Returns:
        The file.

    Raises:
        CheckpointError: If there is no checkpoint, or `checkpoint` is a weights file itself.
        OSError: If writing fails.
    """
    source = _locate(checkpoint)
    state = _read_agent(source)
    if "loop" not in state and "counters" in state:
        raise CheckpointError(f"{source} is a small weights file already: expected a run's folder or a checkpoint")
    agent = {name: state[name] for name in _AGENT}
    with refusing(source, "weights"):
        for part in ("actor", "critics"):  # copied, because a view would bring its whole storage into the file
            agent[part] = {name: value.clone() for name, value in agent[part].items()}
        counters = {"frames": state["loop"]["frames"], "updates": state["learner"]["updates"]}
    agent["config"] = _without_paths(agent["config"])
    out = Path(out)
    with complete_file(out) as unfinished, space_named(out, tensor_bytes(agent)):
        save_state({"schema": SCHEMA_VERSION, **agent, "counters": counters}, unfinished)
    return out


def _without_paths(config: dict[str, Any]) -> dict[str, Any]:
    stages = config.get("stages")
    if isinstance(stages, list):
        config = {**config, "stages": [_without_paths(stage) if isinstance(stage, dict) else stage for stage in stages]}
    return {**config, **dict.fromkeys(_PATHS)}


def initialise_from(
    path_or_domain: Path | str,
    actor: TensorDictModuleBase,
    loss_module: LossModule,
    space: StyleSpace,
    new_observations: int = 0,
) -> None:
    """Overwrite the actor and critics of a new training with those of another one.

    Args:
        path_or_domain: See `load_policy`.
        actor: Actor to overwrite.
        loss_module: Loss built from `actor`; its critics and their targets are overwritten.
        space: Style space of the new training. Only its sampler may differ from that of the other training.
        new_observations: Number of columns at the end of the observation that the other training did not have. While
            they are 0, the outputs of the networks are those of the other training.

    Raises:
        CheckpointError: If style parameters, network shapes or the support of categorical critics differ, or the
            networks cannot take new observations.
    """
    file = _locate(path_or_domain)
    state = _read_agent(file)
    _check_support(state["config"], loss_module, file)
    with refusing(file, "a style space"):
        _check_space({**state["space"], "sampler": None}, StyleSpace(space.parameters, name=space.name), file)
    present = loss_module.state_dict()
    for part, fresh in (("actor", _tensors(actor.state_dict())), ("critics", _tensors(present, _CRITICS))):
        if new_observations:
            with refusing(file, "a network"):
                state[part] = _widened(state[part], state["network"]["actor"]["obs_dim"], new_observations)
        check_fits(state[part], fresh, part, file)
    actor.load_state_dict(state["actor"])
    for name, value in state["critics"].items():
        for prefix in (_CRITICS, "target_" + _CRITICS):
            present[prefix + name].copy_(value)


def _check_support(config: Mapping[str, Any], loss_module: LossModule, source: Path) -> None:
    bins: Any = getattr(loss_module, "bins", None)
    with refusing(source, "a configuration"):
        trained = config.get("loss", {})
        support = [float(trained[name]) for name in ("v_min", "v_max") if name in trained]
    if bins is not None and support and support != [bins.v_min, bins.v_max]:
        raise CheckpointError(
            f"the critics of {source} represent values in {support}, those of this training in "
            f"[{bins.v_min}, {bins.v_max}]: expected the same critic_support"
        )


def _widened(saved: Mapping[str, Tensor], seen: int, new: int) -> dict[str, Tensor]:
    """Return the weights of residual networks with `new` more inputs after the first `seen`."""
    first = "blocks.0.linear.weight"
    trunks = [name.removesuffix(first) for name in saved if name.endswith(first)]
    widened = dict(saved)
    for trunk in trunks:
        own = _tensors(saved, trunk)
        widened |= {trunk + name: value for name, value in with_new_inputs(own, seen, new).items()}
    return widened


def require_same_agent(saved: Mapping[str, Any], present: Mapping[str, Any], source: Path | str) -> None:
    """Check that the state of a checkpoint belongs to the agent of this run, whose `agent_state` is `present`.

    Raises:
        CheckpointError: If domain, style space or network shapes differ.
    """
    _check_agent(saved, source)
    if saved["domain"] != present["domain"]:
        raise CheckpointError(f"{source} belongs to domain {saved['domain']!r}, this run to {present['domain']!r}")
    with refusing(source, "a style space"):
        _check_space(saved["space"], StyleSpace.from_dict(present["space"]), source)
    for part in ("actor", "critics"):
        check_fits(saved[part], present[part], part, source)


def _check_space(saved: Mapping[str, Any], space: StyleSpace, source: Path | str) -> None:
    there, here = _essentials(saved), _essentials(space.to_dict())
    differences = here.difference(there)
    if differences:
        raise CheckpointError(
            f"{source} was trained on another style space: {' '.join(differences)} (Here is this run, there the "
            "checkpoint.) Start a new training, or declare the space as it was."
        )


def _essentials(description: Mapping[str, Any]) -> StyleSpace:
    """Return the space without help texts and evaluation ranges, which may change freely."""
    parameters = [
        {key: value for key, value in parameter.items() if key not in ("help", "evaluation")}
        for parameter in description["parameters"]
    ]
    return StyleSpace.from_dict({**description, "parameters": parameters})


def _locate(path_or_domain: Path | str) -> Path:
    path = located(path_or_domain)
    if path.is_file():
        return path
    try:
        return find_checkpoint(path)
    except CheckpointError as error:
        raise CheckpointError(f"{error}; domains with weights: {', '.join(shipped_agents()) or 'none'}") from None


def _read_agent(source: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    state = read_state(source, device)
    _check_agent(state, source)
    return state


def _check_agent(state: Mapping[str, Any], source: Path | str) -> None:
    missing = [name for name in _AGENT if name not in state]
    if missing:
        raise CheckpointError(f"{source} does not describe a policy: it lacks {', '.join(missing)}")
    for name, kind in _AGENT.items():
        if not isinstance(state[name], kind):
            raise CheckpointError(
                f"{source} has a {type(state[name]).__name__} as its {name}: expected a {kind.__name__}"
            )


def _build(network: Mapping[str, Any], space: StyleSpace, source: Path) -> TensorDictModuleBase:
    arguments = dict(network["actor"])
    target = arguments.pop("_target_")
    if target not in _ACTORS:
        names = " or ".join(name for name in _ACTORS if name.count(".") == 2)
        raise CheckpointError(f"{source} names {target!r} as its network: expected {names}")
    return _ACTORS[target](space=space, **arguments)


def _names(space: StyleSpace) -> list[str]:
    return [f"{p.name} ({'/'.join(p.options)})" if isinstance(p, Choice) else p.name for p in space.parameters]


def _tensors(state: Mapping[str, Any], prefix: str = "") -> dict[str, Tensor]:
    """Return the tensors whose names begin with a prefix, named without it."""
    return {
        k.removeprefix(prefix): v.detach() for k, v in state.items() if k.startswith(prefix) and isinstance(v, Tensor)
    }
