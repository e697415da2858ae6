// Counter-based uniform noise, Philox 4x32-10 (Salmon et al. 2011). Literal reference: torch_zerohess/sampling/philox.py.
#pragma once

#include <cstdint>

#include "dispatch.h"

#if ZH_X86
#include <immintrin.h>
#endif

namespace zerohess {

constexpr int64_t kBlock = 256;  // columns worked on at a time; a multiple of 16

enum Stream : uint32_t { kDimensions = 0, kPicks = 1, kExtra = 2 };

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

// What the words of a row have in common, and the column block that they start at.
struct Counter {
  uint64_t seed, row;
  uint32_t stream, block;
};

constexpr uint32_t kMultiplier0 = 0xD2511F53u, kMultiplier1 = 0xCD9E8D57u;
constexpr uint32_t kWeyl0 = 0x9E3779B9u, kWeyl1 = 0xBB67AE85u;

// Numbers that a block of four words gives: two uniforms of type double, or the four words themselves.
template <class Out>
constexpr int64_t kPerBlock = sizeof(Out) == sizeof(double) ? 2 : 4;

// The numbers of `blocks` blocks, from the block of the counter on.
template <class Out>
ZH_INLINE void noise_generic(const Counter& at, int64_t blocks, Out* out) {
  for (int64_t i = 0; i < blocks; ++i) {
    uint32_t c0 = at.block + uint32_t(i), c1 = uint32_t(at.row), c2 = uint32_t(at.row >> 32), c3 = at.stream;
    uint32_t k0 = uint32_t(at.seed), k1 = uint32_t(at.seed >> 32);
    for (int round = 0; round < 10; ++round, k0 += kWeyl0, k1 += kWeyl1) {
      const uint64_t p0 = uint64_t(c0) * kMultiplier0, p1 = uint64_t(c2) * kMultiplier1;
      c0 = uint32_t(p1 >> 32) ^ c1 ^ k0;
      c1 = uint32_t(p1);
      c2 = uint32_t(p0 >> 32) ^ c3 ^ k1;
      c3 = uint32_t(p0);
    }
    if constexpr (sizeof(Out) == sizeof(double)) {
      out[2 * i] = uniform(c0, c1);
      out[2 * i + 1] = uniform(c2, c3);
    } else {
      out[4 * i] = c0;
      out[4 * i + 1] = c1;
      out[4 * i + 2] = c2;
      out[4 * i + 3] = c3;
    }
  }
}

#if ZH_X86
ZH_IGNORE_UNINITIALIZED
ZH_AVX512 static inline __m512d uniform_avx512(__m512i high, __m512i low) {
  const __m512i word = _mm512_set1_epi64(0xFFFFFFFF), one = _mm512_set1_epi64(0x3FF0000000000000);
  const __m512i k = _mm512_or_epi64(
      _mm512_slli_epi64(_mm512_and_epi64(high, word), 20), _mm512_srli_epi64(_mm512_and_epi64(low, word), 12));
  const __m512d from_one = _mm512_castsi512_pd(_mm512_or_epi64(k, one));
  return _mm512_add_pd(_mm512_sub_pd(from_one, _mm512_set1_pd(1.0)), _mm512_set1_pd(0x1p-53));
}

ZH_AVX2 static inline __m256d uniform_avx2(__m256i high, __m256i low) {
  const __m256i word = _mm256_set1_epi64x(0xFFFFFFFF), one = _mm256_set1_epi64x(0x3FF0000000000000);
  const __m256i k = _mm256_or_si256(
      _mm256_slli_epi64(_mm256_and_si256(high, word), 20), _mm256_srli_epi64(_mm256_and_si256(low, word), 12));
  const __m256d from_one = _mm256_castsi256_pd(_mm256_or_si256(k, one));
  return _mm256_add_pd(_mm256_sub_pd(from_one, _mm256_set1_pd(1.0)), _mm256_set1_pd(0x1p-53));
}

// Keys of all rounds, and the words of the counter that blocks have in common.
struct RoundsAvx512 {
  __m512i k0[10], k1[10], row_low, row_high, stream;
};

// 8 kSets blocks, each word in the lower half of a 64-bit lane; what the upper halves hold is not used. One set after
// another would wait for its own products.
template <int kSets, class Out>
ZH_AVX512 static inline void blocks_avx512(const RoundsAvx512& with, uint64_t block, Out* out) {
  const __m512i m0 = _mm512_set1_epi64(kMultiplier0), m1 = _mm512_set1_epi64(kMultiplier1);
  const __m512i low = _mm512_set1_epi64(0xFFFFFFFF), counted = _mm512_set_epi64(7, 6, 5, 4, 3, 2, 1, 0);
  __m512i c0[kSets], c1[kSets], c2[kSets], c3[kSets];
#pragma GCC unroll 2
  for (int set = 0; set < kSets; ++set) {
    c0[set] = _mm512_add_epi64(_mm512_set1_epi64(int64_t(block) + 8 * set), counted);
    c1[set] = with.row_low;
    c2[set] = with.row_high;
    c3[set] = with.stream;
  }
#pragma GCC unroll 10
  for (int round = 0; round < 10; ++round) {
#pragma GCC unroll 2
    for (int set = 0; set < kSets; ++set) {
      const __m512i p0 = _mm512_mul_epu32(c0[set], m0), p1 = _mm512_mul_epu32(c2[set], m1);
      c0[set] = _mm512_ternarylogic_epi64(_mm512_srli_epi64(p1, 32), c1[set], with.k0[round], 0x96);
      c1[set] = p1;
      c2[set] = _mm512_ternarylogic_epi64(_mm512_srli_epi64(p0, 32), c3[set], with.k1[round], 0x96);
      c3[set] = p0;
    }
  }
#pragma GCC unroll 2
  for (int set = 0; set < kSets; ++set) {
    Out* const to = out + 8 * kPerBlock<Out> * set;
    if constexpr (sizeof(Out) == sizeof(double)) {
      const __m512d even = uniform_avx512(c0[set], c1[set]), odd = uniform_avx512(c2[set], c3[set]);
      _mm512_storeu_pd(to, _mm512_permutex2var_pd(even, _mm512_set_epi64(11, 3, 10, 2, 9, 1, 8, 0), odd));
      _mm512_storeu_pd(to + 8, _mm512_permutex2var_pd(even, _mm512_set_epi64(15, 7, 14, 6, 13, 5, 12, 4), odd));
    } else {
      const __m512i first = _mm512_or_epi64(_mm512_and_epi64(c0[set], low), _mm512_slli_epi64(c1[set], 32));
      const __m512i second = _mm512_or_epi64(_mm512_and_epi64(c2[set], low), _mm512_slli_epi64(c3[set], 32));
      _mm512_storeu_si512(
          to, _mm512_permutex2var_epi64(first, _mm512_set_epi64(11, 3, 10, 2, 9, 1, 8, 0), second));
      _mm512_storeu_si512(
          to + 16, _mm512_permutex2var_epi64(first, _mm512_set_epi64(15, 7, 14, 6, 13, 5, 12, 4), second));
    }
  }
}

template <class Out>
ZH_AVX512 static inline void noise_avx512(const Counter& at, int64_t blocks, Out* out) {
  RoundsAvx512 with;
  for (uint32_t round = 0; round < 10; ++round) {
    with.k0[round] = _mm512_set1_epi64(uint32_t(at.seed) + round * kWeyl0);
    with.k1[round] = _mm512_set1_epi64(uint32_t(at.seed >> 32) + round * kWeyl1);
  }
  with.row_low = _mm512_set1_epi64(uint32_t(at.row));
  with.row_high = _mm512_set1_epi64(uint32_t(at.row >> 32));
  with.stream = _mm512_set1_epi64(at.stream);
  int64_t i = 0;
  for (; i + 16 <= blocks; i += 16) blocks_avx512<2>(with, at.block + i, out + kPerBlock<Out> * i);
  for (; i + 8 <= blocks; i += 8) blocks_avx512<1>(with, at.block + i, out + kPerBlock<Out> * i);
  noise_generic(Counter{at.seed, at.row, at.stream, at.block + uint32_t(i)}, blocks - i, out + kPerBlock<Out> * i);
}

// The same, four blocks at a time.
struct RoundsAvx2 {
  __m256i k0[10], k1[10], row_low, row_high, stream;
};

template <int kSets, class Out>
ZH_AVX2 static inline void blocks_avx2(const RoundsAvx2& with, uint64_t block, Out* out) {
  const __m256i m0 = _mm256_set1_epi64x(kMultiplier0), m1 = _mm256_set1_epi64x(kMultiplier1);
  const __m256i low = _mm256_set1_epi64x(0xFFFFFFFF), counted = _mm256_set_epi64x(3, 2, 1, 0);
  __m256i c0[kSets], c1[kSets], c2[kSets], c3[kSets];
#pragma GCC unroll 2
  for (int set = 0; set < kSets; ++set) {
    c0[set] = _mm256_add_epi64(_mm256_set1_epi64x(int64_t(block) + 4 * set), counted);
    c1[set] = with.row_low;
    c2[set] = with.row_high;
    c3[set] = with.stream;
  }
#pragma GCC unroll 10
  for (int round = 0; round < 10; ++round) {
#pragma GCC unroll 2
    for (int set = 0; set < kSets; ++set) {
      const __m256i p0 = _mm256_mul_epu32(c0[set], m0), p1 = _mm256_mul_epu32(c2[set], m1);
      c0[set] = _mm256_xor_si256(_mm256_xor_si256(_mm256_srli_epi64(p1, 32), c1[set]), with.k0[round]);
      c1[set] = p1;
      c2[set] = _mm256_xor_si256(_mm256_xor_si256(_mm256_srli_epi64(p0, 32), c3[set]), with.k1[round]);
      c3[set] = p0;
    }
  }
#pragma GCC unroll 2
  for (int set = 0; set < kSets; ++set) {
    Out* const to = out + 4 * kPerBlock<Out> * set;
    if constexpr (sizeof(Out) == sizeof(double)) {
      const __m256d even = uniform_avx2(c0[set], c1[set]), odd = uniform_avx2(c2[set], c3[set]);
      const __m256d first = _mm256_unpacklo_pd(even, odd), second = _mm256_unpackhi_pd(even, odd);
      _mm256_storeu_pd(to, _mm256_permute2f128_pd(first, second, 0x20));
      _mm256_storeu_pd(to + 4, _mm256_permute2f128_pd(first, second, 0x31));
    } else {
      const __m256i even = _mm256_or_si256(_mm256_and_si256(c0[set], low), _mm256_slli_epi64(c1[set], 32));
      const __m256i odd = _mm256_or_si256(_mm256_and_si256(c2[set], low), _mm256_slli_epi64(c3[set], 32));
      const __m256i first = _mm256_unpacklo_epi64(even, odd), second = _mm256_unpackhi_epi64(even, odd);
      __m256i* const place = reinterpret_cast<__m256i*>(to);
      _mm256_storeu_si256(place, _mm256_permute2x128_si256(first, second, 0x20));
      _mm256_storeu_si256(place + 1, _mm256_permute2x128_si256(first, second, 0x31));
    }
  }
}

template <class Out>
ZH_AVX2 static inline void noise_avx2(const Counter& at, int64_t blocks, Out* out) {
  RoundsAvx2 with;
  for (uint32_t round = 0; round < 10; ++round) {
    with.k0[round] = _mm256_set1_epi64x(uint32_t(at.seed) + round * kWeyl0);
    with.k1[round] = _mm256_set1_epi64x(uint32_t(at.seed >> 32) + round * kWeyl1);
  }
  with.row_low = _mm256_set1_epi64x(uint32_t(at.row));
  with.row_high = _mm256_set1_epi64x(uint32_t(at.row >> 32));
  with.stream = _mm256_set1_epi64x(at.stream);
  int64_t i = 0;
  for (; i + 8 <= blocks; i += 8) blocks_avx2<2>(with, at.block + i, out + kPerBlock<Out> * i);
  for (; i + 4 <= blocks; i += 4) blocks_avx2<1>(with, at.block + i, out + kPerBlock<Out> * i);
  noise_generic(Counter{at.seed, at.row, at.stream, at.block + uint32_t(i)}, blocks - i, out + kPerBlock<Out> * i);
}
ZH_END_IGNORE
#endif

template <class Out>
ZH_DISPATCH(void, noise, (const Counter& at, int64_t blocks, Out* out), (at, blocks, out))

// Uniforms of columns first .. first + 2 * pairs of one row; first is even.
inline void uniforms(uint64_t seed, uint64_t row, Stream stream, int64_t first, int64_t pairs, double* out) {
  noise(Counter{seed, row, stream, uint32_t(first / 2)}, pairs, out);
}

}  // namespace zerohess
