// As much of torch's stable C++ interface as csrc/ops.cpp and csrc/sparse_ops.cpp use, with ranges on std::thread. The
// thread sanitizer sees all of a program then: torch itself is not compiled for it, and so it would report false races.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <thread>
#include <vector>

#define PyMODINIT_FUNC [[maybe_unused]] static void*
#define PyModuleDef_HEAD_INIT 0
struct PyModuleDef {
  int head;
  const char *name, *text;
  int size;
  void* methods;
};
inline void* PyModule_Create(PyModuleDef*) { return nullptr; }

template <class... Parts>
[[noreturn]] void refuse(const char* condition, const Parts&...) { throw std::invalid_argument(condition); }
#define STD_TORCH_CHECK(condition, ...) \
  if (!(condition)) refuse(#condition, __VA_ARGS__)
#define TORCH_ERROR_CODE_CHECK(call) call
#define ZH_JOINED(a, b) a##b
#define ZH_UNUSED_TEMPLATE(number) \
  template <class Library>         \
  void ZH_JOINED(registers_, number)
#define STABLE_TORCH_LIBRARY(space, m) ZH_UNUSED_TEMPLATE(__COUNTER__)([[maybe_unused]] Library & m)
#define STABLE_TORCH_LIBRARY_FRAGMENT STABLE_TORCH_LIBRARY
#define STABLE_TORCH_LIBRARY_IMPL(space, key, m) STABLE_TORCH_LIBRARY(space, m)
#define TORCH_BOX(function) function

namespace torch::headeronly {
enum class ScalarType { Double, Float, Long, Bool };
}

namespace torch::stable {

using headeronly::ScalarType;

// Numbers in memory of its own, which is poisoned, since an empty tensor holds anything.
class Tensor {
 public:
  Tensor() = default;
  Tensor(std::vector<int64_t> sizes, ScalarType type, int poison = 0xFF) : sizes_(sizes), type_(type) {
    size_t bytes = 8;
    for (const int64_t size : sizes) bytes *= size_t(size);
    memory_.reset(std::malloc(bytes + 1), std::free);
    std::memset(memory_.get(), poison, bytes);
  }
  template <class T>
  T* mutable_data_ptr() const { return static_cast<T*>(memory_.get()); }
  template <class T>
  const T* const_data_ptr() const { return static_cast<const T*>(memory_.get()); }
  int64_t size(int64_t d) const { return sizes_[size_t(d)]; }
  int64_t dim() const { return int64_t(sizes_.size()); }
  ScalarType scalar_type() const { return type_; }
  bool is_contiguous() const { return true; }

 private:
  std::vector<int64_t> sizes_;
  ScalarType type_ = ScalarType::Double;
  std::shared_ptr<void> memory_;
};

inline Tensor new_zeros(const Tensor& like, std::vector<int64_t> sizes) { return {sizes, like.scalar_type(), 0}; }

inline int64_t threads = 1;

// As at::parallel_for cuts a range, but for its grain: every range is cut, if only in ranges of one.
template <class Body>
void parallel_for(int64_t begin, int64_t end, int64_t, const Body& body) {
  const int64_t each = (end - begin + threads - 1) / threads;
  std::vector<std::thread> running;
  for (int64_t first = begin; first < end; first += each)
    running.emplace_back([&body, first, last = first + each < end ? first + each : end] { body(first, last); });
  for (std::thread& one : running) one.join();
}

}  // namespace torch::stable

using AtenTensorHandle = torch::stable::Tensor;
inline int32_t aoti_torch_dtype_float64() { return int32_t(torch::headeronly::ScalarType::Double); }
inline int32_t aoti_torch_dtype_float32() { return int32_t(torch::headeronly::ScalarType::Float); }
inline int32_t aoti_torch_dtype_int64() { return int32_t(torch::headeronly::ScalarType::Long); }
inline int32_t aoti_torch_device_type_cpu() { return 0; }
inline void aoti_torch_empty_strided(
    int64_t dim, const int64_t* sizes, const int64_t*, int32_t type, int32_t, int32_t, AtenTensorHandle* made) {
  *made = {std::vector<int64_t>(sizes, sizes + dim), torch::headeronly::ScalarType(type)};
}
