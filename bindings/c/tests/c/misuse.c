/* Wrong input: each call answers with an error, and the process goes on. */

#include <sys/wait.h>
#include <unistd.h>

#include "check.h"

#define REFUSED(call) CHECK((call) == FIPA_RESULT_INVALID && fipa_error().len > 0)
#define BAD(call) CHECK((call) == FIPA_RESULT_BAD_HANDLE && fipa_error().len > 0)

static void wrong_pointers(fipa_handle domain, fipa_handle agent) {
  fipa_text to = text("rover"), invalid = {(const uint8_t *)"\xff\xfe", 2}, missing = {NULL, 5};
  fipa_message sent = message("inform", &to, NULL);
  fipa_handle handle;
  fipa_item item;
  fipa_topic topic;

  REFUSED(fipa_open(NULL, NULL));
  REFUSED(fipa_register(domain, invalid, NULL, &handle));
  REFUSED(fipa_register(domain, missing, NULL, &handle));
  REFUSED(fipa_register(domain, text(""), NULL, &handle));
  REFUSED(fipa_register(domain, text("x"), NULL, NULL));
  REFUSED(fipa_register(domain, text("x"), NULL, (fipa_handle *)((char *)&handle + 1)));
  REFUSED(fipa_send(agent, NULL, -1, NULL));
  sent.size = 0;
  REFUSED(fipa_send(agent, &sent, -1, NULL));
  sent.size = (size_t)-1;
  REFUSED(fipa_send(agent, &sent, -1, NULL));
  sent = message("", &to, NULL);
  REFUSED(fipa_send(agent, &sent, -1, NULL));
  sent = message("inform", NULL, NULL);
  REFUSED(fipa_send(agent, &sent, -1, NULL));
  sent.receiver_count = 3;
  REFUSED(fipa_send(agent, &sent, -1, NULL));
  sent = message("inform", &to, NULL);
  sent.receiver_count = (size_t)-1;
  REFUSED(fipa_send(agent, &sent, -1, NULL));
  sent = message("inform", &to, NULL);
  sent.content.data = (const uint8_t *)"x";
  sent.content.len = (size_t)-1;
  REFUSED(fipa_send(agent, &sent, -1, NULL));
  sent = message("inform", &to, NULL);
  sent.ontology = invalid;
  REFUSED(fipa_send(agent, &sent, -1, NULL));
  sent = message("inform", &to, NULL);
  sent.reply_by = INT64_MIN;
  fipa_send(agent, &sent, -1, NULL);
  sent = message("inform", &to, NULL);
  sent.lock = agent;
  BAD(fipa_send(agent, &sent, -1, NULL));
  sent = message("inform", &to, NULL);
  REFUSED(fipa_send(agent, &sent, -1, (fipa_handle *)((char *)&handle + 1)));
  REFUSED(fipa_register_service(agent, missing));
  REFUSED(fipa_register_service(agent, invalid));
  REFUSED(fipa_register_service(agent, text("[]")));
  REFUSED(fipa_search_services(agent, invalid, &handle));
  REFUSED(fipa_search_services(agent, text(""), NULL));
  BAD(fipa_deregister_services(domain));
  REFUSED(fipa_next(domain, 0, NULL));
  memset(&item, 0, sizeof item);
  REFUSED(fipa_next(domain, 0, &item));
  REFUSED(fipa_fd(domain, NULL));
  REFUSED(fipa_loan(agent, &sent, 1, &handle, NULL));
  REFUSED(fipa_request(agent, NULL, 0, &handle));
  memset(&topic, 0, sizeof topic);
  topic.size = sizeof topic;
  REFUSED(fipa_publisher(agent, &topic, &handle));
  topic.name = text("t");
  topic.rate = -1.0;
  REFUSED(fipa_publisher(agent, &topic, &handle));
  REFUSED(fipa_lock(agent, NULL, 0, 0, &handle));
}

static void wrong_handles(fipa_handle domain, fipa_handle agent) {
  const fipa_handle wrong[] = {0, 1, UINT64_MAX, agent + 1000, agent ^ (UINT64_C(1) << 40)};
  fipa_message it = message("inform", NULL, NULL);
  fipa_handle handle;
  fipa_item item;
  fipa_text json;
  int fd;

  memset(&item, 0, sizeof item);
  item.size = sizeof item;
  for (size_t i = 0; i < sizeof wrong / sizeof *wrong; i++) {
    BAD(fipa_close(wrong[i]));
    BAD(fipa_next(wrong[i], 0, &item));
    BAD(fipa_fd(wrong[i], &fd));
    BAD(fipa_read_message(wrong[i], &it));
    BAD(fipa_read_text(wrong[i], &json));
    BAD(fipa_cancel(wrong[i]));
    BAD(fipa_receive(wrong[i], 0, &handle));
    BAD(fipa_send(wrong[i], &it, 0, NULL));
    BAD(fipa_task_reply(wrong[i], FIPA_REPLY_AGREE, bytes("")));
    BAD(fipa_publish(wrong[i], bytes(""), NULL));
    BAD(fipa_check_fence(wrong[i], wrong[i]));
  }
  BAD(fipa_send(domain, &it, 0, NULL));
  CHECK(has(fipa_error(), "of another kind: expected OwnAgent"));
  BAD(fipa_next(agent, 0, &item));
  BAD(fipa_read_message(agent, &it));
}

/* A structure of an earlier version is shorter, and one of a later version is longer. */
static void other_versions(fipa_handle domain, fipa_handle agent) {
  struct {
    fipa_message known;
    uint64_t unknown;
  } later;
  fipa_text to = text("rover");
  fipa_handle letter;
  fipa_message part;

  later.known = message("inform", &to, "x");
  later.known.size = sizeof later;
  later.unknown = 42;
  OK(fipa_send(agent, &later.known, -1, NULL));
  OK(fipa_receive(agent, LONG, &letter));
  memset(&part, 0xaa, sizeof part);
  part.size = offsetof(fipa_message, receivers);
  OK(fipa_read_message(letter, &part));
  CHECK(is(part.performative, "inform") && is(part.sender, "rover"));
  CHECK(part.receiver_count == (size_t)0xaaaaaaaaaaaaaaaa);
  OK(fipa_close(letter));
  (void)domain;
}

static void forked(fipa_handle domain, fipa_handle agent) {
  int status;
  pid_t child = fork();
  CHECK(child >= 0);
  if (child == 0) {
    fipa_text to = text("rover");
    fipa_message it = message("inform", &to, "x");
    fipa_handle handle;
    CHECK(fipa_send(agent, &it, -1, NULL) == FIPA_RESULT_FORKED);
    CHECK(has(fipa_error(), "exec"));
    CHECK(fipa_open(NULL, &handle) == FIPA_RESULT_FORKED);
    CHECK(fipa_close(domain) == FIPA_RESULT_FORKED);
    exit(0);
  }
  CHECK(waitpid(child, &status, 0) == child && WIFEXITED(status) && WEXITSTATUS(status) == 0);
}

int main(int argc, char **argv) {
  fipa_domain_options options;
  fipa_handle domain, agent;
  CHECK(argc == 3);
  memset(&options, 0, sizeof options);
  options.size = sizeof options;
  options.config = text("/no/such/file");
  CHECK(fipa_open(&options, &domain) == FIPA_RESULT_INVALID);
  CHECK(has(fipa_error(), "/no/such/file"));
  options.config = text(argv[1]);
  OK(fipa_open(&options, &domain));
  OK(fipa_register(domain, text("rover"), NULL, &agent));
  wrong_pointers(domain, agent);
  wrong_handles(domain, agent);
  other_versions(domain, agent);
  forked(domain, agent);
  OK(fipa_close(domain));
  puts("all steps passed");
  return 0;
}
