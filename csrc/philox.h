// Counter-based uniform noise, Philox 4x32-10 (Salmon et al. 2011). Literal reference: torch_zerohess/sampling/philox.py.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(_MSC_VER)
#define ZH_INLINE static __forceinline
#else
#define ZH_INLINE static inline __attribute__((always_inline))  // also into functions made for one instruction set
#endif

namespace zerohess {

constexpr int64_t kBlock = 128;  // columns worked on at a time; even, as one Philox block gives two columns

enum Stream : uint32_t { kDimensions = 0, kPicks = 1 };

ZH_INLINE double from_bits(uint64_t bits) {
  double x;
  std::memcpy(&x, &bits, sizeof x);
  return x;
}

ZH_INLINE uint64_t to_bits(double x) {
  uint64_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  return bits;
}

// (k + 1/2) / 2^52 with the 52-bit k made of two words. The double 1.k is exact, and so are both sums.
ZH_INLINE double uniform(uint32_t high, uint32_t low) {
  const uint64_t k = (uint64_t(high) << 20) | (low >> 12);
  return (from_bits(0x3FF0000000000000u | k) - 1.0) + 0x1p-53;
}

// Uniforms of columns first .. first + 2 * pairs of one row; first is even, pairs <= kBlock / 2.
ZH_INLINE void uniforms(uint64_t seed, uint64_t row, Stream stream, int64_t first, int64_t pairs, double* out) {
  uint32_t c0[kBlock / 2], c1[kBlock / 2], c2[kBlock / 2], c3[kBlock / 2];
  for (int64_t i = 0; i < pairs; ++i) {
    c0[i] = uint32_t(first / 2 + i);
    c1[i] = uint32_t(row);
    c2[i] = uint32_t(row >> 32);
    c3[i] = stream;
  }
  uint32_t k0 = uint32_t(seed), k1 = uint32_t(seed >> 32);
  for (int round = 0; round < 10; ++round, k0 += 0x9E3779B9u, k1 += 0xBB67AE85u) {
    for (int64_t i = 0; i < pairs; ++i) {
      const uint64_t p0 = uint64_t(c0[i]) * 0xD2511F53u, p1 = uint64_t(c2[i]) * 0xCD9E8D57u;
      const uint32_t high0 = uint32_t(p0 >> 32), high1 = uint32_t(p1 >> 32);
      c0[i] = high1 ^ c1[i] ^ k0;
      c1[i] = uint32_t(p1);
      c2[i] = high0 ^ c3[i] ^ k1;
      c3[i] = uint32_t(p0);
    }
  }
  for (int64_t i = 0; i < pairs; ++i) {
    out[2 * i] = uniform(c0[i], c1[i]);
    out[2 * i + 1] = uniform(c2[i], c3[i]);
  }
}

}  // namespace zerohess
