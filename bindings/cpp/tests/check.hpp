/* Checks for the programs of the tests. */

#ifndef CHECK_HPP
#define CHECK_HPP

#include <cstdio>
#include <cstdlib>
#include <string>
#include <string_view>

#include "fipa.hpp"

#define CHECK(condition)                                                                 \
  do {                                                                                   \
    if (!(condition)) {                                                                  \
      const fipa_text why = fipa_error();                                                \
      std::fprintf(stderr, "%s:%d: not so: %s (last failure: %.*s)\n", __FILE__, __LINE__, \
                   #condition, static_cast<int>(why.len),                                \
                   reinterpret_cast<const char*>(why.data));                             \
      std::exit(1);                                                                      \
    }                                                                                    \
  } while (0)

/* Time after which a step of a test has failed. */
inline constexpr auto step = std::chrono::seconds(60);

inline bool has(std::string_view text, std::string_view part) {
  return text.find(part) != std::string_view::npos;
}

/* Takes the value of a result, which must not be a failure. */
template <class T>
T take(fipa::result<T> result) {
  if (!result) {
    std::fprintf(stderr, "failed: %s\n", result.error().text().c_str());
    std::exit(1);
  }
  return *std::move(result);
}

/* Takes the next item, which must be of this kind and tag. */
inline fipa::item next(const fipa::domain& domain, std::uint64_t tag, fipa::event kind) {
  auto item = take(domain.next(step));
  CHECK(item);
  if (item->tag() != tag || item->kind() != kind) {
    std::fprintf(stderr, "an item of kind %d and tag %d came, and not of kind %d and tag %d\n",
                 static_cast<int>(item->kind()), static_cast<int>(item->tag()),
                 static_cast<int>(kind), static_cast<int>(tag));
    std::exit(1);
  }
  return std::move(*item);
}

#endif
