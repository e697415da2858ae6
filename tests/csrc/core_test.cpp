// Every function of csrc/*.h without torch, at awkward sizes: made to be run under the sanitizers (test_sanitizers.py).
// g++ -std=c++20 -fsanitize=address,undefined core_test.cpp && ./a.out
#include "../../csrc/reduce.h"

#include <limits>

#include "expect.h"

using namespace zerohess;

namespace {

constexpr int64_t kSizes[] = {1, 2, 3, 7, 127, 128, 129, 255, 256, 257, 385};
constexpr int64_t kSeeds[] = {0, 1, int64_t(1) << 32, std::numeric_limits<int64_t>::max()};

bool near(double a, double b, double bound) { return std::fabs(a - b) <= bound; }

// Numbers in (-1, 1) of no order.
std::vector<double> numbers(int64_t count, uint64_t seed) {
  std::vector<double> out(size_t(count + 1));
  for (int64_t i = 0; i < count; i += 2) uniforms(seed, uint64_t(i), kPicks, 0, 1, out.data() + i);
  out.resize(size_t(count));
  for (double& x : out) x = 2.0 * x - 1.0;
  return out;
}

// Random123, kat_vectors: philox4x32 10. Counter words are block, row low, row high, stream.
void test_philox() {
  struct Known {
    uint64_t seed, row;
    uint32_t block, stream, words[4];
  };
  const Known known[] = {
      {0, 0, 0, 0, {0x6627e8d5, 0xe169c58d, 0xbc57ac4c, 0x9b00dbd8}},
      {~uint64_t(0), ~uint64_t(0), ~uint32_t(0), ~uint32_t(0), {0x408f276d, 0x41c83b0e, 0xa20bc7c6, 0x6d5451fd}},
      {0x299f31d0a4093822, 0x13198a2e85a308d3, 0x243f6a88, 0x03707344, {0xd16cfe09, 0x94fdcceb, 0x5001e420, 0x24126ea1}},
  };
  for (const Known& k : known) {
    double p[2];
    uniforms(k.seed, k.row, Stream(k.stream), int64_t(k.block) * 2, 1, p);
    EXPECT(p[0] == uniform(k.words[0], k.words[1]));
    EXPECT(p[1] == uniform(k.words[2], k.words[3]));
  }
  EXPECT(uniform(0, 0) == 0x1p-53);
  EXPECT(uniform(~uint32_t(0), ~uint32_t(0)) == 1.0 - 0x1p-53);
  // A block at a time or column by column: the same numbers.
  double whole[kBlock], pair[2];
  uniforms(7, 11, kDimensions, 0, kBlock / 2, whole);
  for (int64_t first = 0; first < kBlock; first += 2) {
    uniforms(7, 11, kDimensions, first, 1, pair);
    EXPECT(pair[0] == whole[first] && pair[1] == whole[first + 1]);
  }
}

double gradient_lobe_cdf(double u) { return u < 0 ? 0.5 * std::exp(-0.5 * u * u) : 1.0 - 0.5 * std::exp(-0.5 * u * u); }

double hessian_lobe_cdf(double u) {
  const double bump = 0.25 * u * std::exp(0.5 * (1.0 - u * u));
  return u < -1.0 ? -bump : u > 1.0 ? 1.0 - bump : 0.5 + bump;
}

void test_quantiles() {
  std::vector<double> p = {0x1p-53, 3 * 0x1p-53, 1e-12, 1e-9, 0.25, 0.5, 0.75, 0.25 - 0x1p-54, 0.75 + 0x1p-53};
  for (int i = 1; i < 1000; ++i) p.push_back(i / 1000.0);
  for (const double centre : {0.25, 0.5, 0.75})
    for (double step = 0x1p-50; step < 0.1; step *= 4) p.insert(p.end(), {centre - step, centre + step});
  for (size_t i = p.size(); i-- > 0;) p.push_back(1.0 - p[i]);
  for (size_t i = 0; i < p.size(); ++i) {
    double normal = 0.0;
    normal_quantiles(&p[i], 1, &normal);
    const double tail = std::min(p[i], 1.0 - p[i]);
    EXPECT(near(0.5 * std::erfc(-normal / std::sqrt(2.0)), p[i], 1e-14 * std::max(tail, 1e-2) + 2e-16));
    EXPECT(near(gradient_lobe_cdf(gradient_lobe_quantile(p[i])), p[i], 4e-16));
    EXPECT(near(hessian_lobe_cdf(hessian_lobe_quantile(p[i])), p[i], 4e-16));
  }
  // Together or alone: the same bits.
  for (int64_t count : {int64_t(1), int64_t(7), kBlock - 1, kBlock}) {
    std::vector<double> together(size_t(count), 0.0);
    normal_quantiles(p.data(), count, together.data());
    for (int64_t i = 0; i < count; ++i) {
      double alone = 0.0;
      normal_quantiles(&p[size_t(i)], 1, &alone);
      EXPECT(alone == together[size_t(i)]);
    }
  }
  for (const double x : {1e-300, 1e-20, 0.5, 0.7, 1.0 - 0x1p-53, 1.0, 1.5, 2.0, 1e20, 1e300})
    EXPECT(near(zerohess::log(x), std::log(x), 3e-16 * std::fabs(std::log(x))));
}

void test_single_quantiles() {
  std::vector<uint32_t> words = {0, 1, 2, kTail - 1, kTail, kTail + 1, 0x7FFFFFFF, 0x7FFFFFFE, 0x7FFFFFC0};
  for (uint32_t k = 1; k < 31; ++k) words.insert(words.end(), {1u << k, (1u << k) - 1, (1u << k) + (1u << k) / 3});
  for (size_t i = words.size(); i-- > 0;) words.push_back(~words[i]);
  const int64_t count = int64_t(words.size());
  std::vector<float> together(words.size(), 0.0f);
  normal_quantiles(words.data(), count, together.data());
  for (int64_t i = 0; i < count; ++i) {
    const double p = (double(words[size_t(i)]) + 0.5) * 0x1p-32;
    double exact = 0.0;
    normal_quantiles(&p, 1, &exact);
    float alone = 0.0f;
    normal_quantiles(&words[size_t(i)], 1, &alone);
    EXPECT(alone == together[size_t(i)]);
    EXPECT(alone == -together[size_t(count - 1 - i)]);
    EXPECT(near(alone, exact, 3e-7 * std::fabs(exact)));
  }
}

void test_rows() {
  for (const int64_t seed : kSeeds) {
    for (const int64_t n : kSizes) {
      for (int64_t proposal = kGaussian; proposal <= kSignedLobes; ++proposal) {
        for (const int64_t index : {int64_t(0), int64_t(1), int64_t(1) << 40, std::numeric_limits<int64_t>::max()}) {
          const Row row = pick(seed, index, n, proposal);
          EXPECT(row.seed == seed && row.index == index);
          EXPECT(row.i >= 0 && row.i < n && row.j >= 0 && row.j < n);
          EXPECT(row.kind >= kNormal && row.kind <= kBox);
          EXPECT((row.kind == kOffDiagonalLobe) == (row.i != row.j));
        }
      }
    }
  }
}

// u of a whole row, block by block as the operators do it.
template <class T>
std::vector<double> drawn_as(const Row& row, int64_t n) {
  std::vector<T> out(size_t(n), T(0));
  for (int64_t first = 0; first < n; first += kBlock)
    draw_columns(row, first, std::min(kBlock, n - first), out.data() + first);
  return std::vector<double>(out.begin(), out.end());
}

std::vector<double> drawn(const Row& row, int64_t n, bool single = false) {
  return single ? drawn_as<float>(row, n) : drawn_as<double>(row, n);
}

double weight(const double* u, int64_t n, int64_t proposal) {
  Magnitudes sums{};
  for (int64_t first = 0; first < n; first += kBlock) add_magnitudes(u + first, std::min(kBlock, n - first), sums);
  return density_ratio(sums, n, proposal);
}

void test_draw(bool single) {
  for (const int64_t seed : kSeeds) {
    for (const int64_t n : kSizes) {
      const std::vector<double> normal = drawn({seed, 5, kNormal, 0, 0}, n, single);
      for (int64_t kind = kNormal; kind <= kBox; ++kind) {
        for (const int64_t i : {int64_t(0), n / 2, n - 1}) {
          for (const int64_t j : {int64_t(0), n - 1}) {
            const std::vector<double> u = drawn({seed, 5, kind, i, j}, n, single);
            for (int64_t d = 0; d < n; ++d) {
              EXPECT(std::isfinite(u[size_t(d)]));
              if (kind == kBox) EXPECT(std::fabs(u[size_t(d)]) < kBoxHalfWidth);
              const bool lobe = kind == kGradientLobe || kind == kDiagonalLobe ? d == i : d == i || d == j;
              if (kind == kNormal || (kind <= kOffDiagonalLobe && !lobe)) EXPECT(u[size_t(d)] == normal[size_t(d)]);
            }
          }
        }
        for (const int64_t far : {std::numeric_limits<int64_t>::min(), std::numeric_limits<int64_t>::max()})
          if (kind <= kOffDiagonalLobe) EXPECT(drawn({seed, 5, kind, far, far}, n, single) == normal);
      }
    }
  }
}

void test_place_and_weight() {
  // A batch of two, placed from noise in both precisions and with both signs.
  const double sigma[3] = {1e-3, 2.0, 0.5}, x[6] = {1.0, -2.0, 3.0, 0.25, 0.0, 7.0};
  const float x_single[6] = {1.0f, -2.0f, 3.0f, 0.25f, 0.0f, 7.0f};
  double points[24], u[24], weights[8];
  float points_single[24];
  const auto columns = [](int64_t r, int64_t first, int64_t count, auto* buffer) {
    draw_columns(pick(3, r, 3, kSecondOrder), first, count, buffer);
    return buffer;
  };
  place_rows<double>(Batch<double, double>{x, sigma, 2, 4, 3, kSecondOrder, true, points, u, weights}, 0, 4, columns);
  place_rows<float>(
      Batch<float, float>{x_single, sigma, 2, 4, 3, kSecondOrder, true, points_single, nullptr, weights}, 0, 4, columns);
  for (int64_t b = 0; b < 2; ++b) {
    for (int64_t k = 0; k < 4; ++k) {
      const Row row = pick(3, 2 * b + k % 2, 3, kSecondOrder);
      const std::vector<double> one = drawn(row, 3), other = drawn(row, 3, true);
      const double sign = k < 2 ? 1.0 : -1.0;
      for (int64_t d = 0; d < 3; ++d) {
        const int64_t at = (4 * b + k) * 3 + d;
        EXPECT(u[at] == sign * one[size_t(d)]);
        EXPECT(points[at] == x[3 * b + d] + sigma[d] * (sign * one[size_t(d)]));
        EXPECT(points_single[at] == float(x[3 * b + d] + sigma[d] * (sign * other[size_t(d)])));
      }
      EXPECT(near(weights[4 * b + k], weight(other.data(), 3, kSecondOrder), 0x1p-20 * weights[4 * b + k]));
    }
  }
  for (const int64_t n : kSizes) {
    const std::vector<double> x = numbers(n, 3);
    double l1 = 0.0, l2 = 0.0, hole = 0.0;
    for (const double d : x) {
      l1 += std::fabs(d);
      l2 += d * d;
      hole += std::fabs(d * d - 1.0);
    }
    const double size = double(n), gradient = kSqrtHalfPi * l1 / size;
    const double hessian = (kHalfPi * (l1 * l1 - l2) + kDiagonalLobeScale * hole) / (size * size);
    EXPECT(weight(x.data(), n, kGaussian) == 1.0 && weight(x.data(), n, kSignedLobes) == 1.0);
    EXPECT(near(weight(x.data(), n, kFirstOrder) * (1.0 + gradient), 2.0, 1e-13));
    EXPECT(near(weight(x.data(), n, kSecondOrder) * (1.0 + gradient + hessian), 3.0, 1e-12));
    if (n <= 257) EXPECT(near(std::log(weight(x.data(), n, kUniform)), size * kLogBox - 0.5 * l2, 1e-11 * size));
  }
}

std::vector<double> projected(
    const StoredRows& rows, int64_t K, int64_t n, int64_t M, const std::vector<double>& t) {
  std::vector<double> out(size_t(M * K), -1.0);
  for (int64_t k = 0; k < K; ++k) project_row(rows, k, K, n, M, t.data(), out.data());
  return out;
}

std::vector<double> projected(
    const DrawnRows& rows, int64_t K, int64_t n, int64_t M, const std::vector<double>& t) {
  std::vector<double> out(size_t(M * K), -1.0);
  project_drawn_rows(rows, 0, 2, K, n, M, t.data(), out.data());
  project_drawn_rows(rows, 2, rows.samples, K, n, M, t.data(), out.data());
  return out;
}

template <class Rows>
std::vector<double> accumulated(
    const Rows& rows, int64_t K, int64_t n, int64_t M, bool squares, const std::vector<double>& a) {
  std::vector<double> out(size_t(M * n), -1.0);
  for (int64_t first = 0; first < n; first += kBlock)
    accumulate_block(rows, first, K, n, M, squares, a.data(), out.data());
  return out;
}

void test_sums() {
  const int64_t M = 3, S = 5;
  for (const int64_t seed : kSeeds) {
    for (const int64_t n : kSizes) {
      for (const bool single : {false, true}) {
        for (const int64_t K : {S, 2 * S}) {
          std::vector<Row> rows;
          for (int64_t s = 0; s < S; ++s) rows.push_back(pick(seed, s, n, kSecondOrder));
          // All perturbations, stored.
          std::vector<double> u;
          for (int64_t k = 0; k < K; ++k) {
            const std::vector<double> row = drawn(rows[size_t(k % S)], n, single);
            for (const double one : row) u.push_back(k < S ? one : -one);
          }
          const StoredRows stored{u.data(), n};
          const DrawnRows again{rows.data(), S, single};
          const std::vector<double> t = numbers(M * n, 4), a = numbers(M * K, 5);
          const std::vector<double> Ut = projected(stored, K, n, M, t), aU = accumulated(stored, K, n, M, false, a);
          EXPECT(projected(again, K, n, M, t) == Ut);
          EXPECT(accumulated(again, K, n, M, false, a) == aU);
          EXPECT(accumulated(again, K, n, M, true, a) == accumulated(stored, K, n, M, true, a));
          for (int64_t m = 0; m < M; ++m) {
            // a.(U t) = (a U).t: each is the transpose of the other.
            const double left = dot(a.data() + m * K, Ut.data() + m * K, K);
            const double right = dot(aU.data() + m * n, t.data() + m * n, n);
            EXPECT(near(left, right, 1e-13 * double(K * n)));
          }
          // The Hessian's rows against its diagonal and against a product with a vector.
          std::vector<double> H(size_t(n * n), 0.0);
          for (int64_t i = 0; i < n; ++i) hessian_row(u.data(), i, K, n, a.data(), H.data());
          const std::vector<double> squares = accumulated(stored, K, n, M, true, a);
          std::vector<double> scaled(size_t(K), 0.0), Hv;
          for (int64_t k = 0; k < K; ++k) scaled[size_t(k)] = a[size_t(k)] * Ut[size_t(k)];
          Hv = accumulated(stored, K, n, 1, false, scaled);
          for (int64_t i = 0; i < n; ++i) {
            double product = 0.0;
            for (int64_t j = 0; j < n; ++j) product += H[size_t(std::min(i, j) * n + std::max(i, j))] * t[size_t(j)];
            EXPECT(near(H[size_t(i * n + i)], squares[size_t(i)], 1e-12));
            EXPECT(near(product, Hv[size_t(i)], 1e-12 * double(K * n)));
          }
        }
      }
    }
  }
}

void test_small_sums() {
  for (int64_t count = 0; count <= 20; ++count) {
    const std::vector<double> a = numbers(count, 6), b = numbers(count, 7);
    double exact = 0.0;
    for (int64_t d = 0; d < count; ++d) exact += a[size_t(d)] * b[size_t(d)];
    EXPECT(near(dot(a.data(), b.data(), count), exact, 1e-14));
    std::vector<double> sum = b, squares = b;
    add_scaled(0.5, a.data(), count, sum.data());
    add_scaled_squares(0.5, a.data(), count, squares.data());
    for (size_t d = 0; d < size_t(count); ++d) {
      EXPECT(sum[d] == b[d] + 0.5 * a[d]);
      EXPECT(squares[d] == b[d] + 0.5 * (a[d] * a[d]));
    }
  }
}

}  // namespace

int main() {
  for (int set = kBaseline; set <= best_instructions(); ++set) {
    instructions = Instructions(set);
    test_philox();
    test_quantiles();
    test_single_quantiles();
    test_rows();
    test_draw(false);
    test_draw(true);
    test_place_and_weight();
    test_sums();
    test_small_sums();
  }
  return verdict();
}
