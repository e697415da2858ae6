// The operators of torch_zerohess, bound to the LibTorch stable ABI: one binary for torch >= 2.10 and Python >= 3.10.
// Those of sparse Jacobians are in sparse_ops.cpp. Kernels first, then all schemas, then all registrations. Shapes: B
// batch, S samples, K = S or 2 S evaluations per x, n parameters, M vectors. Everything is contiguous float64 unless it
// says int64 or "type of x".
#include <Python.h>

#include <torch/csrc/stable/library.h>

#include <optional>
#include <tuple>
#include <vector>

#include "reduce.h"
#include "tensors.h"

PyMODINIT_FUNC PyInit__C(void) {
  // An empty module: importing it runs the registrations below.
  static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_C", nullptr, -1, nullptr};
  return PyModule_Create(&module);
}

namespace zerohess {
namespace {

const Row* row_data(const Tensor& rows) {
  check(rows, "rows", 2, ScalarType::Long);
  STD_TORCH_CHECK(rows.size(1) == 5, "rows has ", rows.size(1), " columns instead of 5");
  const Row* row = reinterpret_cast<const Row*>(rows.const_data_ptr<int64_t>());
  for (int64_t r = 0; r < rows.size(0); ++r)
    STD_TORCH_CHECK(row[r].kind >= kNormal && row[r].kind <= kBox, "the kind of row ", r, " is ", row[r].kind,
                    ", but must be from 0 to ", int64_t(kBox));
  return row;
}

void check_proposal(int64_t proposal) {
  STD_TORCH_CHECK(proposal >= kGaussian && proposal <= kSignedLobes, "proposal is ", proposal,
                  ", but must be from 0 to ", int64_t(kSignedLobes));
}

Tensor pick_rows(int64_t seed, int64_t first, int64_t count, int64_t n, int64_t proposal) {
  check_size(count, "count", 0);
  check_size(n, "n", 1);
  check_proposal(proposal);
  Tensor rows = empty({count, 5}, ScalarType::Long);
  Row* out = reinterpret_cast<Row*>(rows.mutable_data_ptr<int64_t>());
  for (int64_t r = 0; r < count; ++r) out[r] = pick(seed, first + r, n, proposal);
  return rows;
}

template <typename T>
Tensor draw_as(const Tensor& rows, int64_t n, ScalarType type) {
  check_size(n, "n", 0);
  const Row* row = row_data(rows);
  Tensor u = empty({rows.size(0), n}, type);
  T* out = u.mutable_data_ptr<T>();
  torch::stable::parallel_for(0, rows.size(0), grain(8 * n), [&](int64_t begin, int64_t end) {
    for (int64_t r = begin; r < end; ++r)
      for (int64_t first = 0; first < n; first += kBlock)
        draw_columns(row[r], first, std::min(kBlock, n - first), out + r * n + first);
  });
  return u;
}

Tensor draw(const Tensor& rows, int64_t n, bool single) {
  return single ? draw_as<float>(rows, n, ScalarType::Float) : draw_as<double>(rows, n, ScalarType::Double);
}

// Uniforms [R, count] of columns first .. first + count of rows with the given seeds and indices; first is even.
Tensor uniforms_of(const Tensor& seed, const Tensor& row, int64_t first, int64_t count, int64_t stream) {
  check(seed, "seed", 1, ScalarType::Long);
  check(row, "row", 1, ScalarType::Long);
  check_size(count, "count", 0);
  check_size(first, "first", 0);
  STD_TORCH_CHECK(seed.size(0) == row.size(0) && first % 2 == 0, "seed and row do not fit, or first is odd");
  const int64_t R = row.size(0);
  Tensor result = empty({R, count}, ScalarType::Double);
  const int64_t *seeds = seed.const_data_ptr<int64_t>(), *rows = row.const_data_ptr<int64_t>();
  double* out = result.mutable_data_ptr<double>();
  torch::stable::parallel_for(0, R, grain(2 * count), [&](int64_t begin, int64_t end) {
    double buffer[kBlock];
    for (int64_t r = begin; r < end; ++r) {
      for (int64_t at = 0; at < count; at += kBlock) {
        const int64_t some = std::min(kBlock, count - at);
        uniforms(uint64_t(seeds[r]), uint64_t(rows[r]), Stream(stream), first + at, (some + 1) / 2, buffer);
        std::copy_n(buffer, some, out + r * count + at);
      }
    }
  });
  return result;
}

// Turns uniforms p [R, n] into perturbations of the kinds that the rows ask for.
Tensor shape(const Tensor& rows, const Tensor& p) {
  const Row* row = row_data(rows);
  check(p, "p", 2);
  STD_TORCH_CHECK(rows.size(0) == p.size(0), "rows and p do not fit");
  const int64_t n = p.size(1);
  Tensor u = empty({p.size(0), n}, ScalarType::Double);
  const double* source = p.const_data_ptr<double>();
  double* out = u.mutable_data_ptr<double>();
  torch::stable::parallel_for(0, p.size(0), grain(8 * n), [&](int64_t begin, int64_t end) {
    for (int64_t r = begin; r < end; ++r) shape_row(row[r], source + r * n, n, out + r * n);
  });
  return u;
}

// Copies u [R, n], with the lobes of the rows in dimensions i and j, from uniforms p_i and p_j [R].
Tensor with_lobes(const Tensor& rows, const Tensor& u, const Tensor& p_i, const Tensor& p_j) {
  const Row* row = row_data(rows);
  check(u, "u", 2);
  check(p_i, "p_i", 1);
  check(p_j, "p_j", 1);
  const int64_t R = u.size(0), n = u.size(1);
  STD_TORCH_CHECK(rows.size(0) == R && p_i.size(0) == R && p_j.size(0) == R, "rows, u, p_i and p_j do not fit");
  Tensor result = empty({R, n}, ScalarType::Double);
  const double *first = p_i.const_data_ptr<double>(), *second = p_j.const_data_ptr<double>();
  double* out = result.mutable_data_ptr<double>();
  std::copy_n(u.const_data_ptr<double>(), R * n, out);
  for (int64_t r = 0; r < R; ++r)
    set_lobes(row[r], 0, n, out + r * n, [&](int64_t d) { return d == row[r].i ? first[r] : second[r]; });
  return result;
}

// Places the rows of a batch; u is kept, empty or absent.
template <class U, class X, class T, class Columns>
std::tuple<Tensor, Tensor, Tensor> placed(
    const Tensor& x, const Tensor& sigma, int64_t S, bool antithetic, int64_t proposal, bool center, bool keep,
    ScalarType type, const Columns& columns) {
  const int64_t B = x.size(0), n = x.size(1), K = antithetic ? 2 * S : S, E = K + center;
  Tensor points = empty({B, E, n}, type);
  Tensor u = empty({keep ? B : 0, K, n}, ScalarType::Double);
  Tensor weights = empty({B, K}, ScalarType::Double);
  const Batch<X, T> batch{
      x.const_data_ptr<X>(), sigma.const_data_ptr<double>(), S, E, n, proposal, antithetic,
      points.mutable_data_ptr<T>(), keep ? u.mutable_data_ptr<double>() : nullptr, weights.mutable_data_ptr<double>()};
  torch::stable::parallel_for(0, B * S, grain(8 * n), [&](int64_t begin, int64_t end) {
    place_rows<U>(batch, begin, end, columns);
  });
  for (int64_t b = 0; center && b < B; ++b) std::copy_n(batch.x + b * n, n, batch.points + (b * E + K) * n);
  return {points, u, weights};
}

std::tuple<Tensor, Tensor, Tensor> place_all(
    const Tensor& u, const Tensor& x, const Tensor& sigma, bool antithetic, bool single, int64_t proposal) {
  check(u, "u", 2);
  check(x, "x", 2);
  check(sigma, "sigma", 1);
  check_proposal(proposal);
  const int64_t B = x.size(0), n = x.size(1);
  STD_TORCH_CHECK(B > 0 && u.size(0) % B == 0 && u.size(1) == n && sigma.size(0) == n, "u, x and sigma do not fit");
  const double* source = u.const_data_ptr<double>();
  const auto columns = [=](int64_t row, int64_t first, int64_t, double*) { return source + row * n + first; };
  const int64_t S = u.size(0) / B;
  if (single)
    return placed<double, double, float>(x, sigma, S, antithetic, proposal, false, true, ScalarType::Float, columns);
  return placed<double, double, double>(x, sigma, S, antithetic, proposal, false, true, ScalarType::Double, columns);
}

// Draws and places in one pass, in the precision of x: rows [B * S, 5], points [B, E, n] with x itself as the last one
// where `center`, u [B, K, n] or [0, K, n] where it is not kept, and weights [B, K].
std::tuple<Tensor, Tensor, Tensor, Tensor> sample(
    int64_t seed, int64_t S, const Tensor& x, const Tensor& sigma, bool antithetic, int64_t proposal, bool center,
    bool keep) {
  const bool single = x.scalar_type() == ScalarType::Float;
  check(x, "x", 2, single ? ScalarType::Float : ScalarType::Double);
  check(sigma, "sigma", 1);
  STD_TORCH_CHECK(S > 0 && x.size(0) > 0 && sigma.size(0) == x.size(1), "S, x and sigma do not fit");
  Tensor rows = pick_rows(seed, 0, x.size(0) * S, x.size(1), proposal);
  const auto columns = [row = row_data(rows)](int64_t r, int64_t first, int64_t count, auto* buffer) {
    draw_columns(row[r], first, count, buffer);
    return buffer;
  };
  auto [points, u, weights] =
      single ? placed<float, float, float>(x, sigma, S, antithetic, proposal, center, keep, ScalarType::Float, columns)
             : placed<double, double, double>(x, sigma, S, antithetic, proposal, center, keep, ScalarType::Double,
                                              columns);
  return {rows, points, u, weights};
}

// `rows_of(b)` gives the rows of U that belong to batch element b; a is [B, M, K].
template <class RowsOf>
Tensor accumulate_numbers(
    const RowsOf& rows_of, int64_t B, int64_t M, int64_t K, int64_t n, bool squares, const double* a) {
  const int64_t blocks = (n + kBlock - 1) / kBlock;
  Tensor result = empty({B, M, n}, ScalarType::Double);
  double* out = result.mutable_data_ptr<double>();
  torch::stable::parallel_for(0, B * blocks, grain(M * K * std::min(n, kBlock)), [&](int64_t begin, int64_t end) {
    for (int64_t task = begin; task < end; ++task) {
      const int64_t b = task / blocks, first = task % blocks * kBlock;
      accumulate_block(rows_of(b), first, K, n, M, squares, a + b * M * K, out + b * M * n);
    }
  });
  return result;
}

// Writes u_k . v_m to out [B, M, K], for rows as above and vectors [B, M, n].
template <class RowsOf>
void project_numbers(
    const RowsOf& rows_of, int64_t B, int64_t M, int64_t K, int64_t n, const double* vectors, double* out) {
  torch::stable::parallel_for(0, B * K, grain(M * n), [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const int64_t b = row / K;
      project_row(rows_of(b), row % K, K, n, M, vectors + b * M * n, out + b * M * K);
    }
  });
}

auto stored(const Tensor& u) {
  check(u, "u", 3);
  return [data = u.const_data_ptr<double>(), K = u.size(1), n = u.size(2)](int64_t b) {
    return StoredRows{data + b * K * n, n};
  };
}

// Rejects empty batches: callers divide by x.size(0).
auto drawn(const Tensor& rows, const Tensor& x, const Tensor& sigma, bool single) {
  const Row* row = row_data(rows);
  STD_TORCH_CHECK(x.dim() == 2 && sigma.dim() == 1, "x and sigma must have 2 and 1 dimensions");
  STD_TORCH_CHECK(
      x.size(0) > 0 && rows.size(0) > 0 && rows.size(0) % x.size(0) == 0 && sigma.size(0) == x.size(1),
      "rows, x and sigma do not fit");
  const int64_t S = rows.size(0) / x.size(0);
  return [row, S, single](int64_t b) { return DrawnRows{row + b * S, S, single}; };
}

Tensor project(const Tensor& u, const Tensor& t) {
  const auto rows_of = stored(u);
  check(t, "t", 3);
  STD_TORCH_CHECK(u.size(0) == t.size(0) && u.size(2) == t.size(2), "u and t do not fit");
  const int64_t B = t.size(0), M = t.size(1), n = t.size(2), K = u.size(1);
  Tensor result = empty({B, M, K}, ScalarType::Double);
  project_numbers(rows_of, B, M, K, n, t.const_data_ptr<double>(), result.mutable_data_ptr<double>());
  return result;
}

Tensor accumulate(const Tensor& u, const Tensor& a, bool squares) {
  const auto rows_of = stored(u);
  check(a, "a", 3);
  STD_TORCH_CHECK(u.size(0) == a.size(0) && u.size(1) == a.size(2), "u and a do not fit");
  return accumulate_numbers(
      rows_of, a.size(0), a.size(1), a.size(2), u.size(2), squares, a.const_data_ptr<double>());
}

template <class T>
Tensor coefficients_of(const T* values, const double* share, int64_t B, int64_t E, int64_t P, int64_t K, bool center) {
  Tensor result = empty({B, K, P}, ScalarType::Double);
  double* out = result.mutable_data_ptr<double>();
  torch::stable::parallel_for(0, B * K, grain(P), [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const T* const f = values + (row / K * E + row % K) * P;
      const T* const baseline = center ? values + (row / K * E + K) * P : nullptr;
      center_row(f, baseline, share ? share[row] : 1.0 / double(K), P, out + row * P);
    }
  });
  return result;
}

// (f - baseline) * share [B, K, P] for values [B, E, *out] of P numbers each, in single or double precision: the
// baseline is value K where `center`, else zero; share is [B, K, 1], or 1 / K where it is absent.
Tensor coefficients(const Tensor& values, const std::optional<Tensor>& share, int64_t K, bool center) {
  const bool single = values.scalar_type() == ScalarType::Float;
  check(values, "values", std::max<int64_t>(2, values.dim()), single ? ScalarType::Float : ScalarType::Double);
  const int64_t B = values.size(0), E = values.size(1);
  int64_t P = 1;
  for (int64_t d = 2; d < values.dim(); ++d) P *= values.size(d);
  STD_TORCH_CHECK(K > 0 && K + center <= E, "values do not have K rows, and one more for the center");
  if (share) {
    check(*share, "share", 3);
    STD_TORCH_CHECK(share->size(0) == B && share->size(1) == K && share->size(2) == 1, "values and share do not fit");
  }
  const double* weights = share ? share->const_data_ptr<double>() : nullptr;
  return single ? coefficients_of(values.const_data_ptr<float>(), weights, B, E, P, K, center)
                : coefficients_of(values.const_data_ptr<double>(), weights, B, E, P, K, center);
}

// a[b, m, k] * weight[b, k], after a check of all that the sums of a likelihood ratio are made of.
std::vector<double> weighted(const Tensor& u, const Tensor& weight, const Tensor& a) {
  check(u, "u", 3);
  check(weight, "weight", 2);
  check(a, "a", 3);
  const int64_t B = a.size(0), M = a.size(1), K = a.size(2);
  STD_TORCH_CHECK(
      u.size(0) == B && u.size(1) == K && weight.size(0) == B && weight.size(1) == K, "u, weight and a do not fit");
  const double *weights = weight.const_data_ptr<double>(), *coefficients = a.const_data_ptr<double>();
  std::vector<double> result(size_t(B * M * K));
  for (int64_t row = 0; row < B * M; ++row)
    for (int64_t k = 0; k < K; ++k)
      result[size_t(row * K + k)] = coefficients[row * K + k] * weights[row / M * K + k];
  return result;
}

// The numbers of sigma [n], or null where it is absent.
const double* sigma_data(const std::optional<Tensor>& sigma, int64_t n) {
  if (!sigma) return nullptr;
  check(*sigma, "sigma", 1);
  STD_TORCH_CHECK(sigma->size(0) == n, "sigma has ", sigma->size(0), " elements instead of ", n);
  return sigma->const_data_ptr<double>();
}

// sum_k a_k w_k u_k, divided by sigma where it is given.
Tensor weighted_gradient(
    const Tensor& u, const Tensor& weight, const Tensor& a, const std::optional<Tensor>& sigma) {
  const std::vector<double> numbers = weighted(u, weight, a);
  const double* const unit = sigma_data(sigma, u.size(2));
  const int64_t B = a.size(0), M = a.size(1), n = u.size(2);
  Tensor result = accumulate_numbers(stored(u), B, M, a.size(2), n, false, numbers.data());
  if (unit) divide_rows(result.mutable_data_ptr<double>(), unit, B * M, n);
  return result;
}

// sum_k a_k w_k ((u_k . v) u_k - v); with v / sigma in place of v and divided by sigma where it is given.
Tensor weighted_hvp(
    const Tensor& u, const Tensor& weight, const Tensor& a, const Tensor& v, const std::optional<Tensor>& sigma) {
  std::vector<double> numbers = weighted(u, weight, a);
  check(v, "v", 3);
  const double* const unit = sigma_data(sigma, u.size(2));
  const int64_t B = a.size(0), M = a.size(1), K = a.size(2), n = u.size(2);
  STD_TORCH_CHECK(v.size(0) == B && v.size(1) == M && v.size(2) == n, "u, a and v do not fit");
  const auto rows_of = stored(u);
  const double* vectors = v.const_data_ptr<double>();
  std::vector<double> divided;
  if (unit) {
    divided.assign(vectors, vectors + B * M * n);
    divide_rows(divided.data(), unit, B * M, n);
    vectors = divided.data();
  }
  std::vector<double> totals(size_t(B * M)), along(size_t(B * M * K));
  for (int64_t row = 0; row < B * M; ++row) totals[size_t(row)] = total(numbers.data() + row * K, K);
  project_numbers(rows_of, B, M, K, n, vectors, along.data());
  for (size_t k = 0; k < numbers.size(); ++k) numbers[k] *= along[k];
  Tensor result = accumulate_numbers(rows_of, B, M, K, n, false, numbers.data());
  double* out = result.mutable_data_ptr<double>();
  for (int64_t row = 0; row < B * M; ++row)
    for (int64_t d = 0; d < n; ++d) out[row * n + d] -= totals[size_t(row)] * vectors[row * n + d];
  if (unit) divide_rows(out, unit, B * M, n);
  return result;
}

Tensor project_drawn(
    const Tensor& rows, const Tensor& x, const Tensor& sigma, bool antithetic, bool single, const Tensor& t) {
  const auto rows_of = drawn(rows, x, sigma, single);
  check(t, "t", 3);
  STD_TORCH_CHECK(x.size(0) == t.size(0) && x.size(1) == t.size(2), "x and t do not fit");
  const int64_t B = t.size(0), M = t.size(1), n = t.size(2), S = rows.size(0) / B, K = antithetic ? 2 * S : S;
  Tensor result = empty({B, M, K}, ScalarType::Double);
  const double* vectors = t.const_data_ptr<double>();
  double* out = result.mutable_data_ptr<double>();
  torch::stable::parallel_for(0, B * S, grain((M + 8) * n), [&](int64_t begin, int64_t end) {
    for (int64_t next = begin; next < end;) {  // the rows of one batch element at a time
      const int64_t b = next / S, last = std::min(end, (b + 1) * S);
      project_drawn_rows(rows_of(b), next - b * S, last - b * S, K, n, M, vectors + b * M * n, out + b * M * K);
      next = last;
    }
  });
  return result;
}

Tensor accumulate_drawn(
    const Tensor& rows, const Tensor& x, const Tensor& sigma, bool antithetic, bool single, const Tensor& a,
    bool squares) {
  const auto rows_of = drawn(rows, x, sigma, single);
  check(a, "a", 3);
  const int64_t K = rows.size(0) / x.size(0) * (antithetic ? 2 : 1);
  STD_TORCH_CHECK(x.size(0) == a.size(0) && K == a.size(2), "rows and a do not fit");
  return accumulate_numbers(rows_of, a.size(0), a.size(1), K, x.size(1), squares, a.const_data_ptr<double>());
}

Tensor hessian(const Tensor& u, const Tensor& a) {
  check(u, "u", 3);
  check(a, "a", 3);
  STD_TORCH_CHECK(u.size(0) == a.size(0) && u.size(1) == a.size(2), "u and a do not fit");
  const int64_t B = a.size(0), M = a.size(1), K = a.size(2), n = u.size(2);
  Tensor result = empty({B, M, n, n}, ScalarType::Double);
  const double *rows = u.const_data_ptr<double>(), *coefficients = a.const_data_ptr<double>();
  double* out = result.mutable_data_ptr<double>();
  torch::stable::parallel_for(0, B * M * n, grain(K * n / 2), [&](int64_t begin, int64_t end) {
    for (int64_t task = begin; task < end; ++task) {
      const int64_t m = task / n, i = task % n;
      hessian_row(rows + m / M * K * n, i, K, n, coefficients + m * K, out + m * n * n);
    }
  });
  for (int64_t m = 0; m < B * M; ++m) mirror_rows(out + m * n * n, n, 0, n);
  return result;
}

// Makes matrices [B, n, n] symmetric, in place: their lower triangles become copies of the upper ones.
void mirror(const Tensor& matrices) {
  check(matrices, "matrices", 3);
  const int64_t B = matrices.size(0), n = matrices.size(1);
  STD_TORCH_CHECK(matrices.size(2) == n, "matrices are not square");
  double* out = matrices.mutable_data_ptr<double>();
  for (int64_t b = 0; b < B; ++b) {
    torch::stable::parallel_for(0, n, grain(2 * n), [&](int64_t begin, int64_t end) {
      mirror_rows(out + b * n * n, n, begin, end);
    });
  }
}

}  // namespace

STABLE_TORCH_LIBRARY(torch_zerohess, m) {
  m.def("pick_rows(int seed, int first, int count, int n, int proposal) -> Tensor");
  m.def("draw(Tensor rows, int n, bool single=False) -> Tensor");
  m.def(
      "sample(int seed, int S, Tensor x, Tensor sigma, bool antithetic, int proposal, bool center, bool keep) "
      "-> (Tensor, Tensor, Tensor, Tensor)");
  m.def(
      "place(Tensor u, Tensor x, Tensor sigma, bool antithetic, bool single, int proposal) "
      "-> (Tensor, Tensor, Tensor)");
  m.def("uniforms(Tensor seed, Tensor row, int first, int count, int stream) -> Tensor");
  m.def("shape(Tensor rows, Tensor p) -> Tensor");
  m.def("with_lobes(Tensor rows, Tensor u, Tensor p_i, Tensor p_j) -> Tensor");
  m.def("project(Tensor u, Tensor t) -> Tensor");
  m.def("accumulate(Tensor u, Tensor a, bool squares) -> Tensor");
  m.def("hessian(Tensor u, Tensor a) -> Tensor");
  m.def("coefficients(Tensor values, Tensor? share, int K, bool center) -> Tensor");
  m.def("weighted_gradient(Tensor u, Tensor weight, Tensor a, Tensor? sigma=None) -> Tensor");
  m.def("weighted_hvp(Tensor u, Tensor weight, Tensor a, Tensor v, Tensor? sigma=None) -> Tensor");
  m.def("mirror(Tensor(a!) matrices) -> ()");
  m.def(
      "project_drawn(Tensor rows, Tensor x, Tensor sigma, bool antithetic, bool single, Tensor t) "
      "-> Tensor");
  m.def(
      "accumulate_drawn(Tensor rows, Tensor x, Tensor sigma, bool antithetic, bool single, Tensor a, bool squares) "
      "-> Tensor");
}

STABLE_TORCH_LIBRARY_IMPL(torch_zerohess, CompositeExplicitAutograd, m) {
  m.impl("pick_rows", TORCH_BOX(&pick_rows));
}

STABLE_TORCH_LIBRARY_IMPL(torch_zerohess, CPU, m) {
  m.impl("draw", TORCH_BOX(&draw));
  m.impl("sample", TORCH_BOX(&sample));
  m.impl("place", TORCH_BOX(&place_all));
  m.impl("uniforms", TORCH_BOX(&uniforms_of));
  m.impl("shape", TORCH_BOX(&shape));
  m.impl("with_lobes", TORCH_BOX(&with_lobes));
  m.impl("project", TORCH_BOX(&project));
  m.impl("accumulate", TORCH_BOX(&accumulate));
  m.impl("hessian", TORCH_BOX(&hessian));
  m.impl("coefficients", TORCH_BOX(&coefficients));
  m.impl("weighted_gradient", TORCH_BOX(&weighted_gradient));
  m.impl("weighted_hvp", TORCH_BOX(&weighted_hvp));
  m.impl("mirror", TORCH_BOX(&mirror));
  m.impl("project_drawn", TORCH_BOX(&project_drawn));
  m.impl("accumulate_drawn", TORCH_BOX(&accumulate_drawn));
}

}  // namespace zerohess
