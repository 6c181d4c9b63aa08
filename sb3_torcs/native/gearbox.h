// When the gearbox of the agent shifts, as shares of the motor's limit.
#pragma once

namespace torcs {

// [rpm] at which the limiter of the SCR car cuts in; the shift points are given for it.
constexpr float LIMITER = 9152.0f;
constexpr float SHIFT_UP = 8500.0f / LIMITER;
// Below which the lower gear would turn the motor.
constexpr float SHIFT_DOWN = 7500.0f / LIMITER;

// Of a standing car. Up to two thirds the game's clutch passes all torque, beyond that less.
constexpr float LAUNCH_CLUTCH = 0.8f;
// The value is rounded, so that a client that reads the speed in six digits gets the same.
constexpr float CLUTCH_STEPS = 128.0f;

}  // namespace torcs
