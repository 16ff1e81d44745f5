/* An operator of the arm of `driver.cpp`, with coroutines over the descriptor of its domain.
 *
 * Usage: operator [CONFIG]
 */

#include <cstdio>
#include <cstdlib>

#include "coroutines.hpp"

using namespace std::chrono_literals;

/* Prints positions, and waits until the arm is at one of at least `least`. */
static job<bool> reached(inbox& positions, double least) {
  while (true) {
    fipa::item item = co_await positions.next();
    if (item.kind() == fipa::event::ended) throw fipa::failure(item.error());
    // An interrupted subscription goes on.
    if (item.kind() != fipa::event::notification) continue;
    const fipa::letter letter = item.take_letter().value();
    const double position = std::strtod(letter.content().string().c_str(), nullptr);
    std::printf("at %.2f\n", position);
    if (position >= least) co_return true;
  }
}

static job<int> operate(loop& events, const fipa::agent& agent) {
  inbox positions(events);
  const fipa::operation subscription =
      agent.subscribe({.to = "arm", .content = "position"}, positions.tag()).value();

  // The answer of a request that was begun, while positions arrive.
  request half(events, agent, {.to = "arm", .content = "0.5"}, 30s);
  auto answering = half.answer();
  co_await reached(positions, 0.4);
  const fipa::letter moved = (co_await answering).value();
  std::printf("moved to %.2f\n", std::strtod(moved.content().string().c_str(), nullptr));

  request too_far(events, agent, {.to = "arm", .content = "7"}, 30s);
  const auto refused = co_await too_far.answer();
  std::printf("refused: %s\n", refused.error().text().c_str());

  request full(events, agent, {.to = "arm", .content = "1"}, 30s);
  co_await reached(positions, 0.6);
  full.cancel();
  const auto stopped = co_await full.answer();
  std::printf("%s\n", stopped.error().code() == fipa::errc::cancelled ? "stopped" : "not stopped");
  co_return stopped ? 1 : 0;
}

int main(int argc, char** argv) {
  try {
    const auto domain = fipa::domain::open({argc > 1 ? argv[1] : ""}).value();
    const auto agent = domain.add_agent("operator").value();
    loop events(domain);
    return events.run(operate(events, agent));
  } catch (const fipa::failure& failure) {
    std::fprintf(stderr, "operator: %s\n", failure.what());
    return 1;
  }
}
