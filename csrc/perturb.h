// Perturbations, the points that they lead to, and importance weights.
// Literal reference: torch_zerohess/sampling/proposals.py.
#pragma once

#include "quantiles.h"

// One function, compiled for several instruction sets and chosen when the library loads. Without contraction and
// reassociation all of them return the same bits. Sanitizers run before such a choice can be made.
#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__) && !defined(ZH_NO_CLONES)
#define ZH_CLONES __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define ZH_CLONES
#endif

namespace zerohess {

enum Kind : int64_t { kNormal, kGradientLobe, kDiagonalLobe, kOffDiagonalLobe, kEveryGradientLobe, kBox };
enum Proposal : int64_t { kGaussian, kFirstOrder, kSecondOrder, kUniform, kSignedLobes };

constexpr double kBoxHalfWidth = 5.0;
constexpr double kSqrtHalfPi = 1.2533141373155003;         // sqrt(pi / 2)
constexpr double kHalfPi = 1.5707963267948966;             // pi / 2
constexpr double kDiagonalLobeScale = 1.0331828385306232;  // sqrt(2 pi e) / 4
constexpr double kLogBox = 1.383646559789373;             // log(2 * kBoxHalfWidth / sqrt(2 pi))

// How one row of noise was made: a row of the int64 tensor `rows`.
struct Row {
  int64_t seed, index, kind, i, j;
};

inline Row pick(int64_t seed, int64_t index, int64_t n, int64_t proposal) {
  double p[4];
  uniforms(uint64_t(seed), uint64_t(index), kPicks, 0, 2, p);
  const int64_t i = int64_t(p[1] * double(n)), j = int64_t(p[2] * double(n));
  const int64_t component = proposal == kFirstOrder ? int64_t(p[0] * 2.0) : int64_t(p[0] * 3.0);
  if (proposal == kUniform) return {seed, index, kBox, 0, 0};
  if (proposal == kSignedLobes) return {seed, index, kEveryGradientLobe, 0, 0};
  if (proposal == kGaussian || component == 0) return {seed, index, kNormal, 0, 0};
  if (component == 1) return {seed, index, kGradientLobe, i, i};
  return {seed, index, i == j ? kDiagonalLobe : kOffDiagonalLobe, i, j};
}

// u of columns first .. first + count of one row; first is even, count <= kBlock, out has room for kBlock numbers.
ZH_CLONES static inline void draw_columns(const Row& row, int64_t first, int64_t count, double* out) {
  uniforms(uint64_t(row.seed), uint64_t(row.index), kDimensions, first, (count + 1) / 2, out);
  const int64_t i = row.i - first, j = row.j - first;
  const double p_i = i >= 0 && i < count ? out[i] : 0.5, p_j = j >= 0 && j < count ? out[j] : 0.5;
  if (row.kind == kBox) {
    for (int64_t d = 0; d < count; ++d) out[d] = kBoxHalfWidth * (2.0 * out[d] - 1.0);
  } else if (row.kind == kEveryGradientLobe) {
    for (int64_t d = 0; d < count; ++d) out[d] = gradient_lobe_quantile(out[d]);
  } else {
    normal_quantiles(out, count);
  }
  const bool has_i = i >= 0 && i < count, has_j = j >= 0 && j < count;
  if (row.kind == kDiagonalLobe && has_i) out[i] = hessian_lobe_quantile(p_i);
  if ((row.kind == kGradientLobe || row.kind == kOffDiagonalLobe) && has_i) out[i] = gradient_lobe_quantile(p_i);
  if (row.kind == kOffDiagonalLobe && has_j) out[j] = gradient_lobe_quantile(p_j);
}

// z = x + sigma u in the type of x, and u again. The rounding of z acts as dither: estimates from the u that was drawn
// have less bias than estimates from (z - x) / sigma, see the reference.
template <typename T>
ZH_INLINE double place(double x, double sigma, double u, T* point) {
  if (point) *point = T(x + sigma * u);
  return u;
}

// Density ratio N(u) / p(u) of one row of n perturbations.
ZH_CLONES static inline double weight(const double* u, int64_t n, int64_t proposal) {
  if (proposal == kGaussian || proposal == kSignedLobes) return 1.0;
  double first[8] = {}, second[8] = {}, hole[8] = {};
  for (int64_t d = 0; d < n; d += 8) {
    const int64_t lanes = n - d < 8 ? n - d : 8;
    for (int64_t lane = 0; lane < lanes; ++lane) {
      const double square = u[d + lane] * u[d + lane];
      first[lane] += std::fabs(u[d + lane]);
      second[lane] += square;
      hole[lane] += std::fabs(square - 1.0);
    }
  }
  double l1 = 0.0, l2 = 0.0, l3 = 0.0;
  for (int lane = 0; lane < 8; ++lane) {
    l1 += first[lane];
    l2 += second[lane];
    l3 += hole[lane];
  }
  const double size = double(n);
  if (proposal == kUniform) return std::exp(size * kLogBox - 0.5 * l2);
  const double gradient = kSqrtHalfPi * (l1 / size);
  if (proposal == kFirstOrder) return 2.0 / (1.0 + gradient);
  const double hessian = (kHalfPi * (l1 * l1 - l2) + kDiagonalLobeScale * l3) / (size * size);
  return 3.0 / (1.0 + gradient + hessian);
}

}  // namespace zerohess
