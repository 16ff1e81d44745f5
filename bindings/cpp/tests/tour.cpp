/* Each class of the header, between agents of one process. The configuration is the first argument,
 * and a directory for files the second. */

#include <poll.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <csignal>
#include <cstring>
#include <memory>

#include "check.hpp"

using namespace std::chrono_literals;
using fipa::errc;
using fipa::event;

// What the types promise.
template <class T>
constexpr bool is_move_only =
    std::is_nothrow_move_constructible_v<T> && std::is_nothrow_move_assignable_v<T> &&
    std::is_nothrow_default_constructible_v<T> && !std::is_copy_constructible_v<T> &&
    !std::is_copy_assignable_v<T>;
static_assert(is_move_only<fipa::domain> && is_move_only<fipa::agent> &&
              is_move_only<fipa::letter> && is_move_only<fipa::content> &&
              is_move_only<fipa::loan> && is_move_only<fipa::task> && is_move_only<fipa::server> &&
              is_move_only<fipa::operation> && is_move_only<fipa::lock> &&
              is_move_only<fipa::owned_resource> && is_move_only<fipa::publisher> &&
              is_move_only<fipa::notification_loan> && is_move_only<fipa::json> &&
              is_move_only<fipa::bids> && is_move_only<fipa::offer> && is_move_only<fipa::goal> &&
              is_move_only<fipa::coalition> && is_move_only<fipa::member>);
static_assert(!std::is_copy_constructible_v<fipa::item>);
// A handle is no number, and a handle of one class is none of another.
static_assert(!std::is_convertible_v<fipa::agent, bool>);
static_assert(!std::is_constructible_v<fipa::agent, fipa_handle>);
static_assert(!std::is_constructible_v<fipa::agent, fipa::letter>);
static_assert(std::is_same_v<fipa::domain, fipa::v0::domain>);
static_assert(std::is_trivially_copyable_v<fipa::bytes> && sizeof(fipa::agent) == 8);

template <class T, class = void>
constexpr bool has_content = false;
template <class T>
constexpr bool has_content<T, std::void_t<decltype(std::declval<T>().content())>> = true;
// The content of a temporary letter does not compile.
static_assert(has_content<fipa::letter&> && !has_content<fipa::letter>);

static_assert(fipa::limit(1500us).milliseconds() == 2 && fipa::limit(2ms).milliseconds() == 2);
static_assert(fipa::limit(-1s).milliseconds() == 0 && fipa::limit(0.5s).milliseconds() == 500);
static_assert(fipa::limit(std::chrono::hours::max()).milliseconds() == 3'153'600'000'000);
static_assert(fipa::unlimited.milliseconds() == -1 && fipa::limit(std::nullopt).milliseconds() < 0);
static_assert(fipa::at_once.milliseconds() == 0);
static_assert(fipa::limit(std::optional(3ms)).milliseconds() == 3);
static_assert(fipa::limit(std::optional<std::chrono::seconds>()).milliseconds() == -1);

#if defined(__cpp_lib_span)
static_assert(std::is_convertible_v<fipa::bytes, std::span<const std::byte>>);
static_assert(std::is_convertible_v<std::span<const std::byte>, fipa::bytes>);
#elif __cplusplus >= 202002L
#error "C++20 without std::span"
#endif

static void views() {
  const std::vector<unsigned char> numbers{1, 2, 3};
  const std::array<std::byte, 2> array{};
  const std::string text = "abc";
  CHECK(fipa::bytes(numbers).size() == 3 && fipa::bytes(numbers)[2] == std::byte{3});
  CHECK(fipa::bytes(array).size() == 2 && fipa::bytes(text).text() == "abc");
  CHECK(fipa::bytes("ab").string() == "ab" && fipa::bytes().empty());
  CHECK(fipa::bytes().data() == nullptr && fipa::bytes("").data() != nullptr);
  CHECK(fipa::bytes().text().empty());
  int sum = 0;
  for (const std::byte byte : fipa::bytes(numbers)) sum += std::to_integer<int>(byte);
  CHECK(sum == 6);
#if defined(__cpp_lib_span)
  const std::span<const std::byte> span = fipa::bytes(numbers);
  CHECK(span.size() == 3 && fipa::bytes(span).data() == span.data());
#endif

  const std::vector<std::string> strings{"a", "b", "c", "d", "e", "f"};
  const std::array<std::string_view, 2> views{"x", "y"};
  CHECK(fipa::texts().size() == 0 && fipa::texts("").size() == 0);
  CHECK(fipa::texts("one").size() == 1 && fipa::texts(text)[0] == "abc");
  CHECK(fipa::texts(strings).size() == 6 && fipa::texts(strings)[5] == "f");
  CHECK(fipa::texts(views).size() == 2 && fipa::texts(views)[1] == "y");
}

/* Errors as values, and as exceptions or an abort. */
static void errors(const fipa::domain& domain) {
  const auto taken = domain.add_agent("rover");
  CHECK(!taken && !taken.has_value() && taken.error().code() == errc::name_taken);
  CHECK(has(taken.error().text(), "rover"));
  const fipa::result<int> number = 7;
  CHECK(number && *number == 7 && number.value() == 7 && number.error().code() == errc::ok);
  CHECK(number.error().text().empty());
  const auto missing = fipa::domain::open({"/no/such/file"});
  CHECK(missing.error().code() == errc::invalid && has(missing.error().text(), "/no/such/file"));
  // A result of a type without a default constructor that can only be moved.
  fipa::result<std::unique_ptr<int>> pointer = std::make_unique<int>(3);
  CHECK(**pointer == 3);
  CHECK(*std::move(pointer).value() == 3);

#if FIPA_EXCEPTIONS
  bool is_thrown = false;
  try {
    (void)domain.add_agent("rover").value();
  } catch (const std::runtime_error& error) {
    const auto* failure = dynamic_cast<const fipa::failure*>(&error);
    is_thrown = failure != nullptr && failure->code() == errc::name_taken &&
                has(failure->what(), "rover");
  }
  CHECK(is_thrown);
  is_thrown = false;
  try {
    fipa::agent().send({"inform", "arm"}).value();
  } catch (const fipa::failure& failure) {
    is_thrown = failure.code() == errc::bad_handle;
  }
  CHECK(is_thrown);
  fipa::domain().close().value();
#else
  const pid_t child = fork();
  CHECK(child >= 0);
  if (child == 0) {
    fipa::result<int>(fipa::error(errc::failed, "expected")).value();
    _exit(0);
  }
  int status = 0;
  CHECK(waitpid(child, &status, 0) == child && WIFSIGNALED(status));
  CHECK(WTERMSIG(status) == SIGABRT);
#endif
}

/* A handle has one owner at each time, and is closed once. */
static void owners(const fipa::domain& domain) {
  fipa::agent one = take(domain.add_agent("one"));
  const fipa_handle raw = one.raw();
  CHECK(one && raw != 0);
  fipa::agent two = std::move(one);
  CHECK(!one && one.raw() == 0 && two.raw() == raw);  // NOLINT: it is moved from
  CHECK(one.send({"inform", "two"}).error().code() == errc::bad_handle);
  CHECK(one.close());

  // Assignment closes what the target had.
  fipa::agent three = take(domain.add_agent("three"));
  const fipa_handle closed = three.raw();
  three = std::move(two);
  CHECK(!two && three.raw() == raw && fipa_close(closed) == FIPA_RESULT_BAD_HANDLE);
  fipa::agent& same = three;
  three = std::move(same);
  CHECK(three.raw() == raw);

  // The second close has no handle that it could close.
  CHECK(three.close() && !three && three.close());
  CHECK(fipa_close(raw) == FIPA_RESULT_BAD_HANDLE);

  // The destructor closes, and the name is free again.
  { const fipa::agent four = take(domain.add_agent("four")); }
  fipa::agent four = take(domain.add_agent("four"));

  // To the C interface and back.
  const fipa_handle released = four.release();
  CHECK(!four);
  four = fipa::agent::adopt(released);
  CHECK(four.raw() == released);

  // An object whose handle the C interface has closed reports it.
  CHECK(fipa_close(four.raw()) == FIPA_RESULT_OK);
  CHECK(four.close().error().code() == errc::bad_handle && !four);
}

static void letters(const fipa::agent& rover, const fipa::agent& arm) {
  const fipa::parameter parameters[] = {{"X-weight", "12"}, {"X-color", "red"}};
  const auto due = std::chrono::system_clock::time_point(1893456000s);
  const std::vector<std::string> everyone{"arm", "rover"};
  fipa::message lift;
  lift.performative = "inform";
  lift.to = everyone;
  lift.content = "(lift crate)";
  lift.language = "fipa-sl";
  lift.encoding = "utf-8";
  lift.ontology = "logistics";
  lift.conversation_id = "c1";
  lift.reply_with = "r1";
  lift.reply_to = "rover";
  lift.reply_by = due;
  lift.parameters = parameters;
  lift.parameter_count = 2;
  const auto outcomes = take(rover.send_for_outcomes(lift));
  CHECK(outcomes.delivered && has(outcomes.details.view(), "\"receiver\":\"arm\""));
  CHECK(outcomes.details.string() == outcomes.details.view());
  CHECK(take(rover.receive(step)));

  const auto received = take(arm.receive(step));
  CHECK(received);
  const fipa::letter& letter = *received;
  CHECK(letter.content().text() == "(lift crate)" && letter.violation().empty());
  CHECK(letter.via().empty() || has("inproc shm unix", letter.via()));
  const fipa::message_view view = letter.message();
  CHECK(view.performative() == "inform" && view.sender() == "rover");
  CHECK(view.receiver_count() == 2 && view.receiver(0) == "arm" && view.receiver(1) == "rover");
  CHECK(view.reply_to_count() == 1 && view.reply_to(0) == "rover");
  CHECK(view.content().data() == letter.content().data());
  CHECK(view.language() == "fipa-sl" && view.encoding() == "utf-8");
  CHECK(view.ontology() == "logistics" && view.conversation_id() == "c1");
  CHECK(view.reply_with() == "r1" && view.protocol().empty() && view.in_reply_to().empty());
  CHECK(view.reply_by() == due);
  CHECK(view.parameter_count() == 2 && view.parameter("X-weight") == "12");
  CHECK(!view.parameter("X-size") && view.parameter(std::size_t{1}).name == "X-color");

  CHECK(arm.answer(letter, {"confirm", {}, "done"}));
  const auto answer = take(rover.receive(step));
  CHECK(answer && answer->content().text() == "done");
  CHECK(answer->message().conversation_id() == "c1" && answer->message().sender() == "arm");
  CHECK(answer->message().in_reply_to() == "r1" && !answer->message().reply_by());
  CHECK(!take(rover.receive(fipa::at_once)) && !take(rover.receive(1ms)));

  // More names than fit into the message itself.
  const std::vector<std::string> many{"a", "b", "c", "d", "e", "f"};
  fipa::message wide{"inform", "arm"};
  wide.reply_to = many;
  CHECK(rover.send(wide));
  const auto wide_letter = take(arm.receive(step));
  CHECK(wide_letter && wide_letter->message().reply_to_count() == many.size());
  for (std::size_t i = 0; i < many.size(); i++) {
    CHECK(wide_letter->message().reply_to(i) == many[i]);
  }

  // An empty letter reads as an empty message.
  const fipa::letter none;
  CHECK(none.content().empty() && none.message().performative().empty() && none.via().empty());

  const fipa::message lost{"inform", "missing", "x"};
  const auto failed = rover.send(lost, 100ms);
  CHECK(failed.error().code() == errc::not_delivered);
  CHECK(has(failed.error().text(), "no such agent"));
  const auto reported = take(rover.send_for_outcomes(lost, 100ms));
  CHECK(!reported.delivered && has(reported.details.view(), "\"outcome\":\"failed\""));
  CHECK(rover.send_for_outcomes({"no act", "arm"}).error().code() == errc::invalid);
  // The reports of the message transport service.
  CHECK(take(rover.receive(step)) && take(rover.receive(step)));
}

static void loans(const fipa::domain& domain, const fipa::agent& rover, const fipa::agent& arm) {
  const std::size_t size = 1'000'000;
  const fipa::message image{"inform", "arm"};
  fipa::loan loan = take(rover.loan(image, size));
  CHECK(loan && loan.size() == size);
  std::memset(loan.data(), 7, loan.size());
#if defined(__cpp_lib_span)
  CHECK(loan.span().size() == size && loan.span().back() == std::byte{7});
#endif
  CHECK(loan.send());
  CHECK(!loan && loan.data() == nullptr && loan.size() == 0);
  CHECK(loan.send().error().code() == errc::bad_handle);
  auto letter = take(arm.receive(step));
  CHECK(letter && letter->content().size() == size && letter->in_place());
  const auto counts = take(domain.content_counts());
  CHECK(counts.in_place > 0 && counts.copied == 0);
  const auto content = letter->content();
  CHECK(std::count(content.begin(), content.end(), std::byte{7}) == 1'000'000);

  loan = take(rover.loan(image, 10));
  std::memcpy(loan.data(), "0123456789", 10);
  fipa::loan moved = std::move(loan);
  CHECK(loan.data() == nullptr && moved.size() == 10);  // NOLINT: it is moved from
  CHECK(moved.begin_send(5));
  const auto outcomes = take(next(domain, 5, event::outcomes).take_json());
  CHECK(has(outcomes.view(), "delivered"));
  letter = take(arm.receive(step));
  CHECK(letter && letter->content().text() == "0123456789");

  // A loan that is dropped, and one that is not delivered.
  { const auto dropped = take(rover.loan(image, 10)); }
  CHECK(rover.loan(image, SIZE_MAX).error().code() == errc::too_large);
  loan = take(rover.loan({"inform", "missing"}, 1));
  *loan.data() = std::byte{1};
  CHECK(loan.send(100ms).error().code() == errc::not_delivered && !loan);
  CHECK(take(rover.receive(step)));
}

/* A content is valid after its agent and its domain are closed. */
static void kept(const std::string_view config) {
  auto domain = take(fipa::domain::open({config}));
  auto camera = take(domain.add_agent("camera"));
  auto viewer = take(domain.add_agent("viewer"));
  const std::string pixels(100'000, 'p');
  CHECK(camera.send({"inform", "viewer", pixels}));
  auto letter = take(viewer.receive(step));
  fipa::content first(std::move(*letter));
  CHECK(!*letter);
  CHECK(viewer.close() && camera.close() && domain.close());
  fipa::content content = std::move(first);
  CHECK(first.view().empty());  // NOLINT: it is moved from
  CHECK(content.view().text() == pixels);
  content = fipa::content();
  CHECK(content.view().empty());
}

/* An event loop: the descriptor is polled, and items are taken until there is none. */
static void items(const fipa::domain& domain, const fipa::agent& rover, const fipa::agent& arm) {
  const fipa::message one{"inform", "arm", "1"};
  pollfd polled{take(domain.descriptor()), POLLIN, 0};
  auto listening = take(arm.listen(1));
  CHECK(!take(domain.next(fipa::at_once)) && poll(&polled, 1, 0) == 0);
  for (int i = 0; i < 100; i++) CHECK(rover.begin_send(one, 2));
  int letters = 0, outcomes = 0;
  while (letters < 100 || outcomes < 100) {
    CHECK(poll(&polled, 1, fipa::limit(step).milliseconds()) == 1);
    while (auto item = take(domain.next(fipa::at_once))) {
      CHECK(item->succeeded() && item->number() == 0 && item->refers_to() == 0);
      if (item->kind() == event::letter) {
        CHECK(item->tag() == 1 && !item->take_task() && !item->take_lock());
        const auto letter = take(item->take_letter());
        CHECK(letter.message().sender() == "rover");
        CHECK(item->take_letter().error().code() == errc::bad_handle);
        letters++;
      } else {
        // The item closes what is not taken.
        CHECK(item->kind() == event::outcomes && item->tag() == 2 && !item->take_letter());
        outcomes++;
      }
    }
  }
  CHECK(letters == 100 && outcomes == 100);
  // The end of an operation loses no letter.
  CHECK(listening.close() && rover.send(one));
  CHECK(!take(domain.next(fipa::at_once)));
  CHECK(take(arm.receive(step)));

  CHECK(rover.begin_send({"inform", "missing", "1"}, 3, 100ms));
  auto failed = next(domain, 3, event::outcomes);
  CHECK(!failed.succeeded() && failed.error().code() == errc::not_delivered);
  CHECK(has(failed.error().text(), "missing"));
  const auto details = fipa::json::adopt(failed.release());
  CHECK(has(details.view(), "missing") && failed.release() == 0 && !failed.take_json());
  CHECK(take(rover.receive(step)));
}

static void directory(const fipa::domain& domain) {
  const auto found = take(domain.agents("ro.*"));
  CHECK(has(found.view(), "\"name\":\"rover\"") && !has(found.view(), "\"name\":\"arm\""));
  CHECK(domain.agents("(ro").error().code() == errc::invalid);
  CHECK(has(take(domain.routes("arm")).string(), "\"routes\":["));
  const auto following = take(domain.follow_agents(8));
  {
    const auto camera = take(domain.add_agent("camera_1", {"camera", "at the front"}));
    const auto change = take(next(domain, 8, event::change).take_json());
    CHECK(has(change.view(), "\"change\":\"joined\"") && has(change.view(), "at the front"));
    CHECK(has(take(domain.agents({}, "camera")).string(), "camera_1"));
  }
  const auto change = take(next(domain, 8, event::change).take_json());
  CHECK(has(change.view(), "\"change\":\"left\""));
}

static void requests(const fipa::domain& domain, const fipa::agent& rover, const fipa::agent& arm) {
  const fipa::message lift{"request", "arm", "lift"};
  auto server = take(arm.serve("fipa-request", 10));
  CHECK(!arm.serve("no-protocol", 11));

  // Agreed, then the result.
  auto request = take(rover.begin_request(lift, 20, step));
  auto task = take(next(domain, 10, event::task).take_task());
  CHECK(task.content().text() == "lift" && task.message().sender() == "rover");
  CHECK(task.agree());
  CHECK(next(domain, 20, event::agreed).succeeded());
  CHECK(task.begin_send(fipa::reply::inform, "lifted", 12));
  bool is_answered = false, is_sent = false;
  while (!is_answered || !is_sent) {
    auto item = take(domain.next(step));
    CHECK(item && item->succeeded());
    if (item->kind() == event::answer) {
      const auto answer = take(item->take_letter());
      is_answered = item->tag() == 20 && answer.content().text() == "lifted";
    } else {
      is_sent = item->kind() == event::ended && item->tag() == 12;
    }
  }
  CHECK(task.inform("again").error().code() == errc::closed);

  // Refused, failed, and dropped without an answer.
  request = take(rover.begin_request(lift, 21, step));
  task = take(next(domain, 10, event::task).take_task());
  CHECK(task.refuse("too heavy"));
  auto ended = next(domain, 21, event::ended);
  CHECK(ended.error().code() == errc::refused && has(ended.error().text(), "too heavy"));
  request = take(rover.begin_request(lift, 22, step));
  task = take(next(domain, 10, event::task).take_task());
  CHECK(task.agree() && next(domain, 22, event::agreed).succeeded() && task.fail("stuck"));
  CHECK(has(next(domain, 22, event::ended).error().text(), "stuck"));
  request = take(rover.begin_request(lift, 23, step));
  { auto dropped = next(domain, 10, event::task); }
  CHECK(next(domain, 23, event::ended).error().code() == errc::refused);

  // Cancelled, and the other side confirms.
  request = take(rover.begin_request(lift, 24, step));
  task = take(next(domain, 10, event::task).take_task());
  CHECK(task.agree() && next(domain, 24, event::agreed).succeeded());
  CHECK(request.cancel());
  {
    // The item does not own the task.
    const auto cancel = next(domain, 10, event::cancel);
    CHECK(cancel.refers_to() == task.id() && cancel.succeeded());
  }
  CHECK(task.begin_send(fipa::reply::inform, "stopped", 13));
  for (int i = 0; i < 2; i++) {
    const auto item = take(domain.next(step));
    CHECK(item && item->kind() == event::ended);
    CHECK(item->error().code() == (item->tag() == 24 ? errc::cancelled : errc::ok));
  }
  CHECK(server.close() && request.close());
  CHECK(fipa::operation().cancel().error().code() == errc::bad_handle);

  CHECK(rover.request({"request", "missing"}, 1s).error().code() == errc::not_delivered);
  const auto silent = take(domain.add_agent("silent"));
  CHECK(rover.request({"request", "silent"}, 10ms).error().code() == errc::timed_out);
}

static void contract_nets(const fipa::domain& domain, const fipa::agent& rover,
                          const fipa::agent& arm) {
  const std::array<std::string_view, 2> to{"arm", "missing"};
  const auto server = take(arm.serve("fipa-contract-net", 60));
  const auto calling = take(rover.begin_call({"cfp", to, "carry"}, 61, step));
  const auto task = take(next(domain, 60, event::task).take_task());
  CHECK(task.begin_send(fipa::reply::propose, "12", 62));
  auto item = next(domain, 61, event::bids);
  CHECK(item.number() == 1 && !item.take_letter());
  const auto bids = take(item.take_bids());
  CHECK(has(bids.others(), "\"unreached\":[\"missing\"]"));
  const auto proposal = take(bids.proposal(0));
  CHECK(proposal.content().text() == "12");
  CHECK(bids.proposal(1).error().code() == errc::invalid);
  CHECK(bids.award({1}, {}, 63).error().code() == errc::invalid);
  CHECK(bids.award({0}, "go", 63, step));
  CHECK(bids.award({0}, "go", 63).error().code() == errc::closed);
  for (int i = 0; i < 2; i++) {
    // The decision does not own the task.
    const auto decided = take(domain.next(step));
    CHECK(decided && decided->succeeded());
    CHECK(decided->kind() == event::decision
              ? decided->refers_to() == task.id() && decided->number() == 1
              : decided->kind() == event::ended && decided->tag() == 62);
  }
  CHECK(task.begin_send(fipa::reply::inform, "carried", 64));
  int awarded = 0;
  for (int i = 0; i < 3; i++) {
    auto ended = take(domain.next(step));
    CHECK(ended && ended->succeeded());
    if (ended->kind() == event::awarded) {
      const auto result = take(ended->take_letter());
      CHECK(ended->number() == 0 && result.content().text() == "carried");
      awarded++;
    }
  }
  CHECK(awarded == 1);
}

/* Takes the goal and its acceptance, which come in any order. */
static fipa::goal accepted(const fipa::domain& domain) {
  fipa::goal goal;
  for (int i = 0; i < 2; i++) {
    auto item = take(domain.next(step));
    CHECK(item && (item->kind() == event::goal || item->kind() == event::accepted));
    if (item->kind() == event::goal) goal = take(item->take_goal());
  }
  CHECK(goal);
  return goal;
}

static void actions(const fipa::domain& domain, const fipa::agent& rover, const fipa::agent& arm) {
  const std::string_view navigate = R"({"name": "navigate", "parameters":
      [{"name": "x", "type": "number", "range": {"min": 0, "max": 10}}]})";
  CHECK(arm.offer("{}", 70).error().code() == errc::invalid);
  const auto offer = take(arm.offer(navigate, 70));
  {
    const auto asking = take(rover.begin_actions("arm", 71));
    const auto actions = take(next(domain, 71, event::result).take_json());
    CHECK(has(actions.view(), "navigate"));
  }
  {
    const auto refused = take(rover.begin_goal("arm", "navigate", "{\"x\": 11}", 72));
    CHECK(!next(domain, 72, event::ended).succeeded());
  }
  CHECK(rover.begin_goal("arm", "navigate", "[1]", 72).error().code() == errc::invalid);
  const fipa::lock none;
  const auto unguarded = rover.begin_goal("arm", "navigate", {}, 72, step, none);
  CHECK(unguarded.error().code() == errc::bad_handle);

  auto going = take(rover.begin_goal("arm", "navigate", "{\"x\": 1.5}", 73, step));
  auto goal = accepted(domain);
  CHECK(goal.arguments() == "{\"x\":1.5}");
  CHECK(goal.progress("{\"fraction\": 0.5, \"value\": [0.7, 2]}"));
  std::string progress;
  while (!has(progress, "\"value\":[0.7,2]")) {
    progress = take(next(domain, 73, event::progress).take_json()).string();
  }
  CHECK(goal.succeed("{broken").error().code() == errc::invalid);
  CHECK(goal.succeed("{\"at\": 1.5}"));
  CHECK(goal.fail("late").error().code() == errc::closed);
  std::string result;
  while (result.empty()) {
    auto item = take(domain.next(step));
    CHECK(item && item->tag() == 73 && item->succeeded());
    if (item->kind() == event::result) result = take(item->take_json()).string();
  }
  CHECK(has(result, "\"at\":1.5"));

  going = take(rover.begin_goal("arm", "navigate", "{\"x\": 2}", 74, step));
  goal = accepted(domain);
  CHECK(going.cancel());
  bool is_ended = false;
  while (!is_ended) {
    const auto item = take(domain.next(step));
    CHECK(item);
    if (item->kind() == event::stop) {
      CHECK(item->refers_to() == goal.id() && item->error().code() == errc::cancelled);
      CHECK(goal.fail("stopped"));
    }
    is_ended = item->kind() == event::ended;
    CHECK(!is_ended || (item->tag() == 74 && !item->succeeded()));
  }

  const auto deciding = take(arm.offer(R"({"name": "grip", "decides": true})", 75));
  going = take(rover.begin_goal("arm", "grip", {}, 76));
  goal = take(next(domain, 75, event::goal).take_goal());
  CHECK(goal.accept());
  CHECK(next(domain, 76, event::accepted).succeeded());
  CHECK(goal.succeed());
  is_ended = false;
  while (!is_ended) {
    const auto item = take(domain.next(step));
    CHECK(item && item->tag() == 76 && item->succeeded());
    is_ended = item->kind() == event::result;
  }
  going = take(rover.begin_goal("arm", "grip", {}, 77));
  goal = take(next(domain, 75, event::goal).take_goal());
  CHECK(goal.fail("no power"));
  const auto refused = next(domain, 77, event::ended);
  CHECK(refused.error().code() == errc::refused && has(refused.error().text(), "no power"));
}

static void topics(const fipa::domain& domain, const fipa::agent& rover, const fipa::agent& arm) {
  const fipa::message charge{{}, "arm", "charge"};
  const auto publisher = take(arm.publisher({"charge", "text/plain", 0.0, 1}));
  CHECK(take(publisher.publish("90")) == 0);
  auto subscription = take(rover.subscribe(charge, 30, "all", step));
  auto item = next(domain, 30, event::notification);
  const auto latched = take(item.take_letter());
  CHECK(item.number() == 0 && latched.message().sender() == "arm");
  CHECK(take(publisher.publish("89")) == 1);
  const auto notification = take(next(domain, 30, event::notification).take_letter());
  CHECK(notification.content().text() == "89");
  auto loan = take(publisher.loan(3));
  std::memcpy(loan.data(), "low", 3);
  CHECK(take(loan.publish()) == 1 && !loan);
  CHECK(loan.publish().error().code() == errc::bad_handle);
  const auto low = take(next(domain, 30, event::notification).take_letter());
  CHECK(low.content().text() == "low");
  CHECK(rover.subscribe(charge, 31, "some").error().code() == errc::invalid);
  CHECK(arm.publisher({}).error().code() == errc::invalid);
  CHECK(subscription.close());
  while (take(publisher.publish("0")) != 0) {
  }
}

static void locks(const fipa::domain& domain, const fipa::agent& rover, const fipa::agent& arm,
                  const std::string_view state_dir) {
  fipa::own_options options;
  options.state_dir = state_dir;
  options.forget = true;
  const auto bay = take(arm.own("bay", options));
  const auto door = take(arm.own("door", options));
  const std::array<std::string_view, 2> both{"bay", "door"};
  auto lock = take(rover.lock(both, step));
  const auto state = take(lock.state());
  CHECK(state.is_held && state.remaining && *state.remaining > 0ms && !state.fence.empty());

  fipa::message command{"inform", "arm", "open"};
  command.guard = lock;
  CHECK(rover.send(command));
  // Letters of the conversations before may come first.
  auto letter = take(arm.receive(step));
  while (letter && letter->content().text() != "open") letter = take(arm.receive(step));
  CHECK(letter && bay.check(*letter) && door.check(*letter));
  CHECK(lock.close());
  // A message with a lock that is closed is not sent without its fences.
  CHECK(rover.send(command).error().code() == errc::bad_handle);
  CHECK(!take(arm.receive(fipa::at_once)));

  // The command of the former holder is late.
  auto locking = take(rover.begin_lock("bay", 40, step));
  auto next_lock = take(next(domain, 40, event::lock).take_lock());
  CHECK(bay.check(*letter).error().code() == errc::stale);
  CHECK(next_lock.close());
  CHECK(next(domain, 40, event::ended).error().code() == errc::closed);
  CHECK(next_lock.state().error().code() == errc::bad_handle);
}

static void coalitions(const fipa::domain& domain, const fipa::agent& rover,
                       const fipa::agent& arm, const std::string_view state_dir) {
  const std::array<std::string_view, 2> both{"rover", "arm"};
  fipa::own_options options;
  options.state_dir = state_dir;
  options.forget = true;
  CHECK(!arm.found_coalition("team", {}, options));
  const auto founded = take(arm.found_coalition("team", both, options));
  const fipa::agent* agents[] = {&rover, &arm};
  fipa::member members[] = {take(rover.join_coalition("team", 0)),
                            take(arm.join_coalition("team", 1))};
  std::optional<std::size_t> leader;
  while (!leader) {
    auto item = take(domain.next(step));
    CHECK(item && item->kind() == event::change);
    const auto change = take(item->take_json());
    if (has(change.view(), "\"leads\":true")) leader = item->tag();
  }
  const std::size_t follower = 1 - *leader;

  fipa::message command{"inform", both[follower], "turn"};
  command.guard = members[*leader];
  CHECK(agents[*leader]->send(command));
  auto letter = take(agents[follower]->receive(step));
  while (letter && letter->content().text() != "turn") {
    letter = take(agents[follower]->receive(step));
  }
  CHECK(letter && members[follower].check(*letter));
  command.to = both[*leader];
  command.guard = members[follower];
  CHECK(agents[follower]->send(command).error().code() == errc::lost);
  command.guard = fipa::member();
  CHECK(agents[follower]->send(command).error().code() == errc::bad_handle);

  CHECK(founded.change("rover") && members[*leader].resign());
  CHECK(fipa::coalition().change("rover").error().code() == errc::bad_handle);
  for (fipa::member& member : members) CHECK(member.close());
  while (take(domain.next(fipa::at_once))) {
  }
}

#if defined(FIPA_GATEWAY)
static void services(const fipa::agent& rover, const fipa::agent& arm) {
  CHECK(arm.register_service(R"({"type": "lift"})"));
  auto found = take(rover.search_services(R"({"type": "lift"})"));
  CHECK(has(found.view(), R"("name":"arm")"));
  CHECK(arm.deregister_services());
  found = take(rover.search_services());
  CHECK(!has(found.view(), "lift"));
  CHECK(rover.search_services("{").error().code() == errc::invalid);
}

static void gateways(const std::string_view config, const fipa::agent& rover,
                     const fipa::agent& arm) {
  const std::array<std::string_view, 1> set{"discovery.mdns=false"};
  auto gateway = take(fipa::gateway::open({config, set}));
  CHECK(has(fipa::gateway::open({config, set}).error().text(), "already running"));
  services(rover, arm);
  CHECK(gateway.close());
}
#endif

int main(int argc, char** argv) {
  CHECK(argc == 3 && fipa::version() == VERSION);
  views();
  kept(argv[1]);
  const std::array<std::string_view, 1> set{"mts.deadline=10s"};
  auto domain = take(fipa::domain::open({argv[1], set}));
  const auto rover = take(domain.add_agent("rover"));
  auto arm = take(domain.add_agent("arm"));
  errors(domain);
  owners(domain);
  letters(rover, arm);
  loans(domain, rover, arm);
  items(domain, rover, arm);
  directory(domain);
  requests(domain, rover, arm);
  contract_nets(domain, rover, arm);
  actions(domain, rover, arm);
  topics(domain, rover, arm);
  locks(domain, rover, arm, argv[2]);
  coalitions(domain, rover, arm, argv[2]);
#if defined(FIPA_GATEWAY)
  gateways(argv[1], rover, arm);
#endif

  // The end of an agent ends what waits for it.
  const auto listening = take(arm.listen(50));
  CHECK(arm.close());
  CHECK(next(domain, 50, event::ended).error().code() == errc::closed);
  CHECK(domain.close());
  CHECK(rover.send({"inform", "arm"}).error().code() == errc::closed);
  std::puts("all steps passed");
  return 0;
}
