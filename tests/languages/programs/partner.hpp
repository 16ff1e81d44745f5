/* What both programs in C++ have in common. */

#ifndef PARTNER_HPP
#define PARTNER_HPP

#include <array>
#include <fipa.hpp>
#include <string>

inline std::string kind(fipa::errc code) {
  static const std::array kinds = {
      "OK",   "Invalid",   "BadHandle", "Closed", "Forked",   "TimedOut",  "NotDelivered", "Refused",
      "Gone", "Cancelled", "Violation", "Lost",   "TooLarge", "NameTaken", "Stale",        "Failed",
  };
  const auto at = static_cast<std::size_t>(-static_cast<int>(code));
  return at < kinds.size() ? kinds[at] : "Panic";
}

#endif
