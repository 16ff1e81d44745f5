/* A driver with an event loop of its own. The agent `arm` serves requests to move to a position,
 * and publishes its position 50 times per second. Only poll waits.
 *
 * Usage: driver [CONFIG]. It ends when its standard input is closed.
 */

#include <poll.h>
#include <unistd.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>

#include "fipa.hpp"

using namespace std::chrono_literals;
using clock_type = std::chrono::steady_clock;

enum tag : std::uint64_t { requests = 1, replies = 2 };

/* The hardware: it moves by at most 0.02 per control step. */
struct arm {
  double position = 0.0;
  double target = 0.0;

  void step() { position += std::fmax(-0.02, std::fmin(0.02, target - position)); }
  bool has_arrived() const { return std::fabs(target - position) < 1e-9; }
};

class driver {
 public:
  explicit driver(std::string_view config)
      : domain_(fipa::domain::open({config}).value()),
        agent_(domain_.add_agent("arm", {"manipulator", "an arm with one axis"}).value()),
        position_(agent_.publisher({"position", "text/plain", 50.0, 1}).value()),
        server_(agent_.serve("fipa-request", requests).value()) {}

  void run() {
    pollfd polled[] = {{domain_.descriptor().value(), POLLIN, 0}, {STDIN_FILENO, POLLIN, 0}};
    auto due = clock_type::now();
    while (true) {
      const auto wait = fipa::limit(due - clock_type::now()).milliseconds();
      poll(polled, 2, static_cast<int>(wait));
      char ignored[64];
      if (polled[1].revents != 0 && read(STDIN_FILENO, ignored, sizeof ignored) <= 0) return;
      while (auto item = domain_.next(fipa::at_once).value()) handle(*item);
      if (clock_type::now() >= due) {
        control();
        due += 20ms;
      }
    }
  }

 private:
  void handle(fipa::item& item) {
    switch (item.kind()) {
      case fipa::event::task:
        begin(item.take_task().value());
        break;
      case fipa::event::cancel:
        if (item.refers_to() == task_.id()) {
          arm_.target = arm_.position;
          end(fipa::reply::inform, "stopped");
        }
        break;
      default:
        // The end of a reply: its initiator may be gone.
        if (!item.succeeded()) std::fprintf(stderr, "arm: %s\n", item.error().text().c_str());
    }
  }

  void begin(fipa::task task) {
    const std::string content = task.content().string();
    char* end = nullptr;
    const double target = std::strtod(content.c_str(), &end);
    if (end == content.c_str() || !(target >= 0.0 && target <= 1.0)) {
      task.begin_send(fipa::reply::refuse, "the position is not in 0 to 1", replies).value();
    } else if (task_) {
      task.begin_send(fipa::reply::refuse, "the arm is moving", replies).value();
    } else {
      task.begin_send(fipa::reply::agree, {}, replies).value();
      task_ = std::move(task);
      arm_.target = target;
    }
  }

  void control() {
    arm_.step();
    const std::string position = std::to_string(arm_.position);
    position_.publish(position).value();
    if (task_ && arm_.has_arrived()) end(fipa::reply::inform, position);
  }

  void end(fipa::reply act, fipa::bytes content) {
    task_.begin_send(act, content, replies).value();
    task_ = {};
  }

  fipa::domain domain_;
  fipa::agent agent_;
  fipa::publisher position_;
  fipa::server server_;
  fipa::task task_;
  arm arm_;
};

int main(int argc, char** argv) {
  try {
    driver driver(argc > 1 ? argv[1] : "");
    std::puts("ready");
    std::fflush(stdout);
    driver.run();
  } catch (const fipa::failure& failure) {
    std::fprintf(stderr, "driver: %s\n", failure.what());
    return 1;
  }
  return 0;
}
