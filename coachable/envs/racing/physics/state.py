"""Names of the rows of the packed tensors of a car's state and inputs."""

from typing import NamedTuple

from torch import Tensor


class CarState(NamedTuple):
    """State of N cars with one tensor (N,) per field, packed as the rows of one tensor (29, N).

    Units are SI, with temperatures in °C, wear in [0, 1] and fuel in litres. The order of the wheels is front left,
    front right, rear left, rear right. x points forward and y to the left; steering angle and lateral acceleration are
    positive to the left.
    """

    x: Tensor
    y: Tensor
    yaw: Tensor
    vx: Tensor  # in the car's frame
    vy: Tensor
    yaw_rate: Tensor
    spin_fl: Tensor  # wheel speeds [rad/s]
    spin_fr: Tensor
    spin_rl: Tensor
    spin_rr: Tensor
    steer: Tensor  # angle of the front wheels
    ax: Tensor  # accelerations, low-passed: they shift the loads
    ay: Tensor
    heat_fl: Tensor
    heat_fr: Tensor
    heat_rl: Tensor
    heat_rr: Tensor
    wear_fl: Tensor
    wear_fr: Tensor
    wear_rl: Tensor
    wear_rr: Tensor
    fuel: Tensor
    gear: Tensor  # 1, 2, ... as a float
    shift_time: Tensor  # left of the torque cut
    throttle: Tensor
    brake: Tensor
    steer_command: Tensor  # in [-1, 1], moves linearly through a control step
    off_time: Tensor  # with three wheels off the track, in this control step
    wall_time: Tensor  # touching a wall, in this control step


class CarInputs(NamedTuple):
    """Constants of N cars in a control step with a tensor (N,) per field, packed as the rows of one tensor (15, N)."""

    steer_step: Tensor  # change of the steering command per substep
    throttle: Tensor
    brake: Tensor
    drag_factor: Tensor  # of the slipstream
    front_lift_factor: Tensor
    grip_factor: Tensor  # of the compound
    wear_factor: Tensor
    # Nearest point of the centre line: an arc that stands for the track during the control step.
    node_x: Tensor
    node_y: Tensor
    node_tx: Tensor
    node_ty: Tensor
    curvature: Tensor
    left: Tensor  # half-widths
    right: Tensor
    margin: Tensor  # from the edge of the track to the wall


STATE_ROWS = len(CarState._fields)
INPUT_ROWS = len(CarInputs._fields)
ROW = {name: row for row, name in enumerate(CarState._fields)}
SPINS = slice(ROW["spin_fl"], ROW["spin_rr"] + 1)
HEATS = slice(ROW["heat_fl"], ROW["heat_rr"] + 1)
WEARS = slice(ROW["wear_fl"], ROW["wear_rr"] + 1)
