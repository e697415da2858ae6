// Sparse Jacobians: their products with vectors, and regressions of their rows: slopes on known supports, with the
// previous slopes as the prior, and their standard errors. Literal references, with the formulas: `sparse_product.py`
// and `sparse_regression.py` in torch_zerohess/surrogates.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "dispatch.h"

namespace zerohess {

// sum_e values[e] vector[column[e]] over the entries of a row, as four sums, which do not wait for each other.
template <class V, class T>
inline T sparse_dot(const int64_t* column, const V* values, int64_t entries, const T* vector) {
  T sums[4] = {};
  for (int64_t e = 0; e < entries; ++e) sums[e % 4] += T(values[e]) * vector[column[e]];
  return (sums[0] + sums[2]) + (sums[1] + sums[3]);
}

// What all rows have in common: n parameters, K samples, `keep` entries of a row, `known` entries of a previous row.
template <class T>
struct Regression {
  const T *directions, *scale, *changes;                      // [n, K], [n], [m, K]
  const int64_t *index, *known_index;                         // [m, keep], [m, known]
  const bool* used;                                           // [m, keep]
  const T *known_values, *ridges, *constant;                  // [m, known], [R, 2], [K] or null
  int64_t m, K, keep, known, R, most;                         // most: used entries of a row, at most
  bool shortened;
  T *values, *errors;  // [R, m, keep] and, of the first ridges, [m, keep] or null; zeros before
};

template <class T>
constexpr int64_t kLanes = 64 / sizeof(T);  // numbers of the longest vector register

template <class T>
constexpr int64_t padded(int64_t count) {
  return (count + kLanes<T> - 1) / kLanes<T> * kLanes<T>;
}

template <class T, int64_t lanes>
ZH_INLINE T lane_total(const T* lane) {
  if constexpr (lanes == 1) {
    return lane[0];
  } else {
    T half[lanes / 2];
    for (int64_t i = 0; i < lanes / 2; ++i) half[i] = lane[i] + lane[i + lanes / 2];
    return lane_total<T, lanes / 2>(half);
  }
}

// Both for `count` numbers, a multiple of the lanes, and in one order for all instruction sets.
template <class T>
ZH_INLINE T dot_padded(const T* a, const T* b, int64_t count) {
  T sums[kLanes<T>] = {};
  for (int64_t first = 0; first < count; first += kLanes<T>)
    for (int64_t lane = 0; lane < kLanes<T>; ++lane) sums[lane] += a[first + lane] * b[first + lane];
  return lane_total<T, kLanes<T>>(sums);
}

template <class T>
ZH_INLINE void add_padded(T scale, const T* a, int64_t count, T* out) {
  for (int64_t first = 0; first < count; first += kLanes<T>)
    for (int64_t lane = 0; lane < kLanes<T>; ++lane) out[first + lane] += scale * a[first + lane];
}

// Symmetric matrices [s, s] with rows of `width` numbers, by their Cholesky factors R^T R, upper triangular.
template <class T>
struct Cholesky {
  int64_t s = 0, width = 0;
  std::vector<T> factor, reciprocal, rest;  // [most, width]; of the diagonal [most]; scratch [width]

  explicit Cholesky(int64_t most) : factor(size_t(most * padded<T>(most))), reciprocal(most), rest(padded<T>(most)) {}

  T* row(int64_t i) { return factor.data() + i * width; }
  static int64_t aligned(int64_t i) { return i / kLanes<T> * kLanes<T>; }
};

// Factors gram + diag(prior); false if it is not positive definite.
template <class T>
ZH_INLINE bool factorize(const T* gram, const T* prior, int64_t s, Cholesky<T>& to) {
  const int64_t width = padded<T>(s);
  to.s = s, to.width = width;
  T* R = to.factor.data();
  std::copy_n(gram, s * width, R);
  for (int64_t j = 0; j < s; ++j) {
    T* top = R + j * width;
    const T pivot = top[j] + prior[j];
    if (!(pivot > T(0))) return false;
    const T scale = to.reciprocal[j] = T(1) / std::sqrt(pivot);
    top[j] = pivot;
    for (int64_t i = to.aligned(j); i < width; ++i) top[i] = i < j ? T(0) : top[i] * scale;
    // The trailing part, in columns of one vector each.
    for (int64_t first = to.aligned(j + 1); first < width; first += kLanes<T>) {
      T tops[kLanes<T>];
      std::copy_n(top + first, kLanes<T>, tops);
      const int64_t last = std::min(s, first + kLanes<T>);
      T* out = R + (j + 1) * width + first;
      for (int64_t i = j + 1; i < last; ++i, out += width) {
        const T factor = top[i];
        for (int64_t lane = 0; lane < kLanes<T>; ++lane) out[lane] -= factor * tops[lane];
      }
    }
  }
  return true;
}

// y with R^T y = b, where b is 0 before the entry `begin`; both [width], y 0 beyond s.
template <class T>
ZH_INLINE void solve_lower(Cholesky<T>& with, const T* b, int64_t begin, T* y) {
  std::copy_n(b, with.width, with.rest.data());
  std::fill_n(y, with.width, T(0));
  for (int64_t j = begin; j < with.s; ++j) {
    const int64_t first = with.aligned(j);
    y[j] = with.rest[j] * with.reciprocal[j];
    add_padded(-y[j], with.row(j) + first, with.width - first, with.rest.data() + first);
  }
}

// x with R x = y; both [width], x 0 beyond s.
template <class T>
ZH_INLINE void solve_upper(Cholesky<T>& with, const T* y, T* x) {
  std::fill_n(x, with.width, T(0));
  for (int64_t j = with.s - 1; j >= 0; --j) {
    const int64_t first = with.aligned(j);
    x[j] = (y[j] - dot_padded(with.row(j) + first, x + first, with.width - first)) * with.reciprocal[j];
  }
}

// The numbers of one row; s entries of it are used, at most `most`.
template <class T>
struct Scratch {
  int64_t s = 0, width = 0, samples;
  std::vector<int64_t> place;              // of the used entries
  std::vector<T> A, target, gram;          // [most, samples], transposed; [samples]; [most, width]
  std::vector<T> product, old, prior, change, half;
  std::vector<T> roots, own, weighted, influence, rest;  // for errors
  Cholesky<T> system;

  explicit Scratch(const Regression<T>& of)
      : samples(padded<T>(of.K)), place(of.keep), A(size_t(of.most * samples)), target(samples),
        gram(size_t(of.most * padded<T>(of.most))), product(padded<T>(of.most)), old(of.most), prior(of.most),
        change(padded<T>(of.most)), half(padded<T>(of.most)), system(of.most) {
    if (of.errors) roots.resize(gram.size()), own.resize(of.most), weighted.resize(padded<T>(of.most));
    if (of.errors && of.constant) influence.resize(A.size()), rest.resize(samples);
  }
};

// Reads one row: A, the old slopes, what they leave of the changes, A^T A (its upper triangle) and A^T times the latter.
template <class T>
ZH_INLINE void read_row(const Regression<T>& of, int64_t row, Scratch<T>& to) {
  const int64_t *index = of.index + row * of.keep, *known = of.known_index + row * of.known;
  const T* values = of.known_values + row * of.known;
  to.s = 0;
  for (int64_t e = 0; e < of.keep; ++e)
    if (of.used[row * of.keep + e]) to.place[to.s++] = e;
  to.width = padded<T>(to.s);
  std::fill(std::copy_n(of.changes + row * of.K, of.K, to.target.begin()), to.target.end(), T(0));
  for (int64_t i = 0; i < to.s; ++i) {
    const int64_t parameter = index[to.place[i]];
    std::copy_n(of.directions + parameter * of.K, of.K, to.A.data() + i * to.samples);
    to.old[i] = T(0);
    for (int64_t e = 0; e < of.known; ++e) to.old[i] += known[e] == parameter ? values[e] : T(0);
  }
  for (int64_t i = 0; i < to.s; ++i)
    if (to.old[i] != T(0)) add_padded(-to.old[i], to.A.data() + i * to.samples, to.samples, to.target.data());
  std::fill_n(to.gram.data(), to.s * to.width, T(0));
  std::fill_n(to.product.data(), to.width, T(0));
  for (int64_t i = 0; i < to.s; ++i) {
    const T* own = to.A.data() + i * to.samples;
    to.product[i] = dot_padded(own, to.target.data(), to.samples);
    for (int64_t j = i; j < to.s; ++j)
      to.gram[i * to.width + j] = dot_padded(own, to.A.data() + j * to.samples, to.samples);
  }
}

// Writes the slopes for one pair of ridges; false if the matrix is not positive definite.
template <class T>
ZH_INLINE bool solve_row(const Regression<T>& of, int64_t row, int64_t r, Scratch<T>& at) {
  const int64_t* index = of.index + row * of.keep;
  for (int64_t i = 0; i < at.s; ++i)
    at.prior[i] = of.ridges[2 * r + (at.old[i] == T(0))] * of.scale[index[at.place[i]]];
  if (!factorize(at.gram.data(), at.prior.data(), at.s, at.system)) return false;
  solve_lower(at.system, at.product.data(), 0, at.half.data());
  solve_upper(at.system, at.half.data(), at.change.data());
  T* out = of.values + (r * of.m + row) * of.keep;
  for (int64_t i = 0; i < at.s; ++i) out[at.place[i]] = at.old[i] + at.change[i];
  return true;
}

// Variances by HC3, sum_k (M a_k)_i^2 (left_k / rest_k)^2, and of the prior, sum_j M_ij^2 variance prior_j.
template <class T>
ZH_INLINE void variances_of_samples(const Regression<T>& of, T variance, Scratch<T>& at, T* out) {
  const T least = std::sqrt(std::numeric_limits<T>::epsilon());
  T* rest = at.rest.data();
  for (int64_t k = 0; k < of.K; ++k) rest[k] = T(1) - of.constant[k];
  for (int64_t i = 0; i < at.s; ++i) {
    T *influence = at.influence.data() + i * at.samples, prior = T(0);
    std::fill_n(influence, at.samples, T(0));
    for (int64_t j = 0; j < at.s; ++j) {
      const T element = dot_padded(at.roots.data() + i * at.width, at.roots.data() + j * at.width, at.width);
      add_padded(element, at.A.data() + j * at.samples, at.samples, influence);
      prior += element * element * at.prior[j];
    }
    for (int64_t k = 0; k < of.K; ++k) rest[k] -= at.A[i * at.samples + k] * influence[k];
    out[i] = variance * prior;
  }
  for (int64_t k = 0; k < of.K; ++k) rest[k] = at.target[k] / std::max(rest[k], least);
  for (int64_t i = 0; i < at.s; ++i) {
    T* influence = at.influence.data() + i * at.samples;
    for (int64_t k = 0; k < of.K; ++k) influence[k] *= rest[k];
    out[i] += dot_padded(influence, influence, at.samples);
  }
}

// Writes the standard errors of the slopes that `solve_row` has written last.
template <class T>
ZH_INLINE void errors_of_row(const Regression<T>& of, int64_t row, Scratch<T>& at) {
  // With the rows z_i of the inverse of R, the elements of M are z_i . z_j.
  T spent = T(0);
  for (int64_t i = 0; i < at.s; ++i) {
    T* z = at.roots.data() + i * at.width;
    std::fill_n(at.weighted.data(), at.width, T(0));
    at.weighted[i] = T(1);
    solve_lower(at.system, at.weighted.data(), i, z);
    at.own[i] = dot_padded(z, z, at.width);
    spent += T(1) - at.own[i] * at.prior[i];
  }
  std::fill_n(at.weighted.data(), at.width, T(0));
  for (int64_t i = 0; i < at.s; ++i)
    at.weighted[i] = of.shortened || at.old[i] != T(0) ? at.prior[i] * at.change[i] : T(0);
  solve_lower(at.system, at.weighted.data(), 0, at.half.data());
  T* bias = at.weighted.data();
  solve_upper(at.system, at.half.data(), bias);
  T* left = at.target.data();  // what the previous slopes leave, and from here on what the slopes leave
  for (int64_t i = 0; i < at.s; ++i) add_padded(-at.change[i], at.A.data() + i * at.samples, at.samples, left);
  const T squares = dot_padded(left, left, at.samples);
  const T variance = squares / std::max(T(of.K - 1) - std::max(spent, T(0)), T(1));
  T* square = at.half.data();
  for (int64_t i = 0; i < at.s; ++i) square[i] = variance * at.own[i];
  if (of.constant) variances_of_samples(of, variance, at, square);
  T* out = of.errors + row * of.keep;
  for (int64_t i = 0; i < at.s; ++i) out[at.place[i]] = std::sqrt(square[i] + bias[i] * bias[i]);
}

// Rows begin .. end; returns how many of them have a matrix that is not positive definite.
template <class T>
ZH_INLINE int64_t regress_rows_generic(const Regression<T>& of, int64_t begin, int64_t end) {
  Scratch<T> scratch(of);
  int64_t failed = 0;
  for (int64_t row = begin; row < end; ++row) {
    read_row(of, row, scratch);
    bool solved = true;
    for (int64_t r = of.R - 1; r >= 0; --r) solved &= solve_row(of, row, r, scratch);
    failed += !solved;
    if (of.errors) errors_of_row(of, row, scratch);
  }
  return failed;
}
ZH_VERSIONS(int64_t, regress_rows, (const Regression<float>& of, int64_t begin, int64_t end), (of, begin, end))
ZH_VERSIONS(int64_t, regress_rows, (const Regression<double>& of, int64_t begin, int64_t end), (of, begin, end))

}  // namespace zerohess
