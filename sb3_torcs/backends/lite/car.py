"""``car1-trb1`` in figures, its motor and its tyres, for the fallback world.

The figures are those of ``cars/car1-trb1/car1-trb1.xml`` of torcs-data 1.3.7; the formulas follow
TORCS's simulation, ``simuv2``. Sines and logarithms stand as numbers, since those of the C library
differ between machines.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from sb3_torcs import maths
from sb3_torcs.actions import SHIFT_UP, automatic_gear, launch_clutch
from sb3_torcs.car import CAR_LENGTH, CAR_WIDTH, LIMITER_RPM, REST_HEIGHT, RPM

_cos_sin, _hypot = maths.compiled(maths.cos_sin), maths.compiled(maths.hypot)
_sin, _atan, _exp = map(maths.compiled, (maths.sin, maths.atan, maths.exp))

GRAVITY = 9.80665  # [m/s²]

# Body
FUEL = 94.0  # [l] a full tank, 1 kg per litre in TORCS
MASS = 1150.0 + FUEL  # [kg]
CG_HEIGHT = 0.25  # [m] in the car file's frame, which weight shifts by
SEEN_HEIGHT = REST_HEIGHT  # [m] over the road, as the game tells it, before the springs give
FRONT_WEIGHT = 0.52  # share of the weight on the front axle
SPREAD = 0.62 * CAR_LENGTH  # [m] "mass repartition coefficient" 0.62
INERTIA_ARM = SPREAD * SPREAD + CAR_WIDTH * CAR_WIDTH  # [m²]
YAW_INERTIA = MASS * INERTIA_ARM / 12.0  # [kg m²]
MAX_YAW_RATE = 9.0  # [rad/s] the limit of simuv2
AXLE_FRONT, AXLE_REAR = 1.22, -1.42  # [m] in the car file's frame
CG_X = FRONT_WEIGHT * AXLE_FRONT + (1.0 - FRONT_WEIGHT) * AXLE_REAR  # [m]
WHEELBASE = AXLE_FRONT - AXLE_REAR  # [m]
TRACK_FRONT, TRACK_REAR = 1.68, 1.60  # [m] between the wheels of an axle
# Per wheel: front right, front left, rear right, rear left
WHEEL_X = np.array([AXLE_FRONT, AXLE_FRONT, AXLE_REAR, AXLE_REAR]) - CG_X  # [m]
WHEEL_Y = 0.5 * np.array([-TRACK_FRONT, TRACK_FRONT, -TRACK_REAR, TRACK_REAR])  # [m]
_RATED_FRONT = 1.2 * 0.5 * FRONT_WEIGHT * MASS * GRAVITY  # simuv2's "operating load": 1.2 × at rest
_RATED_REAR = 1.2 * 0.5 * (1.0 - FRONT_WEIGHT) * MASS * GRAVITY
RATED_LOAD = np.array([_RATED_FRONT, _RATED_FRONT, _RATED_REAR, _RATED_REAR])  # [N]
LOAD_LAG = 0.05  # [s] stands for the suspension: how late loads follow accelerations
HEAVE_STIFFNESS = 4 * 5500.0 * 175.127 * 1.21  # [N/m] four springs of 5500 lbs/in, bellcrank 1.1

# Steering
STEER_RATE = math.radians(360.0)  # [rad/s]

# Tyres
RADIUS = np.array([0.3306, 0.3306, 0.3276, 0.3276])  # [m] per wheel
TYRE_MU = 1.6  # [-] "mu"
TYRE_C = 2.0 - 0.9272952180016123 * 2.0 / math.pi  # asin(0.8) for "dynamic friction" 80 %
TYRE_B = 20.0 / TYRE_C  # "stiffness" 20
TYRE_E = 0.7  # "elasticity factor", the default
LOAD_FACTOR_MIN, LOAD_FACTOR_MAX = 0.8, 1.6
LOAD_FACTOR_K = -1.3862943611198908  # log((1 - min) / (max - min))
SKID_FACTOR = 0.3  # extra grip of a sliding tyre for a driver of the level "semi-pro"
MAX_SLIP = 1.5
SLIP_SPEED = 3.0  # [m/s] below it slip is measured against this speed, so that a stop is stable
_CAMBER_FRONT = 1.0 + 0.05 * 0.9510565162951535  # sin(18 · 4°)
_CAMBER_REAR = 1.0 + 0.05 * 0.8090169943749475  # sin(18 · 3°)
CAMBER = np.array([_CAMBER_FRONT, _CAMBER_FRONT, _CAMBER_REAR, _CAMBER_REAR])  # grip factor
WHEEL_INERTIA_FRONT = 1.22 + 0.1241  # [kg m²] wheel and brake disk
WHEEL_INERTIA_REAR = 1.22 + 0.0714

# Brakes: torque per wheel at full pedal = pressure × share × disk radius × piston area × mu
_BRAKE_FRONT = 29.0e6 * 0.54 * 0.190 * 50.0e-4 * 0.4
_BRAKE_REAR = 29.0e6 * 0.46 * 0.165 * 25.0e-4 * 0.4
BRAKE = np.array([_BRAKE_FRONT, _BRAKE_FRONT, _BRAKE_REAR, _BRAKE_REAR])  # [N m]

# Motor and gearbox
TICKOVER = 900.0 * RPM
LIMITER = LIMITER_RPM * RPM
REVS_MAX = 10000.0 * RPM
MOTOR_INERTIA = 0.2423  # [kg m²] simuv2's default
MOTOR_BRAKE = 0.33  # simuv2's default
TORQUE_STEP = 1000.0 * RPM  # [rad/s] between the points of the torque curve
TORQUE = np.array([100, 160, 190, 280, 350, 405, 443, 465, 483, 415, 360, 360], float)  # [N m]
FINAL_DRIVE = 4.5
GEARS = np.array([-4.0, 0.0, 3.0, 1.9, 1.4, 1.1, 0.9, 0.77])  # reverse, neutral, 1 to 6
EFFICIENCY = np.array([0.957, 1.0, 0.955, 0.957, 0.95, 0.983, 0.948, 0.94]) * 0.9625
RATIOS = GEARS[2:].copy()  # of the forward gears
TOP_GEAR = len(RATIOS)
OPEN_CLUTCH = 0.01  # [-] of its way to closed: up to here nothing is passed on
FULL_TORQUE = 3.0  # [-] a clutch passes all torque from a third of its way on
SHIFT_TIME = 0.15  # [s] the clutch is open after a change of gear
DIFFERENTIAL = 300.0  # [N m s/rad] locking torque per difference of wheel speed
DIFFERENTIAL_MAX = 1500.0  # [N m]

# Air
DRAG = 0.645 * 0.35 * 1.92  # [N s²/m²] Cx 0.35, front area 1.92 m²
WING_FRONT = 1.23 * 0.25 * 0.10452846326765347  # sin(6°)
WING_REAR = 1.23 * 0.70 * 0.24192189559966773  # sin(14°)
WING_LIFT = 4.0  # downforce per drag of a wing
GROUND_EFFECT = 1.5  # simuv2's 2 exp(-3 h⁴) at the car's usual ride height
LIFT_FRONT, LIFT_REAR = 0.69 * GROUND_EFFECT, 0.70 * GROUND_EFFECT


@njit(cache=True)
def front_wheels(angle: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """
    Return cosine and sine of the angles of the right and the left front wheel.

    :param angle: of the inner one, left positive [rad]
    """
    ahead, aside = _cos_sin(angle)
    outer_ahead = WHEELBASE * ahead + 0.5 * (TRACK_FRONT + TRACK_REAR) * abs(aside)
    outer_aside = WHEELBASE * aside
    size = _hypot(outer_ahead, outer_aside)
    inner, outer = (ahead, aside), (outer_ahead / size, outer_aside / size)
    return (outer, inner) if angle > 0.0 else (inner, outer)


@njit(cache=True)
def motor_torque(engine_speed: float, throttle: float) -> float:
    """
    Torque [N m] of the motor, braking when the throttle is closed.

    :param engine_speed: [rad/s]
    :param throttle: [-] in [0, 1]
    """
    if engine_speed > LIMITER:
        return 0.0
    i = min(int(engine_speed / TORQUE_STEP), TORQUE.shape[0] - 2)
    full = TORQUE[i] + (TORQUE[i + 1] - TORQUE[i]) * (engine_speed / TORQUE_STEP - i)
    braking = MOTOR_BRAKE * (engine_speed - TICKOVER) / (REVS_MAX - TICKOVER)
    return full * (throttle * (1.0 + braking) - braking)


@njit(cache=True)
def road_speed_gear(gear: int, speed: float) -> tuple[int, float]:
    """
    Choose gear and clutch by how fast the motor would turn if no wheel slipped.

    :param gear: the present one, -1 reverse, 0 neutral
    :param speed: along the car [m/s]
    :return: the gear to ask for, and the clutch in [0, 1]
    """
    ratio = GEARS[max(gear, 1) + 1] * FINAL_DRIVE
    engine_speed = max(speed, 0.0) / RADIUS[2] * ratio
    launch = launch_clutch(engine_speed, SHIFT_UP) if gear <= 1 else 0.0
    return automatic_gear(gear, engine_speed, RATIOS), launch


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
    shape = _sin(TYRE_C * _atan(bx * (1.0 - TYRE_E) + TYRE_E * _atan(bx)))
    load_factor = LOAD_FACTOR_MIN + (LOAD_FACTOR_MAX - LOAD_FACTOR_MIN) * _exp(
        LOAD_FACTOR_K * load / rated_load
    )
    return shape * (1.0 + SKID_FACTOR * slip) * TYRE_MU * load_factor * load
