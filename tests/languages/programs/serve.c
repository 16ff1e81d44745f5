/* The server in C. Usage: serve NAME */

#include <inttypes.h>

#include "partner.h"

enum { LETTERS = 1, LETTERS_OF_SECOND, REQUESTS, GOALS };

static fipa_handle domain, agent, second, bay, charge;
/* The goal that is pursued, and the number to which it counts. */
static fipa_handle goal;
static char number[16];
/* The last command with a fence. */
static fipa_handle command;

/* Writes the length and the Adler-32 checksum of a content. */
static fipa_bytes sum(fipa_bytes content, char *into, size_t size) {
  uint32_t a = 1, b = 0;
  for (size_t at = 0; at < content.len; at++) {
    a = (a + content.data[at]) % 65521;
    b = (b + a) % 65521;
  }
  snprintf(into, size, "%zu bytes, %08" PRIx32 ", 谢谢 🤖", content.len, b << 16 | a);
  return bytes(into);
}

static void answer(fipa_handle to, fipa_handle letter) {
  fipa_message read = {.size = sizeof read}, inform = {.size = sizeof inform, .performative = text("inform")};
  fipa_letter_info info = {.size = sizeof info};
  char summed[64];
  must(fipa_read_message(letter, &read));
  must(fipa_read_info(letter, &info));
  if (info.violation.len > 0) {
    inform.receivers = &read.sender;
    inform.receiver_count = 1;
    inform.conversation_id = text("violation report");
    inform.content = (fipa_bytes){info.violation.data, info.violation.len};
    must(fipa_send(to, &inform, -1, NULL));
  } else if (read.performative.len == 6 && memcmp(read.performative.data, "inform", 6) == 0) {
    inform.content = sum(read.content, summed, sizeof summed);
    must(fipa_answer(to, letter, &inform, -1, NULL));
  }
  must(fipa_close(letter));
}

static void reply(fipa_handle task, int32_t act, const char *content) {
  must(fipa_task_reply(task, act, bytes(content)));
}

/* Locks the bay for the second agent, while the first checks the late command. */
static void lock(fipa_handle task, int64_t limit) {
  fipa_text resource = text("bay");
  fipa_lock_info info = {.size = sizeof info};
  fipa_handle held;
  char answer[256];
  fipa_result result = fipa_lock(second, &resource, 1, limit, &held);
  if (result != FIPA_RESULT_OK) {
    reply(task, FIPA_REPLY_INFORM, kind(result));
    return;
  }
  must(fipa_read_lock(held, &info));
  snprintf(answer, sizeof answer, "%s %.*s", kind(fipa_check_fence(bay, command)), (int)info.fence.len,
           (const char *)info.fence.data);
  reply(task, FIPA_REPLY_INFORM, answer);
  must(fipa_close(held));
}

static void handle(fipa_handle task) {
  char content[32];
  fipa_bytes read;
  must(fipa_read_content(task, &read));
  copy(content, sizeof content, read.data, read.len);
  if (strcmp(content, "lift") == 0) {
    reply(task, FIPA_REPLY_AGREE, "");
    reply(task, FIPA_REPLY_INFORM, "lifted");
  } else if (strcmp(content, "drop") == 0) {
    reply(task, FIPA_REPLY_REFUSE, "too heavy");
  } else if (strcmp(content, "throw") == 0) {
    reply(task, FIPA_REPLY_AGREE, "");
    reply(task, FIPA_REPLY_FAILURE, "no motor");
  } else if (strcmp(content, "wait") == 0) {
    /* Until the leader cancels, which it may have done before the agreement. */
    fipa_task_reply(task, FIPA_REPLY_AGREE, bytes(""));
    return;
  } else if (strcmp(content, "go") == 0) {
    must(fipa_goal_end(goal, 1, text(number)));
    must(fipa_close(goal));
    reply(task, FIPA_REPLY_INFORM, "");
  } else if (strncmp(content, "publish ", 8) == 0) {
    must(fipa_publish(charge, bytes(content + 8), NULL));
    reply(task, FIPA_REPLY_INFORM, "");
  } else if (strncmp(content, "lock ", 5) == 0) {
    lock(task, strtol(content + 5, NULL, 10));
  } else if (strcmp(content, "dock") == 0) {
    fipa_result checked = fipa_check_fence(bay, task);
    reply(task, FIPA_REPLY_INFORM, checked == FIPA_RESULT_OK ? "admitted" : kind(checked));
    fipa_close(command);
    command = task;
    return;
  } else {
    reply(task, FIPA_REPLY_REFUSE, "unknown");
  }
  must(fipa_close(task));
}

static void pursue(fipa_handle begun) {
  char arguments[32];
  fipa_text json;
  goal = begun;
  must(fipa_read_text(goal, &json));
  sscanf(copy(arguments, sizeof arguments, json.data, json.len), "{\"to\":%15[0-9]}", number);
  must(fipa_goal_progress(goal, text("{\"fraction\": 0.5, \"note\": \"half way\"}")));
}

int main(int argc, char **argv) {
  const char *count = "{\"name\": \"count\", \"parameters\": [{\"name\": \"to\", \"type\": \"integer\"}],"
                      " \"result\": \"integer\"}";
  fipa_own_options options = {.size = sizeof options, .is_volatile = 1, .forget = 1};
  fipa_topic topic = {.size = sizeof topic, .name = text("charge"), .latched = 1};
  fipa_handle running[4];
  char name[64];
  if (argc != 2) return 2;
  snprintf(name, sizeof name, "%s_2", argv[1]);
  must(fipa_open(NULL, &domain));
  must(fipa_register(domain, text(argv[1]), NULL, &agent));
  must(fipa_register(domain, text(name), NULL, &second));
  must(fipa_own(agent, text("bay"), &options, &bay));
  must(fipa_publisher(agent, &topic, &charge));
  must(fipa_publish(charge, bytes("90"), NULL));
  must(fipa_offer(agent, text(count), GOALS, &running[0]));
  must(fipa_serve(agent, text("fipa-request"), REQUESTS, &running[1]));
  must(fipa_listen(agent, LETTERS, &running[2]));
  must(fipa_listen(second, LETTERS_OF_SECOND, &running[3]));
  puts("ready");
  fflush(stdout);
  for (;;) {
    fipa_item item = {.size = sizeof item};
    must(fipa_next(domain, -1, &item));
    switch (item.kind) {
      case FIPA_EVENT_LETTER:
        answer(item.tag == LETTERS ? agent : second, item.handle);
        break;
      case FIPA_EVENT_TASK:
        handle(item.handle);
        break;
      case FIPA_EVENT_CANCEL:
        if (item.result == FIPA_RESULT_OK) reply(item.handle, FIPA_REPLY_INFORM, "cancelled");
        must(fipa_close(item.handle));
        break;
      case FIPA_EVENT_GOAL:
        pursue(item.handle);
        break;
      case FIPA_EVENT_STOP:
        must(fipa_goal_end(item.handle, 0, text("stopped")));
        must(fipa_close(item.handle));
        break;
      default:
        fprintf(stderr, "unexpected item of kind %d\n", (int)item.kind);
        return 1;
    }
  }
}
