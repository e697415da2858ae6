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

// `blocks` blocks of four words: two uniforms of type double, or the four words themselves.
template <class Out>
constexpr int64_t kPerBlock = sizeof(Out) == sizeof(double) ? 2 : 4;

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

// Eight blocks at a time, each word in the lower half of a 64-bit lane; what the upper halves hold is not used.
template <class Out>
ZH_AVX512 static inline void noise_avx512(const Counter& at, int64_t blocks, Out* out) {
  const __m512i m0 = _mm512_set1_epi64(kMultiplier0), m1 = _mm512_set1_epi64(kMultiplier1);
  const __m512i low = _mm512_set1_epi64(0xFFFFFFFF);
  __m512i k0[10], k1[10];
  for (uint32_t round = 0; round < 10; ++round) {
    k0[round] = _mm512_set1_epi64(uint32_t(at.seed) + round * kWeyl0);
    k1[round] = _mm512_set1_epi64(uint32_t(at.seed >> 32) + round * kWeyl1);
  }
  const __m512i row_low = _mm512_set1_epi64(uint32_t(at.row)), row_high = _mm512_set1_epi64(uint32_t(at.row >> 32));
  int64_t i = 0;
  for (; i + 8 <= blocks; i += 8) {
    __m512i c0 = _mm512_add_epi64(_mm512_set1_epi64(at.block + i), _mm512_set_epi64(7, 6, 5, 4, 3, 2, 1, 0));
    __m512i c1 = row_low, c2 = row_high, c3 = _mm512_set1_epi64(at.stream);
#pragma GCC unroll 10
    for (int round = 0; round < 10; ++round) {
      const __m512i p0 = _mm512_mul_epu32(c0, m0), p1 = _mm512_mul_epu32(c2, m1);
      c0 = _mm512_ternarylogic_epi64(_mm512_srli_epi64(p1, 32), c1, k0[round], 0x96);
      c1 = p1;
      c2 = _mm512_ternarylogic_epi64(_mm512_srli_epi64(p0, 32), c3, k1[round], 0x96);
      c3 = p0;
    }
    if constexpr (sizeof(Out) == sizeof(double)) {
      const __m512d even = uniform_avx512(c0, c1), odd = uniform_avx512(c2, c3);
      _mm512_storeu_pd(
          out + 2 * i, _mm512_permutex2var_pd(even, _mm512_set_epi64(11, 3, 10, 2, 9, 1, 8, 0), odd));
      _mm512_storeu_pd(
          out + 2 * i + 8, _mm512_permutex2var_pd(even, _mm512_set_epi64(15, 7, 14, 6, 13, 5, 12, 4), odd));
    } else {
      const __m512i first = _mm512_or_epi64(_mm512_and_epi64(c0, low), _mm512_slli_epi64(c1, 32));
      const __m512i second = _mm512_or_epi64(_mm512_and_epi64(c2, low), _mm512_slli_epi64(c3, 32));
      _mm512_storeu_si512(
          out + 4 * i, _mm512_permutex2var_epi64(first, _mm512_set_epi64(11, 3, 10, 2, 9, 1, 8, 0), second));
      _mm512_storeu_si512(
          out + 4 * i + 16, _mm512_permutex2var_epi64(first, _mm512_set_epi64(15, 7, 14, 6, 13, 5, 12, 4), second));
    }
  }
  noise_generic(Counter{at.seed, at.row, at.stream, at.block + uint32_t(i)}, blocks - i, out + kPerBlock<Out> * i);
}

// The same, four blocks at a time.
template <class Out>
ZH_AVX2 static inline void noise_avx2(const Counter& at, int64_t blocks, Out* out) {
  const __m256i m0 = _mm256_set1_epi64x(kMultiplier0), m1 = _mm256_set1_epi64x(kMultiplier1);
  const __m256i low = _mm256_set1_epi64x(0xFFFFFFFF);
  __m256i k0[10], k1[10];
  for (uint32_t round = 0; round < 10; ++round) {
    k0[round] = _mm256_set1_epi64x(uint32_t(at.seed) + round * kWeyl0);
    k1[round] = _mm256_set1_epi64x(uint32_t(at.seed >> 32) + round * kWeyl1);
  }
  const __m256i row_low = _mm256_set1_epi64x(uint32_t(at.row)), row_high = _mm256_set1_epi64x(uint32_t(at.row >> 32));
  int64_t i = 0;
  for (; i + 4 <= blocks; i += 4) {
    __m256i c0 = _mm256_add_epi64(_mm256_set1_epi64x(at.block + i), _mm256_set_epi64x(3, 2, 1, 0));
    __m256i c1 = row_low, c2 = row_high, c3 = _mm256_set1_epi64x(at.stream);
#pragma GCC unroll 10
    for (int round = 0; round < 10; ++round) {
      const __m256i p0 = _mm256_mul_epu32(c0, m0), p1 = _mm256_mul_epu32(c2, m1);
      c0 = _mm256_xor_si256(_mm256_xor_si256(_mm256_srli_epi64(p1, 32), c1), k0[round]);
      c1 = p1;
      c2 = _mm256_xor_si256(_mm256_xor_si256(_mm256_srli_epi64(p0, 32), c3), k1[round]);
      c3 = p0;
    }
    if constexpr (sizeof(Out) == sizeof(double)) {
      const __m256d even = uniform_avx2(c0, c1), odd = uniform_avx2(c2, c3);
      const __m256d first = _mm256_unpacklo_pd(even, odd), second = _mm256_unpackhi_pd(even, odd);
      _mm256_storeu_pd(out + 2 * i, _mm256_permute2f128_pd(first, second, 0x20));
      _mm256_storeu_pd(out + 2 * i + 4, _mm256_permute2f128_pd(first, second, 0x31));
    } else {
      const __m256i even = _mm256_or_si256(_mm256_and_si256(c0, low), _mm256_slli_epi64(c1, 32));
      const __m256i odd = _mm256_or_si256(_mm256_and_si256(c2, low), _mm256_slli_epi64(c3, 32));
      const __m256i first = _mm256_unpacklo_epi64(even, odd), second = _mm256_unpackhi_epi64(even, odd);
      __m256i* place = reinterpret_cast<__m256i*>(out + 4 * i);
      _mm256_storeu_si256(place, _mm256_permute2x128_si256(first, second, 0x20));
      _mm256_storeu_si256(place + 1, _mm256_permute2x128_si256(first, second, 0x31));
    }
  }
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
