/* The C interface of fipa: agents of robots, to the FIPA standards.
 *
 * Made from the Rust sources; see the README beside this folder.
 * SPDX-License-Identifier: MIT OR Apache-2.0
 */

#ifndef FIPA_H
#define FIPA_H

#include <stddef.h>
#include <stdint.h>

/*
 The result of a call. Zero is success, a positive number is success without a value, and a negative
 number is a failure. `fipa_error` has its text.
 */
enum fipa_result
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  /*
   The call has succeeded.
   */
  FIPA_RESULT_OK = 0,
  /*
   The time limit is over and nothing has arrived: no letter, no item.
   */
  FIPA_RESULT_EMPTY = 1,
  /*
   A pointer is NULL, a text is not UTF-8, a number is out of bounds, or a name or a configuration is invalid.
   */
  FIPA_RESULT_INVALID = -1,
  /*
   The handle was closed, is of another kind, or was never given out.
   */
  FIPA_RESULT_BAD_HANDLE = -2,
  /*
   The agent was deregistered, or the domain was closed.
   */
  FIPA_RESULT_CLOSED = -3,
  /*
   This process was forked from the one that opened the library. A child calls exec first.
   */
  FIPA_RESULT_FORKED = -4,
  /*
   The time limit is over before the operation has ended.
   */
  FIPA_RESULT_TIMED_OUT = -5,
  /*
   A letter was not delivered to each of its receivers.
   */
  FIPA_RESULT_NOT_DELIVERED = -6,
  /*
   The other agent refuses, fails, or does not understand.
   */
  FIPA_RESULT_REFUSED = -7,
  /*
   The other agent is gone, or its host is silent.
   */
  FIPA_RESULT_GONE = -8,
  /*
   The conversation was cancelled.
   */
  FIPA_RESULT_CANCELLED = -9,
  /*
   A message violates its protocol.
   */
  FIPA_RESULT_VIOLATION = -10,
  /*
   The lock was lost.
   */
  FIPA_RESULT_LOST = -11,
  /*
   The letter or the content is too large.
   */
  FIPA_RESULT_TOO_LARGE = -12,
  /*
   Another agent has the name.
   */
  FIPA_RESULT_NAME_TAKEN = -13,
  /*
   A fence is missing, or is not the live one.
   */
  FIPA_RESULT_STALE = -14,
  /*
   Another failure; the text says which.
   */
  FIPA_RESULT_FAILED = -15,
  /*
   A mistake of this library. The call had no effect that can be relied on.
   */
  FIPA_RESULT_PANIC = -16,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum fipa_result fipa_result;
#else
typedef int32_t fipa_result;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 The kind of an item, which says what its handle refers to.
 */
enum fipa_event
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  /*
   The operation has ended. `result` says how; there is no handle.
   */
  FIPA_EVENT_ENDED = 0,
  /*
   A message has its outcomes: `fipa_read_text`, the JSON of `fipa_send`.
   */
  FIPA_EVENT_OUTCOMES = 1,
  /*
   A letter has arrived: `fipa_read_message`.
   */
  FIPA_EVENT_LETTER = 2,
  /*
   The directory or a coalition has changed: `fipa_read_text`.
   */
  FIPA_EVENT_CHANGE = 3,
  /*
   The other agent has agreed to a request. There is no handle.
   */
  FIPA_EVENT_AGREED = 4,
  /*
   The answer to a request: `fipa_read_message`.
   */
  FIPA_EVENT_ANSWER = 5,
  /*
   A conversation that this agent serves has begun: `fipa_read_message`, `fipa_task_reply`.
   */
  FIPA_EVENT_TASK = 6,
  /*
   A notification of a subscription: `fipa_read_message`. `number` is the number of notifications that were missed
   just before.
   */
  FIPA_EVENT_NOTIFICATION = 7,
  /*
   A lock is held.
   */
  FIPA_EVENT_LOCK = 8,
  /*
   The initiator of a task cancels it, or is gone if `result` says so. The handle is that of the task.
   */
  FIPA_EVENT_CANCEL = 9,
  /*
   A subscription is interrupted for the reason in `result`, and goes on when the publisher returns. There is no
   handle.
   */
  FIPA_EVENT_INTERRUPTED = 10,
  /*
   The answers to a call for proposals: `fipa_read_bid`, `fipa_award`. `number` is the number of proposals.
   */
  FIPA_EVENT_BIDS = 11,
  /*
   The result of an accepted proposal: `fipa_read_message`, or no handle and the failure in `result`. `number` is
   the index of the proposal.
   */
  FIPA_EVENT_AWARDED = 12,
  /*
   The initiator has decided on the proposal of a task, whose handle it is. `number` is 1 if it has accepted.
   */
  FIPA_EVENT_DECISION = 13,
  /*
   A goal of an action that this agent offers: `fipa_read_text` returns its arguments, `fipa_goal_end` ends it.
   */
  FIPA_EVENT_GOAL = 14,
  /*
   A goal is to stop, for the reason in `result`: it was cancelled (`FIPA_RESULT_CANCELLED`), its time is over, or
   its client is gone. The handle is that of the goal.
   */
  FIPA_EVENT_STOP = 15,
  /*
   A robot has accepted a goal. There is no handle.
   */
  FIPA_EVENT_ACCEPTED = 16,
  /*
   The progress of a goal: `fipa_read_text`, a JSON object with `state`, `fraction`, `note` and `value`.
   */
  FIPA_EVENT_PROGRESS = 17,
  /*
   The result of a goal or of a question: `fipa_read_text`, the value in JSON.
   */
  FIPA_EVENT_RESULT = 18,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum fipa_event fipa_event;
#else
typedef int32_t fipa_event;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 The act of a message of a participant.
 */
enum fipa_reply
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  /*
   Agrees; the result follows.
   */
  FIPA_REPLY_AGREE = 0,
  /*
   The result, or the answer. The last message.
   */
  FIPA_REPLY_INFORM = 1,
  /*
   Refuses, with the reason. The last message.
   */
  FIPA_REPLY_REFUSE = 2,
  /*
   Reports a failure, with the reason. The last message.
   */
  FIPA_REPLY_FAILURE = 3,
  /*
   An `inform` after which the conversation goes on, such as a notification of a subscription.
   */
  FIPA_REPLY_NOTIFY = 4,
  /*
   A proposal, as an answer to a call (FIPA00029). The decision is an item of the kind `FIPA_EVENT_DECISION`. The
   result of an accepted proposal is the last message; after a rejection there is none.
   */
  FIPA_REPLY_PROPOSE = 5,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum fipa_reply fipa_reply;
#else
typedef int32_t fipa_reply;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

/*
 A text in UTF-8. It need not end with NUL. A NULL pointer is no text, and an empty text of a message's parameter
 is none, too.
 */
typedef struct fipa_text {
  /*
   The first byte.
   */
  const uint8_t *data;
  /*
   Number of bytes.
   */
  size_t len;
} fipa_text;

/*
 A handle: an index with a generation. Zero is no handle. A handle that was closed is never given out again before
 2^31 others in its place.
 */
typedef uint64_t fipa_handle;

/*
 The description of an agent in the directory. A field that is zero is not set.
 */
typedef struct fipa_agent_options {
  /*
   sizeof(struct fipa_agent_options).
   */
  size_t size;
  /*
   The kind of agent, for searches.
   */
  struct fipa_text agent_type;
  /*
   Free text.
   */
  struct fipa_text description;
} fipa_agent_options;

/*
 Bytes. A NULL pointer means none.
 */
typedef struct fipa_bytes {
  /*
   The first byte.
   */
  const uint8_t *data;
  /*
   Number of bytes.
   */
  size_t len;
} fipa_bytes;

/*
 A user-defined parameter of a message.
 */
typedef struct fipa_parameter {
  /*
   The name, one word.
   */
  struct fipa_text name;
  /*
   The value.
   */
  struct fipa_text value;
} fipa_parameter;

/*
 The parameters of a message (FIPA00061). A parameter that is zero is not set.

 A call does not use the structure, or anything that it points to, after the call. The texts and bytes that
 `fipa_read_message` writes into it belong to the letter, and are valid until the handle of the letter is closed.
 */
typedef struct fipa_message {
  /*
   sizeof(struct fipa_message).
   */
  size_t size;
  /*
   The act, such as `request` or `inform`. An answer (`fipa_answer`) and a message (`fipa_send`) need one.
   */
  struct fipa_text performative;
  /*
   The name of the sender. Ignored in messages that are sent: the agent is the sender.
   */
  struct fipa_text sender;
  /*
   Names of the receivers, or patterns such as `arm_.*`.
   */
  const struct fipa_text *receivers;
  /*
   Number of the receivers.
   */
  size_t receiver_count;
  /*
   Names of the agents that get the answers instead of the sender.
   */
  const struct fipa_text *reply_to;
  /*
   Number of these agents.
   */
  size_t reply_to_count;
  /*
   The content. An empty content has a pointer that is not NULL.
   */
  struct fipa_bytes content;
  /*
   The language of the content.
   */
  struct fipa_text language;
  /*
   The encoding of the content.
   */
  struct fipa_text encoding;
  /*
   The ontology of the content.
   */
  struct fipa_text ontology;
  /*
   The interaction protocol, such as `fipa-request`.
   */
  struct fipa_text protocol;
  /*
   The conversation identifier.
   */
  struct fipa_text conversation_id;
  /*
   The text that an answer has as its `in_reply_to`.
   */
  struct fipa_text reply_with;
  /*
   The `reply_with` of the message that this one answers.
   */
  struct fipa_text in_reply_to;
  /*
   Time by which an answer is due, in nanoseconds since 1970-01-01 UTC.
   */
  int64_t reply_by;
  /*
   User-defined parameters.
   */
  const struct fipa_parameter *parameters;
  /*
   Number of the user-defined parameters.
   */
  size_t parameter_count;
  /*
   The handle of a lock, or of the membership in a coalition that the agent leads. The message then carries its
   fences. Zero in messages that are read.
   */
  uint64_t lock;
} fipa_message;

/*
 How an agent owns a resource. A field that is zero has its default.
 */
typedef struct fipa_own_options {
  /*
   sizeof(struct fipa_own_options).
   */
  size_t size;
  /*
   Lease of a grant in milliseconds (15,000). A holder that ends without a proof delays the next one for this time.
   */
  int64_t lease_ms;
  /*
   Directory of the state file, which keeps fences rising over restarts. By default `$FIPA_STATE_DIR`, else `fipa`
   in `$XDG_STATE_HOME`, else `~/.local/state/fipa`.
   */
  struct fipa_text state_dir;
  /*
   Not 0: without a state file. Each start then grants nothing for one lease, and for at least 15 s.
   */
  int32_t is_volatile;
  /*
   Not 0: an owner without a file grants at once, because no lock of an earlier run is in use.
   */
  int32_t forget;
} fipa_own_options;

/*
 How a process joins a domain. A field that is zero is not set.
 */
typedef struct fipa_domain_options {
  /*
   sizeof(struct fipa_domain_options).
   */
  size_t size;
  /*
   The configuration file. Without it, the file that the environment selects: `$FIPA_CONFIG`, else `./fipa.toml`,
   else `~/.config/fipa/fipa.toml`, else `/etc/fipa/fipa.toml`, else the defaults.
   */
  struct fipa_text config;
  /*
   Values that override the file, each as `key=value`, for example `domain=test`.
   */
  const struct fipa_text *set;
  /*
   Number of these values.
   */
  size_t set_count;
} fipa_domain_options;

/*
 Numbers of contents of at least 1 KiB that have arrived through shared memory.
 */
typedef struct fipa_content_counts {
  /*
   sizeof(struct fipa_content_counts).
   */
  size_t size;
  /*
   Contents that are read in shared memory of their sender.
   */
  uint64_t in_place;
  /*
   Contents that were copied, because the program held too many in place.
   */
  uint64_t copied;
} fipa_content_counts;

/*
 An item of a queue.
 */
typedef struct fipa_item {
  /*
   sizeof(struct fipa_item).
   */
  size_t size;
  /*
   The tag with which the operation was begun.
   */
  uint64_t tag;
  /*
   The kind.
   */
  fipa_event kind;
  /*
   Zero, or the failure of the operation. `fipa_error` has its text until the next failure of this thread.
   */
  fipa_result result;
  /*
   The handle, which the caller closes unless the kind says that it is that of a task or goal; zero if there is
   none.
   */
  fipa_handle handle;
  /*
   A number that depends on the kind.
   */
  uint64_t number;
} fipa_item;

/*
 The state of a lock.
 */
typedef struct fipa_lock_info {
  /*
   sizeof(struct fipa_lock_info).
   */
  size_t size;
  /*
   Milliseconds until the shortest lease ends unless it is renewed: 0 after the loss of the lock, -1 if no owner
   gives a lease.
   */
  int64_t remaining_ms;
  /*
   The fence of the first resource. Empty if its owner gives none. Valid until the lock is closed.
   */
  struct fipa_text fence;
  /*
   1 if the agent holds all resources, else 0.
   */
  int32_t is_held;
} fipa_lock_info;

/*
 Facts about a letter.
 */
typedef struct fipa_letter_info {
  /*
   sizeof(struct fipa_letter_info).
   */
  size_t size;
  /*
   The transport that handed the letter to this process. Empty for a letter of this process itself, and for a
   message that a conversation has read.
   */
  struct fipa_text via;
  /*
   How the message violates its protocol, if `monitor.check` is `warn` or `enforce`. Empty if it does not.
   */
  struct fipa_text violation;
  /*
   Whether the content is read in shared memory of the sender: 1, or 0. A process has a bounded number of such
   contents: at most 15 of one sender. It gets copies of further ones.
   */
  int32_t in_place;
} fipa_letter_info;

/*
 A topic. A field that is zero is not set.
 */
typedef struct fipa_topic {
  /*
   sizeof(struct fipa_topic).
   */
  size_t size;
  /*
   The name.
   */
  struct fipa_text name;
  /*
   The media type of the contents, such as `image/jpeg`, for users.
   */
  struct fipa_text media_type;
  /*
   Notifications per second. The topic is then a stream: subscribers get the newest notification unless they ask
   for others.
   */
  double rate;
  /*
   Number of the newest contents that a new subscriber gets at once, at most 64.
   */
  size_t latched;
} fipa_topic;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/*
 Returns the version of the library, such as `0.1.0`.
 */
struct fipa_text fipa_version(void);

/*
 Returns the text of the last failure of this thread: what went wrong, where, and what to do. It is valid until the
 next failure of this thread, and empty if none has failed.
 */
struct fipa_text fipa_error(void);

/*
 Offers an action. `description` is a JSON object with a `name` and, as far as they are needed, `description`,
 `parameters` (each with `name`, `type` such as `number`, and `unit`, `range`, `default`, `description`,
 `optional`), `result` (a type), and `policy` (`reject`, `preempt`, or `{"queue": N}`). `concurrency` is the maximum
 number of goals that run at the same time, by default 1; `client_gone` is `cancel`, the default, or `continue`, for a
 goal whose client is gone; `fenced_by` is an object with `owner` and `resource`, the lock whose fence each goal needs;
 with `decides`, `true`, the client learns that its goal is accepted by `fipa_goal_accept`. Each goal is an item of the
 kind `FIPA_EVENT_GOAL`. Closing the offer withdraws the action and cancels its goals.

 # Safety
 The text must be readable. `offer` is NULL or can be written.
 */
fipa_result fipa_offer(fipa_handle agent,
                       struct fipa_text description,
                       uint64_t tag,
                       fipa_handle *offer);

/*
 Accepts a goal of an action with `decides`. Without effect on other goals, and on one that is accepted already.
 */
fipa_result fipa_goal_accept(fipa_handle goal);

/*
 Reports the progress of a goal: a JSON object with `fraction` from 0 to 1, `note` and `value`, each optional.

 # Safety
 The text must be readable.
 */
fipa_result fipa_goal_progress(fipa_handle goal,
                               struct fipa_text progress);

/*
 Ends a goal: with its result, a value in JSON or an empty text, if `is_done` is not 0; else with a failure, whose
 reason is the text; a goal of an action with `decides` that was not accepted is refused with it. The caller closes
 the handle afterwards. A goal that is closed without an end fails.

 # Safety
 The text must be readable.
 */
fipa_result fipa_goal_end(fipa_handle goal,
                          int32_t is_done,
                          struct fipa_text result);

/*
 Lists the actions of a robot. The item is of the kind `FIPA_EVENT_RESULT`, a JSON array of descriptions as in
 `fipa_offer`, or `FIPA_EVENT_ENDED` with the failure.

 # Safety
 The text must be readable. `operation` is NULL or can be written.
 */
fipa_result fipa_begin_actions(fipa_handle agent,
                               struct fipa_text robot,
                               uint64_t tag,
                               fipa_handle *operation);

/*
 Invokes an action of a robot. `arguments` is empty or a JSON object. `lock` is 0 or a lock whose first fence the
 goal carries. With `timeout_ms`, the robot stops the goal after that time.

 The items are `FIPA_EVENT_ACCEPTED`, `FIPA_EVENT_PROGRESS` as often as the robot reports it, and then
 `FIPA_EVENT_RESULT`, or `FIPA_EVENT_ENDED` with the failure. `fipa_cancel` cancels the goal.

 # Safety
 The texts must be readable. `operation` is NULL or can be written.
 */
fipa_result fipa_begin_goal(fipa_handle agent,
                            struct fipa_text robot,
                            struct fipa_text action,
                            struct fipa_text arguments,
                            fipa_handle lock,
                            int64_t timeout_ms,
                            uint64_t tag,
                            fipa_handle *operation);

/*
 Registers an agent. `options` may be NULL. `fipa_close` deregisters it, and what it has not received is dropped.

 # Safety
 The texts must be readable. `agent` is NULL or can be written.
 */
fipa_result fipa_register(fipa_handle domain,
                          struct fipa_text name,
                          const struct fipa_agent_options *options,
                          fipa_handle *agent);

/*
 Sends a message, and waits until each receiver has an outcome: at most `timeout_ms`, or the deadline of the
 configuration (`mts.deadline`) if it is negative. Letters leave in the order of the calls.

 The result is `FIPA_RESULT_NOT_DELIVERED` if a receiver has not got the letter; `fipa_error` lists the outcomes.
 With `outcomes`, the caller gets them as JSON (`fipa_read_text`): an array with an object per receiver, with
 `receiver`, `outcome` (`delivered`, `sent` or `failed`), `via` or `reason`, and the failed `attempts`.

 # Safety
 `message` is NULL or as its documentation says. `outcomes` is NULL or can be written.
 */
fipa_result fipa_send(fipa_handle agent,
                      const struct fipa_message *message,
                      int64_t timeout_ms,
                      fipa_handle *outcomes);

/*
 Sends a message as `fipa_send`, without waiting. The outcomes are an item of the kind `FIPA_EVENT_OUTCOMES`.

 # Safety
 `message` is NULL or as its documentation says.
 */
fipa_result fipa_begin_send(fipa_handle agent,
                            const struct fipa_message *message,
                            int64_t timeout_ms,
                            uint64_t tag);

/*
 Sends an answer to a letter, as `fipa_send`: to its `reply_to` or its sender, in the same conversation and
 protocol. What `message` sets takes precedence.

 # Safety
 As for `fipa_send`.
 */
fipa_result fipa_answer(fipa_handle agent,
                        fipa_handle letter,
                        const struct fipa_message *message,
                        int64_t timeout_ms,
                        fipa_handle *outcomes);

/*
 Loans memory of `len` bytes for the content of a message, in shared memory where possible: receivers on this host
 read in place what the caller writes. The content of `message` is ignored. The memory is valid until the loan is
 sent or closed.

 # Safety
 `message` is NULL or as its documentation says. `loan` and `content` are NULL or can be written.
 */
fipa_result fipa_loan(fipa_handle agent,
                      const struct fipa_message *message,
                      size_t len,
                      fipa_handle *loan,
                      uint8_t **content);

/*
 Sends a loan as `fipa_send`. Its handle is closed, and the caller no longer writes the memory.

 # Safety
 `outcomes` is NULL or can be written.
 */
fipa_result fipa_send_loan(fipa_handle loan, int64_t timeout_ms, fipa_handle *outcomes);

/*
 Sends a loan as `fipa_send_loan`, without waiting. The outcomes are an item of the kind `FIPA_EVENT_OUTCOMES`.
 */
fipa_result fipa_begin_send_loan(fipa_handle loan,
                                 int64_t timeout_ms,
                                 uint64_t tag);

/*
 Waits for the next letter of an agent, up to `timeout_ms`, or without a limit if it is negative. Returns
 `FIPA_RESULT_EMPTY` if none has arrived. The caller closes the letter.

 # Safety
 `letter` is NULL or can be written.
 */
fipa_result fipa_receive(fipa_handle agent,
                         int64_t timeout_ms,
                         fipa_handle *letter);

/*
 Makes the letters of an agent items of the kind `FIPA_EVENT_LETTER`. They wait in the queue of the agent until
 `fipa_next` takes them. Closing the operation ends it, and no letter is lost.

 # Safety
 `operation` is NULL or can be written.
 */
fipa_result fipa_listen(fipa_handle agent,
                        uint64_t tag,
                        fipa_handle *operation);

/*
 Founds a coalition: one name for these agents. Letters to it go to the leader, the member that holds the lock
 `coalition/NAME`, which this agent owns. `options` may be NULL, and is as for `fipa_own`. `fipa_close` dissolves it.

 # Safety
 The texts must be readable. `options` is NULL or as its documentation says. `coalition` is NULL or can be written.
 */
fipa_result fipa_found_coalition(fipa_handle agent,
                                 struct fipa_text name,
                                 const struct fipa_text *members,
                                 size_t member_count,
                                 const struct fipa_own_options *options,
                                 fipa_handle *coalition);

/*
 Replaces the members of a coalition that an agent of this process has founded.

 # Safety
 The texts must be readable.
 */
fipa_result fipa_change_coalition(fipa_handle coalition,
                                  const struct fipa_text *members,
                                  size_t member_count);

/*
 Takes part in a coalition, which may be founded later: the agent leads when it is its turn. Each change is an item
 of the kind `FIPA_EVENT_CHANGE`, a JSON text with `members`, `leader` (null if there is none at present) and
 `leads`. While the agent leads, `lock` of a message may be this handle, and the message carries the fence of the
 leader; `fipa_check_fence` with this handle checks the commands of a leader. `fipa_close` ends the membership.

 # Safety
 The text must be readable. `member` is NULL or can be written.
 */
fipa_result fipa_join_coalition(fipa_handle agent,
                                struct fipa_text name,
                                uint64_t tag,
                                fipa_handle *member);

/*
 Gives up the lead of a coalition, if the agent leads. The other members are asked first to lead again.
 */
fipa_result fipa_resign(fipa_handle member);

/*
 Calls the receivers of the message, names and patterns, for proposals. Waits for their answers up to `timeout_ms`
 (10 s if it is negative). The item is of the kind `FIPA_EVENT_BIDS`, or `FIPA_EVENT_ENDED` with the failure.

 # Safety
 `message` is NULL or as its documentation says. `operation` is NULL or can be written.
 */
fipa_result fipa_begin_call(fipa_handle agent,
                            const struct fipa_message *message,
                            int64_t timeout_ms,
                            uint64_t tag,
                            fipa_handle *operation);

/*
 Returns a proposal, with an index from 0, as a letter that the caller closes. `fipa_read_text` of the call returns
 the other answers in JSON: `refusals` (each with `agent` and `reason`), `silent`, `unreached`, `gone` and `violations`.

 # Safety
 `letter` is NULL or can be written.
 */
fipa_result fipa_read_bid(fipa_handle bids,
                          size_t index,
                          fipa_handle *letter);

/*
 Accepts the proposals of these indices, none or several, and rejects the others; each gets the content. Waits for
 the results up to `timeout_ms`, or without a limit if it is negative. There is an item of the kind
 `FIPA_EVENT_AWARDED` per accepted proposal, and then `FIPA_EVENT_ENDED`. A call is awarded once; one that is closed
 without an award rejects all proposals.

 # Safety
 The indices and the content must be readable.
 */
fipa_result fipa_award(fipa_handle bids,
                       const size_t *accepted,
                       size_t accepted_count,
                       struct fipa_bytes content,
                       int64_t timeout_ms,
                       uint64_t tag);

/*
 Requests an action from one agent (FIPA00026), or asks it (FIPA00027) if the performative is `query-ref` or
 `query-if`. Waits for the result, up to `timeout_ms` or without a limit if it is negative. The caller closes the
 answer.

 # Safety
 `message` is NULL or as its documentation says. `answer` is NULL or can be written.
 */
fipa_result fipa_request(fipa_handle agent,
                         const struct fipa_message *message,
                         int64_t timeout_ms,
                         fipa_handle *answer);

/*
 Begins a request as `fipa_request`, without waiting. Its items are `FIPA_EVENT_AGREED`, if the other agent agrees
 first, and then `FIPA_EVENT_ANSWER`, or `FIPA_EVENT_ENDED` with the failure. `fipa_cancel` cancels it; closing the
 operation only stops listening.

 # Safety
 `message` is NULL or as its documentation says. `operation` is NULL or can be written.
 */
fipa_result fipa_begin_request(fipa_handle agent,
                               const struct fipa_message *message,
                               int64_t timeout_ms,
                               uint64_t tag,
                               fipa_handle *operation);

/*
 Serves a protocol, such as `fipa-request` or `fipa-query`: each message that begins a conversation of it is an item
 of the kind `FIPA_EVENT_TASK`. The caller answers it with `fipa_task_reply` and closes it. A task that is closed
 without a last message ends with `failure`. Closing the server ends the acceptance of further conversations.

 # Safety
 The text must be readable. `server` is NULL or can be written.
 */
fipa_result fipa_serve(fipa_handle agent,
                       struct fipa_text protocol,
                       uint64_t tag,
                       fipa_handle *server);

/*
 Sends a message of a conversation that this agent serves, with one of the acts of `fipa_reply`, and waits until it
 is delivered; a proposal, until it is decided on. After `FIPA_EVENT_CANCEL`, `FIPA_REPLY_INFORM` confirms the
 cancel.

 # Safety
 The content must be readable.
 */
fipa_result fipa_task_reply(fipa_handle task,
                            int32_t act,
                            struct fipa_bytes content);

/*
 Sends a message as `fipa_task_reply`, without waiting. The operation has one item, `FIPA_EVENT_ENDED`.

 # Safety
 The content must be readable.
 */
fipa_result fipa_begin_task_reply(fipa_handle task,
                                  int32_t act,
                                  struct fipa_bytes content,
                                  uint64_t tag);

/*
 Joins a domain: that of the environment if `options` is NULL. `fipa_close` leaves it.

 # Safety
 `options` is NULL or as its documentation says. `domain` is NULL or can be written.
 */
fipa_result fipa_open(const struct fipa_domain_options *options, fipa_handle *domain);

/*
 Returns the known agents of this host and of others as a JSON array, with the text as a handle
 (`fipa_read_text`). `pattern` and `agent_type` may be empty; each is a name or a pattern for the whole text.

 Each object has `name`, `type`, `description`, `role`, `reach` (`local` or `remote`), `locations`, `mts`,
 `incarnation`, `registered` and `source`.

 # Safety
 The texts must be readable. `agents` is NULL or can be written.
 */
fipa_result fipa_agents(fipa_handle domain,
                        struct fipa_text pattern,
                        struct fipa_text agent_type,
                        fipa_handle *agents);

/*
 Reports the routes of letters to the agents of a pattern (empty: to all) as JSON, with the text as a handle.

 # Safety
 As for `fipa_agents`.
 */
fipa_result fipa_routes(fipa_handle domain,
                        struct fipa_text pattern,
                        fipa_handle *routes);

/*
 Counts the contents that have arrived through shared memory since the domain was opened.

 # Safety
 `counts` is NULL, or its first field is the number of bytes that can be written there.
 */
fipa_result fipa_read_content_counts(fipa_handle domain, struct fipa_content_counts *counts);

/*
 Follows the directory: each agent that joins, changes or leaves is an item of the kind `FIPA_EVENT_CHANGE`, with a
 JSON text. Its `change` is `joined`, `changed` or `left`, and `agent` is as in `fipa_agents`. It is `lagged`,
 without an agent, if the program was too slow and has missed changes. Closing the operation ends it.

 # Safety
 `operation` is NULL or can be written.
 */
fipa_result fipa_follow_agents(fipa_handle domain,
                               uint64_t tag,
                               fipa_handle *operation);

#if defined(FIPA_GATEWAY)
/*
 Runs the gateway of this host in the process, as `fipa up` does, with the configuration of `options` or, if that is
 NULL, of the environment. Only in a library with the feature `gateway`. `fipa_close` ends it.

 # Safety
 `options` is NULL or as its documentation says. `gateway` is NULL or can be written.
 */
fipa_result fipa_open_gateway(const struct fipa_domain_options *options,
                              fipa_handle *gateway);
#endif

/*
 Takes the next item of a domain; waits for it up to `timeout_ms`, or without a limit if that is negative. Returns
 `FIPA_RESULT_EMPTY` if there is none. Several threads may wait; each item goes to one of them.

 # Safety
 `item` is NULL, or its first field is the number of bytes that can be written there.
 */
fipa_result fipa_next(fipa_handle domain,
                      int64_t timeout_ms,
                      struct fipa_item *item);

/*
 Returns a descriptor for poll, epoll or an event loop. It is readable from before an item can be taken until
 `fipa_next` with a time limit of 0 has returned `FIPA_RESULT_EMPTY`. It may be readable without an item. The caller
 neither reads nor closes it, and stops polling it before it closes the domain.

 # Safety
 `fd` is NULL or can be written.
 */
fipa_result fipa_fd(fipa_handle domain,
                    int32_t *fd);

/*
 Asks the other side to cancel the conversation of an operation. The operation then ends with
 `FIPA_RESULT_CANCELLED`, or with its result if the other side goes on.
 */
fipa_result fipa_cancel(fipa_handle operation);

/*
 Returns the text of a handle: of a JSON text, of the answers to a call for proposals, or of the arguments of a goal.
 It is valid until the handle is closed.

 # Safety
 `text` is NULL or can be written.
 */
fipa_result fipa_read_text(fipa_handle handle,
                           struct fipa_text *text);

/*
 Closes a handle of any kind. What was read from it is no longer valid.

 A domain is left, and letters in transit get one second; an agent is deregistered; a lock is released; a task that
 has no answer fails; an operation ends, without a further item; an open loan is dropped.
 */
fipa_result fipa_close(fipa_handle handle);

/*
 Locks resources, all of them or none; waits up to `timeout_ms`, or without a limit if it is negative. The agent
 renews the leases in the background. `fipa_close` releases the lock.

 # Safety
 The texts must be readable. `lock` is NULL or can be written.
 */
fipa_result fipa_lock(fipa_handle agent,
                      const struct fipa_text *resources,
                      size_t resource_count,
                      int64_t timeout_ms,
                      fipa_handle *lock);

/*
 Locks resources as `fipa_lock`, without waiting. The first item is `FIPA_EVENT_LOCK`, with the handle of the lock,
 or `FIPA_EVENT_ENDED` with the failure. After the lock, an item `FIPA_EVENT_ENDED` says that it was lost
 (`FIPA_RESULT_LOST`), or that it was released or the agent deregistered (`FIPA_RESULT_CLOSED`). Closing the
 operation before the lock withdraws the request.

 # Safety
 The texts must be readable. `operation` is NULL or can be written.
 */
fipa_result fipa_begin_lock(fipa_handle agent,
                            const struct fipa_text *resources,
                            size_t resource_count,
                            int64_t timeout_ms,
                            uint64_t tag,
                            fipa_handle *operation);

/*
 Returns the state of a lock.

 # Safety
 `info` is NULL, or its first field is the number of bytes that can be written there.
 */
fipa_result fipa_read_lock(fipa_handle lock, struct fipa_lock_info *info);

/*
 Owns a resource, whose locks other agents then request. `options` may be NULL. `fipa_close` ends it.

 # Safety
 `resource` must be readable. `options` is NULL or as its documentation says. `owned` is NULL or can be written.
 */
fipa_result fipa_own(fipa_handle agent,
                     struct fipa_text resource,
                     const struct fipa_own_options *options,
                     fipa_handle *owned);

/*
 Checks the fence that a message carries (`lock` of `fipa_message`) for a resource that this agent owns, or for a
 coalition in which it takes part. The result is `FIPA_RESULT_STALE` if the message must not be acted on.
 */
fipa_result fipa_check_fence(fipa_handle guard,
                             fipa_handle letter);

/*
 Reads the message of a letter, an answer, a notification or a task.

 # Safety
 `message` is NULL, or its first field is the number of bytes that can be written there.
 */
fipa_result fipa_read_message(fipa_handle letter, struct fipa_message *message);

/*
 Returns the content of a letter, an answer, a notification or a task, without decoding the rest of the message.
 The bytes are valid until the handle is closed. They may be in shared memory of the sender, which can change them.

 # Safety
 `content` is NULL or can be written.
 */
fipa_result fipa_read_content(fipa_handle letter,
                              struct fipa_bytes *content);

/*
 Returns facts about a letter. The texts are valid until the handle of the letter is closed.

 # Safety
 `info` is NULL, or its first field is the number of bytes that can be written there.
 */
fipa_result fipa_read_info(fipa_handle letter, struct fipa_letter_info *info);

/*
 Lists a service of an agent in the directory facilitator of the host, or replaces its service of the same name.
 `service` is a JSON object with a `type`, and optionally a `name` (if it is missing, the type), `ownership`,
 `protocols`, `ontologies`, `languages` (arrays of texts) and `properties` (an object). Waits for the answer.

 # Safety
 The text must be readable.
 */
fipa_result fipa_register_service(fipa_handle agent,
                                  struct fipa_text service);

/*
 Removes all services of an agent from the directory facilitator, except its topics. Waits for the answer.
 */
fipa_result fipa_deregister_services(fipa_handle agent);

/*
 Searches for agents with a service, of this host and of those that its gateway knows. `pattern` is a JSON object as
 for `fipa_register_service`, of which each part is optional, and may have the `agent`; an empty text finds all. The
 value of a property is null if any will do. Waits for the answer: a JSON array of objects with `name`, `services`,
 `protocols`, `ontologies`, `languages` and `lease`.

 # Safety
 The text must be readable. `found` is NULL or can be written.
 */
fipa_result fipa_search_services(fipa_handle agent,
                                 struct fipa_text pattern,
                                 fipa_handle *found);

/*
 Publishes a topic: accepts the subscriptions whose content is its name (FIPA00035). `fipa_close` ends it.

 # Safety
 `topic` is NULL or as its documentation says. `publisher` is NULL or can be written.
 */
fipa_result fipa_publisher(fipa_handle agent,
                           const struct fipa_topic *topic,
                           fipa_handle *publisher);

/*
 Notifies all subscribers. Waits only for a subscriber that asks for all notifications and is slow, at most 5 s.
 `subscribers` may be NULL, or gets their number.

 # Safety
 The content must be readable. `subscribers` is NULL or can be written.
 */
fipa_result fipa_publish(fipa_handle publisher,
                         struct fipa_bytes content,
                         size_t *subscribers);

/*
 Loans memory of `len` bytes for a notification, which subscribers on this host read in place. The memory is valid
 until the loan is published or closed.

 # Safety
 `loan` and `content` are NULL or can be written.
 */
fipa_result fipa_loan_notification(fipa_handle publisher,
                                   size_t len,
                                   fipa_handle *loan,
                                   uint8_t **content);

/*
 Notifies all subscribers with a loan, as `fipa_publish`. Its handle is closed.

 # Safety
 `subscribers` is NULL or can be written.
 */
fipa_result fipa_publish_loan(fipa_handle loan, size_t *subscribers);

/*
 Subscribes to a topic: `message` has the publishing agent as its receiver and the name of the topic as its content.
 `keep` is empty, or says which notifications are wanted: `all`, or `latest N`. Each is an item of the kind
 `FIPA_EVENT_NOTIFICATION`. `FIPA_EVENT_INTERRUPTED` says that the publisher or its host is lost and the subscription
 goes on when it returns, and `FIPA_EVENT_ENDED` that the subscription has ended. Closing the operation cancels the
 subscription.

 # Safety
 `message` is NULL or as its documentation says. The text must be readable. `operation` is NULL or can be written.
 */
fipa_result fipa_subscribe(fipa_handle agent,
                           const struct fipa_message *message,
                           struct fipa_text keep,
                           int64_t timeout_ms,
                           uint64_t tag,
                           fipa_handle *operation);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* FIPA_H */
