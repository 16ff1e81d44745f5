// Reads a content after its letter is gone. The address sanitizer must end this program.

#include "check.hpp"

int main(int argc, char** argv) {
  CHECK(argc == 3);
  const auto domain = take(fipa::domain::open({argv[1]}));
  const auto agent = take(domain.add_agent("rover"));
  CHECK(agent.send({"inform", "rover", "a content"}));
  auto letter = take(agent.receive(step));
  const fipa::bytes content = letter->content();
  CHECK(content.text() == "a content");
  letter.reset();
  std::printf("%d\n", std::to_integer<int>(content[0]));
}
