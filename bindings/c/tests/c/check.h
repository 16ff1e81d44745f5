/* Checks for the programs of the tests. */

#ifndef CHECK_H
#define CHECK_H

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fipa.h"

#define CHECK(condition)                                                                          \
  do {                                                                                            \
    if (!(condition)) {                                                                           \
      fipa_text why = fipa_error();                                                               \
      fprintf(stderr, "%s:%d: not so: %s (last failure: %.*s)\n", __FILE__, __LINE__, #condition, \
              (int)why.len, (const char *)why.data);                                              \
      exit(1);                                                                                    \
    }                                                                                             \
  } while (0)

#define OK(call) CHECK((call) == FIPA_RESULT_OK)

/* Time after which a step of a test has failed, in milliseconds. */
#define LONG 60000

static inline fipa_text text(const char *text) {
  fipa_text it = {(const uint8_t *)text, strlen(text)};
  return it;
}

static inline fipa_bytes bytes(const char *text) {
  fipa_bytes it = {(const uint8_t *)text, strlen(text)};
  return it;
}

static inline int is(fipa_text it, const char *expected) {
  return it.len == strlen(expected) && memcmp(it.data, expected, it.len) == 0;
}

static inline int has(fipa_text it, const char *part) {
  size_t len = strlen(part);
  for (size_t at = 0; at + len <= it.len; at++) {
    if (memcmp(it.data + at, part, len) == 0) {
      return 1;
    }
  }
  return 0;
}

static inline int content_is(fipa_handle letter, const char *expected) {
  fipa_bytes content;
  OK(fipa_read_content(letter, &content));
  return content.len == strlen(expected) && memcmp(content.data, expected, content.len) == 0;
}

static inline fipa_message message(const char *performative, const fipa_text *to,
                                   const char *content) {
  fipa_message it;
  memset(&it, 0, sizeof it);
  it.size = sizeof it;
  it.performative = text(performative);
  it.receivers = to;
  it.receiver_count = to == NULL ? 0 : 1;
  if (content != NULL) {
    it.content = bytes(content);
  }
  return it;
}

/* Takes the next item, which must be of this kind and tag. */
static inline fipa_item next(fipa_handle domain, uint64_t tag, int32_t kind) {
  fipa_item item;
  memset(&item, 0, sizeof item);
  item.size = sizeof item;
  OK(fipa_next(domain, LONG, &item));
  if (item.tag != tag || item.kind != kind) {
    fprintf(stderr, "an item of kind %d and tag %d came, and not of kind %d and tag %d\n", (int)item.kind,
            (int)item.tag, (int)kind, (int)tag);
    exit(1);
  }
  return item;
}

/* Takes two items, which come in any order, also with progress between them: returns the one of the first kind; the
   other has no handle. */
static inline fipa_item both(fipa_handle domain, uint64_t tag, int32_t kind, uint64_t other_tag,
                             int32_t other) {
  fipa_item items[2], wanted;
  memset(items, 0, sizeof items);
  for (int i = 0; i < 2; i++) {
    items[i].size = sizeof *items;
    OK(fipa_next(domain, LONG, &items[i]));
    if (items[i].kind == FIPA_EVENT_PROGRESS) {
      OK(fipa_close(items[i].handle));
      i--;
    }
  }
  wanted = items[0].kind == kind ? items[0] : items[1];
  CHECK(wanted.kind == kind && wanted.tag == tag);
  wanted = items[0].kind == kind ? items[1] : items[0];
  CHECK(wanted.kind == other && wanted.tag == other_tag && wanted.result == FIPA_RESULT_OK);
  return items[0].kind == kind ? items[0] : items[1];
}

static inline int is_empty(fipa_handle domain) {
  fipa_item item;
  memset(&item, 0, sizeof item);
  item.size = sizeof item;
  return fipa_next(domain, 0, &item) == FIPA_RESULT_EMPTY;
}

#endif
