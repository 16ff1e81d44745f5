/* A carrier in C++, which bids its distance from a crate. Usage: bid NAME X Y */

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <map>

#include "partner.hpp"

enum tag : std::uint64_t { calls = 1, replies };

class carrier {
 public:
  carrier(const std::string& name, double x, double y)
      : name_(name),
        x_(x),
        y_(y),
        domain_(fipa::domain::open().value()),
        agent_(domain_.add_agent(name).value()),
        server_(agent_.serve("fipa-contract-net", calls).value()) {}

  void run() {
    while (auto item = domain_.next().value()) {
      if (item->kind() == fipa::event::task) {
        bid(item->take_task().value());
      } else if (item->kind() == fipa::event::decision) {
        decided(item->refers_to(), item->number() == 1);
      }
    }
  }

 private:
  /* A carrier refuses a crate that is farther away. */
  static constexpr double reach = 6.0;

  void bid(fipa::task task) {
    double x = 0.0, y = 0.0;
    std::sscanf(task.content().string().c_str(), R"({ "x" : %lf , "y" : %lf })", &x, &y);
    const double distance = std::hypot(x - x_, y - y_);
    if (distance > reach) {
      std::cout << "refused" << std::endl;
      task.begin_send(fipa::reply::refuse, "too far", replies).value();
      return;
    }
    const std::string proposal = R"({"distance": )" + std::to_string(distance) + "}";
    task.begin_send(fipa::reply::propose, proposal, replies).value();
    const std::uint64_t id = task.id();
    open_.emplace(id, std::move(task));
  }

  /* A task without a further message ends when it is removed. */
  void decided(std::uint64_t id, bool accepted) {
    std::cout << (accepted ? "accepted" : "rejected") << std::endl;
    const auto task = open_.extract(id);
    if (accepted) task.mapped().begin_send(fipa::reply::inform, "carried by " + name_, replies).value();
  }

  std::string name_;
  double x_, y_;
  fipa::domain domain_;
  fipa::agent agent_;
  fipa::server server_;
  /* The tasks with a proposal. */
  std::map<std::uint64_t, fipa::task> open_;
};

int main(int argc, char** argv) {
  if (argc != 4) return 2;
  try {
    carrier carrier(argv[1], std::atof(argv[2]), std::atof(argv[3]));
    std::cout << "ready" << std::endl;
    carrier.run();
  } catch (const fipa::failure& failure) {
    std::cerr << failure.what() << '\n';
  }
  return 1;
}
