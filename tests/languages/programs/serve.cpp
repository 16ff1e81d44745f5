/* The server in C++. Usage: serve NAME */

#include <cinttypes>
#include <cstdio>
#include <iostream>

#include "partner.hpp"

using namespace std::chrono_literals;

enum tag : std::uint64_t { letters = 1, letters_of_second, requests, goals };

/* Returns the length and the Adler-32 checksum of a content. */
static std::string sum(fipa::bytes content) {
  std::uint32_t a = 1, b = 0;
  for (const std::byte byte : content) {
    a = (a + std::to_integer<std::uint32_t>(byte)) % 65521;
    b = (b + a) % 65521;
  }
  char checksum[9];
  std::snprintf(checksum, sizeof checksum, "%08" PRIx32, b << 16 | a);
  return std::to_string(content.size()) + " bytes, " + checksum + ", 谢谢 🤖";
}

class server {
 public:
  explicit server(const std::string& name)
      : domain_(fipa::domain::open().value()),
        agent_(domain_.add_agent(name).value()),
        second_(domain_.add_agent(name + "_2").value()),
        bay_(agent_.own("bay", {0ms, {}, true, true}).value()),
        charge_(agent_.publisher({"charge", {}, 0.0, 1}).value()),
        offer_(agent_.offer(count, goals).value()),
        server_(agent_.serve("fipa-request", requests).value()),
        letters_(agent_.listen(letters).value()),
        letters_of_second_(second_.listen(letters_of_second).value()) {
    charge_.publish("90").value();
  }

  void run() {
    while (auto item = domain_.next().value()) {
      switch (item->kind()) {
        case fipa::event::letter:
          answer(item->tag() == letters ? agent_ : second_, item->take_letter().value());
          break;
        case fipa::event::task:
          handle(item->take_task().value());
          break;
        case fipa::event::cancel:
          if (item->refers_to() == waiting_.id() && item->succeeded()) waiting_.inform("cancelled").value();
          break;
        case fipa::event::goal:
          pursue(item->take_goal().value());
          break;
        case fipa::event::stop:
          if (item->refers_to() == goal_.id()) goal_.fail("stopped").value();
          break;
        default:
          std::cerr << "unexpected item\n";
          return;
      }
    }
  }

 private:
  static constexpr std::string_view count =
      R"({"name": "count", "parameters": [{"name": "to", "type": "integer"}], "result": "integer"})";

  static void answer(const fipa::agent& agent, const fipa::letter& letter) {
    const fipa::message_view message = letter.message();
    if (!letter.violation().empty()) {
      fipa::message report{"inform", message.sender(), letter.violation()};
      report.conversation_id = "violation report";
      agent.send(report).value();
    } else if (message.performative() == "inform") {
      agent.answer(letter, {"inform", {}, sum(letter.content())}).value();
    }
  }

  void handle(fipa::task task) {
    const std::string content = task.content().string();
    if (content == "lift") {
      task.agree().value();
      task.inform("lifted").value();
    } else if (content == "drop") {
      task.refuse("too heavy").value();
    } else if (content == "throw") {
      task.agree().value();
      task.fail("no motor").value();
    } else if (content == "wait") {
      // Until the leader cancels, which it may have done before the agreement.
      (void)task.agree();
      waiting_ = std::move(task);
    } else if (content == "go") {
      goal_.succeed(to_).value();
      task.inform().value();
    } else if (content.rfind("publish ", 0) == 0) {
      charge_.publish(content.substr(8)).value();
      task.inform().value();
    } else if (content == "dock") {
      task.inform(checked(task)).value();
      command_ = std::move(task);
    } else if (content.rfind("lock ", 0) == 0) {
      task.inform(lock(std::chrono::milliseconds(std::stol(content.substr(5))))).value();
    } else {
      task.refuse("unknown").value();
    }
  }

  std::string checked(const fipa::task& command) const {
    const auto result = bay_.check(command);
    return result ? "admitted" : kind(result.error().code());
  }

  /* Locks the bay for the second agent, while the first checks the late command. */
  std::string lock(std::chrono::milliseconds limit) const {
    const auto lock = second_.lock("bay", limit);
    if (!lock) return kind(lock.error().code());
    return checked(command_) + " " + std::string(lock->state().value().fence);
  }

  void pursue(fipa::goal goal) {
    goal_ = std::move(goal);
    const std::string_view arguments = goal_.arguments();
    const auto from = arguments.find(':') + 1;
    to_ = arguments.substr(from, arguments.size() - 1 - from);
    goal_.progress(R"({"fraction": 0.5, "note": "half way"})").value();
  }

  fipa::domain domain_;
  fipa::agent agent_, second_;
  fipa::owned_resource bay_;
  fipa::publisher charge_;
  fipa::offer offer_;
  fipa::server server_;
  fipa::operation letters_, letters_of_second_;
  fipa::task waiting_;
  // The last command with a fence.
  fipa::task command_;
  // The goal that is pursued, and the number to which it counts.
  fipa::goal goal_;
  std::string to_;
};

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  try {
    server server(argv[1]);
    std::cout << "ready" << std::endl;
    server.run();
  } catch (const fipa::failure& failure) {
    std::cerr << failure.what() << '\n';
  }
  return 1;
}
