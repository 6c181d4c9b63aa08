"""A planar race car in motion, compiled: the inner loop of the fallback world.

Follows TORCS's simulation, ``simuv2``, in the plane: combined slip, wheel spin, a limited-slip
rear differential, load transfer, walls with damage. Suspension travel and hills are left out:
wheel loads follow the accelerations with a short lag instead. Fuel is not used up.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from sb3_torcs import maths
from sb3_torcs.actions import automatic_gear
from sb3_torcs.backends.lite import car
from sb3_torcs.backends.lite.rays import cast
from sb3_torcs.backends.lite.road import ground, project, road_width, walls, wrap
from sb3_torcs.car import CAR_LENGTH, CAR_WIDTH, CONTROL_TICK, MAX_DAMAGE, STEER_LOCK, CarState
from sb3_torcs.car import FloatArray as Floats
from sb3_torcs.tracks import track as column

cos_sin, hypot = maths.compiled(maths.cos_sin), maths.compiled(maths.hypot)

SUBSTEPS = 10  # physics steps per control tick, as in TORCS
DT = CONTROL_TICK / SUBSTEPS  # [s]
STEPS_PER_SECOND = 500.0  # time is counted in steps, so that it never drifts

# Walls: the columns of a wall are counted from that of its friction.
REBOUND = column.LEFT_WALL_REBOUND - column.LEFT_WALL_FRICTION
DAMAGE_RATE = column.LEFT_WALL_DAMAGE - column.LEFT_WALL_FRICTION
WALL_SPIN = 10.0  # how much a hit turns the car, simuv2's VELSCALE
WALL_SPIN_MAX = 6.0  # [rad/s]
DAMAGE_FACTOR = 0.8  # for a driver of the level "semi-pro"

# The state vector. LAPS is -1 for a car that begins elsewhere than on the grid or the line, until
# it crosses the line: the drive up to there is not a lap.
(
    STEPS, X, Y, YAW, VX, VY, YAW_RATE, ACC_X, ACC_Y, STEER,
    SPIN_FR, SPIN_FL, SPIN_RR, SPIN_RL, MOTOR, GEAR, SHIFT, DAMAGE,
    SEGMENT, ALONG, OFFSET, TANGENT, RACED, CROSSINGS, LAPS, LAP_START, LAST_LAP, BEST_LAP,
    SINK, SINK_RATE,
) = range(30)  # fmt: skip
STATE_SIZE = 30
AUTOMATIC = -99  # stands for "no gear asked for" in the compiled code
BY_ROAD_SPEED = -98  # the same, with the other gearbox


@njit(cache=True)
def locate(state: Floats, track: Floats) -> None:
    """Set SEGMENT, ALONG [m], OFFSET [m] and TANGENT [rad] from the car's position."""
    segment, along, offset, tangent = project(track, int(state[SEGMENT]), state[X], state[Y])
    state[SEGMENT], state[ALONG], state[OFFSET], state[TANGENT] = segment, along, offset, tangent


@njit(cache=True)
def _count_laps(state: Floats, track: Floats, previous: float) -> None:
    """Follow the distance and the crossings of the start line, as the game's race engine does."""
    length = track[-1, column.START] + track[-1, column.LENGTH]
    distance = track[int(state[SEGMENT]), column.START] + state[ALONG]
    moved = distance - previous
    if moved < -0.5 * length:
        moved += length
        state[CROSSINGS] += 1.0
        if state[CROSSINGS] > state[LAPS] + 1.0:
            lap = (state[STEPS] - state[LAP_START]) / STEPS_PER_SECOND
            state[LAPS] += 1.0
            if state[LAPS] > 0.0:
                state[LAST_LAP] = lap
                if state[BEST_LAP] == 0.0 or lap < state[BEST_LAP]:
                    state[BEST_LAP] = lap
            state[LAP_START] = state[STEPS]
    elif moved > 0.5 * length:  # back over the line: the next crossing must not count again
        moved -= length
        state[CROSSINGS] -= 1.0
    state[RACED] += moved


@njit(cache=True)
def _spin_up(spin: float, torque: float, brake: float, inertia: float) -> float:
    """Turn a wheel for one step; a brake stops it but never turns it backwards."""
    spin += DT * torque / inertia
    stop = DT * brake / inertia
    if abs(spin) <= stop:
        return 0.0
    return spin - math.copysign(stop, spin)


@njit(cache=True)
def _drive(state: Floats, throttle: float, clutch: float) -> tuple[float, float]:
    """Run motor and clutch; return the torque [N m] and inertia [kg m²] at each rear wheel."""
    gear, closed = int(state[GEAR]), 1.0 - clutch
    ratio = car.GEARS[gear + 1] * car.FINAL_DRIVE
    axle = 0.5 * (state[SPIN_RR] + state[SPIN_RL])
    if state[SHIFT] > 0.0:
        state[SHIFT] -= DT
    shifts = gear != 0 and state[SHIFT] > 0.0
    if gear == 0 or shifts or closed <= car.OPEN_CLUTCH:
        target = axle * ratio if shifts else car.TICKOVER + throttle * (car.LIMITER - car.TICKOVER)
        target = min(max(target, car.TICKOVER), car.REVS_MAX)
        state[MOTOR] += (target - state[MOTOR]) * (DT / 0.05)  # the free motor, 50 ms lag
        return 0.0, car.WHEEL_INERTIA_REAR
    motor, inertia, passed = axle * ratio, car.MOTOR_INERTIA, 1.0
    if clutch > 0.0:
        free = state[MOTOR] + DT * car.motor_torque(state[MOTOR], throttle) / inertia
        motor = free + (motor - free) * closed**4
        inertia, passed = inertia * closed, min(car.FULL_TORQUE * closed, 1.0)
    state[MOTOR] = min(max(motor, car.TICKOVER), car.REVS_MAX)
    torque = car.motor_torque(state[MOTOR], throttle) * ratio * car.EFFICIENCY[gear + 1] * passed
    return 0.5 * torque, car.WHEEL_INERTIA_REAR + 0.5 * inertia * ratio * ratio


@njit(cache=True)
def _hit_walls(state: Floats, track: Floats) -> None:
    """Stop the car's corners at the walls, with rebound, spin and damage as in simuv2."""
    segment, along = int(state[SEGMENT]), state[ALONG]
    left, right = walls(track, segment, along)
    offset = state[OFFSET]
    if abs(offset) + CAR_LENGTH < min(left, right):  # nowhere near
        return
    cos_yaw, sin_yaw = cos_sin(state[YAW])
    to_left_y, sin_tangent = cos_sin(state[TANGENT])
    to_left_x = -sin_tangent
    for corner in range(4):
        ahead = (0.5 if corner < 2 else -0.5) * CAR_LENGTH
        aside = (0.5 if corner % 2 else -0.5) * CAR_WIDTH
        dx = ahead * cos_yaw - aside * sin_yaw
        dy = ahead * sin_yaw + aside * cos_yaw
        lateral = offset + dx * to_left_x + dy * to_left_y
        if lateral > left:
            depth, nx, ny, wall = lateral - left, -to_left_x, -to_left_y, column.LEFT_WALL_FRICTION
        elif -lateral > right:
            depth, nx, ny, wall = -lateral - right, to_left_x, to_left_y, column.RIGHT_WALL_FRICTION
        else:
            continue
        state[X] += nx * depth
        state[Y] += ny * depth
        offset += depth * (1.0 if wall == column.RIGHT_WALL_FRICTION else -1.0)
        impact = nx * (state[VX] - state[YAW_RATE] * dy) + ny * (state[VY] + state[YAW_RATE] * dx)
        speed = max(1.0, hypot(state[VX], state[VY]))
        normal_speed = nx * state[VX] + ny * state[VY]
        cosine = normal_speed / speed
        friction, rebound = track[segment, wall], track[segment, wall + REBOUND]
        state[VX] -= nx * impact * friction
        state[VY] -= ny * impact * friction
        turn = (nx * dx + ny * dy) * impact * friction / WALL_SPIN
        state[YAW_RATE] = min(max(state[YAW_RATE] - turn, -WALL_SPIN_MAX), WALL_SPIN_MAX)
        if impact < 0.0:
            blow = 0.5 * (normal_speed * cosine) ** 2 + 0.005 * abs(1.0 - cosine) * speed
            state[DAMAGE] += math.floor(track[segment, wall + DAMAGE_RATE] * blow * DAMAGE_FACTOR)
            state[VX] -= nx * impact * rebound
            state[VY] -= ny * impact * rebound
    state[OFFSET] = offset


@njit(cache=True)
def _steer(state: Floats, command: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Turn the steering at its limited rate; return where the right and left wheel point."""
    step = car.STEER_RATE * DT
    state[STEER] += min(max(command * STEER_LOCK - state[STEER], -step), step)
    return car.front_wheels(state[STEER])


@njit(cache=True)
def _air(vx: float, vy: float, damage: float) -> tuple[float, float, float]:
    """Drag [N] against the car's axis, downforce [N] on the front and on the rear axle."""
    pressure = vx * vx
    # Wings work forwards only; the ground effect fades when the car slides sideways.
    wings = pressure if vx > 0.0 else 0.0
    straight = max(vx, 0.0) / max(hypot(vx, vy), 1.0)
    front = car.LIFT_FRONT * pressure * straight + car.WING_LIFT * car.WING_FRONT * wings
    rear = car.LIFT_REAR * pressure * straight + car.WING_LIFT * car.WING_REAR * wings
    wing_drag = (car.WING_FRONT + car.WING_REAR) * wings
    worn = 1.0 + damage / MAX_DAMAGE
    return (math.copysign(car.DRAG * pressure, vx) + wing_drag) * worn, front, rear


@njit(cache=True)
def _loads(state: Floats, front: float, rear: float) -> tuple[float, float, float, float]:
    """Load [N] on each wheel, from the downforce [N] on each axle and the accelerations."""
    along = 0.5 * car.MASS * state[ACC_X] * car.CG_HEIGHT / car.WHEELBASE
    across = 0.5 * car.MASS * state[ACC_Y] * car.CG_HEIGHT
    front = car.RATED_LOAD[0] / 1.2 + 0.5 * front - along
    rear = car.RATED_LOAD[2] / 1.2 + 0.5 * rear + along
    at_front, at_rear = across / car.TRACK_FRONT, across / car.TRACK_REAR
    return (  # a left turn presses the right side down
        max(front + at_front, 0.0),
        max(front - at_front, 0.0),
        max(rear + at_rear, 0.0),
        max(rear - at_rear, 0.0),
    )


@njit(cache=True)
def _roll(
    state: Floats,
    wheel: int,
    velocity: tuple[float, float],
    heading: tuple[float, float],
    grip_limit: tuple[float, float],
    drive: tuple[float, float, float],
) -> tuple[float, float]:
    """
    Turn one wheel for a step and return the force of its tyre on the car.

    :param state: the state vector; the wheel's spin changes
    :param wheel: its index
    :param velocity: of the wheel in the car's frame [m/s]
    :param heading: cosine and sine of its angle to the car
    :param grip_limit: load [N] and friction of the ground [-]
    :param drive: driving torque [N m], braking torque [N m], inertia [kg m²]
    :return: force along and across the car [N]
    """
    vx, vy = velocity
    load, friction = grip_limit
    torque, brake, inertia = drive
    radius, spin = car.RADIUS[wheel], state[SPIN_FR + wheel]
    cos_angle, sin_angle = heading
    rolling_speed = vx * cos_angle + vy * sin_angle
    sliding_speed = vy * cos_angle - vx * sin_angle
    reference = max(abs(rolling_speed), car.SLIP_SPEED)
    slip_x = (rolling_speed - spin * radius) / reference
    slip_y = sliding_speed / max(hypot(vx, vy), car.SLIP_SPEED)
    slip = math.sqrt(slip_x * slip_x + slip_y * slip_y)
    grip = 0.0  # [N] per slip
    if slip > 1e-9:
        force = car.tyre_grip(slip, load, car.RATED_LOAD[wheel]) * friction * car.CAMBER[wheel]
        grip = force / slip
    along, across = -grip * slip_x, -grip * slip_y
    # The tyre resists the wheel's spin the more, the slower the car: taken implicitly, since a
    # wheel is too light for an explicit step of 2 ms at walking pace.
    stiff = inertia + DT * grip * radius * radius / reference
    state[SPIN_FR + wheel] = _spin_up(spin, torque - along * radius, brake, stiff)
    return along * cos_angle - across * sin_angle, along * sin_angle + across * cos_angle


@njit(cache=True)
def _substep(
    state: Floats, track: Floats, steering: float, throttle: float, brake: float, clutch: float
) -> None:
    """Advance the car by one physics step."""
    yaw, yaw_rate = state[YAW], state[YAW_RATE]
    cos_yaw, sin_yaw = cos_sin(yaw)
    vx = state[VX] * cos_yaw + state[VY] * sin_yaw
    vy = state[VY] * cos_yaw - state[VX] * sin_yaw
    right, left = _steer(state, steering)
    headings = (right, left, (1.0, 0.0), (1.0, 0.0))
    torque, inertia = _drive(state, throttle, clutch)
    lock = car.DIFFERENTIAL * (state[SPIN_RR] - state[SPIN_RL])
    lock = min(max(lock, -car.DIFFERENTIAL_MAX), car.DIFFERENTIAL_MAX)
    torques = (0.0, 0.0, torque - lock, torque + lock)
    inertias = (car.WHEEL_INERTIA_FRONT, car.WHEEL_INERTIA_FRONT, inertia, inertia)
    drag, down_front, down_rear = _air(vx, vy, state[DAMAGE])
    loads = _loads(state, down_front, down_rear)
    state[SINK_RATE] = ((down_front + down_rear) / car.HEAVE_STIFFNESS - state[SINK]) / car.LOAD_LAG
    state[SINK] += state[SINK_RATE] * DT
    segment, along, offset = int(state[SEGMENT]), state[ALONG], state[OFFSET]
    skew = yaw - state[TANGENT]
    cos_skew, sin_skew = cos_sin(skew)

    force_x, force_y, moment, rolling = -drag, 0.0, 0.0, 0.0
    for wheel in range(4):
        x, y = car.WHEEL_X[wheel], car.WHEEL_Y[wheel]
        friction, resistance = ground(track, segment, along, offset + x * sin_skew + y * cos_skew)
        fx, fy = _roll(
            state,
            wheel,
            (vx - yaw_rate * y, vy + yaw_rate * x),
            headings[wheel],
            (loads[wheel], friction),
            (torques[wheel], brake * car.BRAKE[wheel], inertias[wheel]),
        )
        force_x += fx
        force_y += fy
        moment += fy * x - fx * y
        rolling += loads[wheel] * resistance

    speed = hypot(vx, vy)
    rolling = min(rolling, car.MASS * speed / DT) / max(speed, 1e-6)
    acc_x, acc_y = (force_x - rolling * vx) / car.MASS, (force_y - rolling * vy) / car.MASS
    state[ACC_X] += (acc_x - state[ACC_X]) * (DT / car.LOAD_LAG)
    state[ACC_Y] += (acc_y - state[ACC_Y]) * (DT / car.LOAD_LAG)
    state[VX] += (acc_x * cos_yaw - acc_y * sin_yaw) * DT
    state[VY] += (acc_x * sin_yaw + acc_y * cos_yaw) * DT
    yaw_rate += moment / car.YAW_INERTIA * DT
    state[YAW_RATE] = min(max(yaw_rate, -car.MAX_YAW_RATE), car.MAX_YAW_RATE)
    state[X] += state[VX] * DT
    state[Y] += state[VY] * DT
    state[YAW] = wrap(yaw + state[YAW_RATE] * DT)


@njit(cache=True)
def advance(
    state: Floats,
    track: Floats,
    controls: tuple[float, float, float, int, float],
    ticks: int,
) -> None:
    """
    Drive for some control ticks, changing the state vector in place.

    :param state: the state vector
    :param track: ``Track.table``
    :param controls: steering, throttle, brake, gear and clutch as in ``Controls``; the gear may be
        ``AUTOMATIC`` or ``BY_ROAD_SPEED``
    :param ticks: control ticks of 0.02 s
    """
    steering, throttle, brake, gear, pressed = controls
    for _tick in range(ticks):
        wanted, clutch = gear, pressed
        if gear == AUTOMATIC:
            wanted = automatic_gear(int(state[GEAR]), state[MOTOR], car.RATIOS)
        elif gear == BY_ROAD_SPEED:
            cos_yaw, sin_yaw = cos_sin(state[YAW])
            speed = state[VX] * cos_yaw + state[VY] * sin_yaw
            wanted, launch = car.road_speed_gear(int(state[GEAR]), speed)
            clutch = max(pressed, launch)
        if wanted != int(state[GEAR]) and state[SHIFT] <= 0.0:
            state[GEAR] = wanted
            state[SHIFT] = car.SHIFT_TIME if wanted != 0 else 0.0
        for _step in range(SUBSTEPS):
            distance = track[int(state[SEGMENT]), column.START] + state[ALONG]
            _substep(state, track, steering, throttle, brake, clutch)
            state[STEPS] += 1.0
            locate(state, track)
            _hit_walls(state, track)
            _count_laps(state, track, distance)


def place(x: float, y: float, yaw: float, speed: float, segment: int, track: Floats) -> Floats:
    """
    Return the state of a car that rolls freely, in the gear for its speed.

    :param x: [m]
    :param y: [m]
    :param yaw: [rad]
    :param speed: [m/s] along the car
    :param segment: index of the segment it stands on
    :param track: ``Track.table``
    :return: a new state vector
    """
    state = np.zeros(STATE_SIZE)
    state[X], state[Y], state[YAW] = x, y, wrap(yaw)
    cos_yaw, sin_yaw = cos_sin(yaw)
    state[VX], state[VY] = speed * cos_yaw, speed * sin_yaw
    state[SPIN_FR] = state[SPIN_FL] = speed / car.RADIUS[0]
    state[SPIN_RR] = state[SPIN_RL] = speed / car.RADIUS[2]
    gear = 1
    while (
        gear < car.TOP_GEAR
        and speed / car.RADIUS[2] * car.GEARS[gear + 1] * car.FINAL_DRIVE > 0.8 * car.LIMITER
    ):
        gear += 1
    state[GEAR] = gear
    state[MOTOR] = min(
        max(speed / car.RADIUS[2] * car.GEARS[gear + 1] * car.FINAL_DRIVE, car.TICKOVER),
        car.REVS_MAX,
    )
    state[SEGMENT] = segment
    locate(state, track)
    return state


SCALARS = CarState._fields.index("race_position")  # numbers of CarState that `read` fills, in order
GEAR_FIELD = CarState._fields.index("gear")
LAPS_FIELD = CarState._fields.index("laps")


@njit(cache=True)
def read(
    state: Floats,
    track: Floats,
    shapes: Floats,
    first: npt.NDArray[np.int64],
    reach: npt.NDArray[np.int64],
    angles: Floats,
    scalars: Floats,
    wheels: Floats,
    beams: Floats,
) -> None:
    """
    Measure the car for a ``CarState``.

    :param state: the state vector
    :param track: ``Track.table``
    :param shapes: the road's edges, and
    :param first: their places, and
    :param reach: how far to look; see :class:`~sb3_torcs.backends.lite.rays.Edges`
    :param angles: (19,) [rad] of the range finders
    :param scalars: (SCALARS,) filled in the order of ``CarState``
    :param wheels: (4,) filled [rad/s]
    :param beams: (19,) filled [m]
    """
    segment, along = int(state[SEGMENT]), state[ALONG]
    yaw = state[YAW]
    cos_yaw, sin_yaw = cos_sin(yaw)
    width = road_width(track, segment, along)
    scalars[0] = state[STEPS] / STEPS_PER_SECOND
    scalars[1], scalars[2], scalars[3] = state[X], state[Y], yaw
    scalars[4] = state[YAW_RATE]
    scalars[5] = state[VX] * cos_yaw + state[VY] * sin_yaw
    scalars[6] = state[VY] * cos_yaw - state[VX] * sin_yaw
    scalars[7] = -state[SINK_RATE]  # the road is flat, but downforce presses the springs
    scalars[8] = car.SEEN_HEIGHT - state[SINK]
    scalars[9] = wrap(state[TANGENT] - yaw)
    scalars[10] = state[OFFSET]
    scalars[11] = width
    scalars[12] = track[segment, column.START] + along
    scalars[13] = state[RACED]
    scalars[14] = state[MOTOR]
    scalars[15] = state[GEAR]
    scalars[16] = car.FUEL
    scalars[17] = state[DAMAGE]
    scalars[18] = max(state[LAPS], 0.0)
    scalars[19] = (state[STEPS] - state[LAP_START]) / STEPS_PER_SECOND
    scalars[20], scalars[21] = state[LAST_LAP], state[BEST_LAP]
    wheels[:] = state[SPIN_FR : SPIN_RL + 1]
    if abs(state[OFFSET]) > 0.5 * width:  # off the road the SCR server gives -1
        beams[:] = -1.0
    else:
        cast(shapes, first, reach, segment, (state[X], state[Y], yaw), angles, beams)
