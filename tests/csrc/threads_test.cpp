// Every operator that cuts its work into ranges, with one thread and with several: made to be run under the thread
// sanitizer (test_sanitizers.py). The bits are the same.
#include "torch_stand_in.h"

#include "../../csrc/ops.cpp"
#include "../../csrc/sparse_ops.cpp"
#include "expect.h"

namespace zerohess {
namespace {

using Bits = std::vector<Tensor>;

Tensor numbers(std::vector<int64_t> sizes, uint64_t seed, ScalarType type = ScalarType::Double) {
  Tensor made(sizes, type);
  int64_t count = 1;
  for (const int64_t size : sizes) count *= size;
  std::vector<double> p(size_t(count + 1));
  uniforms(seed, 0, kPicks, 0, (count + 1) / 2, p.data());
  for (int64_t i = 0; i < count; ++i) {
    if (type == ScalarType::Double) made.mutable_data_ptr<double>()[i] = 0.25 + p[size_t(i)];
    if (type == ScalarType::Float) made.mutable_data_ptr<float>()[i] = float(0.25 + p[size_t(i)]);
  }
  return made;
}

template <class T>
Tensor values(std::vector<int64_t> sizes, const std::vector<T>& from, ScalarType type) {
  Tensor made(sizes, type);
  std::copy(from.begin(), from.end(), made.mutable_data_ptr<T>());
  return made;
}

// Two points of n parameters with S draws each, drawn and placed, and the sums over them, stored and drawn again.
Bits estimates(int64_t n, bool antithetic, ScalarType type) {
  const int64_t B = 2, S = 5, M = 2, K = antithetic ? 2 * S : S;
  const bool single = type == ScalarType::Float;
  const Tensor x = numbers({B, n}, 1, type), sigma = numbers({n}, 2), v = numbers({B, M, n}, 3);
  const Tensor a = numbers({B, M, K}, 4), weight = numbers({B, K}, 5), share = numbers({B, K, 1}, 6);
  const auto [rows, points, u, weights] = sample(7, S, x, sigma, antithetic, kSecondOrder, true, true);
  const Tensor drawn_rows = draw(rows, n, single), p = numbers({B * S, n}, 8), p_i = numbers({B * S}, 9);
  const auto [again, none, weights_again] =
      place_all(draw(rows, n, false), numbers({B, n}, 1), sigma, antithetic, single, kSecondOrder);
  Bits out{points, u, weights, drawn_rows, again, weights_again, shape(rows, numbers({B * S, n}, 8)),
           with_lobes(rows, p, p_i, p_i), project(u, v), accumulate(u, a, false), accumulate(u, a, true),
           coefficients(points, share, K, true), weighted_gradient(u, weight, a, sigma),
           weighted_hvp(u, weight, a, v, sigma), project_drawn(rows, x, sigma, antithetic, single, v),
           accumulate_drawn(rows, x, sigma, antithetic, single, a, false),
           accumulate_drawn(rows, x, sigma, antithetic, single, a, true)};
  if (n < 100) {
    const Tensor H = hessian(u, a), square = numbers({B, n, n}, 10);
    mirror(square);
    out.push_back(H), out.push_back(square);
  }
  const Tensor seeds = values<int64_t>({3}, {1, 2, 3}, ScalarType::Long);
  out.push_back(uniforms_of(seeds, seeds, 0, n, kPicks));
  return out;
}

// Slopes and errors of seven rows, and products of four.
Bits regressions(ScalarType type) {
  const int64_t m = 7, keep = 6, n = 9, K = 11;
  std::vector<int64_t> index;
  std::vector<uint8_t> used;
  for (int64_t i = 0; i < m * keep; ++i) index.push_back(i * 5 % n), used.push_back(i % 4 > 0);
  const Tensor supports = values(std::vector<int64_t>{m, keep}, index, ScalarType::Long);
  const Tensor ridges = numbers({2, 2}, 1, type), known = numbers({m, keep}, 2, type);
  const Tensor changes = numbers({m, K}, 3, type), scale = numbers({n}, 4, type), directions = numbers({n, K}, 5, type);
  const auto [slopes, errors, failed] =
      regress(directions, scale, changes, supports, values(std::vector<int64_t>{m, keep}, used, ScalarType::Bool),
              supports, known, ridges, numbers({K}, 6, type), true, true);
  const Tensor first = values<int64_t>({4}, {0, 10, 10, 30}, ScalarType::Long);
  const Tensor column = values(std::vector<int64_t>{m * keep}, index, ScalarType::Long);
  return {slopes, errors, failed, sparse_times(column, first, numbers({m * keep}, 7, type), numbers({n}, 8)),
          sparse_times(column, first, numbers({m * keep}, 7), numbers({n}, 8, type))};
}

Bits all() {
  Bits out;
  for (const int64_t n : {int64_t(3), int64_t(70), 3 * kBlock + 5})
    for (const bool antithetic : {false, true})
      for (const ScalarType type : {ScalarType::Float, ScalarType::Double})
        for (const Tensor& one : estimates(n, antithetic, type)) out.push_back(one);
  for (const ScalarType type : {ScalarType::Float, ScalarType::Double})
    for (const Tensor& one : regressions(type)) out.push_back(one);
  return out;
}

bool same(const Tensor& a, const Tensor& b) {
  size_t bytes = a.scalar_type() == ScalarType::Float ? 4 : 8;
  for (int64_t d = 0; d < a.dim(); ++d) bytes *= size_t(a.size(d));
  return std::memcmp(a.const_data_ptr<char>(), b.const_data_ptr<char>(), bytes) == 0;
}

}  // namespace
}  // namespace zerohess

int main() {
  using namespace zerohess;
  const Bits alone = all();
  for (const int64_t threads : {2, 3, 8}) {
    torch::stable::threads = threads;
    const Bits together = all();
    for (size_t i = 0; i < alone.size(); ++i) EXPECT(same(alone[i], together[i]));
  }
  return verdict();
}
