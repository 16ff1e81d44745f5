// Two translation units with the header, one of them compiled without exceptions.

#include <csignal>
#include <sys/wait.h>
#include <unistd.h>

#include "check.hpp"

#ifdef FIPA_UNIT
static_assert(FIPA_EXCEPTIONS == 0);
void value_of_a_failure() {
  fipa::result<int>(fipa::error(fipa::errc::failed, "expected")).value();
}
#else
static_assert(FIPA_EXCEPTIONS == 1);
void value_of_a_failure();

int main() {
  bool is_thrown = false;
  try {
    fipa::result<int>(fipa::error(fipa::errc::failed, "expected")).value();
  } catch (const fipa::failure& failure) {
    is_thrown = std::string_view(failure.what()) == "expected";
  }
  CHECK(is_thrown);

  const pid_t child = fork();
  CHECK(child >= 0);
  if (child == 0) {
    value_of_a_failure();
    _exit(0);
  }
  int status = 0;
  CHECK(waitpid(child, &status, 0) == child && WIFSIGNALED(status));
  CHECK(WTERMSIG(status) == SIGABRT);
  std::puts("all steps passed");
}
#endif
