/* An arm: serves requests in an event loop, and publishes its temperature. Ends with SIGINT or SIGTERM.
 *
 *   cc arm.c $(pkg-config --cflags --libs fipa) -o arm && ./arm
 *   fipa request arm_1 crate
 */

#include <fipa.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>

enum { REQUESTS = 1 };

static volatile sig_atomic_t stopped;

static void stop(int signal) {
  (void)signal;
  stopped = 1;
}

static fipa_text text(const char *text) {
  return (fipa_text){(const uint8_t *)text, strlen(text)};
}

/* Prints why a call has failed, and returns whether it has. */
static int failed(const char *what, fipa_result result) {
  if (result >= 0) {
    return 0;
  }
  fipa_text why = fipa_error();
  fprintf(stderr, "%s: %.*s\n", what, (int)why.len, (const char *)why.data);
  return 1;
}

// ANCHOR: lift
static void lift(fipa_handle task) {
  fipa_bytes load;
  fipa_bytes done = {(const uint8_t *)"lifted", 6}, why = {(const uint8_t *)"lift what?", 10};
  failed("read", fipa_read_content(task, &load));
  if (load.len == 0) {
    failed("refuse", fipa_task_reply(task, FIPA_REPLY_REFUSE, why));
  } else {
    printf("lifting %.*s\n", (int)load.len, (const char *)load.data);
    failed("agree", fipa_task_reply(task, FIPA_REPLY_AGREE, (fipa_bytes){0}));
    failed("inform", fipa_task_reply(task, FIPA_REPLY_INFORM, done));
  }
  fipa_close(task);
}
// ANCHOR_END: lift

// ANCHOR: loop
/* Takes items until the queue is empty; the descriptor is then readable when the next one comes. */
static void take_items(fipa_handle domain) {
  fipa_item item = {.size = sizeof item};
  while (fipa_next(domain, 0, &item) == FIPA_RESULT_OK) {
    if (item.tag == REQUESTS && item.kind == FIPA_EVENT_TASK) {
      lift(item.handle);
    }
  }
}
// ANCHOR_END: loop

int main(void) {
  fipa_handle domain = 0, arm = 0, server = 0, temperature = 0;
  fipa_topic topic = {.size = sizeof topic, .name = text("temperature"), .latched = 1};
  struct pollfd waiting = {.events = POLLIN};
  struct sigaction action;
  int degrees = 20;

  memset(&action, 0, sizeof action);
  action.sa_handler = stop;
  sigaction(SIGINT, &action, NULL);
  sigaction(SIGTERM, &action, NULL);
  if (failed("join the domain", fipa_open(NULL, &domain)) ||
      failed("register", fipa_register(domain, text("arm_1"), NULL, &arm)) ||
      failed("serve", fipa_serve(arm, text("fipa-request"), REQUESTS, &server)) ||
      failed("publish", fipa_publisher(arm, &topic, &temperature)) ||
      failed("descriptor", fipa_fd(domain, &waiting.fd))) {
    return 1;
  }
  puts("arm_1 is ready");
  fflush(stdout);
  while (!stopped) {
    char reading[16];
    fipa_bytes content = {(const uint8_t *)reading, 0};
    content.len = (size_t)snprintf(reading, sizeof reading, "%d", degrees++);
    failed("publish", fipa_publish(temperature, content, NULL));
    poll(&waiting, 1, 1000);
    take_items(domain);
  }
  /* Deregisters the arm, and gives letters in transit a second. */
  return failed("close", fipa_close(domain));
}
