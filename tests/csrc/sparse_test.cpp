// Regressions and products of sparse rows, at awkward sizes: made to be run under the sanitizers (test_sanitizers.py).
// Slopes are compared with Gaussian elimination in long double. Their errors are tested in test_sparse_regression.py.
#include "../../csrc/sparse.h"

#include <random>

#include "expect.h"

using namespace zerohess;

namespace {

constexpr int64_t kRidges = 2, kRows = 3;

template <class T>
struct Problem {
  int64_t n, K, keep, known;
  std::vector<T> directions, scale, changes, known_values, ridges, constant, values, errors;
  std::vector<int64_t> index, known_index;
  std::vector<uint8_t> used;

  Problem(int64_t parameters, int64_t samples, int64_t entries, int64_t previous, std::mt19937& random)
      : n(parameters), K(samples), keep(entries), known(previous), scale(n, T(1)), ridges{T(0.5), T(0.1), T(2), T(3)},
        constant(K, T(1) / T(K)) {
    std::normal_distribution<T> normal;
    const auto numbers = [&](int64_t count) {
      std::vector<T> out;
      while (int64_t(out.size()) < count) out.push_back(normal(random));
      return out;
    };
    directions = numbers(n * K), changes = numbers(kRows * K), known_values = numbers(kRows * known);
    for (int64_t i = 0; i < kRows * keep; ++i) index.push_back((i % keep) * (n / keep)), used.push_back(random() % 4 > 0);
    for (int64_t i = 0; i < kRows * known; ++i) known_index.push_back(i % known);
    values.assign(kRidges * kRows * keep, T(0)), errors.assign(kRows * keep, T(0));
  }

  Regression<T> all(bool errors_too, bool robust) {
    return {directions.data(), scale.data(), changes.data(), index.data(), known_index.data(),
            reinterpret_cast<const bool*>(used.data()), known_values.data(), ridges.data(),
            robust ? constant.data() : nullptr, kRows, K, keep, known, kRidges, keep, true,
            values.data(), errors_too ? errors.data() : nullptr};
  }

  // The slopes of the used entries of a row, by elimination without pivots.
  std::vector<long double> expected(int64_t row, int64_t r, std::vector<int64_t>& places) const {
    std::vector<long double> old, matrix;
    for (int64_t e = 0; e < keep; ++e)
      if (used[row * keep + e]) places.push_back(e);
    const int64_t s = int64_t(places.size());
    for (const int64_t e : places) {
      const int64_t d = index[row * keep + e];
      old.push_back(d < known ? known_values[row * known + d] : 0);
    }
    matrix.assign(s * (s + 1), 0);
    for (int64_t i = 0; i < s; ++i) {
      const T* a = &directions[index[row * keep + places[i]] * K];
      const auto product = [&](const T* b, long double sum = 0) {
        for (int64_t k = 0; k < K; ++k) sum += (long double)(a[k]) * b[k];
        return sum;
      };
      const long double prior = ridges[2 * r + (old[i] == 0)];
      for (int64_t j = 0; j < s; ++j) matrix[i * (s + 1) + j] = product(&directions[index[row * keep + places[j]] * K]);
      matrix[i * (s + 1) + i] += prior;
      matrix[i * (s + 1) + s] = product(&changes[row * K]) + prior * old[i];
    }
    for (int64_t i = 0; i < s; ++i)
      for (int64_t j = 0; j < s; ++j) {
        const long double factor = i == j ? 0 : matrix[j * (s + 1) + i] / matrix[i * (s + 1) + i];
        for (int64_t k = i; k <= s; ++k) matrix[j * (s + 1) + k] -= factor * matrix[i * (s + 1) + k];
      }
    std::vector<long double> slopes;
    for (int64_t i = 0; i < s; ++i) slopes.push_back(matrix[i * (s + 1) + s] / matrix[i * (s + 1) + i]);
    return slopes;
  }
};

template <class T>
void test_slopes(int64_t K, int64_t keep, int64_t known) {
  std::mt19937 random(uint32_t(K * 1000 + keep));
  Problem<T> problem(keep + 5, K, keep, known, random);
  EXPECT(regress_rows(problem.all(true, true), 0, kRows) == 0);
  for (int64_t row = 0; row < kRows; ++row)
    for (int64_t r = 0; r < kRidges; ++r) {
      std::vector<int64_t> places;
      const std::vector<long double> slopes = problem.expected(row, r, places);
      const T* got = &problem.values[(r * kRows + row) * keep];
      for (size_t i = 0; i < places.size(); ++i)
        EXPECT(std::fabs(got[places[i]] - slopes[i]) < 3000 * std::numeric_limits<T>::epsilon());
      for (int64_t e = 0; e < keep; ++e) EXPECT(problem.used[row * keep + e] || got[e] == T(0));
    }
  for (const T one : problem.errors) EXPECT(one >= T(0) && std::isfinite(one));
}

// A row of numbers that are not finite changes no other row, and has no slopes that are finite.
void test_a_bad_row() {
  std::mt19937 random(7);
  Problem<float> good(20, 17, 9, 4, random), bad = good;
  std::fill_n(bad.changes.begin() + 17, 17, std::numeric_limits<float>::quiet_NaN());
  regress_rows(good.all(true, true), 0, kRows), regress_rows(bad.all(true, true), 0, kRows);
  for (int64_t e = 0; e < 9; ++e) {
    EXPECT(good.values[e] == bad.values[e] && good.errors[18 + e] == bad.errors[18 + e]);
    EXPECT(!good.used[9 + e] || !std::isfinite(bad.values[9 + e]));
  }
}

void test_matrices_that_are_not_positive_definite() {
  std::mt19937 random(7);
  for (const double wrong : {0.0, std::numeric_limits<double>::infinity()}) {
    Problem<double> problem(20, 17, 9, 4, random);
    std::fill(problem.directions.begin(), problem.directions.end(), wrong);
    std::fill(problem.scale.begin(), problem.scale.end(), 0.0);
    EXPECT(regress_rows(problem.all(false, false), 0, kRows) == kRows);
  }
}

void test_products() {
  for (int64_t entries = 0; entries < 12; ++entries) {
    std::vector<int64_t> column;
    std::vector<float> values;
    std::vector<double> vector{1.0, -2.0, 4.0};
    double expected = 0.0;
    for (int64_t e = 0; e < entries; ++e) {
      column.push_back(e * e % 3), values.push_back(float(e + 1));
      expected += double(values.back()) * vector[size_t(column.back())];
    }
    EXPECT(sparse_dot(column.data(), values.data(), entries, vector.data()) == expected);
  }
}

}  // namespace

int main() {
  for (int set = kBaseline; set <= best_instructions(); ++set) {
    instructions = Instructions(set);
    for (const int64_t K : {1, 3, 15, 16, 17, 130})
      for (const int64_t keep : {1, 3, 8, 17, 40}) test_slopes<float>(K, keep, 1), test_slopes<double>(K, keep, 6);
    test_a_bad_row();
    test_matrices_that_are_not_positive_definite();
    test_products();
  }
  return verdict();
}
