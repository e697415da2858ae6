// Bytes as sizes, supports and numbers (NaN and infinities too) for the functions of csrc/sparse.h, under sanitizers.
#include "../../csrc/sparse.h"

#include "fuzz.h"

using namespace zerohess;

namespace {

template <class T>
std::vector<T> reals(Bytes& in, int64_t count, bool tame) {
  const Numbers numbers = in.numbers(count, tame ? 0 : 4);
  return std::vector<T>(numbers.begin(), numbers.end());
}

std::vector<uint32_t> words(Bytes& in, int64_t count) {
  std::vector<uint32_t> out(size_t(count + 3));
  noise(Counter{in.take<uint16_t>(), 0, kPicks, 0}, (count + 3) / 4, out.data());
  return out;
}

template <class T>
struct Fit {
  std::vector<T> values, errors;
  std::vector<int64_t> failed;  // of each call
};

// A regression whose arguments fit, as the operator demands.
template <class T>
struct Problem {
  int64_t n, K, m, keep, known, R, wild, most = 0;  // wild: which numbers may have any bits, none above 5
  bool shortened, robust;
  std::vector<T> directions, scale, changes, known_values, ridges, constant;
  std::vector<int64_t> index, known_index;
  std::vector<uint8_t> used;

  explicit Problem(Bytes& in)
      : n(1 + in.up_to(50)), K(in.up_to(140)), m(in.up_to(4)), keep(in.up_to(40)), known(in.up_to(6)), R(in.up_to(3)),
        wild(in.up_to(11)), shortened(in.up_to(1)), robust(in.up_to(1)), directions(reals<T>(in, n * K, wild != 0)),
        scale(reals<T>(in, n, wild != 1)), changes(reals<T>(in, m * K, wild != 2)),
        known_values(reals<T>(in, m * known, wild != 3)), ridges(reals<T>(in, 2 * R, wild != 4)),
        constant(reals<T>(in, K, wild != 5)) {
    const bool negative = in.up_to(7) == 0;
    const uint32_t share = in.take<uint8_t>();
    const std::vector<uint32_t> at = words(in, m * keep), at_known = words(in, m * known);
    for (int64_t i = 0; i < m * keep; ++i) index.push_back(at[size_t(i)] % n);
    for (int64_t i = 0; i < m * keep; ++i) used.push_back(at[size_t(i)] >> 24 <= share);
    for (int64_t i = 0; i < m * known; ++i) {  // an index of the same row, or any
      const int64_t word = at_known[size_t(i)];
      known_index.push_back(keep && word % 2 ? index[size_t(i / known * keep + word / 2 % keep)] : word);
    }
    if (m * known > 0) known_index[size_t(in.up_to(m * known - 1))] = in.take<int64_t>();
    for (T& one : scale) one = (1 + std::fabs(one)) / 2;
    for (T& one : ridges) one = negative ? one : std::fabs(one);
    for (T& one : constant) one = std::fabs(one) / 4;
    for (int64_t row = 0; row < m; ++row)
      most = std::max<int64_t>(most, std::count(used.begin() + row * keep, used.begin() + (row + 1) * keep, 1));
  }

  // Rows 0 .. cuts[0], cuts[0] .. cuts[1] and so on, each in a call of its own.
  Fit<T> fit(const std::vector<int64_t>& cuts, bool with_errors) const {
    Fit<T> to{std::vector<T>(size_t(R * m * keep)), std::vector<T>(size_t(with_errors ? m * keep : 0)), {}};
    const Regression<T> of{directions.data(), scale.data(), changes.data(), index.data(), known_index.data(),
                           reinterpret_cast<const bool*>(used.data()), known_values.data(), ridges.data(),
                           robust ? constant.data() : nullptr, m, K, keep, known, R, most, shortened,
                           to.values.data(), with_errors ? to.errors.data() : nullptr};
    int64_t begin = 0;
    for (const int64_t end : cuts) to.failed.push_back(regress_rows(of, begin, end)), begin = end;
    return to;
  }
};

// What the formulas of sparse_regression.py say of one row, in long double.
template <class T>
struct Exact {
  using Real = long double;
  const Problem<T>& of;
  int64_t row, s = 0;
  std::vector<int64_t> place;
  std::vector<Real> old, target;

  Exact(const Problem<T>& problem, int64_t which) : of(problem), row(which) {
    for (int64_t e = 0; e < of.keep; ++e)
      if (of.used[size_t(row * of.keep + e)]) place.push_back(e), ++s;
    for (int64_t i = 0; i < s; ++i) {
      old.push_back(0);
      for (int64_t e = row * of.known; e < (row + 1) * of.known; ++e)
        if (of.known_index[size_t(e)] == parameter(i)) old.back() += of.known_values[size_t(e)];
    }
    for (int64_t k = 0; k < of.K; ++k) {
      target.push_back(of.changes[size_t(row * of.K + k)]);
      for (int64_t i = 0; i < s; ++i) target.back() -= A(i, k) * old[size_t(i)];
    }
  }

  int64_t parameter(int64_t i) const { return of.index[size_t(row * of.keep + place[size_t(i)])]; }
  Real A(int64_t i, int64_t k) const { return of.directions[size_t(parameter(i) * of.K + k)]; }
  Real gram(int64_t i, int64_t j, Real sum = 0) const {
    for (int64_t k = 0; k < of.K; ++k) sum += A(i, k) * A(j, k);
    return sum;
  }
  Real prior(int64_t r, int64_t i) const {
    return Real(of.ridges[size_t(2 * r + (old[size_t(i)] == 0))]) * of.scale[size_t(parameter(i))];
  }
  T got(const Fit<T>& fit, int64_t r, int64_t i) const {
    return fit.values[size_t((r * of.m + row) * of.keep + place[size_t(i)])];
  }

  // The normal equations hold up to the rounding of a Cholesky factorization, whatever the condition of the matrix.
  void check_slopes(const Fit<T>& fit, int64_t r) const {
    const Real rounding = Real(2 * (of.K + 4 * s + 16)) * std::numeric_limits<T>::epsilon();
    std::vector<Real> left, size;
    Real length = 0, numbers = 0, least = 1, most = 0;
    for (int64_t k = 0; k < of.K; ++k) {
      left.push_back(of.changes[size_t(row * of.K + k)]);
      length += left.back() * left.back();
      for (int64_t i = 0; i < s; ++i) left.back() -= A(i, k) * got(fit, r, i);
    }
    for (int64_t i = 0; i < s; ++i) {
      size.push_back(std::sqrt(gram(i, i) + std::fabs(prior(r, i))));
      numbers += size.back() * (std::fabs(Real(got(fit, r, i))) + std::fabs(old[size_t(i)]));
      for (int64_t any = 0; any < of.R; ++any) least = std::min(least, prior(any, i));
      most += gram(i, i);
      if (gram(i, i) + prior(r, i) < -rounding * size.back() * size.back()) EXPECT(fit.failed[size_t(row)]);
    }
    if (least > rounding * (most + 1)) EXPECT(!fit.failed[size_t(row)]);
    if (fit.failed[size_t(row)]) return;
    for (int64_t i = 0; i < s; ++i) {
      Real residual = -prior(r, i) * (got(fit, r, i) - old[size_t(i)]);
      for (int64_t k = 0; k < of.K; ++k) residual += A(i, k) * left[size_t(k)];
      EXPECT(std::fabs(residual) <= rounding * size[size_t(i)] * (std::sqrt(length) + numbers));
    }
  }

  // The inverse [s, s] of gram + prior, by elimination: priors are positive.
  std::vector<Real> inverse() const {
    std::vector<Real> matrix(size_t(s * s));
    const auto at = [&](int64_t i, int64_t j) -> Real& { return matrix[size_t(i * s + j)]; };
    for (int64_t i = 0; i < s; ++i)
      for (int64_t j = 0; j < s; ++j) at(i, j) = gram(i, j) + (i == j ? prior(0, i) : 0);
    for (int64_t p = 0; p < s; ++p) {
      const Real pivot = at(p, p);
      at(p, p) = 1;
      for (int64_t j = 0; j < s; ++j) at(p, j) /= pivot;
      for (int64_t i = 0; i < s; ++i) {
        const Real factor = at(i, p);
        if (i == p) continue;
        at(i, p) = 0;
        for (int64_t j = 0; j < s; ++j) at(i, j) -= factor * at(p, j);
      }
    }
    return matrix;
  }

  // Standard errors, where the matrix is well conditioned and no sample decides alone.
  void check_errors(const Fit<T>& fit) const {
    for (int64_t i = 0; i < s; ++i)
      if (prior(0, i) < 0x1p-6L) return;
    const std::vector<Real> M = inverse();
    std::vector<Real> change(size_t(s), 0), bias(size_t(s), 0), square(size_t(s), 0), left = target;
    Real squares = 0, spent = 0;
    for (int64_t i = 0; i < s; ++i) {
      for (int64_t j = 0; j < s; ++j)
        for (int64_t k = 0; k < of.K; ++k) change[size_t(i)] += M[size_t(i * s + j)] * A(j, k) * target[size_t(k)];
      spent += 1 - M[size_t(i * s + i)] * prior(0, i);
      for (int64_t k = 0; k < of.K; ++k) left[size_t(k)] -= A(i, k) * change[size_t(i)];
    }
    for (const Real one : left) squares += one * one;
    const Real variance = squares / std::max<Real>(of.K - 1 - spent, 1);
    for (int64_t i = 0; i < s; ++i) {
      square[size_t(i)] = of.robust ? 0 : variance * M[size_t(i * s + i)];
      for (int64_t j = 0; j < s; ++j) {
        const Real element = M[size_t(i * s + j)];
        if (of.shortened || old[size_t(j)] != 0) bias[size_t(i)] += element * prior(0, j) * change[size_t(j)];
        if (of.robust) square[size_t(i)] += element * element * variance * prior(0, j);
      }
    }
    for (int64_t k = 0; of.robust && k < of.K; ++k) {
      std::vector<Real> influence(size_t(s), 0);
      Real rest = 1 - Real(of.constant[size_t(k)]);
      for (int64_t i = 0; i < s; ++i) {
        for (int64_t j = 0; j < s; ++j) influence[size_t(i)] += M[size_t(i * s + j)] * A(j, k);
        rest -= A(i, k) * influence[size_t(i)];
      }
      if (rest < 0x1p-6L) return;
      for (int64_t i = 0; i < s; ++i)
        square[size_t(i)] += std::pow(influence[size_t(i)] * left[size_t(k)] / rest, 2.0L);
    }
    for (int64_t i = 0; i < s; ++i) {
      const Real exact = std::sqrt(square[size_t(i)] + bias[size_t(i)] * bias[size_t(i)]);
      const T error = fit.errors[size_t(row * of.keep + place[size_t(i)])];
      EXPECT(std::fabs(error - exact) <= std::sqrt(std::numeric_limits<T>::epsilon()) * (exact + 1));
    }
  }
};

template <class T>
Numbers test_regressions(Bytes in) {
  const Problem<T> problem(in);
  const int64_t m = problem.m, cut = in.up_to(m);
  const bool errors = problem.R > 0 && in.up_to(1);
  std::vector<int64_t> each;
  for (int64_t row = 0; row < m; ++row) each.push_back(row + 1);
  const Fit<T> alone = problem.fit(each, errors), parts = problem.fit({cut, m}, errors);
  const Fit<T> plain = problem.fit({m}, false);
  EXPECT(same(alone.values, parts.values) && same(alone.values, plain.values));
  EXPECT(plain.failed[0] == std::count(alone.failed.begin(), alone.failed.end(), 1));
  EXPECT(plain.failed[0] == parts.failed[0] + parts.failed[1]);
  for (int64_t i = 0; i < problem.R * m * problem.keep; ++i)
    EXPECT(problem.used[size_t(i % (m * problem.keep))] || alone.values[size_t(i)] == T(0));
  Numbers found(alone.values.begin(), alone.values.end());
  for (int64_t i = 0; errors && i < m * problem.keep; ++i) {
    const T one = alone.errors[size_t(i)];
    EXPECT(problem.used[size_t(i)] || one == T(0));
    if (alone.failed[size_t(i / problem.keep)]) continue;  // without slopes errors have no meaning
    EXPECT(same(one, parts.errors[size_t(i)]) && (in.wild || one >= T(0)));
    found.push_back(one);
  }
  for (int64_t row = 0; !in.wild && row < m; ++row) {
    const Exact<T> exact(problem, row);
    for (int64_t r = 0; r < problem.R; ++r) exact.check_slopes(alone, r);
    if (errors && !alone.failed[size_t(row)]) exact.check_errors(alone);
  }
  return found;
}

template <class V, class T>
Numbers test_products(Bytes in) {
  const int64_t entries = in.up_to(70), n = 1 + in.up_to(50);
  const std::vector<V> values = reals<V>(in, entries, false);
  const std::vector<T> vector = reals<T>(in, n, in.up_to(1));
  std::vector<int64_t> column;
  for (const uint32_t word : words(in, entries)) column.push_back(word % n);
  const T product = sparse_dot(column.data(), values.data(), entries, vector.data());
  check_sum(product, entries, in.wild, [&](int64_t e) {
    return (long double)(T(values[size_t(e)])) * vector[size_t(column[size_t(e)])];
  });
  return {double(product)};
}

constexpr Numbers (*kTests[])(Bytes) = {
    test_regressions<float>, test_regressions<double>, test_regressions<float>, test_regressions<double>,
    test_products<float, float>, test_products<float, double>, test_products<double, float>,
    test_products<double, double>};

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) { return play(kTests, data, size); }
