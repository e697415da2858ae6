// Inverse CDFs of the normal density and its derivative lobes. Literal reference: torch_zerohess/sampling/quantiles.py.
// Only + - * / sqrt, in the order of the reference and compiled without contraction: the same bits everywhere.
#pragma once

#include <cmath>

#include "philox.h"

namespace zerohess {

constexpr double kTiny = 0x1p-500;
constexpr double kExpMinusHalf = 0.6065306597126334;

constexpr double kCentralNumerator[8] = {3.3871328727963666080e0, 1.3314166789178437745e2, 1.9715909503065514427e3,
                                         1.3731693765509461125e4, 4.5921953931549871457e4, 6.7265770927008700853e4,
                                         3.3430575583588128105e4, 2.5090809287301226727e3};
constexpr double kCentralDenominator[8] = {1.0,
                                           4.2313330701600911252e1,
                                           6.8718700749205790830e2,
                                           5.3941960214247511077e3,
                                           2.1213794301586595867e4,
                                           3.9307895800092710610e4,
                                           2.8729085735721942674e4,
                                           5.2264952788528545610e3};
constexpr double kMiddleNumerator[8] = {1.42343711074968357734e0,  4.63033784615654529590e0, 5.76949722146069140550e0,
                                        3.64784832476320460504e0,  1.27045825245236838258e0, 2.41780725177450611770e-1,
                                        2.27238449892691845833e-2, 7.74545014278341407640e-4};
constexpr double kMiddleDenominator[8] = {1.0,
                                          2.05319162663775882187e0,
                                          1.67638483018380384940e0,
                                          6.89767334985100004550e-1,
                                          1.48103976427480074590e-1,
                                          1.51986665636164571966e-2,
                                          5.47593808499534494600e-4,
                                          1.05075007164441684324e-9};
constexpr double kFarNumerator[8] = {6.65790464350110377720e0,  5.46378491116411436990e0,  1.78482653991729133580e0,
                                     2.96560571828504891230e-1, 2.65321895265761230930e-2, 1.24266094738807843860e-3,
                                     2.71155556874348757815e-5, 2.01033439929228813265e-7};
constexpr double kFarDenominator[8] = {1.0,
                                       5.99832206555887937690e-1,
                                       1.36929880922735805310e-1,
                                       1.48753612908506148525e-2,
                                       7.86869131145613259100e-4,
                                       1.84631831751005468180e-5,
                                       1.42151175831644588870e-7,
                                       2.04426310338993978564e-15};

ZH_INLINE double rational(const double (&a)[8], const double (&b)[8], double r) {
  double numerator = a[7], denominator = b[7];
  for (int i = 6; i >= 0; --i) {
    numerator = numerator * r + a[i];
    denominator = denominator * r + b[i];
  }
  return numerator / denominator;
}

// s (f^2/2 + R(s^2)), s = f / (2 + f): what log(1 + f) has beyond f - f^2/2 (fdlibm).
ZH_INLINE double log_tail(double f, double half_square) {
  const double s = f / (2.0 + f), z = s * s;
  double r = 1.479819860511658591e-01;
  r = r * z + 1.531383769920937332e-01;
  r = r * z + 1.818357216161805012e-01;
  r = r * z + 2.222219843214978396e-01;
  r = r * z + 2.857142874366239149e-01;
  r = r * z + 3.999999999940941908e-01;
  r = r * z + 6.666666666666735130e-01;
  return s * (half_square + r * z);
}

// log of a normal positive number; written on unsigned integers so that it vectorizes without AVX-512.
ZH_INLINE double log(double x) {
  const uint64_t bits = to_bits(x);
  const uint64_t biased = (bits - 0x3FE6A09E667F3BCDu + 0x3FF0000000000000u) >> 52;
  const double f = from_bits(bits - (biased << 52) + 0x3FF0000000000000u) - 1.0;
  const double e = from_bits(0x4330000000000000u | biased) - (0x1p52 + 1023.0);
  const double half_square = 0.5 * f * f;
  return e * 6.93147180369123816490e-01 -
         ((half_square - (log_tail(f, half_square) + e * 1.90821492927058770002e-10)) - f);
}

// One of the tails, beyond |p - 1/2| = 0.425; the far one lies beyond a probability of exp(-25).
ZH_INLINE double tail_quantile(double p) {
  const double mirrored = 1.0 - p, r = std::sqrt(-log(p < mirrored ? p : mirrored));
  const double tail = r <= 5.0 ? rational(kMiddleNumerator, kMiddleDenominator, r - 1.6)
                               : rational(kFarNumerator, kFarDenominator, r - 5.0);
  return p < 0.5 ? -tail : tail;
}

// Out of place over count <= kBlock numbers. Three in twenty are in a tail. Those are gathered, worked on together, and
// put back; the far ones among them, one in 10^10, once more.
ZH_INLINE void normal_quantiles_generic(const double* p, int64_t count, double* out) {
  constexpr int64_t kLanes = 8;
  int64_t index[kBlock + kLanes], tails = 0;
  double gathered[kBlock + kLanes], furthest[kLanes] = {};
  for (int64_t i = 0; i < count; ++i) {
    const double q = p[i] - 0.5;
    out[i] = q * rational(kCentralNumerator, kCentralDenominator, 0.180625 - q * q);
  }
  for (int64_t i = 0; i < count; ++i) {
    index[tails] = i;
    tails += std::fabs(p[i] - 0.5) > 0.425;
  }
  for (int64_t i = 0; i < tails; ++i) gathered[i] = p[index[i]];
  for (int64_t i = tails; i % kLanes != 0; ++i) gathered[i] = 0.5;  // whole vectors, no remainder
  for (int64_t first = 0; first < tails; first += kLanes) {
    for (int64_t lane = 0; lane < kLanes; ++lane) {
      const double mine = gathered[first + lane], mirrored = 1.0 - mine;
      const double r = std::sqrt(-log(mine < mirrored ? mine : mirrored));
      const double tail = rational(kMiddleNumerator, kMiddleDenominator, r - 1.6);
      furthest[lane] = r > furthest[lane] ? r : furthest[lane];
      gathered[first + lane] = mine < 0.5 ? -tail : tail;
    }
  }
  for (int64_t i = 0; i < tails; ++i) out[index[i]] = gathered[i];
  for (const double r : furthest)
    if (r > 5.0)
      for (int64_t i = 0; i < tails; ++i) out[index[i]] = tail_quantile(p[index[i]]);
}
ZH_VERSIONS(void, normal_quantiles, (const double* p, int64_t count, double* out), (p, count, out))

ZH_INLINE double gradient_lobe_quantile(double p) {
  const bool left = p <= 0.5;
  const double radius = std::sqrt(-2.0 * log(2.0 * (left ? p : 1.0 - p)));
  return left ? -radius : radius;
}

// Solve (t^2-1)/2 - log t = c by Halley's method in f = t - 1, on the side of t = 1 that `outer` says.
ZH_INLINE double solve_from_one(double c, bool outer) {
  const double root = std::sqrt(c);
  double f = c < 0.2 ? (outer ? root : -root) + c / 6.0 : std::sqrt(1.0 + 2.0 * c + log(1.0 + 2.0 * c)) - 1.0;
  for (int step = 0; step < 4; ++step) {
    const double t = 1.0 + f, half_square = 0.5 * f * f;
    const bool close = f > -0.25 && f < 0.4;
    const double excess =
        (close ? 2.0 * half_square - log_tail(f, half_square) : f + half_square - log(t > kTiny ? t : kTiny)) - c;
    const double slope = f * (2.0 + f) / t;
    const double scale = slope * slope - 0.5 * excess * (1.0 + 1.0 / (t * t));
    if (scale > 0.0) f -= excess * slope / (scale > kTiny ? scale : kTiny);
  }
  return 1.0 + f;
}

// Solve t^2/2 = log(t / small), t < 1: accurate in relative terms down to t = 0.
ZH_INLINE double solve_from_zero(double small) {
  const auto floor = [](double x) { return x > kTiny ? x : kTiny; };
  double t = small + 0.5 * small * small * small;
  for (int step = 0; step < 4; ++step) {
    const double excess = 0.5 * t * t - log(floor(t / floor(small)));
    const double slope = t - 1.0 / floor(t);
    const double scale = slope * slope - 0.5 * excess * (1.0 + 1.0 / floor(t * t));
    if (scale > 0.0) t -= excess * slope / floor(scale);
  }
  return t;
}

// Both Lambert-W branches: |u| = sqrt(-W(-y^2/e)).
ZH_INLINE double hessian_lobe_quantile(double p) {
  const bool left = p < 0.25, right = p > 0.75, outer = left || right;
  const double y = left ? 4.0 * p : right ? 4.0 * (1.0 - p) : std::fabs(4.0 * p - 2.0);
  const double c = -log(y > kTiny ? y : kTiny);
  const double t = outer || c < 0.2 ? solve_from_one(c, outer) : solve_from_zero(y * kExpMinusHalf);
  return left || (!right && p < 0.5) ? -t : t;
}

}  // namespace zerohess
