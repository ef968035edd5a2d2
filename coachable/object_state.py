"""Saving and restoring the state of Gymnasium and dm_control environments from their attributes."""

import sys
from functools import partial
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import torch

# Types whose attributes are their state, by module.
_STATEFUL = {"gymnasium": ("Env",), "dm_env": ("Environment",), "dm_control.rl.control": ("Task",)}

# Types whose objects are equal in all environments that are made in the same way, by module.
_CONSTANT = {
    "gymnasium.envs.registration": ("EnvSpec",),
    "gymnasium.envs.mujoco.mujoco_rendering": ("MujocoRenderer",),
    "mujoco": ("MjModel",),
}
_SPACE = {"gymnasium": ("Space",)}  # equal, too, but for its generator of samples
_CODE = (type, partial, FunctionType, MethodType, BuiltinFunctionType, ModuleType)


class UnsavableError(ValueError):
    """A part of an environment's state cannot be saved or restored; the message names it."""


def save_object(thing: Any, known: dict[int, tuple[int, Any]] | None = None) -> dict[str, Any]:
    """Save the attributes of an environment of another library, including nested wrappers, tasks and generators.

    Args:
        thing: Object of `gymnasium` or `dm_control`. Functions are left out, and of spaces all but their generators,
            because they are equal in all environments that are made in the same way.
        known: Numbers of the arrays, lists and dicts that were saved before, by identity; None if this is the first
            object. What several attributes share is saved once, and shared again when it is restored.

    Returns:
        Tensors and plain containers.

    Raises:
        UnsavableError: If an attribute is of an unknown kind.
    """
    kind = type(thing).__name__
    changing = {n: v for n, v in vars(thing).items() if not (isinstance(v, _CODE) or _is_one_of(v, _CONSTANT))}
    known = {} if known is None else known
    return {name: _pack(value, f"{kind}.{name}", known) for name, value in changing.items()}


def load_object(thing: Any, state: dict[str, Any], known: list[Any] | None = None) -> None:
    """Restore the output of `save_object`.

    Args:
        thing: Object of the same kind as the saved one.
        state: Output of `save_object`.
        known: Arrays, lists and dicts that were restored before, by their numbers; None if this is the first object.

    Raises:
        UnsavableError: If the state does not fit the object.
    """
    known = [] if known is None else known
    for name, saved in state.items():
        if name not in vars(thing) and hasattr(type(thing), name):
            raise UnsavableError(f"{type(thing).__name__}.{name} belongs to its class, not to a checkpoint")
        vars(thing)[name] = _unpack(saved, vars(thing).get(name), f"{type(thing).__name__}.{name}", known)


def _pack(value: Any, where: str, known: dict[int, tuple[int, Any]]) -> Any:
    if value is None or type(value) in (bool, int, float, str):
        return value
    if id(value) in known:
        return {"same": known[id(value)][0]}
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        arrays = (other for _, other in known.values() if isinstance(other, np.ndarray))
        if any(np.may_share_memory(value, other) for other in arrays):
            raise UnsavableError(f"{where} is a view of another attribute's array, which cannot be saved")
    if isinstance(value, np.ndarray) or type(value) in (list, dict):
        known[id(value)] = len(known), value  # with the value, so that nothing else gets its identity
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf":
        return {"numpy": torch.from_numpy(np.array(value)), "scalar": isinstance(value, np.generic)}
    for kind in (list, tuple):
        if type(value) is kind:
            return {kind.__name__: [_pack(part, where, known) for part in value]}
    if type(value) is dict:
        keys, values = ([_pack(part, where, known) for part in parts] for parts in (value, value.values()))
        return {"keys": keys, "values": values}
    if isinstance(value, np.random.Generator):
        return {"generator": _pack(value.bit_generator.state, where, known)}
    if isinstance(value, np.random.RandomState):
        return {"generator": _pack(value.get_state(legacy=False), where, known)}
    if _is_one_of(value, _SPACE):
        return {"space": [_pack(generator, where, known) for generator in _generators(value)]}
    if (physics := _mujoco(value)) is not None:
        return {"mujoco": _save_mujoco(*physics)}
    if _is_one_of(value, _STATEFUL):
        return {"object": save_object(value, known)}
    raise UnsavableError(f"{where} is of type {type(value).__name__}, which cannot be saved")


def _unpack(saved: Any, present: Any, where: str, known: list[Any]) -> Any:
    """Return the value of an attribute; generators, simulations and objects are restored in place and returned."""
    if isinstance(saved, str) and saved != present:  # a checkpoint must not change texts such as names of files
        raise UnsavableError(f"{where} is text that changes, which is not restored")
    if not isinstance(saved, dict):
        return saved
    if "same" in saved:
        return known[saved["same"]]
    if "numpy" in saved:
        array = saved["numpy"].numpy().copy()
        if saved["scalar"]:
            return array[()]
        known.append(array)
        return array
    if "keys" in saved:
        restored: dict[Any, Any] = {}
        known.append(restored)  # before its parts, as it was numbered
        keys = [_unpack(key, key, where, known) for key in saved["keys"]]
        before = present if isinstance(present, dict) else {}
        restored |= {k: _unpack(v, before.get(k), where, known) for k, v in zip(keys, saved["values"], strict=True)}
        return restored
    for kind in (list, tuple):
        if kind.__name__ in saved:
            items, fits = saved[kind.__name__], isinstance(present, list | tuple)
            before = present if fits and len(present) == len(items) else [None] * len(items)
            parts: list[Any] = []
            if kind is list:
                known.append(parts)
            parts += [_unpack(item, old, where, known) for item, old in zip(items, before, strict=True)]
            return parts if kind is list else tuple(parts)
    if "generator" in saved and isinstance(present, np.random.Generator):
        present.bit_generator.state = _unpack(saved["generator"], present.bit_generator.state, where, known)
    elif "generator" in saved and isinstance(present, np.random.RandomState):
        present.set_state(_unpack(saved["generator"], present.get_state(legacy=False), where, known))
    elif "space" in saved and _is_one_of(present, _SPACE):
        for generator, state in zip(_generators(present), saved["space"], strict=True):
            _unpack(state, generator, where, known)
    elif "mujoco" in saved and (physics := _mujoco(present)) is not None:
        _load_mujoco(*physics, saved["mujoco"])
    elif "object" in saved and _is_one_of(present, _STATEFUL):
        load_object(present, saved["object"], known)
    else:
        raise UnsavableError(f"{where} is of type {type(present).__name__} here, and was of another kind when saved")
    return present


def _generators(space: Any) -> list[np.random.Generator]:
    """Return the generators of samples of a space of Gymnasium and of the spaces within it."""
    inner = getattr(space, "spaces", ())
    parts = inner.values() if isinstance(inner, dict) else inner
    return [space.np_random, *(generator for part in parts for generator in _generators(part))]


def _is_one_of(value: Any, kinds: dict[str, tuple[str, ...]]) -> bool:
    """Return whether a value is of one of the kinds, whose modules are imported already if there are such values."""
    modules = [(sys.modules.get(module), names) for module, names in kinds.items()]
    return any(isinstance(value, getattr(module, name)) for module, names in modules if module for name in names)


def _mujoco(value: Any) -> tuple[Any, Any] | None:
    """Return model and data of a MuJoCo or dm_control simulation, or None for other values."""
    if _is_one_of(value, {"mujoco": ("MjData",)}):
        return value.model, value
    if _is_one_of(value, {"dm_control.mujoco": ("Physics",)}):
        return value.model.ptr, value.data.ptr
    return None


def _save_mujoco(model: Any, data: Any) -> dict[str, Any]:
    """Return the state and the model, on which a step depends, and derived arrays, which rewards may read before."""
    import mujoco

    what = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, what))
    mujoco.mj_getState(model, data, state, what)
    derived, constants = (
        {name: torch.from_numpy(array.copy()) for name, array in _float_arrays(part).items()} for part in (data, model)
    )
    return {"state": torch.from_numpy(state), "derived": derived, "model": constants}


def _load_mujoco(model: Any, data: Any, saved: dict[str, Any]) -> None:
    import mujoco

    _fill(_float_arrays(model), saved.get("model", {}))  # tasks write into them: positions of targets, sizes, ...
    mujoco.mj_setState(model, data, saved["state"].numpy(), mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_forward(model, data)  # contacts and constraints
    # mj_step derives arrays before it advances the state, so that they belong to the previous state.
    _fill(_float_arrays(data), saved["derived"])


def _fill(arrays: dict[str, np.ndarray], saved: dict[str, torch.Tensor]) -> None:
    for name, array in arrays.items():
        if name in saved and tuple(saved[name].shape) == array.shape:
            array[:] = saved[name].numpy()


def _float_arrays(part: Any) -> dict[str, np.ndarray]:
    arrays = ((name, getattr(part, name)) for name in dir(part) if not name.startswith("_"))
    return {name: a for name, a in arrays if isinstance(a, np.ndarray) and a.dtype == np.float64}
