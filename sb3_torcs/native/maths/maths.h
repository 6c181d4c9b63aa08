// Mathematics with the same results on every machine.
//
// A system's libm differs from release to release, and from processor to processor: the same car
// would drive other laps. These functions use operations that IEEE 754 defines, in a fixed order;
// build them with -ffp-contract=off.
#pragma once

namespace torcs::maths {

// ---- As in the C library's libm, for the game's modules and our own code
// -------------------------

// Correctly rounded, as in glibc from 2.41 on.
float tanf(float x);
float atanf(float x);
float asinf(float x);
float acosf(float x);
float tanhf(float x);
float atan2f(float y, float x);

// As in glibc from 2.28 on, on a processor with fused multiply-adds.
float sinf(float x);
float cosf(float x);
void sincosf(float x, float* sine, float* cosine);
float expf(float x);
float logf(float x);

// ---- For our own code ---------------------------------------------------------------------------

// The last digit may differ from that of the exact result.
struct SineCosine {
    double sine, cosine;
};
SineCosine sine_cosine(double angle);  // [rad] of at most a million
double atan2(double y, double x);      // of finite numbers
double log(double x);                  // of positive and normal numbers
double hypot(double x, double y);      // of numbers whose squares are neither 0 nor infinite

// ---- For tests ----------------------------------------------------------------------------------

// The functions that need fused multiply-adds: computed by the processor, or by additions and
// multiplications only.
struct Fused {
    float (*sinf)(float);
    float (*cosf)(float);
    void (*sincosf)(float, float*, float*);
    float (*expf)(float);
    float (*logf)(float);
};
extern const Fused BY_PROCESSOR, BY_ADDITIONS;
bool processor_fuses();

}  // namespace torcs::maths
