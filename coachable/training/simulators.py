"""Saving and restoring the running episodes of environments, including third-party ones."""

from typing import Any, Protocol, runtime_checkable

from torchrl.envs import EnvBase, SerialEnv, TransformedEnv

from coachable.object_state import UnsavableError, load_object, save_object

_WRAPPED = ("DMControlWrapper", "GymWrapper")  # TorchRL's environments around one of another library, in `_env`


@runtime_checkable
class ResumableEnv(Protocol):
    """Environment whose running episodes can be saved and continued."""

    def simulator_state(self) -> dict[str, Any]:
        """Return everything that the next step depends on, as tensors and plain values."""
        ...

    def load_simulator_state(self, state: dict[str, Any]) -> None:
        """Restore what `simulator_state` returned."""
        ...


def save_simulator(env: EnvBase) -> dict[str, Any]:
    """Return the state of an environment's running episodes.

    Args:
        env: A `ResumableEnv`, one of TorchRL's wrappers of Gymnasium or dm_control, or a `SerialEnv` of them.

    Returns:
        Tensors and plain containers.

    Raises:
        UnsavableError: If a part of its state cannot be saved.
    """
    if isinstance(env, SerialEnv):  # first, because it forwards attributes to its parts
        return {"parts": [save_simulator(part) for part in env._envs]}
    if isinstance(env, TransformedEnv):
        return {"transforms": dict(env.state_dict()), "base": save_simulator(env.base_env)}
    if isinstance(env, ResumableEnv):
        return env.simulator_state()
    if any(kind.__name__ in _WRAPPED for kind in type(env).__mro__):
        return {"environment": save_object(env._env)}
    raise UnsavableError(f"{type(env).__name__} has no simulator_state() and load_simulator_state()")


def load_simulator(env: EnvBase, state: dict[str, Any]) -> None:
    """Restore what `save_simulator` returned, into an environment that was made like the saved one, and reset.

    Raises:
        UnsavableError: If a part cannot be restored. Reset the environment then.
    """
    if isinstance(env, SerialEnv):
        for part, saved in zip(env._envs, state["parts"], strict=True):
            load_simulator(part, saved)
    elif isinstance(env, TransformedEnv):
        env.load_state_dict(state["transforms"])
        load_simulator(env.base_env, state["base"])
    elif isinstance(env, ResumableEnv):
        env.load_simulator_state(state)
    else:
        load_object(env._env, state["environment"])
