/* The leader in C++. Usage: lead NAME PARTNER */

#include <cstdio>
#include <iostream>
#include <set>

#include "partner.hpp"

using namespace std::chrono_literals;

/* A time limit that no step reaches, and one that passes. */
constexpr auto long_limit = 60s;
constexpr auto short_limit = 3s;

enum tag : std::uint64_t { operations = 1 };

template <class T>
static void step(std::string_view name, const T& observed) {
  std::cout << std::boolalpha << name << ": " << observed << std::endl;
}

/* Prints the failure of a step that must fail. */
static void fails(std::string_view name, const fipa::error& error) {
  step(name, kind(error.code()) + ": " + error.text());
}

static void fill(std::byte* content, std::size_t size) {
  for (std::size_t at = 0; at < size; at++) content[at] = static_cast<std::byte>(at % 251);
}

/* Returns the first two numbers of a fence, whose order is that of the fences. */
static std::pair<unsigned long long, unsigned long long> position(const std::string& fence) {
  std::pair<unsigned long long, unsigned long long> position;
  std::sscanf(fence.c_str(), "%llu.%llu", &position.first, &position.second);
  return position;
}

class leader {
 public:
  leader(std::string own, std::string partner)
      : own_(std::move(own)),
        partner_(std::move(partner)),
        domain_(fipa::domain::open().value()),
        agent_(domain_.add_agent(own_).value()) {}

  void run() {
    step("register", own_);
    step("register the partner", kind(domain_.add_agent(partner_).error().code()));
    letters();
    requests();
    goals();
    notifications();
    locks();
    violations();
    const auto wait = agent_.begin_request({{}, partner_, "wait"}, operations).value();
    step("request without an end", next().kind() == fipa::event::agreed);
    fails("the partner is killed", next().error());
  }

 private:
  /* Waits for a letter of a conversation. Others are late messages of conversations that have ended. */
  fipa::letter receive(std::string_view conversation) const {
    while (auto letter = agent_.receive().value()) {
      if (letter->message().conversation_id() == conversation) return std::move(*letter);
    }
    return {};
  }

  fipa::message inform(std::string_view conversation, fipa::bytes content) const {
    fipa::message message{"inform", partner_, content};
    message.conversation_id = conversation;
    return message;
  }

  /* Requests an action, with the fence of a lock or none. */
  fipa::result<fipa::letter> ask(std::string_view content, fipa::limit limit = long_limit,
                                 fipa::guard lock = {}) const {
    fipa::message request{{}, partner_, content};
    request.guard = lock;
    return agent_.request(request, limit);
  }

  std::string asked(std::string_view content, fipa::guard lock = {}) const {
    const auto answer = ask(content, long_limit, lock).value();
    return answer.content().string();
  }

  fipa::item next() const { return std::move(*domain_.next().value()); }

  void letters() const {
    fipa::message hello = inform("inform", "Grüße, 起重机 🏗");
    hello.language = "text";
    hello.reply_with = "q1";
    agent_.send(hello).value();
    fipa::letter answer = receive("inform");
    step("inform", answer.content().text());
    step("in reply to", answer.message().in_reply_to());
    step("sender", answer.message().sender());

    fipa::loan loan = agent_.loan(inform("loan", {}), 1000000).value();
    fill(loan.data(), loan.size());
    loan.send().value();
    answer = receive("loan");
    step("loan", answer.content().text());

    std::vector<std::byte> content(64000000);
    fill(content.data(), content.size());
    agent_.send(inform("large", content)).value();
    answer = receive("large");
    step("large", answer.content().text());

    fipa::message unknown{"inform", "missing", ""};
    unknown.conversation_id = "unknown";
    fails("unknown receiver", agent_.send(unknown, short_limit).error());
    answer = receive("unknown");
    step("report", answer.message().performative());

    const std::array both = {partner_, partner_ + "_2"};
    fipa::message multicast{"inform", both, "both"};
    multicast.conversation_id = "both";
    agent_.send(multicast).value();
    std::set<std::string> answers;
    while (answers.size() < both.size()) {
      answer = receive("both");
      answers.insert(std::string(answer.message().sender()) + " " + answer.content().string());
    }
    step("multicast", *answers.begin() + "; " + *answers.rbegin());
  }

  void requests() const {
    const auto lift = agent_.begin_request({{}, partner_, "lift"}, operations).value();
    step("agreed", next().kind() == fipa::event::agreed);
    const auto answer = next().take_letter().value();
    step("answer", answer.content().text());
    fails("refused", ask("drop").error());
    fails("failed", ask("throw").error());
    fails("timed out", ask("wait", short_limit).error());
    const auto wait = agent_.begin_request({{}, partner_, "wait"}, operations).value();
    (void)next();
    wait.cancel().value();
    fails("cancelled", next().error());
  }

  void goals() const {
    auto goal = agent_.begin_goal(partner_, "count", R"({"to": 7})", operations).value();
    fipa::item item = next();
    for (bool is_released = false; item.kind() != fipa::event::result; item = next()) {
      if (item.kind() != fipa::event::progress || is_released) continue;
      const std::string progress = item.take_json().value().string();
      const std::string key = R"("note":")";
      const auto found = progress.find(key);
      if (found == std::string::npos) continue;
      const auto from = found + key.size();
      step("progress", progress.substr(from, progress.find('"', from) - from));
      is_released = ask("go").has_value();
    }
    step("result", item.take_json().value().string());

    goal = agent_.begin_goal(partner_, "count", R"({"to": "far"})", operations).value();
    fails("wrong goal", next().error());
    goal = agent_.begin_goal(partner_, "count", R"({"to": 8})", operations).value();
    (void)next();
    goal.cancel().value();
    do item = next();
    while (item.kind() == fipa::event::progress);
    fails("cancelled goal", item.error());
  }

  void notifications() const {
    const auto charge = agent_.subscribe({{}, partner_, "charge"}, operations, "all", long_limit).value();
    fipa::letter notification = next().take_letter().value();
    step("notification", notification.content().text());
    for (const auto* publish : {"publish 80", "publish 70 ☀"}) {
      ask(publish).value();
      notification = next().take_letter().value();
      step("notification", notification.content().text());
    }
  }

  void locks() const {
    step("no fence", asked("dock"));
    auto lock = agent_.lock("bay", long_limit).value();
    step("fence", asked("dock", lock));
    step("locked", asked("lock 200"));
    const std::string own(lock.state().value().fence);
    lock.close().value();
    const std::string answer = asked("lock 60000");
    const auto blank = answer.find(' ');
    step("late command", answer.substr(0, blank));
    step("next fence is greater", position(answer.substr(blank + 1)) > position(own));
  }

  /* Sends a message that its protocol does not have: with a domain that checks what it sends, and with one that does
   * not. */
  void violations() const {
    fipa::message propose{"propose", partner_, ""};
    propose.protocol = "fipa-request";
    propose.conversation_id = "violation";
    {
      const auto strict = fipa::domain::open({{}, "monitor.check=enforce"}).value();
      const auto other = strict.add_agent(own_ + "_strict").value();
      fails("violation", other.send(propose).error());
    }
    agent_.send(propose).value();
    const fipa::letter report = receive("violation report");
    step("violation at the partner", report.content().text());
  }

  std::string own_, partner_;
  fipa::domain domain_;
  fipa::agent agent_;
};

int main(int argc, char** argv) {
  if (argc != 3) return 2;
  try {
    leader(argv[1], argv[2]).run();
  } catch (const fipa::failure& failure) {
    std::cerr << failure.what() << '\n';
    return 1;
  }
  return 0;
}
