"""A planar race car on a track, compiled: the inner loop of the fallback world.

The figures are those of TORCS's ``car1-trb1`` (``cars/car1-trb1/car1-trb1.xml`` of torcs-data
1.3.7) and the formulas follow its simulation, ``simuv2``, in the plane: magic-formula tyres with
combined slip and load sensitivity, wheel spin, a limited-slip rear differential, the engine's
torque curve, drag, wings and ground effect, walls with damage. Suspension travel and hills are
left out: wheel loads follow the accelerations with a short lag instead, and fuel is not used up.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from sb3_torcs import tracks as column
from sb3_torcs.actions import automatic_gear
from sb3_torcs.backends.lite_rays import cast
from sb3_torcs.car import CONTROL_TICK, CarState
from sb3_torcs.car import FloatArray as Floats

SUBSTEPS = 10  # physics steps per control tick, as in TORCS
DT = CONTROL_TICK / SUBSTEPS  # [s]
STEPS_PER_SECOND = 500.0  # time is counted in steps, so that it never drifts
GRAVITY = 9.80665  # [m/s²]

# Body
FUEL = 94.0  # [l] a full tank, 1 kg per litre in TORCS
MASS = 1150.0 + FUEL  # [kg]
LENGTH = 4.52  # [m]
WIDTH = 1.94  # [m]
CG_HEIGHT = 0.25  # [m]
FRONT_WEIGHT = 0.52  # share of the weight on the front axle
INERTIA_ARM = 0.62**2 * LENGTH**2 + WIDTH**2  # [m²] "mass repartition coefficient" 0.62
YAW_INERTIA = MASS * INERTIA_ARM / 12.0  # [kg m²]
MAX_YAW_RATE = 9.0  # [rad/s] the limit of simuv2
AXLE_FRONT, AXLE_REAR = 1.22, -1.42  # [m] in the car file's frame
CG_X = FRONT_WEIGHT * AXLE_FRONT + (1.0 - FRONT_WEIGHT) * AXLE_REAR  # [m]
WHEELBASE = AXLE_FRONT - AXLE_REAR  # [m]
TRACK_FRONT, TRACK_REAR = 1.68, 1.60  # [m] between the wheels of an axle
LOAD_LAG = 0.05  # [s] stands for the suspension: how late loads follow accelerations

# Steering
STEER_LOCK = math.radians(21.0)  # [rad]
STEER_RATE = math.radians(360.0)  # [rad/s]

# Tyres
RADIUS_FRONT, RADIUS_REAR = 0.3306, 0.3276  # [m]
TYRE_MU = 1.6  # [-] "mu"
TYRE_C = 2.0 - math.asin(0.8) * 2.0 / math.pi  # "dynamic friction" 80 %
TYRE_B = 20.0 / TYRE_C  # "stiffness" 20
TYRE_E = 0.7  # "elasticity factor", the default
LOAD_FACTOR_MIN, LOAD_FACTOR_MAX = 0.8, 1.6
LOAD_FACTOR_K = math.log((1.0 - LOAD_FACTOR_MIN) / (LOAD_FACTOR_MAX - LOAD_FACTOR_MIN))
SKID_FACTOR = 0.3  # extra grip of a sliding tyre for a driver of the level "semi-pro"
MAX_SLIP = 1.5
SLIP_SPEED = 3.0  # [m/s] below it slip is measured against this speed, so that a stop is stable
CAMBER_FRONT = 1.0 + 0.05 * math.sin(18.0 * math.radians(4.0))  # grip factor at -4 degrees
CAMBER_REAR = 1.0 + 0.05 * math.sin(18.0 * math.radians(3.0))  # at -3 degrees
WHEEL_INERTIA_FRONT = 1.22 + 0.1241  # [kg m²] wheel and brake disk
WHEEL_INERTIA_REAR = 1.22 + 0.0714

# Brakes: torque per wheel at full pedal = pressure × share × disk radius × piston area × mu
BRAKE_FRONT = 29.0e6 * 0.54 * 0.190 * 50.0e-4 * 0.4  # [N m]
BRAKE_REAR = 29.0e6 * 0.46 * 0.165 * 25.0e-4 * 0.4

# Engine and gearbox
RPM = 2.0 * math.pi / 60.0  # [rad/s] per rpm
TICKOVER = 900.0 * RPM
LIMITER = 9152.0 * RPM
REVS_MAX = 10000.0 * RPM
ENGINE_INERTIA = 0.2423  # [kg m²] simuv2's default
ENGINE_BRAKE = 0.33  # simuv2's default
TORQUE_STEP = 1000.0 * RPM  # [rad/s] between the points of the torque curve
TORQUE = np.array([100, 160, 190, 280, 350, 405, 443, 465, 483, 415, 360, 360], float)  # [N m]
FINAL_DRIVE = 4.5
GEARS = np.array([-4.0, 0.0, 3.0, 1.9, 1.4, 1.1, 0.9, 0.77])  # reverse, neutral, 1 to 6
EFFICIENCY = np.array([0.957, 1.0, 0.955, 0.957, 0.95, 0.983, 0.948, 0.94]) * 0.9625
TOP_GEAR = 6
SHIFT_TIME = 0.15  # [s] the clutch is open after a change of gear
DIFFERENTIAL = 300.0  # [N m s/rad] locking torque per difference of wheel speed
DIFFERENTIAL_MAX = 1500.0  # [N m]

# Air
DRAG = 0.645 * 0.35 * 1.92  # [N s²/m²] Cx 0.35, front area 1.92 m²
WING_FRONT = 1.23 * 0.25 * math.sin(math.radians(6.0))
WING_REAR = 1.23 * 0.70 * math.sin(math.radians(14.0))
WING_LIFT = 4.0  # downforce per drag of a wing
GROUND_EFFECT = 1.5  # simuv2's 2 exp(-3 h⁴) at the car's usual ride height
LIFT_FRONT, LIFT_REAR = 0.69 * GROUND_EFFECT, 0.70 * GROUND_EFFECT

# Walls
WALL_SPIN = 10.0  # how much a hit turns the car, simuv2's VELSCALE
WALL_SPIN_MAX = 6.0  # [rad/s]
DAMAGE_FACTOR = 0.8  # for a driver of the level "semi-pro"
MAX_DAMAGE = 10000.0  # [points] TORCS takes the car out of the race

# The state vector
(
    STEPS, X, Y, YAW, VX, VY, YAW_RATE, ACC_X, ACC_Y, STEER,
    SPIN_FR, SPIN_FL, SPIN_RR, SPIN_RL, ENGINE, GEAR, SHIFT, DAMAGE,
    SEGMENT, ALONG, OFFSET, TANGENT, RACED, CROSSINGS, LAPS, LAP_START, LAST_LAP, BEST_LAP,
) = range(28)  # fmt: skip
STATE_SIZE = 28
AUTOMATIC = -99  # stands for "no gear asked for" in the compiled code


@njit(cache=True, inline="always")
def _wrap(angle: float) -> float:
    """Bring an angle into [-pi, pi]."""
    while angle > math.pi:
        angle -= 2.0 * math.pi
    while angle < -math.pi:
        angle += 2.0 * math.pi
    return angle


@njit(cache=True, inline="always")
def _between(track: Floats, segment: int, first: int, along: float) -> float:
    """Interpolate a width given by the columns ``first`` (start) and ``first + 1`` (end)."""
    share = along / track[segment, column.LENGTH]
    return track[segment, first] + (track[segment, first + 1] - track[segment, first]) * share


@njit(cache=True)
def road_width(track: Floats, segment: int, along: float) -> float:
    """Width of the road [m] at a place of a segment."""
    return _between(track, segment, column.WIDTH_START, along)


@njit(cache=True)
def locate(state: Floats, track: Floats) -> None:
    """
    Find the car's place on the road from its position, walking on from its last segment.

    Sets SEGMENT, ALONG [m], OFFSET [m] and TANGENT [rad].
    """
    n = track.shape[0]
    segment = int(state[SEGMENT])
    along = offset = tangent = 0.0
    for _ in range(n):
        dx, dy = state[X] - track[segment, column.X], state[Y] - track[segment, column.Y]
        heading, curvature = track[segment, column.HEADING], track[segment, column.CURVATURE]
        ahead = dx * math.cos(heading) + dy * math.sin(heading)
        left = dy * math.cos(heading) - dx * math.sin(heading)
        if curvature == 0.0:
            along, offset = ahead, left
        else:
            side = 1.0 if curvature > 0.0 else -1.0
            radius = 1.0 / abs(curvature)
            inward = radius - side * left  # from the centre of the arc towards the start
            # Measured from the middle of the arc, so that one of more than half a turn works too.
            half = 0.5 * abs(curvature) * track[segment, column.LENGTH]
            along = (_wrap(math.atan2(ahead, inward) - half) + half) * radius
            offset = side * (radius - math.sqrt(ahead * ahead + inward * inward))
        if along < 0.0:
            segment = (segment - 1) % n
        elif along >= track[segment, column.LENGTH]:
            segment = (segment + 1) % n
        else:
            break
        # Between two segments the rounding of both may deny the place: take the border.
        along = min(max(along, 0.0), track[segment, column.LENGTH])
    tangent = track[segment, column.HEADING] + track[segment, column.CURVATURE] * along
    state[SEGMENT], state[ALONG], state[OFFSET] = segment, along, offset
    state[TANGENT] = tangent


@njit(cache=True)
def _count_laps(state: Floats, track: Floats, previous: float, flying: bool) -> None:
    """Follow the distance and the crossings of the start line, as the game's race engine does."""
    length = track[-1, column.START] + track[-1, column.LENGTH]
    distance = track[int(state[SEGMENT]), column.START] + state[ALONG]
    moved = distance - previous
    if moved < -0.5 * length:
        moved += length
        state[CROSSINGS] += 1.0
        if state[CROSSINGS] == 1.0 and flying:
            state[LAP_START] = state[STEPS]  # the way to the line was not a lap
        elif state[CROSSINGS] > state[LAPS] + 1.0:
            lap = (state[STEPS] - state[LAP_START]) / STEPS_PER_SECOND
            state[LAPS] += 1.0
            state[LAST_LAP] = lap
            if state[BEST_LAP] == 0.0 or lap < state[BEST_LAP]:
                state[BEST_LAP] = lap
            state[LAP_START] = state[STEPS]
    elif moved > 0.5 * length:  # back over the line: the next crossing must not count again
        moved -= length
        state[CROSSINGS] -= 1.0
    state[RACED] += moved


@njit(cache=True)
def engine_torque(engine_speed: float, throttle: float) -> float:
    """
    Torque [N m] of the engine, braking when the throttle is closed.

    :param engine_speed: [rad/s]
    :param throttle: [-] in [0, 1]
    """
    if engine_speed > LIMITER:
        return 0.0
    i = min(int(engine_speed / TORQUE_STEP), TORQUE.shape[0] - 2)
    full = TORQUE[i] + (TORQUE[i + 1] - TORQUE[i]) * (engine_speed / TORQUE_STEP - i)
    braking = ENGINE_BRAKE * (engine_speed - TICKOVER) / (REVS_MAX - TICKOVER)
    return full * (throttle * (1.0 + braking) - braking)


@njit(cache=True)
def tyre_grip(slip: float, load: float, rated_load: float) -> float:
    """
    Force per slip direction [N] of a tyre on ground of friction 1 (magic formula of simuv2).

    :param slip: [-] length of the combined slip vector
    :param load: [N] pressing the tyre to the ground
    :param rated_load: [N] load at which the load factor is 1
    """
    slip = min(slip, MAX_SLIP)
    bx = TYRE_B * slip
    shape = math.sin(TYRE_C * math.atan(bx * (1.0 - TYRE_E) + TYRE_E * math.atan(bx)))
    load_factor = LOAD_FACTOR_MIN + (LOAD_FACTOR_MAX - LOAD_FACTOR_MIN) * math.exp(
        LOAD_FACTOR_K * load / rated_load
    )
    return shape * (1.0 + SKID_FACTOR * slip) * TYRE_MU * load_factor * load


@njit(cache=True)
def _spin_up(spin: float, torque: float, brake: float, inertia: float) -> float:
    """Turn a wheel for one step; a brake stops it but never turns it backwards."""
    spin += DT * torque / inertia
    stop = DT * brake / inertia
    if abs(spin) <= stop:
        return 0.0
    return spin - math.copysign(stop, spin)


@njit(cache=True)
def _drive(state: Floats, throttle: float) -> tuple[float, float]:
    """Run engine and clutch; return the torque [N m] and inertia [kg m²] at each rear wheel."""
    gear = int(state[GEAR])
    ratio = GEARS[gear + 1] * FINAL_DRIVE
    axle = 0.5 * (state[SPIN_RR] + state[SPIN_RL])
    if state[SHIFT] > 0.0:
        state[SHIFT] -= DT
    if gear == 0 or state[SHIFT] > 0.0:
        target = axle * ratio if gear != 0 else TICKOVER + throttle * (LIMITER - TICKOVER)
        target = min(max(target, TICKOVER), REVS_MAX)
        state[ENGINE] += (target - state[ENGINE]) * (DT / 0.05)  # the free engine, 50 ms lag
        return 0.0, WHEEL_INERTIA_REAR
    state[ENGINE] = min(max(axle * ratio, TICKOVER), REVS_MAX)
    torque = engine_torque(state[ENGINE], throttle) * ratio * EFFICIENCY[gear + 1]
    return 0.5 * torque, WHEEL_INERTIA_REAR + 0.5 * ENGINE_INERTIA * ratio * ratio


@njit(cache=True)
def _hit_walls(state: Floats, track: Floats) -> None:
    """Stop the car's corners at the walls, with rebound, spin and damage as in simuv2."""
    segment, along = int(state[SEGMENT]), state[ALONG]
    half = 0.5 * road_width(track, segment, along)
    left = half + _between(track, segment, column.LEFT_START, along)
    right = half + _between(track, segment, column.RIGHT_START, along)
    offset = state[OFFSET]
    if abs(offset) + LENGTH < min(left, right):  # nowhere near
        return
    cos_yaw, sin_yaw = math.cos(state[YAW]), math.sin(state[YAW])
    to_left_x, to_left_y = -math.sin(state[TANGENT]), math.cos(state[TANGENT])
    for corner in range(4):
        ahead = (0.5 if corner < 2 else -0.5) * LENGTH
        aside = (0.5 if corner % 2 else -0.5) * WIDTH
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
        speed = max(1.0, math.hypot(state[VX], state[VY]))
        normal_speed = nx * state[VX] + ny * state[VY]
        cosine = normal_speed / speed
        friction, rebound = track[segment, wall], track[segment, wall + 1]
        state[VX] -= nx * impact * friction
        state[VY] -= ny * impact * friction
        turn = (nx * dx + ny * dy) * impact * friction / WALL_SPIN
        state[YAW_RATE] = min(max(state[YAW_RATE] - turn, -WALL_SPIN_MAX), WALL_SPIN_MAX)
        if impact < 0.0:
            blow = 0.5 * (normal_speed * cosine) ** 2 + 0.005 * abs(1.0 - cosine) * speed
            state[DAMAGE] += math.floor(track[segment, wall + 2] * blow * DAMAGE_FACTOR)
            state[VX] -= nx * impact * rebound
            state[VY] -= ny * impact * rebound
    state[OFFSET] = offset


@njit(cache=True)
def _ground(track: Floats, segment: int, half: float, lateral: float) -> tuple[float, float]:
    """Friction and rolling resistance under a wheel."""
    if lateral > half:
        return track[segment, column.LEFT_FRICTION], track[segment, column.LEFT_ROLLING_RESISTANCE]
    if lateral < -half:
        return track[segment, column.RIGHT_FRICTION], track[
            segment, column.RIGHT_ROLLING_RESISTANCE
        ]
    return track[segment, column.ROAD_FRICTION], track[segment, column.ROAD_ROLLING_RESISTANCE]


@njit(cache=True)
def _steer(state: Floats, command: float) -> tuple[float, float]:
    """Turn the steering at its limited rate; return the angles of the right and left wheel."""
    step = STEER_RATE * DT
    state[STEER] += min(max(command * STEER_LOCK - state[STEER], -step), step)
    angle = state[STEER]
    tangent = math.tan(abs(angle))
    outer = math.atan2(WHEELBASE * tangent, WHEELBASE + tangent * 0.5 * (TRACK_FRONT + TRACK_REAR))
    return (outer, angle) if angle > 0.0 else (angle, -outer)


@njit(cache=True)
def _substep(state: Floats, track: Floats, steering: float, throttle: float, brake: float) -> None:
    """Advance the car by one physics step."""
    yaw, yaw_rate = state[YAW], state[YAW_RATE]
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    vx = state[VX] * cos_yaw + state[VY] * sin_yaw
    vy = state[VY] * cos_yaw - state[VX] * sin_yaw
    steer_right, steer_left = _steer(state, steering)
    drive_torque, drive_inertia = _drive(state, throttle)
    lock = DIFFERENTIAL * (state[SPIN_RR] - state[SPIN_RL])
    lock = min(max(lock, -DIFFERENTIAL_MAX), DIFFERENTIAL_MAX)

    # Air: wings work forwards only, ground effect fades when the car slides sideways.
    pressure = vx * vx
    straight = max(vx, 0.0) / max(math.hypot(vx, vy), 1.0)
    wings = pressure if vx > 0.0 else 0.0
    down_front = LIFT_FRONT * pressure * straight + WING_LIFT * WING_FRONT * wings
    down_rear = LIFT_REAR * pressure * straight + WING_LIFT * WING_REAR * wings
    worn = 1.0 + state[DAMAGE] / MAX_DAMAGE
    drag = (math.copysign(DRAG * pressure, vx) + (WING_FRONT + WING_REAR) * wings) * worn

    along_transfer = 0.5 * MASS * state[ACC_X] * CG_HEIGHT / WHEELBASE
    across = 0.5 * MASS * state[ACC_Y] * CG_HEIGHT
    segment = int(state[SEGMENT])
    half = 0.5 * road_width(track, segment, state[ALONG])
    skew = yaw - state[TANGENT]
    cos_skew, sin_skew = math.cos(skew), math.sin(skew)

    force_x, force_y, moment, rolling = -drag, 0.0, 0.0, 0.0
    for wheel in range(4):
        front, left = wheel < 2, wheel % 2 == 1
        if front:
            x, y = AXLE_FRONT - CG_X, 0.5 * TRACK_FRONT
            rated = 1.2 * 0.5 * FRONT_WEIGHT * MASS * GRAVITY
            load = rated / 1.2 + 0.5 * down_front - along_transfer
            shift, radius, camber = across / TRACK_FRONT, RADIUS_FRONT, CAMBER_FRONT
            angle = steer_left if left else steer_right
            torque, inertia, brake_torque = 0.0, WHEEL_INERTIA_FRONT, brake * BRAKE_FRONT
        else:
            x, y = AXLE_REAR - CG_X, 0.5 * TRACK_REAR
            rated = 1.2 * 0.5 * (1.0 - FRONT_WEIGHT) * MASS * GRAVITY
            load = rated / 1.2 + 0.5 * down_rear + along_transfer
            shift, radius, camber = across / TRACK_REAR, RADIUS_REAR, CAMBER_REAR
            angle = 0.0
            torque = drive_torque + (lock if left else -lock)
            inertia, brake_torque = drive_inertia, brake * BRAKE_REAR
        if not left:
            y, shift = -y, -shift
        load = max(load - shift, 0.0)  # turning left (ACC_Y > 0) presses the right side down

        lateral = state[OFFSET] + x * sin_skew + y * cos_skew
        friction, resistance = _ground(track, segment, half, lateral)
        wheel_vx, wheel_vy = vx - yaw_rate * y, vy + yaw_rate * x
        cos_angle, sin_angle = math.cos(angle), math.sin(angle)
        rolling_speed = wheel_vx * cos_angle + wheel_vy * sin_angle
        sliding_speed = wheel_vy * cos_angle - wheel_vx * sin_angle
        reference = max(abs(rolling_speed), SLIP_SPEED)
        slip_x = (rolling_speed - state[SPIN_FR + wheel] * radius) / reference
        slip_y = sliding_speed / max(math.hypot(wheel_vx, wheel_vy), SLIP_SPEED)
        slip = math.sqrt(slip_x * slip_x + slip_y * slip_y)
        grip = 0.0
        if slip > 1e-9:
            grip = tyre_grip(slip, load, rated) * friction * camber / slip
        wheel_force_x, wheel_force_y = -grip * slip_x, -grip * slip_y

        # The tyre resists the wheel's spin the more, the slower the car: taken implicitly,
        # since a wheel is too light for an explicit step of 2 ms at walking pace.
        stiff = inertia + DT * grip * radius * radius / reference
        state[SPIN_FR + wheel] = _spin_up(
            state[SPIN_FR + wheel], torque - wheel_force_x * radius, brake_torque, stiff
        )
        fx = wheel_force_x * cos_angle - wheel_force_y * sin_angle
        fy = wheel_force_x * sin_angle + wheel_force_y * cos_angle
        force_x += fx
        force_y += fy
        moment += fy * x - fx * y
        rolling += load * resistance

    speed = math.hypot(vx, vy)
    rolling = min(rolling, MASS * speed / DT) / max(speed, 1e-6)
    acc_x, acc_y = (force_x - rolling * vx) / MASS, (force_y - rolling * vy) / MASS
    state[ACC_X] += (acc_x - state[ACC_X]) * (DT / LOAD_LAG)
    state[ACC_Y] += (acc_y - state[ACC_Y]) * (DT / LOAD_LAG)
    state[VX] += (acc_x * cos_yaw - acc_y * sin_yaw) * DT
    state[VY] += (acc_x * sin_yaw + acc_y * cos_yaw) * DT
    yaw_rate += moment / YAW_INERTIA * DT
    state[YAW_RATE] = min(max(yaw_rate, -MAX_YAW_RATE), MAX_YAW_RATE)
    state[X] += state[VX] * DT
    state[Y] += state[VY] * DT
    state[YAW] = _wrap(yaw + state[YAW_RATE] * DT)


@njit(cache=True)
def advance(
    state: Floats,
    track: Floats,
    steering: float,
    throttle: float,
    brake: float,
    gear: int,
    ticks: int,
    flying: bool,
) -> None:
    """
    Drive for some control ticks, changing the state vector in place.

    :param state: the state vector
    :param track: ``Track.table``
    :param steering: [-] in [-1, 1]
    :param throttle: [-] in [0, 1]
    :param brake: [-] in [0, 1]
    :param gear: -1 to 6, or ``AUTOMATIC``
    :param ticks: control ticks of 0.02 s
    :param flying: whether the episode began elsewhere than on the grid
    """
    for _tick in range(ticks):
        wanted = gear
        if gear == AUTOMATIC:
            wanted = automatic_gear(int(state[GEAR]), state[ENGINE], GEARS)
        if wanted != int(state[GEAR]) and state[SHIFT] <= 0.0:
            state[GEAR] = wanted
            state[SHIFT] = SHIFT_TIME if wanted != 0 else 0.0
        for _step in range(SUBSTEPS):
            distance = track[int(state[SEGMENT]), column.START] + state[ALONG]
            _substep(state, track, steering, throttle, brake)
            state[STEPS] += 1.0
            locate(state, track)
            _hit_walls(state, track)
            _count_laps(state, track, distance, flying)


def place(x: float, y: float, yaw: float, speed: float, segment: int, track: Floats) -> Floats:
    """
    Put the car somewhere, rolling freely in the gear that suits its speed.

    :param x: [m]
    :param y: [m]
    :param yaw: [rad]
    :param speed: [m/s] along the car
    :param segment: index of the segment it stands on
    :param track: ``Track.table``
    :return: a new state vector
    """
    state = np.zeros(STATE_SIZE)
    state[X], state[Y], state[YAW] = x, y, _wrap(yaw)
    state[VX], state[VY] = speed * math.cos(yaw), speed * math.sin(yaw)
    state[SPIN_FR] = state[SPIN_FL] = speed / RADIUS_FRONT
    state[SPIN_RR] = state[SPIN_RL] = speed / RADIUS_REAR
    gear = 1
    while gear < TOP_GEAR and speed / RADIUS_REAR * GEARS[gear + 1] * FINAL_DRIVE > 0.8 * LIMITER:
        gear += 1
    state[GEAR] = gear
    state[ENGINE] = min(
        max(speed / RADIUS_REAR * GEARS[gear + 1] * FINAL_DRIVE, TICKOVER), REVS_MAX
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
    :param reach: how far to look; see :class:`~sb3_torcs.backends.lite_rays.Edges`
    :param angles: (19,) [rad] of the range finders
    :param scalars: (SCALARS,) filled in the order of ``CarState``
    :param wheels: (4,) filled [rad/s]
    :param beams: (19,) filled [m]
    """
    segment, along = int(state[SEGMENT]), state[ALONG]
    yaw = state[YAW]
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    width = road_width(track, segment, along)
    scalars[0] = state[STEPS] / STEPS_PER_SECOND
    scalars[1], scalars[2], scalars[3] = state[X], state[Y], yaw
    scalars[4] = state[YAW_RATE]
    scalars[5] = state[VX] * cos_yaw + state[VY] * sin_yaw
    scalars[6] = state[VY] * cos_yaw - state[VX] * sin_yaw
    scalars[7] = 0.0  # the plane has no vertical speed
    scalars[8] = CG_HEIGHT
    scalars[9] = _wrap(state[TANGENT] - yaw)
    scalars[10] = state[OFFSET]
    scalars[11] = width
    scalars[12] = track[segment, column.START] + along
    scalars[13] = state[RACED]
    scalars[14] = state[ENGINE]
    scalars[15] = state[GEAR]
    scalars[16] = FUEL
    scalars[17] = state[DAMAGE]
    scalars[18] = state[LAPS]
    scalars[19] = (state[STEPS] - state[LAP_START]) / STEPS_PER_SECOND
    scalars[20], scalars[21] = state[LAST_LAP], state[BEST_LAP]
    wheels[:] = state[SPIN_FR : SPIN_RL + 1]
    if abs(state[OFFSET]) > 0.5 * width:  # off the road the SCR server gives -1
        beams[:] = -1.0
    else:
        cast(shapes, first, reach, segment, (state[X], state[Y], yaw), angles, beams)
