// Linear maps between parameters and samples: the only sums over samples that an estimate is made of.
// Rows of U [K, n] are either stored or drawn again from (seed, index), so that memory stays O(K + n).
// Every output element is summed in one fixed order, whatever the number of threads.
#pragma once

#include <algorithm>
#include <vector>

#include "perturb.h"

namespace zerohess {

struct StoredRows {
  const double* u;
  int64_t n;

  const double* columns(int64_t k, int64_t first, int64_t, double*) const { return u + k * n + first; }
};

// K = (1 + antithetic) * samples rows around one x; the second half repeats the first with the opposite sign.
struct DrawnRows {
  const Row* rows;
  const double *x, *sigma;
  int64_t samples;
  bool single;

  const double* columns(int64_t k, int64_t first, int64_t count, double* buffer) const {
    const double sign = k < samples ? 1.0 : -1.0;
    draw_columns(rows[k % samples], first, count, buffer);
    for (int64_t d = 0; d < count; ++d) {
      const double x_d = x[first + d], sigma_d = sigma[first + d], u = sign * buffer[d];
      buffer[d] = single ? place<float>(x_d, sigma_d, u, nullptr) : place<double>(x_d, sigma_d, u, nullptr);
    }
    return buffer;
  }
};

ZH_CLONES static inline double dot(const double* a, const double* b, int64_t count) {
  double lanes[8] = {}, rest = 0.0;
  int64_t d = 0;
  for (; d + 8 <= count; d += 8)
    for (int lane = 0; lane < 8; ++lane) lanes[lane] += a[d + lane] * b[d + lane];
  for (; d < count; ++d) rest += a[d] * b[d];
  return ((lanes[0] + lanes[4]) + (lanes[2] + lanes[6])) + ((lanes[1] + lanes[5]) + (lanes[3] + lanes[7])) + rest;
}

ZH_CLONES static inline void add_scaled(double scale, const double* u, int64_t count, double* out) {
  for (int64_t d = 0; d < count; ++d) out[d] += scale * u[d];
}

ZH_CLONES static inline void add_scaled_squares(double scale, const double* u, int64_t count, double* out) {
  for (int64_t d = 0; d < count; ++d) out[d] += scale * (u[d] * u[d]);
}

// out[m, k] = sum_d U[k, d] t[m, d] for one row k; t is [M, n], out has stride K.
template <class Rows>
void project_row(const Rows& rows, int64_t k, int64_t K, int64_t n, int64_t M, const double* t, double* out) {
  double buffer[kBlock];
  for (int64_t m = 0; m < M; ++m) out[m * K + k] = 0.0;
  for (int64_t first = 0; first < n; first += kBlock) {
    const int64_t count = std::min(kBlock, n - first);
    const double* u = rows.columns(k, first, count, buffer);
    for (int64_t m = 0; m < M; ++m) out[m * K + k] += dot(u, t + m * n + first, count);
  }
}

// out[m, d] = sum_k a[m, k] U[k, d] (or U[k, d]^2) for the columns of one block; a is [M, K], out is [M, n].
template <class Rows>
void accumulate_block(
    const Rows& rows, int64_t first, int64_t K, int64_t n, int64_t M, bool squares, const double* a, double* out) {
  double buffer[kBlock];
  const int64_t count = std::min(kBlock, n - first);
  std::vector<double> sums(size_t(M * count), 0.0);
  for (int64_t k = 0; k < K; ++k) {
    const double* u = rows.columns(k, first, count, buffer);
    for (int64_t m = 0; m < M; ++m) {
      if (squares)
        add_scaled_squares(a[m * K + k], u, count, sums.data() + m * count);
      else
        add_scaled(a[m * K + k], u, count, sums.data() + m * count);
    }
  }
  for (int64_t m = 0; m < M; ++m) std::copy_n(sums.data() + m * count, count, out + m * n + first);
}

// out[i, j] = sum_k a[k] U[k, i] U[k, j] for one row i of the upper triangle; u is [K, n].
inline void hessian_row(const double* u, int64_t i, int64_t K, int64_t n, const double* a, double* out) {
  std::fill_n(out + i * n + i, n - i, 0.0);
  for (int64_t k = 0; k < K; ++k) add_scaled(a[k] * u[k * n + i], u + k * n + i, n - i, out + i * n + i);
}

}  // namespace zerohess
