/* Sends a letter. The configuration is the first argument. */

#include <stdio.h>
#include <string.h>

#include <fipa.h>

int main(int argc, char **argv) {
  const fipa_text rover = {(const uint8_t *)"rover", 5}, inform = {(const uint8_t *)"inform", 6};
  fipa_domain_options options = {0};
  fipa_message message = {0};
  fipa_handle domain, agent;
  if (argc < 2) return 2;
  options.size = sizeof options;
  options.config.data = (const uint8_t *)argv[1];
  options.config.len = strlen(argv[1]);
  message.size = sizeof message;
  message.performative = inform;
  message.receivers = &rover;
  message.receiver_count = 1;
  if (fipa_open(&options, &domain) != FIPA_RESULT_OK) return 1;
  if (fipa_register(domain, rover, NULL, &agent) != FIPA_RESULT_OK) return 1;
  if (fipa_send(agent, &message, -1, NULL) != FIPA_RESULT_OK) return 1;
  if (fipa_close(domain) != FIPA_RESULT_OK) return 1;
  puts("all steps passed");
  return 0;
}
