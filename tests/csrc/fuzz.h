// What the fuzzers share: bytes as sizes and numbers, and a test of theirs with every instruction set.
// Built by clang with -fsanitize=fuzzer they are fuzzers (tests/README.md). With -DREPLAY=N they play N random inputs.
#pragma once

#include <algorithm>
#include <cstdio>
#include <random>
#include <vector>

#include "../../csrc/philox.h"

using Numbers = std::vector<double>;
#define EXPECT(condition) \
  if (!(condition)) std::fprintf(stderr, "%s:%d: not %s\n", __FILE__, __LINE__, #condition), std::abort()

struct Bytes {
  const uint8_t* data;
  size_t size;
  bool wild = false;  // numbers of any bits were given
  template <class T>
  T take() {
    T x{};
    const size_t count = std::min(sizeof x, size);
    if (count) std::memcpy(&x, data, count);
    data += count, size -= count;
    return x;
  }
  int64_t up_to(int64_t most) { return take<uint16_t>() % (most + 1); }
  Numbers numbers(int64_t count, int64_t most = 4) {  // in (-1, 1), but for some of any bits
    Numbers out(size_t(count + 1));
    zerohess::uniforms(take<uint8_t>(), 0, zerohess::kPicks, 0, (count + 1) / 2, out.data());
    out.resize(size_t(count));
    for (double& one : out) one = 2.0 * one - 1.0;
    for (int64_t given = count ? up_to(most) : 0; given > 0; --given, wild = true)
      out[size_t(up_to(count - 1))] = take<double>();
    return out;
  }
};

inline bool same(double a, double b) { return a == b || (a != a && b != b); }
template <class T>
bool same(const std::vector<T>& a, const std::vector<T>& b) {
  return std::equal(a.begin(), a.end(), b.begin(), b.end(), [](T p, T q) { return same(double(p), double(q)); });
}

// A sum in the precision of T is within rounding of the exact one, and not finite where a term is not.
template <class T, class Term>
void check_sum(T got, int64_t terms, bool wild, const Term& term) {
  long double exact = 0.0, size = 0.0;
  for (int64_t k = 0; k < terms; ++k) exact += term(k), size += std::fabs(term(k));
  const bool near = std::fabs(got - exact) <= double(terms + 3) * (std::numeric_limits<T>::epsilon() / 2) * size;
  EXPECT(wild ? std::isfinite(size) || !std::isfinite(got) : near);
}

// One of the tests, chosen by the first byte. It returns the same numbers with every instruction set.
template <size_t count>
int play(Numbers (*const (&tests)[count])(Bytes), const uint8_t* data, size_t size) {
  Numbers first;
  for (int set = zerohess::kBaseline; size && set <= zerohess::best_instructions(); ++set) {
    zerohess::instructions = zerohess::Instructions(set);
    const Numbers got = tests[data[0] % count]({data + 1, size - 1});
    EXPECT(set == zerohess::kBaseline || same(got, first));
    first = got;
  }
  return 0;
}

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);

#ifdef REPLAY
int main() {
  std::mt19937 generator(0);
  for (int run = 0; run < REPLAY; ++run) {
    std::vector<uint8_t> bytes(generator() % 200);
    for (uint8_t& one : bytes) one = uint8_t(generator());
    LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
  }
}
#endif
