/* Coroutines over the queue of a domain, in C++20: a loop, a job, and the items of an operation. */

#ifndef COROUTINES_HPP
#define COROUTINES_HPP

#include <poll.h>

#include <coroutine>
#include <deque>
#include <exception>
#include <unordered_map>

#include "fipa.hpp"

/* A coroutine that runs at once until it waits. `co_await` of a job gives what it returns. */
template <class T>
class job {
 public:
  struct promise_type {
    std::optional<T> value{};
    std::exception_ptr thrown{};
    std::coroutine_handle<> waiter = std::noop_coroutine();

    struct resume_waiter {
      bool await_ready() noexcept { return false; }
      std::coroutine_handle<> await_suspend(
          std::coroutine_handle<promise_type> ended) noexcept {
        return ended.promise().waiter;
      }
      void await_resume() noexcept {}
    };

    job get_return_object() { return job(handle::from_promise(*this)); }
    std::suspend_never initial_suspend() noexcept { return {}; }
    resume_waiter final_suspend() noexcept { return {}; }
    void return_value(T returned) { value = std::move(returned); }
    void unhandled_exception() { thrown = std::current_exception(); }
  };

  job(job&& other) noexcept : handle_(std::exchange(other.handle_, nullptr)) {}
  job& operator=(job&&) = delete;
  /* Ends the coroutine where it waits. */
  ~job() {
    if (handle_) handle_.destroy();
  }

  bool await_ready() const { return handle_.done(); }
  void await_suspend(std::coroutine_handle<> waiter) { handle_.promise().waiter = waiter; }
  T await_resume() {
    if (handle_.promise().thrown) std::rethrow_exception(handle_.promise().thrown);
    return std::move(*handle_.promise().value);
  }

 private:
  using handle = std::coroutine_handle<promise_type>;
  explicit job(handle own) : handle_(own) {}

  handle handle_;
};

class inbox;

/* Takes items from a domain, and resumes the coroutines that wait for them. */
class loop {
 public:
  explicit loop(const fipa::domain& domain)
      : domain_(domain), descriptor_(domain.descriptor().value()) {}

  /* Runs until a job has ended. */
  template <class T>
  T run(job<T> main) {
    pollfd polled{descriptor_, POLLIN, 0};
    while (!main.await_ready()) {
      poll(&polled, 1, -1);
      while (auto item = domain_.next(fipa::at_once).value()) deliver(std::move(*item));
    }
    return main.await_resume();
  }

 private:
  friend class inbox;
  void deliver(fipa::item item);

  const fipa::domain& domain_;
  int descriptor_;
  std::uint64_t last_tag_ = 0;
  std::unordered_map<std::uint64_t, inbox*> inboxes_;
};

/* The items of one operation: `co_await inbox.next()`. */
class inbox {
 public:
  explicit inbox(loop& loop) : loop_(loop), tag_(++loop.last_tag_) {
    loop_.inboxes_.emplace(tag_, this);
  }
  inbox(const inbox&) = delete;
  inbox& operator=(const inbox&) = delete;
  ~inbox() { loop_.inboxes_.erase(tag_); }

  /* The tag with which the operation is begun. */
  std::uint64_t tag() const { return tag_; }

  auto next() {
    struct awaiter {
      inbox& own;
      bool await_ready() const { return !own.items_.empty(); }
      void await_suspend(std::coroutine_handle<> waiter) { own.waiter_ = waiter; }
      fipa::item await_resume() {
        fipa::item item = std::move(own.items_.front());
        own.items_.pop_front();
        return item;
      }
    };
    return awaiter{*this};
  }

 private:
  friend class loop;

  loop& loop_;
  std::uint64_t tag_;
  std::deque<fipa::item> items_;
  std::coroutine_handle<> waiter_;
};

inline void loop::deliver(fipa::item item) {
  const auto found = inboxes_.find(item.tag());
  // An operation whose coroutine has ended.
  if (found == inboxes_.end()) return;
  found->second->items_.push_back(std::move(item));
  // The coroutine may destroy the inbox.
  if (auto waiter = std::exchange(found->second->waiter_, nullptr)) waiter.resume();
}

/* A request that was begun. */
class request {
 public:
  request(loop& loop, const fipa::agent& agent, const fipa::message& message, fipa::limit within)
      : inbox_(loop), operation_(agent.begin_request(message, inbox_.tag(), within).value()) {}

  void cancel() { operation_.cancel().value(); }

  /* Waits for the answer. */
  job<fipa::result<fipa::letter>> answer() {
    while (true) {
      fipa::item item = co_await inbox_.next();
      if (item.kind() == fipa::event::answer) co_return item.take_letter();
      if (item.kind() == fipa::event::ended) co_return item.error();
    }
  }

 private:
  inbox inbox_;
  fipa::operation operation_;
};

#endif
