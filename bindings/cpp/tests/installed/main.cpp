// Sends a letter. The configuration is the first argument.

#include <cstdio>

#include <fipa.hpp>

int main(int argc, char** argv) {
  if (argc < 2) return 2;
  const auto domain = fipa::domain::open({argv[1]}).value();
  const auto agent = domain.add_agent("rover").value();
  agent.send({"inform", "rover"}).value();
#if defined(FIPA_GATEWAY)
  if (fipa::gateway::open({"/no/such/file"})) return 1;
#endif
  std::puts("all steps passed");
}
