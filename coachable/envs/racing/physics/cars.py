"""Parameters of cars, tyre compounds and resources."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from typing import Any

import torch
from torch import Tensor

CARS = ("gt3", "x2019", "street")
MAX_GEARS = 8
POOL_CARS, POOL_GT3 = 530, 50  # cars of the pool, and those of them that are derived from the GT3 car

COMPOUNDS = tuple(
    f"{kind}_{hardness}" for kind in ("comfort", "sport", "race") for hardness in ("hard", "medium", "soft")
)
RACE_COMPOUNDS = (6, 7, 8)  # indices into COMPOUNDS
_KIND_GRIP = {"comfort": 0.70, "sport": 0.83, "race": 1.0}  # estimate
_HARDNESS = {"hard": (0.95, 0.7), "medium": (1.0, 1.0), "soft": (1.04, 1.6)}  # grip, wear; estimate

_DEGREES = ("peak_slip_angle", "steer_max", "steer_rate")


@dataclass(frozen=True)
class Car:
    """Parameters of one car or of many: each field is a number, or a tensor (N,) with one value per car.

    Units are SI, with angles in radians (the data files have degrees), `grip_per_load` in 1/kN and engine speeds in
    rpm. The data files, `coachable/envs/racing/cars/*.toml`, explain each field. `gears` has eight ratios, of which the
    last real one is repeated, and `top_gear` is the number of real ones.
    """

    mass: Any
    yaw_inertia: Any
    front_axle: Any
    rear_axle: Any
    cg_height: Any
    track_front: Any
    track_rear: Any
    roll_share_front: Any
    length: Any
    width: Any
    drag_area: Any
    lift_area: Any
    aero_share_front: Any
    rolling_resistance: Any
    wheel_radius: Any
    wheel_inertia_front: Any
    wheel_inertia_rear: Any
    grip: Any
    grip_per_load: Any
    reference_load: Any
    peak_slip_ratio: Any
    peak_slip_angle: Any
    shape: Any
    power: Any
    torque: Any
    engine_brake: Any
    engine_inertia: Any
    rpm_idle: Any
    rpm_max: Any
    efficiency: Any
    final_drive: Any
    drive_share_front: Any
    brake_torque: Any
    brake_share_front: Any
    steer_max: Any
    steer_rate: Any
    gears: tuple[Any, ...]
    top_gear: Any

    def pack(self, dtype: torch.dtype = torch.float32) -> Tensor:
        """Return all numbers of one car as a tensor (P,) that ends with the gears and `top_gear`; see `unpack`."""
        scalars = [getattr(self, name) for name in _SCALARS]
        return torch.tensor([*scalars, *self.gears, self.top_gear], dtype=dtype)

    @classmethod
    def unpack(cls, packed: Tensor) -> Car:
        """Return cars whose fields are the rows (N,) of a tensor (P, N)."""
        rows = packed.unbind(0)
        count = len(_SCALARS)
        named = dict(zip(_SCALARS, rows[:count], strict=True))
        return cls(**named, gears=tuple(rows[count : count + MAX_GEARS]), top_gear=rows[-1])


_SCALARS = tuple(f.name for f in fields(Car) if f.name not in ("gears", "top_gear"))


def load_car(name: str) -> Car:
    """Return the parameters of a shipped car.

    Args:
        name: "gt3", "x2019" or "street".

    Raises:
        ValueError: If there is no such car.

    Example:
        >>> load_car("gt3").mass
        1320.0
    """
    if name not in CARS:
        raise ValueError(f"unknown car {name!r}: expected one of {', '.join(CARS)}")
    table = tomllib.loads((files("coachable.envs.racing") / "cars" / f"{name}.toml").read_text())
    values = {key: entry["value"] for key, entry in table.items()}
    for key in _DEGREES:
        values[key] = math.radians(values[key])
    gears = values.pop("gears")
    return Car(**values, gears=tuple(gears + gears[-1:] * (MAX_GEARS - len(gears))), top_gear=float(len(gears)))


def compound_table() -> Tensor:
    """Return the grip and wear factors of each compound, (9, 2)."""
    rows = []
    for name in COMPOUNDS:
        kind, hardness = name.split("_")
        grip, wear = _HARDNESS[hardness]
        rows.append([_KIND_GRIP[kind] * grip, wear])
    return torch.tensor(rows)


@dataclass(frozen=True)
class Resources:
    """Rates at which tyres wear and fuel burns; a rate of 0 switches it off.

    Attributes:
        wear: Multiple k_wear of the physical wear rate.
        fuel: Multiple k_fuel of the physical fuel rate.
        fuel_exponent: Exponent n of the fuel law. 1 is physical; 2.5 is the game-like law that rewards part throttle.
    """

    wear: float = 0.0
    fuel: float = 0.0
    fuel_exponent: float = 2.5

    @classmethod
    def calibrated(cls, car: str) -> Resources:
        """Return the rates of `resources.toml`, at which a stint on Lakeside lasts about ten laps.

        Args:
            car: "gt3" or "x2019".

        Raises:
            ValueError: If the file has no rates for this car.
        """
        table = tomllib.loads((files("coachable.envs.racing") / "resources.toml").read_text())
        if car not in table:
            raise ValueError(f"no calibrated wear and fuel rates of {car!r}: expected one of {', '.join(table)}")
        return cls(**{name: entry["value"] for name, entry in table[car].items()})


def car_pool() -> Tensor:
    """Draw a pool of different cars (our choice, for the paper's 530).

    Six archetypes (GT3, open-wheel and street car, and the GT3 car with front-wheel drive, all-wheel drive and mid
    engine) are perturbed in mass, power, torque, centre of gravity, grip and aerodynamics. The first 50 cars are
    derived from the GT3 car.

    Returns:
        Packed parameters (P, 530), always the same; see `Car.unpack`.
    """
    gt3 = load_car("gt3")
    archetypes = [
        gt3,
        load_car("x2019"),
        load_car("street"),
        replace(gt3, drive_share_front=1.0, front_axle=1.05, rear_axle=1.60, power=300e3, torque=430.0, lift_area=1.2),
        replace(gt3, drive_share_front=0.4, mass=1420.0, power=430e3, torque=600.0, lift_area=1.4),
        replace(gt3, front_axle=1.50, rear_axle=1.15, mass=1250.0, yaw_inertia=1700.0),
    ]
    generator = torch.Generator().manual_seed(0)
    columns = []
    for index in range(POOL_CARS):
        base = archetypes[0 if index < POOL_GT3 else index % len(archetypes)]
        mass, power, grip, lift, drag, shift = (1 + 0.08 * (2 * torch.rand(6, generator=generator) - 1)).tolist()
        moved = (shift - 1) * (base.front_axle + base.rear_axle) / 2
        car = replace(
            base,
            mass=base.mass * mass,
            yaw_inertia=base.yaw_inertia * mass,
            power=base.power * power,
            torque=base.torque * power,
            grip=base.grip * grip,
            lift_area=base.lift_area * lift,
            drag_area=base.drag_area * drag,
            front_axle=base.front_axle + moved,
            rear_axle=base.rear_axle - moved,
        )
        columns.append(car.pack())
    return torch.stack(columns, dim=1)
