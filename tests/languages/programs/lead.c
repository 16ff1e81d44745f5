/* The leader in C. Usage: lead NAME PARTNER */

#include "partner.h"

enum { OPERATION = 1 };

/* A time limit in milliseconds that no step reaches, and one that passes. */
#define LONG 60000
#define SHORT 200

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
  if (result >= 0) {
    step(name, "no failure");
  } else {
    printf("%s: %s: %.*s\n", name, kind(result), (int)why.len, (const char *)why.data);
  }
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

static void step_answer(const char *name, const char *conversation) {
  fipa_message read;
  fipa_handle letter = receive(conversation, &read);
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
  step_answer("loan", "loan");

  memory = malloc(large);
  fill(memory, large);
  inform = message("inform", to, 1, "large", "");
  inform.content = (fipa_bytes){memory, large};
  must(fipa_send(agent, &inform, -1, NULL));
  free(memory);
  step_answer("large", "large");

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
  answer = next().handle;
  step_text("answer", content_of(answer));
  must(fipa_close(answer));
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
  fipa_handle operation = begin_goal("{\"to\": 7}"), answer;
  fipa_item item;
  fipa_text json;
  char note[32] = "";
  while ((item = next()).kind != FIPA_EVENT_RESULT) {
    must(item.result);
    if (item.kind != FIPA_EVENT_PROGRESS) continue;
    must(fipa_read_text(item.handle, &json));
    const char *found = note[0] == '\0' ? strstr((const char *)json.data, "\"note\":\"") : NULL;
    if (found != NULL && sscanf(found, "\"note\":\"%31[^\"]", note) == 1) {
      step("progress", note);
      must(ask("go", 0, LONG, &answer));
      must(fipa_close(answer));
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
  fipa_handle subscription, answer;
  must(fipa_subscribe(agent, &subscribe, text("all"), LONG, OPERATION, &subscription));
  for (int at = 0; at < 3; at++) {
    if (published[at] != NULL) {
      must(ask(published[at], 0, LONG, &answer));
      must(fipa_close(answer));
    }
    fipa_item item = next();
    step_text("notification", content_of(item.handle));
    must(fipa_close(item.handle));
  }
  must(fipa_close(subscription));
}

static fipa_text asked(const char *content, fipa_handle lock) {
  /* The letter is not closed, so the text stays valid. */
  fipa_handle answer;
  must(ask(content, lock, LONG, &answer));
  return content_of(answer);
}

static void locks(void) {
  fipa_text bay = text("bay");
  fipa_lock_info info = {.size = sizeof info};
  fipa_handle lock;
  unsigned long long own[2] = {0}, other[2] = {0};
  char late[32] = "";
  step_text("no fence", asked("dock", 0));
  must(fipa_lock(agent, &bay, 1, LONG, &lock));
  step_text("fence", asked("dock", lock));
  step_text("locked", asked("lock 200", 0));
  must(fipa_read_lock(lock, &info));
  sscanf((const char *)info.fence.data, "%llu.%llu", &own[0], &own[1]);
  must(fipa_close(lock));
  sscanf((const char *)asked("lock 60000", 0).data, "%31s %llu.%llu", late, &other[0], &other[1]);
  step("late command", late);
  int is_greater = other[0] > own[0] || (other[0] == own[0] && other[1] > own[1]);
  step("next fence is greater", is_greater ? "true" : "false");
}

/* Sends a message that its protocol does not have: with a domain that checks what it sends, and with one that does
 * not. */
static void violations(const char *own) {
  fipa_text to = text(partner), check = text("monitor.check=enforce");
  fipa_domain_options options = {.size = sizeof options, .set = &check, .set_count = 1};
  fipa_message propose = message("propose", &to, 1, "violation", "");
  fipa_handle strict, other;
  char name[64];
  snprintf(name, sizeof name, "%s_strict", own);
  propose.protocol = text("fipa-request");
  must(fipa_open(&options, &strict));
  must(fipa_register(strict, text(name), NULL, &other));
  fails("violation", fipa_send(other, &propose, -1, NULL));
  must(fipa_close(strict));
  must(fipa_send(agent, &propose, -1, NULL));
  step_answer("violation at the partner", "violation report");
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
