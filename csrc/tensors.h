// What all operators need of LibTorch: checks of arguments, new tensors, and the work of a thread.
#pragma once

#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>
#include <torch/headeronly/util/shim_utils.h>

#include <algorithm>
#include <initializer_list>
#include <vector>

namespace zerohess {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

constexpr int64_t kGrain = 1 << 14;  // elements of work that one more thread is worth

// Every argument is checked before LibTorch is asked about it: LibTorch prints a trace to stderr where it refuses.
inline void check_size(int64_t size, const char* name, int64_t least) {
  STD_TORCH_CHECK(size >= least, name, " is ", size, ", but must be at least ", least);
}

inline void check(const Tensor& tensor, const char* name, int64_t dim, ScalarType type = ScalarType::Double) {
  STD_TORCH_CHECK(tensor.scalar_type() == type, name, " has the wrong dtype");
  STD_TORCH_CHECK(tensor.dim() == dim, name, " has ", tensor.dim(), " dimensions instead of ", dim);
  STD_TORCH_CHECK(tensor.is_contiguous(), name, " is not contiguous");
}

// A new contiguous tensor of the CPU, [*sizes]. Not torch::stable::empty: it finds its operator by name at every call,
// which takes longer than the sums of a small estimate.
inline Tensor empty(std::initializer_list<int64_t> sizes, ScalarType type) {
  std::vector<int64_t> strides(sizes.size(), 1);
  for (size_t d = sizes.size(); d-- > 1;) strides[d - 1] = strides[d] * std::max<int64_t>(1, sizes.begin()[d]);
  const int32_t dtype = type == ScalarType::Double  ? aoti_torch_dtype_float64()
                        : type == ScalarType::Float ? aoti_torch_dtype_float32()
                                                    : aoti_torch_dtype_int64();
  AtenTensorHandle made;
  TORCH_ERROR_CODE_CHECK(aoti_torch_empty_strided(
      int64_t(sizes.size()), sizes.begin(), strides.data(), dtype, aoti_torch_device_type_cpu(), 0, &made));
  return Tensor(made);
}

inline int64_t grain(int64_t work_per_item) { return std::max<int64_t>(1, kGrain / std::max<int64_t>(1, work_per_item)); }

}  // namespace zerohess
