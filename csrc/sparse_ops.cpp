// The operators of sparse Jacobians. Shapes: K samples, n parameters, m outputs; `entries` and `keep` as in sparse.h.
#include "sparse.h"

#include <torch/csrc/stable/library.h>

#include <atomic>
#include <optional>
#include <tuple>

#include "tensors.h"

namespace zerohess {
namespace {

ScalarType real_type(const Tensor& tensor) {
  return tensor.scalar_type() == ScalarType::Float ? ScalarType::Float : ScalarType::Double;
}

template <class V, class T>
Tensor sparse_times_as(
    const Tensor& column, const Tensor& first, const Tensor& values, const Tensor& vector, ScalarType type) {
  const int64_t rows = first.size(0), entries = column.size(0);
  Tensor result = empty({rows}, type);
  const int64_t *columns = column.const_data_ptr<int64_t>(), *begins = first.const_data_ptr<int64_t>();
  const V* numbers = values.const_data_ptr<V>();
  const T* source = vector.const_data_ptr<T>();
  T* out = result.mutable_data_ptr<T>();
  torch::stable::parallel_for(0, rows, grain(entries / std::max<int64_t>(1, rows)), [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const int64_t at = begins[row], last = row + 1 < rows ? begins[row + 1] : entries;
      out[row] = sparse_dot(columns + at, numbers + at, last - at, source);
    }
  });
  return result;
}

// The product [rows] of a sparse matrix and a vector [columns]: the columns of its entries and their values [entries],
// row after row, and where each row begins [rows]. Values and vector are float32 or float64; the result is as the latter.
Tensor sparse_times(const Tensor& column, const Tensor& first, const Tensor& values, const Tensor& vector) {
  const ScalarType own = real_type(values), type = real_type(vector);
  check(column, "column", 1, ScalarType::Long);
  check(first, "first", 1, ScalarType::Long);
  check(values, "values", 1, own);
  check(vector, "vector", 1, type);
  const int64_t entries = column.size(0), rows = first.size(0), n = vector.size(0);
  const int64_t *columns = column.const_data_ptr<int64_t>(), *begins = first.const_data_ptr<int64_t>();
  STD_TORCH_CHECK(values.size(0) == entries, "column and values do not fit");
  STD_TORCH_CHECK(std::all_of(columns, columns + entries, [n](int64_t c) { return 0 <= c && c < n; }),
                  "column has numbers beyond the vector");
  const bool whole = rows ? begins[0] == 0 && begins[rows - 1] <= entries : entries == 0;
  STD_TORCH_CHECK(whole && std::is_sorted(begins, begins + rows), "first does not say where rows begin");
  if (own == ScalarType::Float)
    return type == own ? sparse_times_as<float, float>(column, first, values, vector, type)
                       : sparse_times_as<float, double>(column, first, values, vector, type);
  return type == own ? sparse_times_as<double, double>(column, first, values, vector, type)
                     : sparse_times_as<double, float>(column, first, values, vector, type);
}

template <class T>
std::tuple<Tensor, Tensor, Tensor> regressed(
    const Tensor& directions, const Tensor& scale, const Tensor& changes, const Tensor& index, const Tensor& used,
    const Tensor& known_index, const Tensor& known_values, const Tensor& ridges,
    const std::optional<Tensor>& constant, bool errors, bool shortened) {
  const int64_t m = index.size(0), keep = index.size(1), K = directions.size(1), R = ridges.size(0);
  const bool* flags = used.const_data_ptr<bool>();
  int64_t most = 0;
  for (int64_t row = 0; row < m; ++row)
    most = std::max<int64_t>(most, std::count(flags + row * keep, flags + (row + 1) * keep, true));
  Tensor values = torch::stable::new_zeros(changes, {R, m, keep});
  Tensor deviations = torch::stable::new_zeros(changes, {errors ? m : 0, keep});
  const Regression<T> of{
      directions.const_data_ptr<T>(), scale.const_data_ptr<T>(), changes.const_data_ptr<T>(),
      index.const_data_ptr<int64_t>(), known_index.const_data_ptr<int64_t>(), flags,
      known_values.const_data_ptr<T>(), ridges.const_data_ptr<T>(), constant ? constant->const_data_ptr<T>() : nullptr,
      m, K, keep, known_index.size(1), R, most, shortened,
      values.mutable_data_ptr<T>(), errors ? deviations.mutable_data_ptr<T>() : nullptr};
  Tensor count = empty({}, ScalarType::Long);
  std::atomic<int64_t> failed{0};
  torch::stable::parallel_for(0, m, grain(keep * keep * K), [&](int64_t begin, int64_t end) {
    failed += regress_rows(of, begin, end);
  });
  *count.mutable_data_ptr<int64_t>() = failed;
  return {values, deviations, count};
}

// The slopes [R, m, keep] of m regressions for R pairs of ridges, standard errors [m, keep] for the first pair or
// [0, keep], and of how many regressions the matrix is not positive definite. See `Regression` for the arguments.
std::tuple<Tensor, Tensor, Tensor> regress(
    const Tensor& directions, const Tensor& scale, const Tensor& changes, const Tensor& index, const Tensor& used,
    const Tensor& known_index, const Tensor& known_values, const Tensor& ridges,
    const std::optional<Tensor>& constant, bool errors, bool shortened) {
  const ScalarType type = real_type(changes);
  check(directions, "directions", 2, type);
  check(scale, "scale", 1, type);
  check(changes, "changes", 2, type);
  check(index, "index", 2, ScalarType::Long);
  check(used, "used", 2, ScalarType::Bool);
  check(known_index, "known_index", 2, ScalarType::Long);
  check(known_values, "known_values", 2, type);
  check(ridges, "ridges", 2, type);
  if (constant) check(*constant, "constant", 1, type);
  const int64_t n = directions.size(0), K = directions.size(1), m = index.size(0), keep = index.size(1);
  STD_TORCH_CHECK(scale.size(0) == n && changes.size(1) == K && (!constant || constant->size(0) == K),
                  "directions, scale, changes and constant do not fit");
  STD_TORCH_CHECK(changes.size(0) == m && used.size(0) == m && used.size(1) == keep && known_index.size(0) == m &&
                      known_values.size(0) == m && known_values.size(1) == known_index.size(1),
                  "changes, index, used, known_index and known_values do not fit");
  STD_TORCH_CHECK(ridges.size(1) == 2 && (!errors || ridges.size(0) > 0), "ridges are no pairs");
  const int64_t* parameters = index.const_data_ptr<int64_t>();
  STD_TORCH_CHECK(std::all_of(parameters, parameters + m * keep, [n](int64_t d) { return 0 <= d && d < n; }),
                  "index has numbers beyond the parameters");
  const auto with = type == ScalarType::Float ? regressed<float> : regressed<double>;
  return with(directions, scale, changes, index, used, known_index, known_values, ridges, constant, errors, shortened);
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(torch_zerohess, m) {
  m.def("sparse_times(Tensor column, Tensor first, Tensor values, Tensor vector) -> Tensor");
  m.def(
      "regress(Tensor directions, Tensor scale, Tensor changes, Tensor index, Tensor used, Tensor known_index, "
      "Tensor known_values, Tensor ridges, Tensor? constant, bool errors, bool shortened) -> (Tensor, Tensor, Tensor)");
}

STABLE_TORCH_LIBRARY_IMPL(torch_zerohess, CPU, m) {
  m.impl("sparse_times", TORCH_BOX(&sparse_times));
  m.impl("regress", TORCH_BOX(&regress));
}

}  // namespace zerohess
