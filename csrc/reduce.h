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

  const double* columns(int64_t k, int64_t first, int64_t) const { return u + k * n + first; }
};

// K = (1 + antithetic) * samples rows around one x; the second half repeats the first with the opposite sign.
struct DrawnRows {
  const Row* rows;
  int64_t samples;
  bool single;

  // Rows begin .. end of the first half, kBlock numbers apart.
  void draw(int64_t begin, int64_t end, int64_t first, int64_t count, double* out) const {
    for (int64_t k = begin; k < end; ++k, out += kBlock) {
      if (single) {
        float buffer[kBlock];
        draw_columns(rows[k], first, count, buffer);
        std::copy_n(buffer, count, out);
      } else {
        draw_columns(rows[k], first, count, out);
      }
    }
  }
};

ZH_INLINE double dot_generic(const double* a, const double* b, int64_t count) {
  double lanes[8] = {}, rest = 0.0;
  int64_t d = 0;
  for (; d + 8 <= count; d += 8)
    for (int lane = 0; lane < 8; ++lane) lanes[lane] += a[d + lane] * b[d + lane];
  for (; d < count; ++d) rest += a[d] * b[d];
  return ((lanes[0] + lanes[4]) + (lanes[2] + lanes[6])) + ((lanes[1] + lanes[5]) + (lanes[3] + lanes[7])) + rest;
}
ZH_VERSIONS(double, dot, (const double* a, const double* b, int64_t count), (a, b, count))

ZH_INLINE void add_scaled_generic(double scale, const double* u, int64_t count, double* out) {
  for (int64_t d = 0; d < count; ++d) out[d] += scale * u[d];
}
ZH_VERSIONS(
    void, add_scaled, (double scale, const double* u, int64_t count, double* out), (scale, u, count, out))

ZH_INLINE void add_scaled_squares_generic(double scale, const double* u, int64_t count, double* out) {
  for (int64_t d = 0; d < count; ++d) out[d] += scale * (u[d] * u[d]);
}
ZH_VERSIONS(
    void, add_scaled_squares, (double scale, const double* u, int64_t count, double* out), (scale, u, count, out))

// out[m, k] = sum_d U[k, d] t[m, d] for one stored row k; t is [M, n], out has stride K.
inline void project_row(const StoredRows& rows, int64_t k, int64_t K, int64_t n, int64_t M, const double* t,
                        double* out) {
  for (int64_t m = 0; m < M; ++m) out[m * K + k] = 0.0;
  for (int64_t first = 0; first < n; first += kBlock) {
    const int64_t count = std::min(kBlock, n - first);
    const double* u = rows.columns(k, first, count);
    for (int64_t m = 0; m < M; ++m) out[m * K + k] += dot(u, t + m * n + first, count);
  }
}

// The same for rows begin .. end of the first half of drawn rows, and their mirror images in the second. Block by block,
// so that t stays in the cache.
inline void project_drawn_rows(const DrawnRows& rows, int64_t begin, int64_t end, int64_t K, int64_t n, int64_t M,
                               const double* t, double* out) {
  double u[kBlock];
  for (int64_t m = 0; m < M; ++m) std::fill(out + m * K + begin, out + m * K + end, 0.0);
  for (int64_t first = 0; first < n; first += kBlock) {
    const int64_t count = std::min(kBlock, n - first);
    for (int64_t k = begin; k < end; ++k) {
      rows.draw(k, k + 1, first, count, u);
      for (int64_t m = 0; m < M; ++m) out[m * K + k] += dot(u, t + m * n + first, count);
    }
  }
  for (int64_t k = begin; K > rows.samples && k < end; ++k)
    for (int64_t m = 0; m < M; ++m) out[m * K + rows.samples + k] = -out[m * K + k];
}

// sums[m, d] += sign sum_k a[m, k] U[k, d] over rows u + k * stride, 0 <= k < rows, of `count` columns; a has stride K.
// With `squares` U[k, d]^2 in place of U[k, d], which has no sign. sign is -1 for the mirror images of drawn rows.
inline void accumulate_rows(const double* u, int64_t stride, int64_t rows, int64_t count, int64_t K, int64_t M,
                            bool squares, double sign, const double* a, double* sums) {
  for (int64_t k = 0; k < rows; ++k) {
    for (int64_t m = 0; m < M; ++m) {
      if (squares)
        add_scaled_squares(a[m * K + k], u + k * stride, count, sums + m * count);
      else
        add_scaled(sign * a[m * K + k], u + k * stride, count, sums + m * count);
    }
  }
}

// out[m, d] = sum_k a[m, k] U[k, d] (or U[k, d]^2) for the columns of one block; a is [M, K], out is [M, n].
inline void accumulate_block(const StoredRows& rows, int64_t first, int64_t K, int64_t n, int64_t M, bool squares,
                             const double* a, double* out) {
  const int64_t count = std::min(kBlock, n - first);
  std::vector<double> sums(size_t(M * count), 0.0);
  accumulate_rows(rows.columns(0, first, count), n, K, count, K, M, squares, 1.0, a, sums.data());
  for (int64_t m = 0; m < M; ++m) std::copy_n(sums.data() + m * count, count, out + m * n + first);
}

constexpr int64_t kHeld = 512;  // drawn rows of a block that are held: one megabyte

// The terms are added in the order of stored rows: all of the first half, then all of the second. Where the rows of a
// block can be held they are drawn once for both.
inline void accumulate_block(const DrawnRows& rows, int64_t first, int64_t K, int64_t n, int64_t M, bool squares,
                             const double* a, double* out) {
  const int64_t count = std::min(kBlock, n - first), S = rows.samples, part = std::min(S, kHeld);
  std::vector<double> sums(size_t(M * count), 0.0), u(size_t(part * kBlock));
  for (int64_t half = 0; half < K / S; ++half) {
    for (int64_t begin = 0; begin < S; begin += part) {
      const int64_t end = std::min(S, begin + part);
      if (half == 0 || part < S) rows.draw(begin, end, first, count, u.data());
      accumulate_rows(u.data(), kBlock, end - begin, count, K, M, squares, half == 0 ? 1.0 : -1.0,
                      a + half * S + begin, sums.data());
    }
  }
  for (int64_t m = 0; m < M; ++m) std::copy_n(sums.data() + m * count, count, out + m * n + first);
}

// out[p] = (f[p] - baseline[p]) * share in double precision; without a baseline f[p] * share.
template <class T>
inline void center_row(const T* f, const T* baseline, double share, int64_t P, double* out) {
  if (baseline)
    for (int64_t p = 0; p < P; ++p) out[p] = (double(f[p]) - double(baseline[p])) * share;
  else
    for (int64_t p = 0; p < P; ++p) out[p] = double(f[p]) * share;
}

// Divides each of `rows` rows of n numbers by sigma [n].
inline void divide_rows(double* numbers, const double* sigma, int64_t rows, int64_t n) {
  for (int64_t row = 0; row < rows; ++row, numbers += n)
    for (int64_t d = 0; d < n; ++d) numbers[d] /= sigma[d];
}

// Sum of K numbers, block by block: an error of a few units in the last place of the sum of magnitudes.
inline double total(const double* a, int64_t K) {
  double whole = 0.0;
  for (int64_t first = 0; first < K; first += kBlock) {
    double part = 0.0;
    for (int64_t k = first; k < std::min(K, first + kBlock); ++k) part += a[k];
    whole += part;
  }
  return whole;
}

// out[i, j] = sum_k a[k] U[k, i] U[k, j] for one row i of the upper triangle; u is [K, n].
inline void hessian_row(const double* u, int64_t i, int64_t K, int64_t n, const double* a, double* out) {
  std::fill_n(out + i * n + i, n - i, 0.0);
  for (int64_t k = 0; k < K; ++k) add_scaled(a[k] * u[k * n + i], u + k * n + i, n - i, out + i * n + i);
}

// Copies rows begin .. end of the lower triangle of a matrix [n, n] from its upper triangle, in tiles that fit the cache.
inline void mirror_rows(double* matrix, int64_t n, int64_t begin, int64_t end) {
  constexpr int64_t kTile = 32;
  for (int64_t top = begin; top < end; top += kTile) {
    const int64_t bottom = std::min(top + kTile, end);
    for (int64_t left = 0; left < bottom; left += kTile)
      for (int64_t i = top; i < bottom; ++i)
        for (int64_t j = left; j < std::min(left + kTile, i); ++j) matrix[i * n + j] = matrix[j * n + i];
  }
}

}  // namespace zerohess
