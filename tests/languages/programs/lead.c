/* The leader in C. Usage: lead NAME PARTNER */

#include "partner.h"

enum { OPERATION = 1 };

/* A time limit in milliseconds that no step reaches, and one that passes. */
#define LONG 60000
#define SHORT 3000

static fipa_handle domain, agent;
static const char *partner;

static void step(const char *name, const char *observed) {
  printf("%s: %s\n", name, observed);
  fflush(stdout);
}

static void step_text(const char *name, fipa_text observed) {
  printf("%s: %.*s\n", name, (int)observed.len, (const char *)observed.data);
}

/* Prints the failure of a step that must fail. */
static void fails(const char *name, fipa_result result) {
  fipa_text why = fipa_error();
  printf("%s: %s: %.*s\n", name, kind(result), (int)why.len, (const char *)why.data);
}

static fipa_message message(const char *performative, const fipa_text *receivers, size_t count,
                            const char *conversation, const char *content) {
  return (fipa_message){
      .size = sizeof(fipa_message),
      .performative = text(performative),
      .receivers = receivers,
      .receiver_count = count,
      .conversation_id = text(conversation),
      .content = bytes(content),
  };
}

static fipa_text content_of(fipa_handle letter) {
  fipa_bytes content;
  must(fipa_read_content(letter, &content));
  return (fipa_text){content.data, content.len};
}

/* Waits for a letter of a conversation. Others are late messages of conversations that have ended. */
static fipa_handle receive(const char *conversation, fipa_message *read) {
  for (;;) {
    fipa_handle letter;
    must(fipa_receive(agent, -1, &letter));
    read->size = sizeof *read;
    must(fipa_read_message(letter, read));
    fipa_text id = read->conversation_id;
    if (id.len == strlen(conversation) && memcmp(id.data, conversation, id.len) == 0) return letter;
    must(fipa_close(letter));
  }
}

/* Prints the content of a letter, and closes it. */
static void step_content(const char *name, fipa_handle letter) {
  step_text(name, content_of(letter));
  must(fipa_close(letter));
}

/* Requests an action, with the fence of a lock or none. */
static fipa_result ask(const char *content, fipa_handle lock, int64_t limit, fipa_handle *answer) {
  fipa_text to = text(partner);
  fipa_message request = message("request", &to, 1, "", content);
  request.lock = lock;
  return fipa_request(agent, &request, limit, answer);
}

/* Requests an action whose answer is empty. */
static void order(const char *content) {
  fipa_handle answer;
  must(ask(content, 0, LONG, &answer));
  must(fipa_close(answer));
}

static fipa_handle begin(const char *content, int64_t limit) {
  fipa_text to = text(partner);
  fipa_message request = message("request", &to, 1, "", content);
  fipa_handle operation;
  must(fipa_begin_request(agent, &request, limit, OPERATION, &operation));
  return operation;
}

static fipa_item next(void) {
  fipa_item item = {.size = sizeof item};
  must(fipa_next(domain, -1, &item));
  return item;
}

/* Returns the handle of the next item, which must not say a failure. */
static fipa_handle next_handle(void) {
  fipa_item item = next();
  must(item.result);
  return item.handle;
}

static void fill(uint8_t *content, size_t len) {
  for (size_t at = 0; at < len; at++) content[at] = (uint8_t)(at % 251);
}

static void letters(void) {
  const size_t large = 64000000, loaned = 1000000;
  char second[64];
  snprintf(second, sizeof second, "%s_2", partner);
  fipa_text to[] = {text(partner), text(second)}, missing = text("missing");
  fipa_message inform = message("inform", to, 1, "inform", "Grüße, 起重机 🏗"), read;
  inform.language = text("text");
  inform.reply_with = text("q1");
  must(fipa_send(agent, &inform, -1, NULL));
  fipa_handle letter = receive("inform", &read), loan;
  step_text("inform", content_of(letter));
  step_text("in reply to", read.in_reply_to);
  step_text("sender", read.sender);
  must(fipa_close(letter));

  uint8_t *memory;
  inform = message("inform", to, 1, "loan", "");
  must(fipa_loan(agent, &inform, loaned, &loan, &memory));
  fill(memory, loaned);
  must(fipa_send_loan(loan, -1, NULL));
  step_content("loan", receive("loan", &read));

  memory = malloc(large);
  fill(memory, large);
  inform = message("inform", to, 1, "large", "");
  inform.content = (fipa_bytes){memory, large};
  must(fipa_send(agent, &inform, -1, NULL));
  free(memory);
  step_content("large", receive("large", &read));

  inform = message("inform", &missing, 1, "unknown", "");
  fails("unknown receiver", fipa_send(agent, &inform, SHORT, NULL));
  letter = receive("unknown", &read);
  step_text("report", read.performative);
  must(fipa_close(letter));

  char answers[2][128];
  inform = message("inform", to, 2, "both", "both");
  must(fipa_send(agent, &inform, -1, NULL));
  for (int at = 0; at < 2; at++) {
    letter = receive("both", &read);
    snprintf(answers[at], sizeof *answers, "%.*s %.*s", (int)read.sender.len, (const char *)read.sender.data,
             (int)read.content.len, (const char *)read.content.data);
    must(fipa_close(letter));
  }
  int first = strcmp(answers[0], answers[1]) > 0;
  printf("multicast: %s; %s\n", answers[first], answers[!first]);
}

static void requests(void) {
  fipa_handle answer, lift = begin("lift", LONG), wait;
  step("agreed", next().kind == FIPA_EVENT_AGREED ? "true" : "false");
  step_content("answer", next_handle());
  must(fipa_close(lift));
  fails("refused", ask("drop", 0, LONG, &answer));
  fails("failed", ask("throw", 0, LONG, &answer));
  fails("timed out", ask("wait", 0, SHORT, &answer));
  wait = begin("wait", LONG);
  next();
  must(fipa_cancel(wait));
  fails("cancelled", next().result);
  must(fipa_close(wait));
}

static fipa_handle begin_goal(const char *arguments) {
  fipa_handle operation;
  must(fipa_begin_goal(agent, text(partner), text("count"), text(arguments), 0, -1, OPERATION, &operation));
  return operation;
}

static void goals(void) {
  fipa_handle operation = begin_goal("{\"to\": 7}");
  fipa_item item;
  fipa_text json;
  char progress[256], note[32] = "";
  while ((item = next()).kind != FIPA_EVENT_RESULT) {
    must(item.result);
    if (item.kind != FIPA_EVENT_PROGRESS) continue;
    must(fipa_read_text(item.handle, &json));
    const char *found = strstr(copy(progress, sizeof progress, json.data, json.len), "\"note\":\"");
    if (found != NULL && note[0] == '\0' && sscanf(found, "\"note\":\"%31[^\"]", note) == 1) {
      step("progress", note);
      order("go");
    }
    must(fipa_close(item.handle));
  }
  must(fipa_read_text(item.handle, &json));
  step_text("result", json);
  must(fipa_close(item.handle));
  must(fipa_close(operation));

  operation = begin_goal("{\"to\": \"far\"}");
  fails("wrong goal", next().result);
  must(fipa_close(operation));
  operation = begin_goal("{\"to\": 8}");
  next();
  must(fipa_cancel(operation));
  while ((item = next()).kind == FIPA_EVENT_PROGRESS) must(fipa_close(item.handle));
  fails("cancelled goal", item.result);
  must(fipa_close(operation));
}

static void notifications(void) {
  const char *const published[] = {NULL, "publish 80", "publish 70 ☀"};
  fipa_text to = text(partner);
  fipa_message subscribe = message("subscribe", &to, 1, "", "charge");
  fipa_handle subscription;
  must(fipa_subscribe(agent, &subscribe, text("all"), LONG, OPERATION, &subscription));
  for (int at = 0; at < 3; at++) {
    if (published[at] != NULL) order(published[at]);
    step_content("notification", next_handle());
  }
  must(fipa_close(subscription));
}

/* Prints the answer to a request. */
static void step_asked(const char *name, const char *content, fipa_handle lock) {
  fipa_handle answer;
  must(ask(content, lock, LONG, &answer));
  step_content(name, answer);
}

/* Reads the first two numbers of a fence, whose order is that of the fences. */
static void read_fence(const char *fence, unsigned long long *numbers) {
  sscanf(fence, "%llu.%llu", &numbers[0], &numbers[1]);
}

static void locks(void) {
  fipa_text bay = text("bay"), read;
  fipa_lock_info info = {.size = sizeof info};
  fipa_handle lock, answer;
  unsigned long long own[2] = {0}, other[2] = {0};
  char fence[256], late[32] = "";
  step_asked("no fence", "dock", 0);
  must(fipa_lock(agent, &bay, 1, LONG, &lock));
  step_asked("fence", "dock", lock);
  step_asked("locked", "lock 200", 0);
  must(fipa_read_lock(lock, &info));
  read_fence(copy(fence, sizeof fence, info.fence.data, info.fence.len), own);
  must(fipa_close(lock));
  must(ask("lock 60000", 0, LONG, &answer));
  read = content_of(answer);
  sscanf(copy(fence, sizeof fence, read.data, read.len), "%31s", late);
  step("late command", late);
  read_fence(fence + strlen(late), other);
  int is_greater = other[0] > own[0] || (other[0] == own[0] && other[1] > own[1]);
  step("next fence is greater", is_greater ? "true" : "false");
  must(fipa_close(answer));
}

/* Sends a message that its protocol does not have: with a domain that checks what it sends, and with one that does
 * not. */
static void violations(const char *own) {
  fipa_text to = text(partner), check = text("monitor.check=enforce");
  fipa_domain_options options = {.size = sizeof options, .set = &check, .set_count = 1};
  fipa_message propose = message("propose", &to, 1, "violation", "");
  fipa_message read;
  fipa_handle strict, other;
  char name[64];
  snprintf(name, sizeof name, "%s_strict", own);
  propose.protocol = text("fipa-request");
  must(fipa_open(&options, &strict));
  must(fipa_register(strict, text(name), NULL, &other));
  fails("violation", fipa_send(other, &propose, -1, NULL));
  must(fipa_close(strict));
  must(fipa_send(agent, &propose, -1, NULL));
  step_content("violation at the partner", receive("violation report", &read));
}

int main(int argc, char **argv) {
  fipa_handle taken;
  if (argc != 3) return 2;
  partner = argv[2];
  must(fipa_open(NULL, &domain));
  must(fipa_register(domain, text(argv[1]), NULL, &agent));
  step("register", argv[1]);
  step("register the partner", kind(fipa_register(domain, text(partner), NULL, &taken)));
  letters();
  requests();
  goals();
  notifications();
  locks();
  violations(argv[1]);
  begin("wait", -1);
  step("request without an end", next().kind == FIPA_EVENT_AGREED ? "true" : "false");
  fails("the partner is killed", next().result);
  must(fipa_close(domain));
  return 0;
}
