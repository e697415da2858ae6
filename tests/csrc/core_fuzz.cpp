// Bytes as sizes, seeds, counters and numbers (NaN and infinities too) for the functions of csrc/reduce.h and of the
// headers that it includes, under sanitizers.
#include "../../csrc/reduce.h"

#include "fuzz.h"

using namespace zerohess;

namespace {

// Together, alone and in two parts the same; odd, finite and increasing, but for rounding, from least to most.
template <class P, class Q>
void check_quantiles(void (*quantiles)(const P*, int64_t, Q*), const std::vector<P>& p, int64_t cut, P least, P most) {
  std::vector<Q> q(p.size()), parts(q);
  quantiles(p.data(), int64_t(p.size()), q.data()), quantiles(p.data(), cut, parts.data());
  quantiles(p.data() + cut, int64_t(p.size()) - cut, parts.data() + cut);
  for (size_t i = 0; i < p.size(); ++i) {
    if (!(p[i] >= least && p[i] <= most)) continue;
    const P mirror = least + (most - p[i]);
    Q other = 0;
    quantiles(&mirror, 1, &other);
    EXPECT(parts[i] == q[i] && std::isfinite(q[i]) && (p[i] < mirror || other == -q[i]));
    EXPECT(!i || p[i - 1] < least || q[i - 1] <= q[i] + 4 * std::numeric_limits<Q>::epsilon() * std::fabs(q[i]));
  }
}

Numbers test_noise(Bytes in) {
  const Counter at{in.take<uint64_t>(), in.take<uint64_t>(), in.take<uint32_t>(), in.take<uint32_t>()};
  const int64_t blocks = in.up_to(kBlock / 4), cut = in.up_to(blocks);
  const Counter rest{at.seed, at.row, at.stream, at.block + uint32_t(cut)};
  Numbers whole(size_t(2 * blocks)), parts(whole), p = in.numbers(4 * blocks);
  std::vector<uint32_t> words(p.size()), pieces(words);
  noise(at, blocks, whole.data()), noise(at, cut, parts.data()), noise(rest, blocks - cut, parts.data() + 2 * cut);
  noise(at, blocks, words.data()), noise(at, cut, pieces.data()), noise(rest, blocks - cut, pieces.data() + 4 * cut);
  EXPECT(parts == whole && pieces == words);
  for (size_t i = 0; i < whole.size(); ++i)
    EXPECT(whole[i] > 0.0 && whole[i] < 1.0 && whole[i] == uniform(words[2 * i], words[2 * i + 1]));
  std::sort(p.begin(), p.end(), [](double a, double b) { return b != b ? a == a : a < b; });
  if (blocks) words[0] = in.take<uint32_t>() >> in.up_to(31);
  std::sort(words.begin(), words.end());
  Numbers of_words, exact(words.size());
  for (const uint32_t word : words) of_words.push_back((double(word) + 0.5) * 0x1p-32);
  std::vector<float> rounded(words.size());
  normal_quantiles(of_words.data(), 4 * blocks, exact.data());
  normal_quantiles(words.data(), 4 * blocks, rounded.data());
  for (size_t i = 0; i < words.size(); ++i) EXPECT(std::fabs(rounded[i] - exact[i]) <= 3e-7 * std::fabs(exact[i]));
  const auto hessian_lobe = [](const double* from, int64_t count, double* to) {
    for (int64_t i = 0; i < count; ++i) to[i] = hessian_lobe_quantile(from[i]);
  };
  check_quantiles<double, double>(normal_quantiles, p, cut, 0x1p-53, 1.0 - 0x1p-53);
  check_quantiles<double, double>(gradient_lobe_quantiles, p, cut, 0x1p-53, 1.0 - 0x1p-53);
  check_quantiles<double, double>(hessian_lobe, p, cut, 0x1p-53, 1.0 - 0x1p-53);
  check_quantiles<uint32_t, float>(normal_quantiles, words, cut, 0, ~uint32_t(0));
  return whole;
}

template <class T>
Numbers drawn(const Row& row, int64_t n) {
  std::vector<T> out(size_t(n), T(0));
  for (int64_t first = 0; first < n; first += kBlock)
    draw_columns(row, first, std::min(kBlock, n - first), out.data() + first);
  for (const T one : out) EXPECT(std::isfinite(one) && (row.kind != kBox || std::fabs(one) <= T(kBoxHalfWidth)));
  return Numbers(out.begin(), out.end());
}

// The points of a batch, placed in two parts, against one at a time. Perturbations are of type U, points of type T.
template <class U, class X, class T>
Numbers test_place(Bytes in) {
  const int64_t S = 1 + in.up_to(2), n = 1 + in.up_to(600), fewer = in.up_to(n), proposal = in.up_to(kSignedLobes);
  const int64_t seed = in.take<int64_t>(), cut = in.up_to(2 * S), both = in.up_to(1);
  const int64_t K = S << both, E = K + in.up_to(1);
  const bool keep = in.up_to(3) > 0;
  const Numbers given = in.numbers(2 * n), sigma = in.numbers(n);
  const std::vector<X> x(given.begin(), given.end());
  std::vector<T> points(size_t(2 * E * n));
  Numbers u(size_t(keep ? 2 * K * n : 0)), weights(size_t(2 * K));
  const Batch<X, T> to{x.data(), sigma.data(), S, E, n, proposal, both == 1, points.data(), keep ? u.data() : nullptr,
                       weights.data()};
  const auto columns = [&](int64_t r, int64_t first, int64_t count, U* buffer) {
    draw_columns(pick(seed, r, n, proposal), first, count, buffer);
    return buffer;
  };
  place_rows<U>(to, 0, cut, columns), place_rows<U>(to, cut, 2 * S, columns);
  for (int64_t k = 0; k < 2 * K; ++k) {
    const Row row = pick(seed, k / K * S + k % K % S, n, proposal);
    const Numbers one = drawn<U>(row, n), part = drawn<U>(row, fewer);
    EXPECT(std::equal(part.begin(), part.end(), one.begin()) && std::isfinite(weights[size_t(k)]));
    for (int64_t d = 0; d < n; ++d) {
      const double mine = k % K < S ? one[size_t(d)] : -one[size_t(d)];
      const T point = T(double(x[size_t(k / K * n + d)]) + sigma[size_t(d)] * mine);
      EXPECT((!keep || u[size_t(k * n + d)] == mine) && same(points[size_t((k / K * E + k % K) * n + d)], point));
    }
  }
  return weights;
}

// Rows of any numbers, as an operator may get them: drawn whole, in two parts, and from given uniforms.
Numbers test_rows(Bytes in) {
  const int64_t n = 1 + in.up_to(600), cut = in.up_to((n - 1) / kBlock) * kBlock;
  const int64_t many = 1 + int64_t(in.take<uint64_t>() >> 2), proposal = in.take<int8_t>();
  const Row any{in.take<int64_t>(), in.take<int64_t>(), in.up_to(kBox), in.take<int64_t>(), in.take<int64_t>()};
  const Row near{any.seed, any.index, any.kind, in.up_to(n + 2) - 1, in.up_to(n + 2) - 1};
  const Row picked = pick(any.seed, any.index, many, proposal);
  EXPECT(picked.i >= 0 && picked.i < many && picked.j >= 0 && picked.j < many);
  EXPECT(picked.kind >= kNormal && picked.kind <= kBox);
  Numbers p(size_t(n + 1)), wild = in.numbers(n), shaped(wild);
  uniforms(uint64_t(any.seed), uint64_t(any.index), kDimensions, 0, (n + 1) / 2, p.data());
  for (const Row& row : {any, near}) {
    const Numbers whole = drawn<double>(row, n);
    Numbers part(size_t(n - cut));
    for (int64_t first = cut; first < n; first += kBlock)
      draw_columns(row, first, std::min(kBlock, n - first), part.data() + first - cut);
    shape_row(row, p.data(), n, shaped.data());
    EXPECT(shaped == whole && std::equal(part.begin(), part.end(), whole.begin() + cut));
    EXPECT(drawn<float>(row, n).size() == whole.size());
    shape_row(row, wild.data(), n, shaped.data());
  }
  return shaped;
}

// Sums over stored rows, and bit for bit over the same rows drawn again, in two parts.
template <class T>
Numbers test_sums(Bytes in) {
  const bool many = in.up_to(15) == 0;  // more rows than are held
  const int64_t S = 1 + in.up_to(many ? 2 * kHeld : 5), n = 1 + in.up_to(many ? 9 : 600), M = 1 + in.up_to(2);
  const int64_t K = S << in.up_to(1), cut = in.up_to(S), kind = in.up_to(kBox), seed = in.take<int64_t>();
  std::vector<Row> rows;
  for (int64_t s = 0; s < S; ++s) rows.push_back({seed, seed ^ s, kind, in.up_to(n + 2) - 1, in.up_to(n + 2) - 1});
  const Numbers t = in.numbers(M * n), a = in.numbers(M * K);
  Numbers u, p(size_t(M * K)), again(p), sums(size_t(M * n)), other(sums), H(size_t(n * n)), H_parts;
  for (int64_t k = 0; k < K; ++k)
    for (const double one : drawn<T>(rows[size_t(k % S)], n)) u.push_back(k < S ? one : -one);
  const StoredRows stored{u.data(), n};
  const DrawnRows redrawn{rows.data(), S, sizeof(T) == sizeof(float)};
  for (int64_t k = 0; k < K; ++k) project_row(stored, k, K, n, M, t.data(), p.data());
  project_drawn_rows(redrawn, 0, cut, K, n, M, t.data(), again.data());
  project_drawn_rows(redrawn, cut, S, K, n, M, t.data(), again.data());
  EXPECT(same(p, again));
  const auto U = [&](int64_t k, int64_t d) { return (long double)(u[size_t(k * n + d)]); };
  const auto A = [&](int64_t i, int64_t k) { return a[size_t(i / n * K + k)]; };
  for (int64_t i = 0; i < M * K; ++i)
    check_sum(p[size_t(i)], n, in.wild, [&](int64_t d) { return U(i % K, d) * t[size_t(i / K * n + d)]; });
  for (const bool squares : {false, true}) {
    for (int64_t first = 0; first < n; first += kBlock) {
      accumulate_block(stored, first, K, n, M, squares, a.data(), sums.data());
      accumulate_block(redrawn, first, K, n, M, squares, a.data(), other.data());
    }
    EXPECT(same(sums, other));
    for (int64_t i = 0; i < M * n; ++i)
      check_sum(sums[size_t(i)], K, in.wild,
                [&](int64_t k) { return A(i, k) * U(k, i % n) * (squares ? U(k, i % n) : 1.0L); });
  }
  for (int64_t m = 0; m < M; ++m)
    check_sum(total(a.data() + m * K, K), K, in.wild, [&](int64_t k) { return (long double)(a[size_t(m * K + k)]); });
  const std::vector<T> f(a.begin(), a.begin() + K), base(p.begin(), p.begin() + K);
  Numbers centered(f.size()), alone(f.size());
  center_row(f.data(), base.data(), t[0], K, centered.data()), center_row<T>(f.data(), nullptr, t[0], K, alone.data());
  for (size_t k = 0; k < f.size(); ++k)
    EXPECT(same(centered[k], (double(f[k]) - double(base[k])) * t[0]) && same(alone[k], double(f[k]) * t[0]));
  Numbers divided = sums;
  divide_rows(divided.data(), t.data(), M, n);
  for (int64_t i = 0; i < M * n; ++i) EXPECT(same(divided[size_t(i)], sums[size_t(i)] / t[size_t(i % n)]));
  if (n > 64) return sums;
  for (int64_t i = 0; i < n; ++i) hessian_row(u.data(), i, K, n, a.data(), H.data());
  H_parts = H;
  mirror_rows(H.data(), n, 0, n);
  mirror_rows(H_parts.data(), n, cut % n, n), mirror_rows(H_parts.data(), n, 0, cut % n);
  EXPECT(same(H, H_parts));
  for (int64_t i = 0; i < n * n; ++i)
    check_sum(H[size_t(i)], K, in.wild, [&](int64_t k) { return A(0, k) * U(k, i / n) * U(k, i % n); });
  return H;
}

constexpr Numbers (*kTests[])(Bytes) = {
    test_noise, test_rows, test_place<float, float, float>, test_place<double, double, double>,
    test_place<double, double, float>, test_sums<float>, test_sums<double>};

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) { return play(kTests, data, size); }
