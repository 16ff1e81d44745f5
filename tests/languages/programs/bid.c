/* A carrier in C, which bids its distance from a crate. Usage: bid NAME X Y */

#include <math.h>

#include "partner.h"

enum { CALLS = 1, REPLIES };

/* A carrier refuses a crate that is farther away. */
static const double reach = 6.0;

static const char *name;
static double own_x, own_y;

static void say(const char *what) {
  puts(what);
  fflush(stdout);
}

/* Answers a call. The decision on a proposal is an item. */
static void bid(fipa_handle task) {
  fipa_bytes content;
  char text[64];
  double x = 0, y = 0, distance;
  must(fipa_read_content(task, &content));
  sscanf(copy(text, sizeof text, content.data, content.len), "{ \"x\" : %lf , \"y\" : %lf }", &x, &y);
  distance = hypot(x - own_x, y - own_y);
  if (distance > reach) {
    say("refused");
    must(fipa_begin_task_reply(task, FIPA_REPLY_REFUSE, bytes("too far"), REPLIES));
    must(fipa_close(task));
    return;
  }
  snprintf(text, sizeof text, "{\"distance\": %f}", distance);
  must(fipa_begin_task_reply(task, FIPA_REPLY_PROPOSE, bytes(text), REPLIES));
}

static void decided(fipa_handle task, int accepted) {
  char done[64];
  say(accepted ? "accepted" : "rejected");
  if (accepted) {
    snprintf(done, sizeof done, "carried by %s", name);
    must(fipa_begin_task_reply(task, FIPA_REPLY_INFORM, bytes(done), REPLIES));
  }
  must(fipa_close(task));
}

int main(int argc, char **argv) {
  fipa_handle domain, agent, server;
  if (argc != 4) return 2;
  name = argv[1];
  own_x = atof(argv[2]);
  own_y = atof(argv[3]);
  must(fipa_open(NULL, &domain));
  must(fipa_register(domain, text(name), NULL, &agent));
  must(fipa_serve(agent, text("fipa-contract-net"), CALLS, &server));
  say("ready");
  for (;;) {
    fipa_item item = {.size = sizeof item};
    must(fipa_next(domain, -1, &item));
    if (item.kind == FIPA_EVENT_TASK) {
      bid(item.handle);
    } else if (item.kind == FIPA_EVENT_DECISION) {
      decided(item.handle, item.number == 1);
    }
  }
}
