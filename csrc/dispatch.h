// One source, compiled for several instruction sets; the best one that the processor has is chosen when the library
// loads. Without contraction and reassociation all of them return the same bits.
#pragma once

#include <cstdlib>
#include <cstring>

#if defined(_MSC_VER)
#define ZH_INLINE static __forceinline
#else
#define ZH_INLINE static inline __attribute__((always_inline))  // also into functions made for one instruction set
#endif

#if defined(__x86_64__) && defined(__GNUC__)
#define ZH_X86 1
#define ZH_AVX2 __attribute__((target("avx2")))
#if defined(__clang__)
#define ZH_AVX512 __attribute__((target("avx512f,avx512bw,avx512dq,avx512vl")))
#else
#define ZH_AVX512 __attribute__((target("avx512f,avx512bw,avx512dq,avx512vl,prefer-vector-width=512")))
#endif
#else
#define ZH_X86 0
#endif

// GCC 12 warns of the undefined operands inside its own intrinsics.
#if defined(__GNUC__) && !defined(__clang__)
#define ZH_IGNORE_UNINITIALIZED \
  _Pragma("GCC diagnostic push") _Pragma("GCC diagnostic ignored \"-Wuninitialized\"") \
      _Pragma("GCC diagnostic ignored \"-Wmaybe-uninitialized\"")
#define ZH_END_IGNORE _Pragma("GCC diagnostic pop")
#else
#define ZH_IGNORE_UNINITIALIZED
#define ZH_END_IGNORE
#endif

namespace zerohess {

enum Instructions { kBaseline, kAvx2, kAvx512 };

inline Instructions best_instructions() {
#if ZH_X86
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl"))
    return kAvx512;
  if (__builtin_cpu_supports("avx2")) return kAvx2;
#endif
  return kBaseline;
}

// The environment can ask for fewer instructions than the processor has, not for more.
inline Instructions chosen_instructions() {
  const Instructions best = best_instructions();
  const char* wanted = std::getenv("TORCH_ZEROHESS_INSTRUCTIONS");
  if (!wanted) return best;
  if (std::strcmp(wanted, "baseline") == 0) return kBaseline;
  if (std::strcmp(wanted, "avx2") == 0 && best > kAvx2) return kAvx2;
  return best;
}

inline Instructions instructions = chosen_instructions();  // constant after loading, except in tests

// Defines `name` from `name_generic`, a ZH_INLINE function of the same parameters.
#if ZH_X86
#define ZH_VERSIONS(result, name, parameters, arguments)                                  \
  ZH_AVX512 static inline result name##_avx512 parameters { return name##_generic arguments; } \
  ZH_AVX2 static inline result name##_avx2 parameters { return name##_generic arguments; }     \
  ZH_DISPATCH(result, name, parameters, arguments)
#define ZH_DISPATCH(result, name, parameters, arguments)         \
  static inline result name parameters {                         \
    if (instructions == kAvx512) return name##_avx512 arguments; \
    if (instructions == kAvx2) return name##_avx2 arguments;     \
    return name##_generic arguments;                             \
  }
#else
#define ZH_VERSIONS(result, name, parameters, arguments) \
  static inline result name parameters { return name##_generic arguments; }
#define ZH_DISPATCH ZH_VERSIONS
#endif

}  // namespace zerohess
