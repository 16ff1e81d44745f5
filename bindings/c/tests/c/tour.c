/* Each call of the interface, between agents of one process. The configuration is the first argument. */

#include <poll.h>

#include "check.h"

static fipa_handle domain, rover, arm;

static fipa_handle open_domain(const char *config) {
  fipa_domain_options options;
  fipa_handle opened = 0;
  memset(&options, 0, sizeof options);
  options.size = sizeof options;
  options.config = text(config);
  OK(fipa_open(&options, &opened));
  return opened;
}

static void close_all(const fipa_handle *handles, size_t count) {
  for (size_t i = 0; i < count; i++) {
    OK(fipa_close(handles[i]));
    CHECK(fipa_close(handles[i]) == FIPA_RESULT_BAD_HANDLE);
  }
}

static void letters(void) {
  fipa_text to = text("arm");
  fipa_message lift = message("inform", &to, "(lift crate)");
  fipa_parameter parameter = {text("X-weight"), text("12")};
  fipa_handle outcomes, letter, answer;
  fipa_text json;
  fipa_letter_info info;
  fipa_message read;

  lift.language = text("fipa-sl");
  lift.ontology = text("logistics");
  lift.conversation_id = text("c1");
  lift.reply_by = INT64_C(1893456000000000000);
  lift.parameters = &parameter;
  lift.parameter_count = 1;
  OK(fipa_send(rover, &lift, -1, &outcomes));
  OK(fipa_read_text(outcomes, &json));
  CHECK(has(json, "\"outcome\":\"delivered\"") && has(json, "\"receiver\":\"arm\""));

  OK(fipa_receive(arm, LONG, &letter));
  CHECK(content_is(letter, "(lift crate)"));
  memset(&read, 0, sizeof read);
  read.size = sizeof read;
  OK(fipa_read_message(letter, &read));
  CHECK(is(read.performative, "inform") && is(read.sender, "rover"));
  CHECK(read.receiver_count == 1 && is(read.receivers[0], "arm"));
  CHECK(is(read.language, "fipa-sl") && is(read.ontology, "logistics"));
  CHECK(is(read.conversation_id, "c1") && read.protocol.data == NULL);
  CHECK(read.reply_by == lift.reply_by);
  CHECK(read.parameter_count == 1 && is(read.parameters[0].name, "X-weight"));
  CHECK(is(read.parameters[0].value, "12"));
  memset(&info, 0, sizeof info);
  info.size = sizeof info;
  OK(fipa_read_info(letter, &info));
  CHECK(info.violation.len == 0);
  CHECK(is(info.via, "shm") && info.in_place == 0);

  lift = message("confirm", NULL, "done");
  OK(fipa_answer(arm, letter, &lift, -1, NULL));
  OK(fipa_receive(rover, LONG, &answer));
  CHECK(content_is(answer, "done"));
  memset(&read, 0, sizeof read);
  read.size = sizeof read;
  OK(fipa_read_message(answer, &read));
  CHECK(is(read.conversation_id, "c1") && is(read.sender, "arm"));
  CHECK(fipa_receive(rover, 0, &answer) == FIPA_RESULT_EMPTY);
  CHECK(fipa_receive(rover, 1, &answer) == FIPA_RESULT_EMPTY);

  to = text("nobody");
  lift = message("inform", &to, "");
  CHECK(fipa_send(rover, &lift, 100, NULL) == FIPA_RESULT_NOT_DELIVERED);
  CHECK(has(fipa_error(), "no such agent"));
  /* The report of the message transport service. */
  OK(fipa_receive(rover, LONG, &answer));
  CHECK(fipa_read_content(answer, NULL) == FIPA_RESULT_INVALID);
  OK(fipa_close(answer));
  OK(fipa_close(outcomes));
  OK(fipa_close(letter));
}

static void loans(void) {
  const size_t len = 1000000;
  fipa_text to = text("arm");
  fipa_message image = message("inform", &to, NULL);
  fipa_handle loan, letter;
  fipa_bytes content;
  fipa_letter_info info;
  fipa_content_counts before, counts;
  uint8_t *memory;

  before.size = counts.size = sizeof counts;
  info.size = sizeof info;
  OK(fipa_read_content_counts(domain, &before));
  OK(fipa_loan(rover, &image, len, &loan, &memory));
  memset(memory, 7, len);
  OK(fipa_send_loan(loan, -1, NULL));
  CHECK(fipa_send_loan(loan, -1, NULL) == FIPA_RESULT_BAD_HANDLE);
  OK(fipa_receive(arm, LONG, &letter));
  OK(fipa_read_content(letter, &content));
  CHECK(content.len == len && content.data[0] == 7 && content.data[len - 1] == 7);
  OK(fipa_read_info(letter, &info));
  OK(fipa_read_content_counts(domain, &counts));
  CHECK(info.in_place == 1 && counts.in_place == before.in_place + 1 && counts.copied == 0);
  OK(fipa_close(letter));

  OK(fipa_loan(rover, &image, 10, &loan, &memory));
  memcpy(memory, "0123456789", 10);
  OK(fipa_begin_send_loan(loan, -1, 5));
  OK(fipa_close(next(domain, 5, FIPA_EVENT_OUTCOMES).handle));
  OK(fipa_receive(arm, LONG, &letter));
  CHECK(content_is(letter, "0123456789"));
  OK(fipa_close(letter));

  OK(fipa_loan(rover, &image, 10, &loan, &memory));
  OK(fipa_close(loan));
  CHECK(fipa_loan(rover, &image, SIZE_MAX, &loan, &memory) == FIPA_RESULT_TOO_LARGE);
}

/* An event loop: the descriptor is polled, and items are taken until there is none. */
static void items(void) {
  fipa_text to = text("arm");
  fipa_message one = message("inform", &to, "1");
  fipa_handle listening, again;
  struct pollfd polled = {0, POLLIN, 0};
  fipa_item item;
  int letters = 0, outcomes = 0, fd = -1;

  OK(fipa_fd(domain, &fd));
  polled.fd = fd;
  OK(fipa_listen(arm, 1, &listening));
  CHECK(is_empty(domain));
  CHECK(poll(&polled, 1, 0) == 0);
  for (int i = 0; i < 100; i++) {
    OK(fipa_begin_send(rover, &one, -1, 2));
  }
  while (letters < 100 || outcomes < 100) {
    CHECK(poll(&polled, 1, LONG) == 1);
    memset(&item, 0, sizeof item);
    item.size = sizeof item;
    while (fipa_next(domain, 0, &item) == FIPA_RESULT_OK) {
      CHECK(item.result == FIPA_RESULT_OK);
      letters += item.kind == FIPA_EVENT_LETTER && item.tag == 1;
      outcomes += item.kind == FIPA_EVENT_OUTCOMES && item.tag == 2;
      OK(fipa_close(item.handle));
    }
  }
  CHECK(letters == 100 && outcomes == 100);

  /* A letter that nobody has taken stays with its agent. */
  OK(fipa_close(listening));
  OK(fipa_send(rover, &one, -1, NULL));
  CHECK(is_empty(domain));
  OK(fipa_listen(arm, 3, &again));
  item = next(domain, 3, FIPA_EVENT_LETTER);
  CHECK(content_is(item.handle, "1"));
  OK(fipa_close(item.handle));
  OK(fipa_close(again));
}

static void directory(void) {
  fipa_handle agents, routes, following, camera;
  fipa_agent_options options;
  fipa_text json;
  fipa_item item;

  OK(fipa_agents(domain, text("ro.*"), text(""), &agents));
  OK(fipa_read_text(agents, &json));
  CHECK(has(json, "\"name\":\"rover\"") && !has(json, "\"name\":\"arm\""));
  OK(fipa_close(agents));
  CHECK(fipa_agents(domain, text("(ro"), text(""), &agents) == FIPA_RESULT_INVALID);
  OK(fipa_routes(domain, text("arm"), &routes));
  OK(fipa_read_text(routes, &json));
  CHECK(has(json, "\"routes\":["));
  OK(fipa_close(routes));

  OK(fipa_follow_agents(domain, 8, &following));
  memset(&options, 0, sizeof options);
  options.size = sizeof options;
  options.agent_type = text("camera");
  options.description = text("at the front");
  OK(fipa_register(domain, text("camera_1"), &options, &camera));
  item = next(domain, 8, FIPA_EVENT_CHANGE);
  OK(fipa_read_text(item.handle, &json));
  CHECK(has(json, "\"change\":\"joined\"") && has(json, "at the front"));
  OK(fipa_close(item.handle));
  OK(fipa_agents(domain, text(""), text("camera"), &agents));
  OK(fipa_read_text(agents, &json));
  CHECK(has(json, "camera_1"));
  OK(fipa_close(agents));
  CHECK(fipa_register(domain, text("camera_1"), NULL, &agents) == FIPA_RESULT_NAME_TAKEN);
  CHECK(has(fipa_error(), "camera_1"));
  OK(fipa_close(camera));
  item = next(domain, 8, FIPA_EVENT_CHANGE);
  OK(fipa_read_text(item.handle, &json));
  CHECK(has(json, "\"change\":\"left\""));
  OK(fipa_close(item.handle));
  OK(fipa_close(following));
}

static void requests(void) {
  fipa_text to = text("arm");
  fipa_message lift = message("request", &to, "lift");
  fipa_handle server, request, task;
  fipa_item item;

  OK(fipa_serve(arm, text("fipa-request"), 10, &server));
  CHECK(fipa_serve(arm, text("no-protocol"), 11, &task) != FIPA_RESULT_OK);

  /* Agreed, then the result. */
  OK(fipa_begin_request(rover, &lift, LONG, 20, &request));
  task = next(domain, 10, FIPA_EVENT_TASK).handle;
  CHECK(content_is(task, "lift"));
  OK(fipa_task_reply(task, FIPA_REPLY_AGREE, bytes("")));
  next(domain, 20, FIPA_EVENT_AGREED);
  OK(fipa_begin_task_reply(task, FIPA_REPLY_INFORM, bytes("lifted"), 12));
  for (int i = 0; i < 2; i++) {
    memset(&item, 0, sizeof item);
    item.size = sizeof item;
    OK(fipa_next(domain, LONG, &item));
    CHECK(item.result == FIPA_RESULT_OK);
    if (item.kind == FIPA_EVENT_ANSWER) {
      CHECK(content_is(item.handle, "lifted"));
      OK(fipa_close(item.handle));
    } else {
      CHECK(item.kind == FIPA_EVENT_ENDED && item.tag == 12);
    }
  }
  CHECK(fipa_task_reply(task, FIPA_REPLY_INFORM, bytes("again")) == FIPA_RESULT_CLOSED);
  OK(fipa_close(task));
  OK(fipa_close(request));

  /* Refused, with the reason. */
  OK(fipa_begin_request(rover, &lift, LONG, 21, &request));
  task = next(domain, 10, FIPA_EVENT_TASK).handle;
  CHECK(fipa_task_reply(task, 99, bytes("")) == FIPA_RESULT_INVALID);
  OK(fipa_task_reply(task, FIPA_REPLY_REFUSE, bytes("too heavy")));
  item = next(domain, 21, FIPA_EVENT_ENDED);
  CHECK(item.result == FIPA_RESULT_REFUSED && has(fipa_error(), "too heavy"));
  OK(fipa_close(task));
  OK(fipa_close(request));

  /* Closed without an answer. */
  OK(fipa_begin_request(rover, &lift, LONG, 22, &request));
  OK(fipa_close(next(domain, 10, FIPA_EVENT_TASK).handle));
  item = next(domain, 22, FIPA_EVENT_ENDED);
  CHECK(item.result == FIPA_RESULT_REFUSED);
  OK(fipa_close(request));

  /* Cancelled, and the other side confirms. */
  OK(fipa_begin_request(rover, &lift, LONG, 23, &request));
  task = next(domain, 10, FIPA_EVENT_TASK).handle;
  OK(fipa_task_reply(task, FIPA_REPLY_AGREE, bytes("")));
  next(domain, 23, FIPA_EVENT_AGREED);
  OK(fipa_cancel(request));
  CHECK(next(domain, 10, FIPA_EVENT_CANCEL).handle == task);
  OK(fipa_begin_task_reply(task, FIPA_REPLY_INFORM, bytes("stopped"), 13));
  for (int i = 0; i < 2; i++) {
    memset(&item, 0, sizeof item);
    item.size = sizeof item;
    OK(fipa_next(domain, LONG, &item));
    CHECK(item.kind == FIPA_EVENT_ENDED);
    CHECK(item.result == (item.tag == 23 ? FIPA_RESULT_CANCELLED : FIPA_RESULT_OK));
  }
  OK(fipa_close(task));
  OK(fipa_close(request));
  OK(fipa_close(server));

  to = text("nobody");
  CHECK(fipa_request(rover, &lift, 1000, &task) == FIPA_RESULT_NOT_DELIVERED);
  OK(fipa_register(domain, text("nobody"), NULL, &server));
  CHECK(fipa_request(rover, &lift, 10, &task) == FIPA_RESULT_TIMED_OUT);
  OK(fipa_close(server));
}

static void contract_nets(void) {
  fipa_text to[2];
  fipa_message carry;
  fipa_handle server, task, calling, bids, proposal, wrong;
  fipa_text json;
  fipa_item item;
  const size_t first = 0, beyond = 1;

  to[0] = text("arm");
  to[1] = text("missing");
  carry = message("cfp", to, "carry");
  carry.receiver_count = 2;
  OK(fipa_serve(arm, text("fipa-contract-net"), 60, &server));
  OK(fipa_begin_call(rover, &carry, LONG, 61, &calling));
  task = next(domain, 60, FIPA_EVENT_TASK).handle;
  CHECK(content_is(task, "carry"));
  OK(fipa_begin_task_reply(task, FIPA_REPLY_PROPOSE, bytes("12"), 62));
  item = next(domain, 61, FIPA_EVENT_BIDS);
  bids = item.handle;
  CHECK(item.number == 1);
  OK(fipa_read_text(bids, &json));
  CHECK(has(json, "\"unreached\":[\"missing\"]"));
  OK(fipa_read_bid(bids, 0, &proposal));
  CHECK(content_is(proposal, "12"));
  OK(fipa_close(proposal));
  CHECK(fipa_read_bid(bids, 1, &proposal) == FIPA_RESULT_INVALID);
  CHECK(fipa_award(bids, &beyond, 1, bytes(""), LONG, 63) == FIPA_RESULT_INVALID);
  OK(fipa_award(bids, &first, 1, bytes("go"), LONG, 63));
  CHECK(fipa_award(bids, &first, 1, bytes("go"), LONG, 63) == FIPA_RESULT_CLOSED);
  /* The decision, and the end of the reply. */
  for (int i = 0; i < 2; i++) {
    memset(&item, 0, sizeof item);
    item.size = sizeof item;
    OK(fipa_next(domain, LONG, &item));
    CHECK(item.kind == FIPA_EVENT_DECISION ? item.handle == task && item.number == 1
                                           : item.tag == 62 && item.result == FIPA_RESULT_OK);
  }
  OK(fipa_begin_task_reply(task, FIPA_REPLY_INFORM, bytes("carried"), 64));
  for (int i = 0; i < 3; i++) {
    memset(&item, 0, sizeof item);
    item.size = sizeof item;
    OK(fipa_next(domain, LONG, &item));
    CHECK(item.result == FIPA_RESULT_OK);
    if (item.kind == FIPA_EVENT_AWARDED) {
      CHECK(item.number == 0 && content_is(item.handle, "carried"));
      OK(fipa_close(item.handle));
    } else {
      CHECK(item.kind == FIPA_EVENT_ENDED);
    }
  }
  CHECK(fipa_read_bid(task, 0, &wrong) == FIPA_RESULT_BAD_HANDLE);
  OK(fipa_close(bids));
  OK(fipa_close(task));
  OK(fipa_close(calling));
  OK(fipa_close(server));
}

static void actions(void) {
  const char *navigate = "{\"name\": \"navigate\", \"description\": \"Drive to a place\", \"parameters\": ["
                         "{\"name\": \"x\", \"type\": \"number\", \"unit\": \"m\","
                         " \"range\": {\"min\": 0, \"max\": 10}}]}";
  fipa_handle offer, asking, going, goal, nothing;
  fipa_text json;
  fipa_item item;

  CHECK(fipa_offer(arm, text("{}"), 70, &offer) == FIPA_RESULT_INVALID);
  CHECK(fipa_offer(arm, text("navigate"), 70, &offer) == FIPA_RESULT_INVALID);
  OK(fipa_offer(arm, text(navigate), 70, &offer));
  OK(fipa_begin_actions(rover, text("arm"), 71, &asking));
  item = next(domain, 71, FIPA_EVENT_RESULT);
  OK(fipa_read_text(item.handle, &json));
  CHECK(has(json, "navigate") && has(json, "\"unit\":\"m\""));
  OK(fipa_close(item.handle));
  OK(fipa_close(asking));

  /* Out of range: refused before the program sees it. */
  OK(fipa_begin_goal(rover, text("arm"), text("navigate"), text("{\"x\": 11}"), 0, -1, 72, &going));
  item = next(domain, 72, FIPA_EVENT_ENDED);
  CHECK(item.result != FIPA_RESULT_OK);
  OK(fipa_close(going));
  CHECK(fipa_begin_goal(rover, text("arm"), text("navigate"), text("[1]"), 0, -1, 72, &nothing) ==
        FIPA_RESULT_INVALID);

  OK(fipa_begin_goal(rover, text("arm"), text("navigate"), text("{\"x\": 1.5}"), 0, -1, 73, &going));
  goal = both(domain, 70, FIPA_EVENT_GOAL, 73, FIPA_EVENT_ACCEPTED).handle;
  OK(fipa_read_text(goal, &json));
  CHECK(is(json, "{\"x\":1.5}"));
  OK(fipa_goal_progress(goal, text("{\"fraction\": 0.5, \"note\": \"half\", \"value\": [0.7, 2]}")));
  CHECK(fipa_goal_progress(goal, text("{\"fraction\": \"half\"}")) == FIPA_RESULT_INVALID);
  do {
    item = next(domain, 73, FIPA_EVENT_PROGRESS);
    OK(fipa_read_text(item.handle, &json));
    CHECK(has(json, "\"state\":"));
  } while (!has(json, "\"value\":[0.7,2]") && fipa_close(item.handle) == FIPA_RESULT_OK);
  OK(fipa_close(item.handle));
  CHECK(fipa_goal_end(goal, 1, text("{broken")) == FIPA_RESULT_INVALID);
  OK(fipa_goal_end(goal, 1, text("{\"at\": 1.5}")));
  CHECK(fipa_goal_end(goal, 0, text("late")) == FIPA_RESULT_CLOSED);
  do {
    memset(&item, 0, sizeof item);
    item.size = sizeof item;
    OK(fipa_next(domain, LONG, &item));
    CHECK(item.tag == 73 && item.handle != 0);
    OK(fipa_read_text(item.handle, &json));
    CHECK(item.kind == FIPA_EVENT_PROGRESS || has(json, "\"at\":1.5"));
    OK(fipa_close(item.handle));
  } while (item.kind != FIPA_EVENT_RESULT);
  OK(fipa_close(goal));
  OK(fipa_close(going));

  /* Cancelled: the robot stops, and says so. */
  OK(fipa_begin_goal(rover, text("arm"), text("navigate"), text("{\"x\": 2}"), 0, -1, 74, &going));
  goal = both(domain, 70, FIPA_EVENT_GOAL, 74, FIPA_EVENT_ACCEPTED).handle;
  OK(fipa_cancel(going));
  do {
    memset(&item, 0, sizeof item);
    item.size = sizeof item;
    OK(fipa_next(domain, LONG, &item));
    if (item.kind == FIPA_EVENT_STOP) {
      CHECK(item.tag == 70 && item.handle == goal && item.result == FIPA_RESULT_CANCELLED);
      OK(fipa_goal_end(goal, 0, text("stopped at 1")));
    } else if (item.kind == FIPA_EVENT_PROGRESS) {
      OK(fipa_close(item.handle));
    } else {
      CHECK(item.kind == FIPA_EVENT_ENDED && item.tag == 74 && item.result < 0);
    }
  } while (item.kind != FIPA_EVENT_ENDED);
  OK(fipa_close(goal));
  OK(fipa_close(going));
  OK(fipa_close(offer));

  /* The program decides about each goal. */
  CHECK(fipa_offer(arm, text("{\"name\": \"grip\", \"decides\": 1}"), 75, &offer) == FIPA_RESULT_INVALID);
  OK(fipa_offer(arm, text("{\"name\": \"grip\", \"decides\": true}"), 75, &offer));
  OK(fipa_begin_goal(rover, text("arm"), text("grip"), text(""), 0, -1, 76, &going));
  goal = next(domain, 75, FIPA_EVENT_GOAL).handle;
  OK(fipa_goal_accept(goal));
  next(domain, 76, FIPA_EVENT_ACCEPTED);
  OK(fipa_goal_accept(goal));
  OK(fipa_goal_end(goal, 1, text("")));
  do {
    memset(&item, 0, sizeof item);
    item.size = sizeof item;
    OK(fipa_next(domain, LONG, &item));
    CHECK(item.tag == 76 && (item.kind == FIPA_EVENT_PROGRESS || item.kind == FIPA_EVENT_RESULT));
    OK(fipa_close(item.handle));
  } while (item.kind != FIPA_EVENT_RESULT);
  OK(fipa_close(goal));
  CHECK(fipa_goal_accept(goal) == FIPA_RESULT_BAD_HANDLE);
  OK(fipa_close(going));
  OK(fipa_begin_goal(rover, text("arm"), text("grip"), text(""), 0, -1, 77, &going));
  goal = next(domain, 75, FIPA_EVENT_GOAL).handle;
  OK(fipa_goal_end(goal, 0, text("no power")));
  CHECK(next(domain, 77, FIPA_EVENT_ENDED).result == FIPA_RESULT_REFUSED);
  OK(fipa_close(goal));
  OK(fipa_close(going));
  OK(fipa_close(offer));
}

static void topics(void) {
  fipa_text to = text("arm");
  fipa_message charge = message("subscribe", &to, "charge");
  fipa_handle publisher, subscription, loan;
  fipa_topic topic;
  fipa_item item;
  uint8_t *memory;
  size_t subscribers = 0;

  memset(&topic, 0, sizeof topic);
  topic.size = sizeof topic;
  topic.name = text("charge");
  topic.media_type = text("text/plain");
  topic.latched = 1;
  OK(fipa_publisher(arm, &topic, &publisher));
  OK(fipa_publish(publisher, bytes("90"), NULL));
  OK(fipa_subscribe(rover, &charge, text("all"), LONG, 30, &subscription));
  item = next(domain, 30, FIPA_EVENT_NOTIFICATION);
  CHECK(content_is(item.handle, "90") && item.number == 0);
  OK(fipa_close(item.handle));
  OK(fipa_publish(publisher, bytes("89"), &subscribers));
  CHECK(subscribers == 1);
  item = next(domain, 30, FIPA_EVENT_NOTIFICATION);
  CHECK(content_is(item.handle, "89"));
  OK(fipa_close(item.handle));
  OK(fipa_loan_notification(publisher, 3, &loan, &memory));
  memcpy(memory, "low", 3);
  OK(fipa_publish_loan(loan, NULL));
  CHECK(fipa_publish_loan(loan, NULL) == FIPA_RESULT_BAD_HANDLE);
  item = next(domain, 30, FIPA_EVENT_NOTIFICATION);
  CHECK(content_is(item.handle, "low"));
  OK(fipa_close(item.handle));
  CHECK(fipa_subscribe(rover, &charge, text("some"), LONG, 31, &loan) == FIPA_RESULT_INVALID);
  OK(fipa_close(subscription));
  while (subscribers != 0) {
    OK(fipa_publish(publisher, bytes("0"), &subscribers));
  }
  OK(fipa_close(publisher));
}

static void locks(const char *state_dir) {
  fipa_text bay = text("bay"), to = text("arm");
  fipa_message command = message("inform", &to, "open");
  fipa_handle owned, lock, locking, letter;
  fipa_own_options options;
  fipa_lock_info info;
  fipa_item item;

  memset(&options, 0, sizeof options);
  options.size = sizeof options;
  options.state_dir = text(state_dir);
  options.forget = 1;
  OK(fipa_own(arm, bay, &options, &owned));
  OK(fipa_lock(rover, &bay, 1, LONG, &lock));
  memset(&info, 0, sizeof info);
  info.size = sizeof info;
  OK(fipa_read_lock(lock, &info));
  CHECK(info.is_held == 1 && info.remaining_ms > 0 && info.fence.len > 0);

  command.lock = lock;
  OK(fipa_send(rover, &command, -1, NULL));
  /* Letters of the conversations before may come first. */
  OK(fipa_receive(arm, LONG, &letter));
  while (!content_is(letter, "open")) {
    OK(fipa_close(letter));
    OK(fipa_receive(arm, LONG, &letter));
  }
  OK(fipa_check_fence(owned, letter));
  OK(fipa_close(lock));
  CHECK(fipa_send(rover, &command, -1, NULL) == FIPA_RESULT_BAD_HANDLE);

  /* The command of the former holder is late. */
  OK(fipa_begin_lock(rover, &bay, 1, LONG, 40, &locking));
  item = next(domain, 40, FIPA_EVENT_LOCK);
  CHECK(fipa_check_fence(owned, letter) == FIPA_RESULT_STALE);
  OK(fipa_close(letter));
  OK(fipa_close(item.handle));
  CHECK(next(domain, 40, FIPA_EVENT_ENDED).result == FIPA_RESULT_CLOSED);
  OK(fipa_close(locking));
  OK(fipa_close(owned));
}

static void coalitions(const char *state_dir) {
  fipa_text members[] = {text("rover"), text("arm")}, to = text("arm"), json;
  fipa_handle founded, member, other, letter;
  fipa_message command = message("inform", &to, "turn");
  fipa_own_options options;
  fipa_item item;
  int leads = 0;

  memset(&options, 0, sizeof options);
  options.size = sizeof options;
  options.state_dir = text(state_dir);
  options.forget = 1;
  CHECK(fipa_found_coalition(arm, text("team"), NULL, 0, &options, &founded) != FIPA_RESULT_OK);
  OK(fipa_found_coalition(arm, text("team"), members, 2, &options, &founded));
  OK(fipa_join_coalition(arm, text("team"), 80, &other));
  OK(fipa_join_coalition(rover, text("team"), 81, &member));
  while (!leads) {
    memset(&item, 0, sizeof item);
    item.size = sizeof item;
    OK(fipa_next(domain, LONG, &item));
    CHECK(item.kind == FIPA_EVENT_CHANGE);
    OK(fipa_read_text(item.handle, &json));
    leads = has(json, "\"leads\":true") ? (int)item.tag : 0;
    OK(fipa_close(item.handle));
  }
  if (leads == 80) {
    /* The rover leads after the arm. */
    fipa_handle arms = other;
    other = member;
    member = arms;
    to = text("rover");
  }
  command.lock = other;
  CHECK(fipa_send(leads == 80 ? rover : arm, &command, -1, NULL) == FIPA_RESULT_LOST);
  command.lock = member;
  OK(fipa_send(leads == 80 ? arm : rover, &command, -1, NULL));
  do {
    OK(fipa_receive(leads == 80 ? rover : arm, LONG, &letter));
  } while (!content_is(letter, "turn") && fipa_close(letter) == FIPA_RESULT_OK);
  OK(fipa_check_fence(other, letter));
  CHECK(fipa_check_fence(domain, letter) == FIPA_RESULT_BAD_HANDLE);
  OK(fipa_close(letter));
  OK(fipa_change_coalition(founded, members, 1));
  OK(fipa_resign(member));
  OK(fipa_close(member));
  OK(fipa_close(other));
  OK(fipa_close(founded));
}

#ifdef FIPA_GATEWAY
static void services(void) {
  fipa_handle found;
  fipa_text json;
  OK(fipa_register_service(arm, text("{\"type\": \"lift\", \"properties\": {\"kg\": 12}}")));
  OK(fipa_search_services(rover, text("{\"type\": \"lift\", \"properties\": {\"kg\": null}}"), &found));
  OK(fipa_read_text(found, &json));
  CHECK(has(json, "\"name\":\"arm\"") && has(json, "{\"kg\":12}"));
  OK(fipa_close(found));
  OK(fipa_deregister_services(arm));
  CHECK(fipa_deregister_services(arm) == FIPA_RESULT_REFUSED);
  OK(fipa_search_services(rover, text(""), &found));
  OK(fipa_read_text(found, &json));
  CHECK(!has(json, "lift"));
  OK(fipa_close(found));
}

static void gateway(const char *config) {
  fipa_text set = text("discovery.mdns=false"), json;
  fipa_handle opened, second, agents;
  fipa_domain_options options;
  memset(&options, 0, sizeof options);
  options.size = sizeof options;
  options.config = text(config);
  options.set = &set;
  options.set_count = 1;
  OK(fipa_open_gateway(&options, &opened));
  CHECK(fipa_open_gateway(&options, &second) != FIPA_RESULT_OK);
  CHECK(has(fipa_error(), "already running"));
  OK(fipa_close(opened));
  OK(fipa_open_gateway(&options, &opened));
  services();
  OK(fipa_close(opened));
  OK(fipa_agents(domain, text("rover"), text(""), &agents));
  OK(fipa_read_text(agents, &json));
  CHECK(has(json, "rover"));
  OK(fipa_close(agents));
}
#endif

int main(int argc, char **argv) {
  const fipa_text to = text("rover");
  const fipa_message last = message("inform", &to, "");
  fipa_handle listening, letter;
  fipa_result result;
  CHECK(argc == 3);
  CHECK(is(fipa_version(), VERSION));
  domain = open_domain(argv[1]);
  OK(fipa_register(domain, text("rover"), NULL, &rover));
  OK(fipa_register(domain, text("arm"), NULL, &arm));
  letters();
  loans();
  items();
  directory();
  requests();
  contract_nets();
  actions();
  topics();
  locks(argv[2]);
  coalitions(argv[2]);
  /* Without a gateway, the host has no directory facilitator. */
  CHECK(fipa_search_services(rover, text(""), &letter) == FIPA_RESULT_FAILED);
  CHECK(has(fipa_error(), "fipa up"));
  CHECK(fipa_register_service(rover, text("{\"kind\": 1}")) == FIPA_RESULT_INVALID);
#ifdef FIPA_GATEWAY
  gateway(argv[1]);
#endif

  /* Closing an agent ends what waits for it, and closing the domain closes the rest. */
  OK(fipa_listen(arm, 50, &listening));
  OK(fipa_close(arm));
  CHECK(next(domain, 50, FIPA_EVENT_ENDED).result == FIPA_RESULT_CLOSED);
  close_all(&domain, 1);
  /* Letters that were delivered before, such as the reports of ended conversations, are not lost. */
  do {
    result = fipa_receive(rover, 0, &letter);
  } while (result == FIPA_RESULT_OK && fipa_close(letter) == FIPA_RESULT_OK);
  CHECK(result == FIPA_RESULT_CLOSED);
  CHECK(fipa_send(rover, &last, -1, NULL) == FIPA_RESULT_CLOSED);
  OK(fipa_close(rover));
  puts("all steps passed");
  return 0;
}
