/* What both programs in C have in common. */

#ifndef PARTNER_H
#define PARTNER_H

#include <fipa.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static inline fipa_text text(const char *text) {
  return (fipa_text){(const uint8_t *)text, strlen(text)};
}

static inline fipa_bytes bytes(const char *text) {
  return (fipa_bytes){(const uint8_t *)text, strlen(text)};
}

/* Copies a text of the library, which need not end with NUL, to one that does. */
static inline const char *copy(char *into, size_t size, const uint8_t *data, size_t len) {
  snprintf(into, size, "%.*s", (int)len, (const char *)data);
  return into;
}

/* Ends the program if a call has failed. */
static inline void must(fipa_result result) {
  if (result != FIPA_RESULT_OK) {
    fipa_text why = fipa_error();
    fprintf(stderr, "failed (%d): %.*s\n", (int)result, (int)why.len, (const char *)why.data);
    exit(1);
  }
}

static inline const char *kind(fipa_result result) {
  static const char *const kinds[] = {
      "OK",      "Invalid",   "BadHandle", "Closed", "Forked",   "TimedOut",  "NotDelivered", "Refused",
      "Gone",    "Cancelled", "Violation", "Lost",   "TooLarge", "NameTaken", "Stale",        "Failed",
  };
  return result <= 0 && result >= FIPA_RESULT_FAILED ? kinds[-result] : "Panic";
}

#endif
