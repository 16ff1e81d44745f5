/* An operator in C, which has crates carried. Usage: call NAME
 *
 * The position of a crate is a line of the standard input. The operator prints the proposals of the carriers, and
 * awards the nearest one after a further line.
 */

#include "partner.h"

enum { CALLING = 1, AWARDING, LONG = 60000, MOST = 16 };

struct proposal {
  double distance;
  size_t index;
  char sender[64];
};

static fipa_handle domain, agent;

static fipa_item next(void) {
  fipa_item item = {.size = sizeof item};
  must(fipa_next(domain, -1, &item));
  return item;
}

static struct proposal read_proposal(fipa_handle bids, size_t index) {
  struct proposal proposal = {.index = index};
  fipa_message message = {.size = sizeof message};
  fipa_handle letter;
  char text[64];
  must(fipa_read_bid(bids, index, &letter));
  must(fipa_read_message(letter, &message));
  copy(proposal.sender, sizeof proposal.sender, message.sender.data, message.sender.len);
  copy(text, sizeof text, message.content.data, message.content.len);
  sscanf(text, "{ \"distance\" : %lf }", &proposal.distance);
  must(fipa_close(letter));
  return proposal;
}

static int compare(const void *one, const void *other) {
  double a = ((const struct proposal *)one)->distance, b = ((const struct proposal *)other)->distance;
  return (a > b) - (a < b);
}

/* Returns the number of refusals among the other answers, which are in JSON. */
static int refusals(fipa_handle bids) {
  fipa_text others;
  char all[4096];
  int count = 0;
  must(fipa_read_text(bids, &others));
  copy(all, sizeof all, others.data, others.len);
  for (const char *at = all; (at = strstr(at, "\"reason\":")) != NULL; at++) count++;
  return count;
}

/* Accepts the nearest proposal, if there is one, and prints its result. */
static void award(fipa_handle bids, const struct proposal *nearest) {
  fipa_item item;
  must(fipa_award(bids, nearest ? &nearest->index : NULL, nearest != NULL, bytes(""), -1, AWARDING));
  for (item = next(); item.kind == FIPA_EVENT_AWARDED; item = next()) {
    fipa_bytes result = bytes(kind(item.result));
    if (item.handle != 0) must(fipa_read_content(item.handle, &result));
    printf("%s: %.*s\n", nearest->sender, (int)result.len, (const char *)result.data);
    if (item.handle != 0) must(fipa_close(item.handle));
  }
  must(item.result);
  fflush(stdout);
}

static void call(double x, double y) {
  char crate[64], line[64];
  fipa_text carriers = text("carrier_.*");
  fipa_message message = {.size = sizeof message, .receivers = &carriers, .receiver_count = 1};
  struct proposal proposals[MOST];
  fipa_handle operation;
  fipa_item item;
  snprintf(crate, sizeof crate, "{\"x\": %f, \"y\": %f}", x, y);
  message.language = text("json");
  message.content = bytes(crate);
  must(fipa_begin_call(agent, &message, LONG, CALLING, &operation));
  item = next();
  must(item.result);
  size_t count = item.number < MOST ? (size_t)item.number : MOST;
  for (size_t index = 0; index < count; index++) proposals[index] = read_proposal(item.handle, index);
  qsort(proposals, count, sizeof *proposals, compare);
  for (size_t at = 0; at < count; at++) printf("%s at %.1f\n", proposals[at].sender, proposals[at].distance);
  printf("%d refused\n", refusals(item.handle));
  fflush(stdout);
  if (fgets(line, sizeof line, stdin) != NULL) award(item.handle, count > 0 ? proposals : NULL);
  must(fipa_close(item.handle));
  must(fipa_close(operation));
}

int main(int argc, char **argv) {
  char position[64];
  double x, y;
  if (argc != 2) return 2;
  must(fipa_open(NULL, &domain));
  must(fipa_register(domain, text(argv[1]), NULL, &agent));
  puts("ready");
  fflush(stdout);
  while (fgets(position, sizeof position, stdin) != NULL) {
    if (sscanf(position, "%lf %lf", &x, &y) == 2) call(x, y);
  }
  must(fipa_close(domain));
  return 0;
}
