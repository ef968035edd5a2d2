"""The single-track drift model of CommonRoad in torch, for N cars, built from the parts of our double-track model.

Equations: Althoff and Würsching, "CommonRoad: Vehicle Models", 2020, section on the single-track drift model. The tyre
is Pacejka's combined-slip curve; how wheel forces move the body, and which way everything is positive, is ours.
"""

import torch

from coachable.envs.racing.physics.body import rotate, sum_wheels, wheel_force, wheel_velocity

GRAVITY = 9.81
BLEND_SPEED, BLEND_WIDTH = 0.2, 0.05  # [m/s], below which the model turns kinematic
SPEED_MIN = BLEND_SPEED / 2


def limit_steering_rate(steer, rate, limits):
    stuck = ((steer <= limits.min) & (rate <= 0)) | ((steer >= limits.max) & (rate >= 0))
    return torch.where(stuck, 0.0, rate.clamp(limits.v_min, limits.v_max))


def limit_acceleration(speed, acceleration, limits):
    most = torch.where(speed > limits.v_switch, limits.a_max * limits.v_switch / speed, limits.a_max)
    stuck = ((speed <= limits.v_min) & (acceleration <= 0)) | ((speed >= limits.v_max) & (acceleration >= 0))
    limited = torch.minimum(acceleration.clamp(min=-limits.a_max), most)
    return torch.where(stuck, 0.0, limited)


def magic(b, c, e, slip):
    """Argument of the sine or cosine of the magic formula."""
    return c * torch.atan(b * slip - e * (b * slip - torch.atan(b * slip)))


def tyre_forces(slip, angle, load, t):
    """Combined-slip forces along and across a wheel, camber 0. `slip` is positive when braking."""
    stiffness = t.p_kx1 / (t.p_cx1 * t.p_dx1)
    pure_x = t.p_dx1 * load * torch.sin(magic(stiffness, t.p_cx1, t.p_ex1, t.p_hx1 - slip) + load * t.p_vx1)
    stiffness = t.p_ky1 / (t.p_cy1 * t.p_dy1)
    pure_y = t.p_dy1 * load * torch.sin(magic(stiffness, t.p_cy1, t.p_ey1, angle))

    b = t.r_bx1 * torch.cos(torch.atan(t.r_bx2 * slip))
    rest = torch.cos(magic(b, t.r_cx1, t.r_ex1, torch.full_like(slip, t.r_hx1)))
    fx = pure_x / rest * torch.cos(magic(b, t.r_cx1, t.r_ex1, angle + t.r_hx1))

    b = t.r_by1 * torch.cos(torch.atan(t.r_by2 * (angle - t.r_by3)))
    rest = torch.cos(magic(b, t.r_cy1, t.r_ey1, torch.full_like(slip, t.r_hy1)))
    side = t.p_dy1 * load * t.r_vy1 * torch.cos(torch.atan(t.r_vy4 * angle))
    side = side * torch.sin(t.r_vy5 * torch.atan(t.r_vy6 * slip))
    return fx, pure_y / rest * torch.cos(magic(b, t.r_cy1, t.r_ey1, slip + t.r_hy1)) + side


def derivative(state, rate, acceleration, p):
    """Time derivative of x, y, steer, speed, yaw, yaw rate, slip angle, front and rear wheel speed, (9, N)."""
    _, _, steer, speed, yaw, yaw_rate, beta, spin_f, spin_r = state.unbind(0)
    rate = limit_steering_rate(steer, rate, p.steering)
    acceleration = limit_acceleration(speed, acceleration, p.longitudinal)
    base = p.a + p.b
    moving = speed > SPEED_MIN

    # Both wheels of one track: positions (2, 1), steering and forces (2, N).
    x = torch.tensor([[p.a], [-p.b]], dtype=state.dtype)
    y = torch.zeros_like(x)
    angle = torch.stack([steer, torch.zeros_like(steer)])
    cos, sin = torch.cos(angle), torch.sin(angle)
    vx, vy = speed * torch.cos(beta), speed * torch.sin(beta)
    body_x, body_y = wheel_velocity(vx, vy, yaw_rate, x, y)
    slip_angle = torch.where(moving, torch.atan(body_y / body_x) - angle, 0.0)
    along = rotate(body_x, body_y, cos, -sin)[0].clamp(min=0.0)
    spin = torch.stack([spin_f, spin_r])
    slip = 1 - p.R_w * spin / along.clamp(min=SPEED_MIN)
    shift = acceleration * p.h_s
    load = p.m / base * torch.stack([GRAVITY * p.b - shift, GRAVITY * p.a + shift])
    fx, fy = tyre_forces(slip, slip_angle, load, p.tire)
    force = sum_wheels(wheel_force(fx, fy, cos, sin, x, y))

    # The body's acceleration along and across its velocity.
    pull, turn = rotate(force.x, force.y, torch.cos(beta), -torch.sin(beta))
    beta_rate = torch.where(moving, turn / (p.m * speed) - yaw_rate, 0.0)
    torque = p.m * p.R_w * acceleration
    brake, engine = torque.clamp(max=0.0), torque.clamp(min=0.0)
    split = torch.tensor([[p.T_sb, p.T_se], [1 - p.T_sb, 1 - p.T_se]], dtype=state.dtype)
    spin_rate = (split[:, :1] * brake + split[:, 1:] * engine - p.R_w * fx) / p.I_y_w
    spin_rate = torch.where(spin >= 0, spin_rate, 0.0)

    # The kinematic model, which takes over at walking pace.
    tan = torch.tan(steer)
    course = torch.atan(tan * p.b / base)
    course_rate = p.b * rate / (base * torch.cos(steer) ** 2 * (1 + (tan**2 * p.b / base) ** 2))
    turn_rate = speed * torch.cos(course) * tan / base
    turn_change = acceleration * torch.cos(beta) * tan - speed * torch.sin(beta) * course_rate * tan
    turn_change = (turn_change + speed * torch.cos(beta) * rate / torch.cos(steer) ** 2) / base
    spin_change = (along / p.R_w - spin.clamp(min=0.0)) / 0.02

    dynamic = torch.stack([pull / p.m, yaw_rate, force.yaw / p.I_z, beta_rate, *spin_rate])
    kinematic = torch.stack([acceleration, turn_rate, turn_change, course_rate, *spin_change])
    share = 0.5 * (torch.tanh((speed - BLEND_SPEED) / BLEND_WIDTH) + 1)
    place = torch.stack([speed * torch.cos(beta + yaw), speed * torch.sin(beta + yaw), rate])
    return torch.cat([place, share * dynamic + (1 - share) * kinematic])


def integrate(state, rate, acceleration, p, h, steps):
    """Runge-Kutta of order four with constant inputs."""
    for _ in range(steps):
        k1 = derivative(state, rate, acceleration, p)
        k2 = derivative(state + h / 2 * k1, rate, acceleration, p)
        k3 = derivative(state + h / 2 * k2, rate, acceleration, p)
        k4 = derivative(state + h * k3, rate, acceleration, p)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state
