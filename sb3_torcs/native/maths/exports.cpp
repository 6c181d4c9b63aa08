// The game's own process loads this library first: its modules then find these functions before
// those of the system, and drive the laps that the engine drives.
#include "maths.h"

#define INSTEAD extern "C" __attribute__((visibility("default")))

INSTEAD float tanf(float x) { return torcs::maths::tanf(x); }
INSTEAD float atanf(float x) { return torcs::maths::atanf(x); }
INSTEAD float asinf(float x) { return torcs::maths::asinf(x); }
INSTEAD float acosf(float x) { return torcs::maths::acosf(x); }
INSTEAD float tanhf(float x) { return torcs::maths::tanhf(x); }
INSTEAD float atan2f(float y, float x) { return torcs::maths::atan2f(y, x); }
INSTEAD float sinf(float x) { return torcs::maths::sinf(x); }
INSTEAD float cosf(float x) { return torcs::maths::cosf(x); }
INSTEAD void sincosf(float x, float* sine, float* cosine) {
    torcs::maths::sincosf(x, sine, cosine);
}
INSTEAD float expf(float x) { return torcs::maths::expf(x); }
INSTEAD float logf(float x) { return torcs::maths::logf(x); }
