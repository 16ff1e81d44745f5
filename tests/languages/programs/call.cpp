/* An operator in C++, which has crates carried. Usage: call NAME
 *
 * The position of a crate is a line of the standard input. The operator prints the proposals of the carriers, and
 * awards the nearest one after a further line.
 */

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <iomanip>
#include <iostream>
#include <sstream>

#include "partner.hpp"

using namespace std::chrono_literals;

enum tag : std::uint64_t { calling = 1, awarding };

struct proposal {
  double distance = 0.0;
  std::size_t index = 0;
  std::string sender{};
};

/* Returns the proposals, the nearest one first. */
static std::vector<proposal> sorted(const fipa::bids& bids, std::size_t count) {
  std::vector<proposal> proposals;
  for (std::size_t index = 0; index < count; index++) {
    const fipa::letter letter = bids.proposal(index).value();
    double distance = 0.0;
    std::sscanf(letter.content().string().c_str(), R"({ "distance" : %lf })", &distance);
    proposals.push_back({distance, index, std::string(letter.message().sender())});
  }
  std::sort(proposals.begin(), proposals.end(),
            [](const proposal& a, const proposal& b) { return a.distance < b.distance; });
  return proposals;
}

/* Returns the number of refusals among the other answers, which are in JSON. */
static int refusals(std::string_view others) {
  int count = 0;
  for (auto at = others.find("\"reason\":"); at != others.npos; at = others.find("\"reason\":", at + 1)) count++;
  return count;
}

static void call(const fipa::domain& domain, const fipa::agent& agent, double x, double y) {
  std::ostringstream crate;
  crate << R"({"x": )" << x << R"(, "y": )" << y << "}";
  const std::string content = crate.str();
  const fipa::operation operation =
      agent.begin_call({{}, "carrier_.*", content, "json"}, calling, 60s).value();
  fipa::item item = std::move(*domain.next().value());
  if (!item.succeeded()) throw fipa::failure(item.error());
  const fipa::bids bids = item.take_bids().value();
  const auto proposals = sorted(bids, item.number());
  for (const auto& one : proposals) std::cout << one.sender << " at " << one.distance << '\n';
  std::cout << refusals(bids.others()) << " refused" << std::endl;

  std::string line;
  std::getline(std::cin, line);
  std::vector<std::size_t> accepted;
  if (!proposals.empty()) accepted.push_back(proposals[0].index);
  bids.award(accepted, {}, awarding).value();
  for (item = std::move(*domain.next().value()); item.kind() == fipa::event::awarded;
       item = std::move(*domain.next().value())) {
    std::cout << proposals[0].sender << ": ";
    if (item.succeeded()) {
      const fipa::letter result = item.take_letter().value();
      std::cout << result.content().text() << std::endl;
    } else {
      std::cout << kind(item.error().code()) << std::endl;
    }
  }
  if (!item.succeeded()) throw fipa::failure(item.error());
}

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  try {
    const auto domain = fipa::domain::open().value();
    const auto agent = domain.add_agent(argv[1]).value();
    std::cout << std::fixed << std::setprecision(1) << "ready" << std::endl;
    std::string position;
    while (std::getline(std::cin, position)) {
      double x = 0.0, y = 0.0;
      std::istringstream(position) >> x >> y;
      call(domain, agent, x, y);
    }
  } catch (const fipa::failure& failure) {
    std::cerr << failure.what() << '\n';
    return 1;
  }
  return 0;
}
