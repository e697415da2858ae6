// EXPECT counts and reports what does not hold; a test program returns `verdict()`.
#pragma once

#include <cstdio>
#include <cstdlib>

inline int failures = 0;

#define EXPECT(condition)                                                        \
  do {                                                                           \
    if (!(condition)) {                                                          \
      std::fprintf(stderr, "%s:%d: not %s\n", __FILE__, __LINE__, #condition);   \
      ++failures;                                                                \
    }                                                                            \
  } while (false)

inline int verdict() {
  if (failures) std::fprintf(stderr, "%d failures\n", failures);
  return failures ? EXIT_FAILURE : EXIT_SUCCESS;
}
