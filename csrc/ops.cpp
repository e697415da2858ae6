// The operators of torch_zerohess, bound to the LibTorch stable ABI: one binary for torch >= 2.10 and Python >= 3.10.
// Kernels first, then all schemas, then all registrations. Shapes: B batch, S samples, K = S or 2 S evaluations per x,
// n parameters, M vectors. Everything is contiguous float64 unless it says int64 or "type of x".
#include <Python.h>

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <tuple>

#include "reduce.h"

PyMODINIT_FUNC PyInit__C(void) {
  // An empty module: importing it runs the registrations below.
  static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_C", nullptr, -1, nullptr};
  return PyModule_Create(&module);
}

namespace zerohess {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

constexpr int64_t kGrain = 1 << 14;  // elements of work that one more thread is worth

// Every argument is checked before LibTorch is asked about it: LibTorch prints a trace to stderr where it refuses.
void check_size(int64_t size, const char* name, int64_t least) {
  STD_TORCH_CHECK(size >= least, name, " is ", size, ", but must be at least ", least);
}

void check(const Tensor& tensor, const char* name, int64_t dim, ScalarType type = ScalarType::Double) {
  STD_TORCH_CHECK(tensor.scalar_type() == type, name, " has the wrong dtype");
  STD_TORCH_CHECK(tensor.dim() == dim, name, " has ", tensor.dim(), " dimensions instead of ", dim);
  STD_TORCH_CHECK(tensor.is_contiguous(), name, " is not contiguous");
}

int64_t grain(int64_t work_per_item) { return std::max<int64_t>(1, kGrain / std::max<int64_t>(1, work_per_item)); }

const Row* row_data(const Tensor& rows) {
  check(rows, "rows", 2, ScalarType::Long);
  STD_TORCH_CHECK(rows.size(1) == 5, "rows has ", rows.size(1), " columns instead of 5");
  return reinterpret_cast<const Row*>(rows.const_data_ptr<int64_t>());
}

Tensor pick_rows(int64_t seed, int64_t first, int64_t count, int64_t n, int64_t proposal) {
  check_size(count, "count", 0);
  check_size(n, "n", 1);
  Tensor rows = torch::stable::empty({count, 5}, ScalarType::Long);
  Row* out = reinterpret_cast<Row*>(rows.mutable_data_ptr<int64_t>());
  for (int64_t r = 0; r < count; ++r) out[r] = pick(seed, first + r, n, proposal);
  return rows;
}

Tensor draw(const Tensor& rows, int64_t n) {
  check_size(n, "n", 0);
  const Row* row = row_data(rows);
  const int64_t R = rows.size(0);
  Tensor u = torch::stable::empty({R, n}, ScalarType::Double);
  double* out = u.mutable_data_ptr<double>();
  torch::stable::parallel_for(0, R, grain(8 * n), [&](int64_t begin, int64_t end) {
    double buffer[kBlock];
    for (int64_t r = begin; r < end; ++r) {
      for (int64_t first = 0; first < n; first += kBlock) {
        const int64_t count = std::min(kBlock, n - first);
        draw_columns(row[r], first, count, buffer);
        std::copy_n(buffer, count, out + r * n + first);
      }
    }
  });
  return u;
}

template <typename T>
void place_rows(
    const double* u, const double* x, const double* sigma, int64_t B, int64_t S, int64_t K, int64_t n, int64_t proposal,
    T* points, double* applied, double* weights) {
  torch::stable::parallel_for(0, B * K, grain(4 * n), [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const int64_t b = row / K, k = row % K;
      const double sign = k < S ? 1.0 : -1.0;
      const double* source = u + (b * S + k % S) * n;
      for (int64_t d = 0; d < n; ++d)
        applied[row * n + d] = place(x[b * n + d], sigma[d], sign * source[d], points + row * n + d);
      weights[row] = weight(applied + row * n, n, proposal);
    }
  });
}

std::tuple<Tensor, Tensor, Tensor> place_all(
    const Tensor& u, const Tensor& x, const Tensor& sigma, bool antithetic, bool single, int64_t proposal) {
  check(u, "u", 2);
  check(x, "x", 2);
  check(sigma, "sigma", 1);
  const int64_t B = x.size(0), n = x.size(1);
  STD_TORCH_CHECK(B > 0 && u.size(0) % B == 0 && u.size(1) == n && sigma.size(0) == n, "u, x and sigma do not fit");
  const int64_t S = u.size(0) / B, K = antithetic ? 2 * S : S;
  Tensor points = torch::stable::empty({B, K, n}, single ? ScalarType::Float : ScalarType::Double);
  Tensor applied = torch::stable::empty({B, K, n}, ScalarType::Double);
  Tensor weights = torch::stable::empty({B, K}, ScalarType::Double);
  const auto run = [&](auto* out) {
    place_rows(u.const_data_ptr<double>(), x.const_data_ptr<double>(), sigma.const_data_ptr<double>(), B, S, K, n,
               proposal, out, applied.mutable_data_ptr<double>(), weights.mutable_data_ptr<double>());
  };
  if (single)
    run(points.mutable_data_ptr<float>());
  else
    run(points.mutable_data_ptr<double>());
  return {points, applied, weights};
}

// `rows_of(b)` gives the rows of U that belong to batch element b.
template <class RowsOf>
Tensor project_with(const RowsOf& rows_of, int64_t K, const Tensor& t) {
  const int64_t B = t.size(0), M = t.size(1), n = t.size(2);
  Tensor result = torch::stable::empty({B, M, K}, ScalarType::Double);
  const double* vectors = t.const_data_ptr<double>();
  double* out = result.mutable_data_ptr<double>();
  torch::stable::parallel_for(0, B * K, grain(M * n), [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const int64_t b = row / K;
      project_row(rows_of(b), row % K, K, n, M, vectors + b * M * n, out + b * M * K);
    }
  });
  return result;
}

template <class RowsOf>
Tensor accumulate_with(const RowsOf& rows_of, int64_t n, bool squares, const Tensor& a) {
  const int64_t B = a.size(0), M = a.size(1), K = a.size(2), blocks = (n + kBlock - 1) / kBlock;
  Tensor result = torch::stable::empty({B, M, n}, ScalarType::Double);
  const double* coefficients = a.const_data_ptr<double>();
  double* out = result.mutable_data_ptr<double>();
  torch::stable::parallel_for(0, B * blocks, grain(M * K * std::min(n, kBlock)), [&](int64_t begin, int64_t end) {
    for (int64_t task = begin; task < end; ++task) {
      const int64_t b = task / blocks, first = task % blocks * kBlock;
      accumulate_block(rows_of(b), first, K, n, M, squares, coefficients + b * M * K, out + b * M * n);
    }
  });
  return result;
}

auto stored(const Tensor& u) {
  check(u, "u", 3);
  return [data = u.const_data_ptr<double>(), K = u.size(1), n = u.size(2)](int64_t b) {
    return StoredRows{data + b * K * n, n};
  };
}

auto drawn(const Tensor& rows, const Tensor& x, const Tensor& sigma, bool single) {
  const Row* row = row_data(rows);
  check(x, "x", 2);
  check(sigma, "sigma", 1);
  STD_TORCH_CHECK(
      x.size(0) > 0 && rows.size(0) % x.size(0) == 0 && sigma.size(0) == x.size(1), "rows, x and sigma do not fit");
  const int64_t S = rows.size(0) / x.size(0);
  return [row, px = x.const_data_ptr<double>(), ps = sigma.const_data_ptr<double>(), n = x.size(1), S,
          single](int64_t b) { return DrawnRows{row + b * S, px + b * n, ps, S, single}; };
}

Tensor project(const Tensor& u, const Tensor& t) {
  const auto rows_of = stored(u);
  check(t, "t", 3);
  STD_TORCH_CHECK(u.size(0) == t.size(0) && u.size(2) == t.size(2), "u and t do not fit");
  return project_with(rows_of, u.size(1), t);
}

Tensor accumulate(const Tensor& u, const Tensor& a, bool squares) {
  const auto rows_of = stored(u);
  check(a, "a", 3);
  STD_TORCH_CHECK(u.size(0) == a.size(0) && u.size(1) == a.size(2), "u and a do not fit");
  return accumulate_with(rows_of, u.size(2), squares, a);
}

Tensor project_drawn(
    const Tensor& rows, const Tensor& x, const Tensor& sigma, bool antithetic, bool single, const Tensor& t) {
  const auto rows_of = drawn(rows, x, sigma, single);  // checks what is divided by below
  check(t, "t", 3);
  STD_TORCH_CHECK(x.size(0) == t.size(0) && x.size(1) == t.size(2), "x and t do not fit");
  const int64_t K = rows.size(0) / x.size(0) * (antithetic ? 2 : 1);
  return project_with(rows_of, K, t);
}

Tensor accumulate_drawn(
    const Tensor& rows, const Tensor& x, const Tensor& sigma, bool antithetic, bool single, const Tensor& a,
    bool squares) {
  const auto rows_of = drawn(rows, x, sigma, single);  // checks what is divided by below
  check(a, "a", 3);
  const int64_t K = rows.size(0) / x.size(0) * (antithetic ? 2 : 1);
  STD_TORCH_CHECK(x.size(0) == a.size(0) && K == a.size(2), "rows and a do not fit");
  return accumulate_with(rows_of, x.size(1), squares, a);
}

Tensor hessian(const Tensor& u, const Tensor& a) {
  check(u, "u", 3);
  check(a, "a", 3);
  STD_TORCH_CHECK(u.size(0) == a.size(0) && u.size(1) == a.size(2), "u and a do not fit");
  const int64_t B = a.size(0), M = a.size(1), K = a.size(2), n = u.size(2);
  Tensor result = torch::stable::empty({B, M, n, n}, ScalarType::Double);
  const double *rows = u.const_data_ptr<double>(), *coefficients = a.const_data_ptr<double>();
  double* out = result.mutable_data_ptr<double>();
  torch::stable::parallel_for(0, B * M * n, grain(K * n / 2), [&](int64_t begin, int64_t end) {
    for (int64_t task = begin; task < end; ++task) {
      const int64_t m = task / n, i = task % n;
      hessian_row(rows + m / M * K * n, i, K, n, coefficients + m * K, out + m * n * n);
    }
  });
  for (int64_t m = 0; m < B * M; ++m)
    for (int64_t i = 1; i < n; ++i)
      for (int64_t j = 0; j < i; ++j) out[(m * n + i) * n + j] = out[(m * n + j) * n + i];
  return result;
}

}  // namespace

STABLE_TORCH_LIBRARY(torch_zerohess, m) {
  m.def("pick_rows(int seed, int first, int count, int n, int proposal) -> Tensor");
  m.def("draw(Tensor rows, int n) -> Tensor");
  m.def(
      "place(Tensor u, Tensor x, Tensor sigma, bool antithetic, bool single, int proposal) "
      "-> (Tensor, Tensor, Tensor)");
  m.def("project(Tensor u, Tensor t) -> Tensor");
  m.def("accumulate(Tensor u, Tensor a, bool squares) -> Tensor");
  m.def("hessian(Tensor u, Tensor a) -> Tensor");
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
  m.impl("place", TORCH_BOX(&place_all));
  m.impl("project", TORCH_BOX(&project));
  m.impl("accumulate", TORCH_BOX(&accumulate));
  m.impl("hessian", TORCH_BOX(&hessian));
  m.impl("project_drawn", TORCH_BOX(&project_drawn));
  m.impl("accumulate_drawn", TORCH_BOX(&accumulate_drawn));
}

}  // namespace zerohess
