/* Several threads begin operations, take items and close handles of one domain. Each item comes once, and a letter
 * arrives exactly if its outcome says so: the queue of the receiver may be full. */

#include <pthread.h>

#include "check.h"

enum { SENDERS = 2, TAKERS = 3, EACH = 3000 };

static fipa_handle domain, rover, arm;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int letters[SENDERS * EACH], outcomes, delivered;

static void *send_all(void *argument) {
  int sender = *(int *)argument;
  fipa_text to = text("arm");
  char number[16];
  for (int i = 0; i < EACH; i++) {
    fipa_message it;
    snprintf(number, sizeof number, "%d", sender * EACH + i);
    it = message("inform", &to, number);
    OK(fipa_begin_send(rover, &it, LONG, 2));
  }
  return NULL;
}

static int is_complete(void) {
  int sum = 0;
  CHECK(pthread_mutex_lock(&lock) == 0);
  for (int i = 0; i < SENDERS * EACH; i++) {
    CHECK(letters[i] <= 1);
    sum += letters[i];
  }
  CHECK(outcomes < SENDERS * EACH || sum <= delivered);
  sum = outcomes == SENDERS * EACH && sum == delivered;
  CHECK(pthread_mutex_unlock(&lock) == 0);
  return sum;
}

static void *take_all(void *argument) {
  (void)argument;
  while (!is_complete()) {
    fipa_item item;
    fipa_bytes content;
    char number[16] = {0};
    memset(&item, 0, sizeof item);
    item.size = sizeof item;
    if (fipa_next(domain, 50, &item) == FIPA_RESULT_EMPTY) {
      continue;
    }
    CHECK(item.result == FIPA_RESULT_OK || has(fipa_error(), "queue full"));
    CHECK(pthread_mutex_lock(&lock) == 0);
    if (item.kind == FIPA_EVENT_LETTER) {
      OK(fipa_read_content(item.handle, &content));
      CHECK(content.len < sizeof number);
      memcpy(number, content.data, content.len);
      letters[atoi(number)]++;
    } else {
      CHECK(item.kind == FIPA_EVENT_OUTCOMES);
      outcomes++;
      delivered += item.result == FIPA_RESULT_OK;
    }
    CHECK(pthread_mutex_unlock(&lock) == 0);
    OK(fipa_close(item.handle));
  }
  return NULL;
}

int main(int argc, char **argv) {
  fipa_domain_options options;
  fipa_handle listening;
  pthread_t threads[SENDERS + TAKERS];
  int numbers[SENDERS];
  CHECK(argc == 3);
  memset(&options, 0, sizeof options);
  options.size = sizeof options;
  options.config = text(argv[1]);
  OK(fipa_open(&options, &domain));
  OK(fipa_register(domain, text("rover"), NULL, &rover));
  OK(fipa_register(domain, text("arm"), NULL, &arm));
  OK(fipa_listen(arm, 1, &listening));
  for (int i = 0; i < SENDERS; i++) {
    numbers[i] = i;
    CHECK(pthread_create(&threads[i], NULL, send_all, &numbers[i]) == 0);
  }
  for (int i = 0; i < TAKERS; i++) {
    CHECK(pthread_create(&threads[SENDERS + i], NULL, take_all, NULL) == 0);
  }
  for (int i = 0; i < SENDERS + TAKERS; i++) {
    CHECK(pthread_join(threads[i], NULL) == 0);
  }
  CHECK(delivered > 0);
  OK(fipa_close(listening));
  OK(fipa_close(domain));
  puts("all steps passed");
  return 0;
}
