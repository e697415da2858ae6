// Perturbations, the points that they lead to, and importance weights.
// Literal reference: torch_zerohess/sampling/proposals.py.
#pragma once

#include <vector>

#include "single.h"

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

// Lobes of a row in place of the normal perturbations of columns first .. first + count; p_of(d) is a column's uniform.
template <class T, class Uniform>
inline void set_lobes(const Row& row, int64_t first, int64_t count, T* out, const Uniform& p_of) {
  const auto holds = [&](int64_t d) { return d >= first && d - first < count; };  // d may be any number
  const bool has_i = holds(row.i), has_j = holds(row.j);
  const int64_t i = has_i ? row.i - first : 0, j = has_j ? row.j - first : 0;
  if (row.kind == kDiagonalLobe && has_i) out[i] = T(hessian_lobe_quantile(p_of(i)));
  if ((row.kind == kGradientLobe || row.kind == kOffDiagonalLobe) && has_i) out[i] = T(gradient_lobe_quantile(p_of(i)));
  if (row.kind == kOffDiagonalLobe && has_j) out[j] = T(gradient_lobe_quantile(p_of(j)));
}

ZH_INLINE void gradient_lobe_quantiles_generic(const double* p, int64_t count, double* out) {
  for (int64_t d = 0; d < count; ++d) out[d] = gradient_lobe_quantile(p[d]);
}
ZH_VERSIONS(void, gradient_lobe_quantiles, (const double* p, int64_t count, double* out), (p, count, out))

// u of columns first .. first + count of one row; first is a multiple of kBlock, count <= kBlock.
inline void draw_columns(const Row& row, int64_t first, int64_t count, double* out) {
  double p[kBlock];
  uniforms(uint64_t(row.seed), uint64_t(row.index), kDimensions, first, (count + 1) / 2, p);
  if (row.kind == kBox) {
    for (int64_t d = 0; d < count; ++d) out[d] = kBoxHalfWidth * (2.0 * p[d] - 1.0);
  } else if (row.kind == kEveryGradientLobe) {
    gradient_lobe_quantiles(p, count, out);
  } else {
    normal_quantiles(p, count, out);
    set_lobes(row, first, count, out, [&](int64_t d) { return p[d]; });
  }
}

// All n perturbations of a row from given uniforms p.
inline void shape_row(const Row& row, const double* p, int64_t n, double* out) {
  if (row.kind == kBox) {
    for (int64_t d = 0; d < n; ++d) out[d] = kBoxHalfWidth * (2.0 * p[d] - 1.0);
  } else if (row.kind == kEveryGradientLobe) {
    gradient_lobe_quantiles(p, n, out);
  } else {
    for (int64_t first = 0; first < n; first += kBlock)
      normal_quantiles(p + first, n - first < kBlock ? n - first : kBlock, out + first);
    set_lobes(row, 0, n, out, [&](int64_t d) { return p[d]; });
  }
}

// The same in single precision, from noise of its own: 32 bits for each number.
inline void draw_columns(const Row& row, int64_t first, int64_t count, float* out) {
  uint32_t words[kBlock];
  noise(Counter{uint64_t(row.seed), uint64_t(row.index), kDimensions, uint32_t(first / 4)}, (count + 3) / 4, words);
  const auto p_of = [&](int64_t d) { return (double(words[d]) + 0.5) * 0x1p-32; };
  if (row.kind == kBox) {
    for (int64_t d = 0; d < count; ++d) out[d] = float(kBoxHalfWidth * (2.0 * p_of(d) - 1.0));
  } else if (row.kind == kEveryGradientLobe) {
    for (int64_t d = 0; d < count; ++d) out[d] = float(gradient_lobe_quantile(p_of(d)));
  } else {
    normal_quantiles(words, count, out);
    set_lobes(row, first, count, out, p_of);
  }
}

// Sums over the perturbations of a row: all that the density of a proposal depends on.
struct Magnitudes {
  double l1, l2, hole;
};

// Adds `count` <= kBlock perturbations. The terms of a block are summed in their own precision, in an order that depends
// on `count` alone: relative errors are below 2^-20 in single precision.
template <class T>
ZH_INLINE void add_magnitudes(const T* u, int64_t count, Magnitudes& sums) {
  constexpr int64_t kLanes = 8;
  T l1[kBlock / 2], l2[kBlock / 2], hole[kBlock / 2];
  if (count == kBlock) {  // a tree: every level is a loop over independent elements
    for (int64_t d = 0; d < kBlock / 2; ++d) {
      const T one = u[d], other = u[d + kBlock / 2];
      l1[d] = std::fabs(one) + std::fabs(other);
      l2[d] = one * one + other * other;
      hole[d] = std::fabs(one * one - T(1)) + std::fabs(other * other - T(1));
    }
    for (int64_t half = kBlock / 4; half >= kLanes; half /= 2) {
      for (int64_t d = 0; d < half; ++d) {
        l1[d] += l1[d + half];
        l2[d] += l2[d + half];
        hole[d] += hole[d + half];
      }
    }
  } else {
    for (int64_t lane = 0; lane < kLanes; ++lane) l1[lane] = l2[lane] = hole[lane] = T(0);
    for (int64_t d = 0; d < count; d += kLanes) {
      const int64_t lanes = count - d < kLanes ? count - d : kLanes;
      for (int64_t lane = 0; lane < lanes; ++lane) {
        const T one = u[d + lane];
        l1[lane] += std::fabs(one);
        l2[lane] += one * one;
        hole[lane] += std::fabs(one * one - T(1));
      }
    }
  }
  for (int64_t lane = 0; lane < kLanes; ++lane) {
    sums.l1 += double(l1[lane]);
    sums.l2 += double(l2[lane]);
    sums.hole += double(hole[lane]);
  }
}

// Density ratio N(u) / p(u) of one row of n perturbations.
inline double density_ratio(const Magnitudes& sums, int64_t n, int64_t proposal) {
  if (proposal == kGaussian || proposal == kSignedLobes) return 1.0;
  const double size = double(n), l1 = sums.l1, l2 = sums.l2;
  if (proposal == kUniform) return std::exp(size * kLogBox - 0.5 * l2);
  const double gradient = kSqrtHalfPi * (l1 / size);
  if (proposal == kFirstOrder) return 2.0 / (1.0 + gradient);
  const double hessian = (kHalfPi * (l1 * l1 - l2) + kDiagonalLobeScale * sums.hole) / (size * size);
  return 3.0 / (1.0 + gradient + hessian);
}

// Where the numbers of one block of a row go, and of the row with the opposite sign; null where nobody wants them.
template <class T>
struct Places {
  T *points, *mirrored_points;
  double *u, *mirrored_u;
};

// Points x + sigma u in the type of x, and the perturbations u that they are made of: the rounding of a point acts as
// dither, see the reference.
template <class U, class X, class T>
ZH_INLINE void place_generic(
    const U* u, int64_t count, const X* x, const double* sigma, bool weigh, const Places<T>& to, Magnitudes& sums) {
  T* const __restrict points = to.points;
  for (int64_t d = 0; d < count; ++d) points[d] = T(double(x[d]) + sigma[d] * double(u[d]));
  if (T* const __restrict mirrored = to.mirrored_points)
    for (int64_t d = 0; d < count; ++d) mirrored[d] = T(double(x[d]) - sigma[d] * double(u[d]));
  if (double* const __restrict kept = to.u)
    for (int64_t d = 0; d < count; ++d) kept[d] = double(u[d]);
  if (double* const __restrict kept = to.mirrored_u)
    for (int64_t d = 0; d < count; ++d) kept[d] = -double(u[d]);
  if (weigh) add_magnitudes(u, count, sums);
}
ZH_VERSIONS(void, place,
            (const float* u, int64_t count, const float* x, const double* sigma, bool weigh, const Places<float>& to,
             Magnitudes& sums),
            (u, count, x, sigma, weigh, to, sums))
ZH_VERSIONS(void, place,
            (const double* u, int64_t count, const double* x, const double* sigma, bool weigh,
             const Places<double>& to, Magnitudes& sums),
            (u, count, x, sigma, weigh, to, sums))
ZH_VERSIONS(void, place,
            (const double* u, int64_t count, const double* x, const double* sigma, bool weigh, const Places<float>& to,
             Magnitudes& sums),
            (u, count, x, sigma, weigh, to, sums))

// Where a batch of B estimates with S rows each is placed: points [B, E, n], u [B, K, n] or null, weights [B, K]; K is
// S, or 2 S where `antithetic`, and E is K or more.
template <class X, class T>
struct Batch {
  const X* x;
  const double* sigma;
  int64_t S, E, n, proposal;
  bool antithetic;
  T* points;
  double *u, *weights;

  int64_t K() const { return antithetic ? 2 * S : S; }
};

// Rows begin .. end of B * S, block by block, so that x and sigma stay in the cache. columns(row, first, count, buffer)
// gives perturbations, in the buffer or elsewhere.
template <class U, class X, class T, class Columns>
inline void place_rows(const Batch<X, T>& batch, int64_t begin, int64_t end, const Columns& columns) {
  const bool weigh = batch.proposal != kGaussian && batch.proposal != kSignedLobes;
  const int64_t S = batch.S, K = batch.K(), n = batch.n;
  std::vector<Magnitudes> sums(size_t(end - begin), Magnitudes{});
  for (int64_t first = 0; first < n; first += kBlock) {
    const int64_t count = n - first < kBlock ? n - first : kBlock;
    for (int64_t row = begin; row < end; ++row) {
      U buffer[kBlock];
      const int64_t b = row / S, s = row % S;
      T* const points = batch.points + (b * batch.E + s) * n + first;
      double* const u = batch.u ? batch.u + (b * K + s) * n + first : nullptr;
      const Places<T> to{points, batch.antithetic ? points + S * n : nullptr, u,
                         u && batch.antithetic ? u + S * n : nullptr};
      const U* const drawn = columns(row, first, count, buffer);
      place(drawn, count, batch.x + b * n + first, batch.sigma + first, weigh, to, sums[size_t(row - begin)]);
    }
  }
  for (int64_t row = begin; row < end; ++row) {
    double* const weight = batch.weights + row / S * K + row % S;
    weight[0] = density_ratio(sums[size_t(row - begin)], n, batch.proposal);
    if (batch.antithetic) weight[S] = weight[0];
  }
}

}  // namespace zerohess
