// The normal quantile in single precision. Literal reference: torch_zerohess/sampling/single.py.
#pragma once

#include "quantiles.h"

namespace zerohess {

constexpr int kDegree = 7;
constexpr uint32_t kTail = 1u << 15;          // of 2^32: words with less probability beyond them are in a tail
constexpr float kBelowHalf = 0x1.fffffep+30f;  // 2^32 / 2 rounded down
// By powers of t - 1.5 from the highest down, then by the last four bits of the exponent.
alignas(64) constexpr float kRatio[kDegree + 1][16] = {
    {-1.0336775e-12f, -1.0655313e-12f, -1.1003568e-12f, -1.138612e-12f,
     -1.180843e-12f, -1.2276943e-12f, -1.2799057e-12f, -1.3382724e-12f,
     -1.4035168e-12f, -1.4759611e-12f, -1.5548014e-12f, -1.6367281e-12f,
     -1.7139254e-12f, -1.7307925e-12f, -9.774152e-13f, -1.0044125e-12f},
    {1.7356347e-12f, 1.790429e-12f, 1.8504855e-12f, 1.9166402e-12f,
     1.9898933e-12f, 2.0714212e-12f, 2.162561e-12f, 2.2647034e-12f,
     2.3789844e-12f, 2.5055264e-12f, 2.6418054e-12f, 2.7796053e-12f,
     2.9008898e-12f, 3.0957368e-12f, 1.6391616e-12f, 1.6854059e-12f},
    {-2.609691e-12f, -2.6941383e-12f, -2.7868922e-12f, -2.8892945e-12f,
     -3.0029423e-12f, -3.1296962e-12f, -3.2716134e-12f, -3.4306945e-12f,
     -3.6082036e-12f, -3.8030998e-12f, -4.0088406e-12f, -4.207852e-12f,
     -4.361967e-12f, -4.0775664e-12f, -2.4614293e-12f, -2.5324317e-12f},
    {4.990207e-12f, 5.155071e-12f, 5.336452e-12f, 5.5370365e-12f,
     5.759995e-12f, 6.0089516e-12f, 6.2877464e-12f, 6.5997004e-12f,
     6.945801e-12f, 7.3207725e-12f, 7.70571e-12f, 8.057599e-12f,
     8.317269e-12f, 9.366958e-12f, 4.701422e-12f, 4.839615e-12f},
    {-1.0233195e-11f, -1.0581769e-11f, -1.09662375e-11f, -1.1392474e-11f,
     -1.1867286e-11f, -1.2398149e-11f, -1.2992225e-11f, -1.3653838e-11f,
     -1.43788054e-11f, -1.5143286e-11f, -1.5884722e-11f, -1.647064e-11f,
     -1.6569164e-11f, -1.3059587e-11f, -9.624754e-12f, -9.9155675e-12f},
    {2.359844e-11f, 2.4443114e-11f, 2.5378312e-11f, 2.641849e-11f,
     2.7579331e-11f, 2.887559e-11f, 3.0315823e-11f, 3.1891354e-11f,
     3.3556328e-11f, 3.5199087e-11f, 3.662262e-11f, 3.7621514e-11f,
     3.8633454e-11f, 4.6991317e-11f, 2.2132365e-11f, 2.2831733e-11f},
    {-7.4849786e-11f, -7.781025e-11f, -8.1080496e-11f, -8.4680006e-11f,
     -8.860243e-11f, -9.278845e-11f, -9.708155e-11f, -1.0116221e-10f,
     -1.04460635e-10f, -1.0605462e-10f, -1.0454799e-10f, -9.7797784e-11f,
     -8.162167e-11f, -4.1000866e-11f, -6.973652e-11f, -7.216926e-11f},
    {1.8218118e-9f, 1.7424755e-9f, 1.6599023e-9f, 1.5737588e-9f,
     1.4837025e-9f, 1.3894226e-9f, 1.2907152e-9f, 1.1876177e-9f,
     1.0806211e-9f, 9.709831e-10f, 8.6115337e-10f, 7.553805e-10f,
     6.6097566e-10f, 5.93512e-10f, 1.9719697e-9f, 1.8982185e-9f},
};

ZH_INLINE uint32_t float_bits(float x) {
  uint32_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  return bits;
}

ZH_INLINE float float_from_bits(uint32_t bits) {
  float x;
  std::memcpy(&x, &bits, sizeof x);
  return x;
}

// The smaller of a word and its complement: 2^32 times the probability beyond it, less 1/2.
ZH_INLINE uint32_t mirrored(uint32_t word) { return word ^ (0u - (word >> 31)); }

// Quantile of p = (word + 1/2) / 2^32: (1/2 - p) times a ratio that is a polynomial in each octave 2^e t of p, 1 <= t < 2.
ZH_INLINE float central_quantile(uint32_t word, uint32_t beyond) {
  const float size = float(int32_t(beyond)) + 0.5f;
  const uint32_t bits = float_bits(size < kBelowHalf ? size : kBelowHalf), octave = bits >> 23 & 15;
  const float t = float_from_bits((bits & 0x007FFFFFu) | 0x3F800000u) - 1.5f;
  float ratio = kRatio[0][octave];
  for (int i = 1; i <= kDegree; ++i) ratio = ratio * t + kRatio[i][octave];
  const float u = (float(int32_t(beyond ^ 0x7FFFFFFFu)) + 0.5f) * ratio;
  return float_from_bits(float_bits(u) ^ (~word & 0x80000000u));
}

// Quantiles of words, wrong in the tails. Returns the least of `mirrored`, or `least`.
ZH_INLINE uint32_t central_quantiles_generic(const uint32_t* words, int64_t count, float* out, uint32_t least) {
  for (int64_t i = 0; i < count; ++i) {
    const uint32_t beyond = mirrored(words[i]);
    out[i] = central_quantile(words[i], beyond);
    least = beyond < least ? beyond : least;
  }
  return least;
}

#if ZH_X86
ZH_IGNORE_UNINITIALIZED
ZH_AVX512 static inline uint32_t central_quantiles_avx512(
    const uint32_t* words, int64_t count, float* out, uint32_t least) {
  __m512 table[kDegree + 1];
  for (int i = 0; i <= kDegree; ++i) table[i] = _mm512_load_ps(kRatio[i]);
  const __m512 half = _mm512_set1_ps(0.5f), most = _mm512_set1_ps(kBelowHalf), middle = _mm512_set1_ps(1.5f);
  const __m512i fraction = _mm512_set1_epi32(0x007FFFFF), one = _mm512_set1_epi32(0x3F800000);
  const __m512i inner = _mm512_set1_epi32(0x7FFFFFFF);
  __m512i smallest = inner;
  int64_t i = 0;
  for (; i + 16 <= count; i += 16) {
    const __m512i word = _mm512_loadu_si512(words + i);
    const __m512i beyond = _mm512_xor_si512(word, _mm512_srai_epi32(word, 31));
    smallest = _mm512_min_epu32(smallest, beyond);
    const __m512i bits = _mm512_castps_si512(_mm512_min_ps(_mm512_add_ps(_mm512_cvtepi32_ps(beyond), half), most));
    const __m512i octave = _mm512_srli_epi32(bits, 23);  // the permutation reads its last four bits
    const __m512i scaled = _mm512_ternarylogic_epi32(bits, fraction, one, 0xEA);  // (bits & fraction) | one
    const __m512 t = _mm512_sub_ps(_mm512_castsi512_ps(scaled), middle);
    __m512 ratio = _mm512_permutexvar_ps(octave, table[0]);
#pragma GCC unroll 8
    for (int k = 1; k <= kDegree; ++k)
      ratio = _mm512_add_ps(_mm512_mul_ps(ratio, t), _mm512_permutexvar_ps(octave, table[k]));
    const __m512 q = _mm512_add_ps(_mm512_cvtepi32_ps(_mm512_xor_si512(beyond, inner)), half);
    const __m512i u = _mm512_castps_si512(_mm512_mul_ps(q, ratio));
    _mm512_storeu_si512(out + i, _mm512_ternarylogic_epi32(u, word, inner, 0xE1));  // u ^ (~word & ~inner)
  }
  const uint32_t found = _mm512_reduce_min_epu32(smallest);
  return central_quantiles_generic(words + i, count - i, out + i, found < least ? found : least);
}

ZH_AVX2 static inline uint32_t central_quantiles_avx2(
    const uint32_t* words, int64_t count, float* out, uint32_t least) {
  __m256 table[kDegree + 1];  // the octaves of 1/256 < p, for all but one number in 128
  for (int i = 0; i <= kDegree; ++i) table[i] = _mm256_load_ps(kRatio[i] + 8);
  const __m256 half = _mm256_set1_ps(0.5f), most = _mm256_set1_ps(kBelowHalf), middle = _mm256_set1_ps(1.5f);
  const __m256i fraction = _mm256_set1_epi32(0x007FFFFF), one = _mm256_set1_epi32(0x3F800000);
  const __m256i inner = _mm256_set1_epi32(0x7FFFFFFF);
  __m256i smallest = inner;
  int64_t i = 0;
  for (; i + 8 <= count; i += 8) {
    const __m256i word = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(words + i));
    const __m256i beyond = _mm256_xor_si256(word, _mm256_srai_epi32(word, 31));
    smallest = _mm256_min_epu32(smallest, beyond);
    const __m256i bits = _mm256_castps_si256(_mm256_min_ps(_mm256_add_ps(_mm256_cvtepi32_ps(beyond), half), most));
    const __m256i octave = _mm256_srli_epi32(bits, 23);
    const __m256 t =
        _mm256_sub_ps(_mm256_castsi256_ps(_mm256_or_si256(_mm256_and_si256(bits, fraction), one)), middle);
    __m256 ratio = _mm256_permutevar8x32_ps(table[0], octave);  // reads the last three bits of the octave
#pragma GCC unroll 8
    for (int k = 1; k <= kDegree; ++k)
      ratio = _mm256_add_ps(_mm256_mul_ps(ratio, t), _mm256_permutevar8x32_ps(table[k], octave));
    const __m256 q = _mm256_add_ps(_mm256_cvtepi32_ps(_mm256_xor_si256(beyond, inner)), half);
    const __m256 sign = _mm256_castsi256_ps(_mm256_andnot_si256(_mm256_or_si256(word, inner), _mm256_set1_epi32(-1)));
    _mm256_storeu_ps(out + i, _mm256_xor_ps(_mm256_mul_ps(q, ratio), sign));
    int others = _mm256_movemask_ps(_mm256_castsi256_ps(_mm256_slli_epi32(bits, 5))) ^ 0xFF;  // without bit 3
    for (; others != 0; others &= others - 1) {
      const int64_t k = i + __builtin_ctz(unsigned(others));
      out[k] = central_quantile(words[k], mirrored(words[k]));
    }
  }
  alignas(32) uint32_t found[8];
  _mm256_store_si256(reinterpret_cast<__m256i*>(found), smallest);
  for (const uint32_t one : found) least = one < least ? one : least;
  return central_quantiles_generic(words + i, count - i, out + i, least);
}
ZH_END_IGNORE
#endif
ZH_DISPATCH(
    uint32_t, central_quantiles, (const uint32_t* words, int64_t count, float* out, uint32_t least),
    (words, count, out, least))

// Quantiles of count words. A tail, one number in 65536, is computed in double precision and rounded.
inline void normal_quantiles(const uint32_t* words, int64_t count, float* out) {
  if (central_quantiles(words, count, out, 0xFFFFFFFFu) >= kTail) return;
  for (int64_t i = 0; i < count; ++i)
    if (mirrored(words[i]) < kTail) out[i] = float(tail_quantile((double(words[i]) + 0.5) * 0x1p-32));
}

}  // namespace zerohess
