/* The C++ interface of fipa: agents of robots, to the FIPA standards. C++17, header only.
 *
 * - A class with a handle is move-only, and closes the handle when it is destroyed.
 * - A call that can fail returns a `fipa::result`. `value()` throws `fipa::failure`, or aborts if
 *   the program is compiled without exceptions. No other function throws, except for lack of
 *   memory.
 * - The library calls no function of the program. What a program waits for is an item of the queue
 *   of its domain: `domain::next`, and `domain::descriptor` for an event loop.
 * - Several threads may call const functions of one object at the same time.
 * - A string view or `bytes` that a function gets is not used after the call.
 *
 * SPDX-License-Identifier: MIT OR Apache-2.0
 */

#ifndef FIPA_HPP
#define FIPA_HPP

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <iterator>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

#if __cplusplus >= 202002L
#include <version>
#endif
#if defined(__cpp_lib_span)
#include <span>
#endif

#include "fipa.h"

/// 1 if the program is compiled with exceptions, else 0.
#if defined(__cpp_exceptions) || defined(__EXCEPTIONS)
#define FIPA_EXCEPTIONS 1
#else
#define FIPA_EXCEPTIONS 0
#endif

namespace fipa {
/// The binary interface. Its name changes when objects of two versions must not be mixed.
inline namespace v0 {
#if !FIPA_EXCEPTIONS
// Inline functions differ without exceptions, so they have other names for the linker.
inline namespace without_exceptions {
#endif

/// The reason of a failure: the values of `fipa_result`.
enum class errc : std::int32_t {
  /// No failure.
  ok = FIPA_RESULT_OK,
  /// A text is not UTF-8, a number is out of bounds, or a name or a configuration is invalid.
  invalid = FIPA_RESULT_INVALID,
  /// The object is empty: it was moved from, or closed.
  bad_handle = FIPA_RESULT_BAD_HANDLE,
  /// The agent was deregistered, or the domain was closed.
  closed = FIPA_RESULT_CLOSED,
  /// This process was forked from the one that opened the library.
  forked = FIPA_RESULT_FORKED,
  /// The time limit is over before the operation has ended.
  timed_out = FIPA_RESULT_TIMED_OUT,
  /// A letter was not delivered to each of its receivers.
  not_delivered = FIPA_RESULT_NOT_DELIVERED,
  /// The other agent refuses, fails, or does not understand.
  refused = FIPA_RESULT_REFUSED,
  /// The other agent is gone, or its host is silent.
  gone = FIPA_RESULT_GONE,
  /// The conversation was cancelled.
  cancelled = FIPA_RESULT_CANCELLED,
  /// A message violates its protocol.
  violation = FIPA_RESULT_VIOLATION,
  /// The lock was lost.
  lost = FIPA_RESULT_LOST,
  /// The letter or the content is too large.
  too_large = FIPA_RESULT_TOO_LARGE,
  /// Another agent has the name.
  name_taken = FIPA_RESULT_NAME_TAKEN,
  /// A fence is missing, or is not the live one.
  stale = FIPA_RESULT_STALE,
  /// Another failure; the text says which.
  failed = FIPA_RESULT_FAILED,
  /// A mistake of the library.
  panic = FIPA_RESULT_PANIC,
};

/// A reason with its text: what went wrong, where, and what to do.
class error {
 public:
  /// No failure.
  error() noexcept = default;
  /// A failure with its text.
  error(errc code, std::string text) noexcept : code_(code), text_(std::move(text)) {}

  /// Returns the reason.
  [[nodiscard]] errc code() const noexcept { return code_; }
  /// Returns the text.
  [[nodiscard]] const std::string& text() const noexcept { return text_; }

 private:
  errc code_ = errc::ok;
  std::string text_;
};

/// The exception of `result::value`.
class failure : public std::runtime_error {
 public:
  /// The exception for an error.
  explicit failure(const fipa::error& cause)
      : std::runtime_error(cause.text()), code_(cause.code()) {}

  /// Returns the reason.
  [[nodiscard]] errc code() const noexcept { return code_; }

 private:
  errc code_;
};

/// A value, or an error.
template <class T>
class [[nodiscard]] result {
 public:
  /// The type of the value.
  using value_type = T;

  /// A success.
  result(T value) : state_(std::in_place_index<1>, std::move(value)) {}
  /// A failure.
  result(fipa::error cause) : state_(std::in_place_index<0>, std::move(cause)) {}

  /// Whether there is a value.
  [[nodiscard]] bool has_value() const noexcept { return state_.index() == 1; }
  /// Whether there is a value.
  explicit operator bool() const noexcept { return has_value(); }

  /// Returns the error; its code is `errc::ok` if there is a value.
  [[nodiscard]] const fipa::error& error() const& noexcept;
  /// Moves the error out.
  [[nodiscard]] fipa::error error() && noexcept;

  /// Returns the value, or throws `failure`.
  [[nodiscard]] T& value() &;
  /// Returns the value, or throws `failure`.
  [[nodiscard]] const T& value() const&;
  /// Moves the value out, or throws `failure`.
  T value() &&;

  /// Returns the value; aborts if there is none.
  [[nodiscard]] T& operator*() & noexcept { return present(*this); }
  /// Returns the value; aborts if there is none.
  [[nodiscard]] const T& operator*() const& noexcept { return present(*this); }
  /// Moves the value out; aborts if there is none.
  [[nodiscard]] T operator*() && noexcept { return std::move(present(*this)); }
  /// Accesses the value; aborts if there is none.
  [[nodiscard]] T* operator->() noexcept { return &present(*this); }
  /// Accesses the value; aborts if there is none.
  [[nodiscard]] const T* operator->() const noexcept { return &present(*this); }

 private:
  template <class Self>
  static auto& present(Self& self) noexcept {
    auto* value = std::get_if<1>(&self.state_);
    if (value == nullptr) std::abort();
    return *value;
  }

  std::variant<fipa::error, T> state_;
};

/// Success without a value, or an error.
template <>
class [[nodiscard]] result<void> {
 public:
  /// The type of the value.
  using value_type = void;

  /// A success.
  result() noexcept = default;
  /// A failure.
  result(fipa::error cause) noexcept : error_(std::move(cause)) {}

  /// Whether the call has succeeded.
  [[nodiscard]] bool has_value() const noexcept { return error_.code() == errc::ok; }
  /// Whether the call has succeeded.
  explicit operator bool() const noexcept { return has_value(); }

  /// Returns the error; its code is `errc::ok` after a success.
  [[nodiscard]] const fipa::error& error() const& noexcept { return error_; }
  /// Moves the error out.
  [[nodiscard]] fipa::error error() && noexcept { return std::move(error_); }

  /// Throws `failure` if the call has failed.
  void value() const;

 private:
  fipa::error error_;
};

/// A time limit of a call, in milliseconds, rounded up.
class limit {
 public:
  /// Without a limit of the caller: see `unlimited` and `as_configured`.
  constexpr limit(std::nullopt_t) noexcept {}
  /// A limit. A negative one is zero, and more than a hundred years are a hundred years.
  template <class Rep, class Period>
  constexpr limit(std::chrono::duration<Rep, Period> duration) noexcept
      : milliseconds_(rounded(duration)) {}
  /// A limit, or none.
  template <class Rep, class Period>
  constexpr limit(const std::optional<std::chrono::duration<Rep, Period>>& duration) noexcept
      : milliseconds_(duration ? rounded(*duration) : -1) {}

  /// Returns the number for the C interface: -1 without a limit.
  [[nodiscard]] constexpr std::int64_t milliseconds() const noexcept { return milliseconds_; }

 private:
  template <class Rep, class Period>
  static constexpr std::int64_t rounded(std::chrono::duration<Rep, Period> duration) noexcept {
    constexpr double most = 100.0 * 365.0 * 24.0 * 3600.0 * 1000.0;
    const double exact = std::chrono::duration<double, std::milli>(duration).count();
    // A value that is not a number is no limit that can pass.
    if (!(exact > 0.0)) return 0;
    if (exact >= most) return static_cast<std::int64_t>(most);
    const auto whole = static_cast<std::int64_t>(exact);
    return static_cast<double>(whole) < exact ? whole + 1 : whole;
  }

  std::int64_t milliseconds_ = -1;
};

/// Waits without a limit.
inline constexpr limit unlimited{std::nullopt};
/// The limit of the configuration (`mts.deadline`) for calls that send, 30 s for a subscription.
inline constexpr limit as_configured{std::nullopt};
/// Does not wait.
inline constexpr limit at_once{std::chrono::milliseconds(0)};

/// A view of bytes that other memory holds. It is a contiguous range, which converts to
/// `std::span<const std::byte>` in C++20.
class bytes {
 public:
  /// No bytes.
  constexpr bytes() noexcept = default;
  /// Memory of a length.
  bytes(const void* data, std::size_t size) noexcept
      : data_(static_cast<const std::byte*>(data)), size_(size) {}
  /// The bytes of a text.
  bytes(std::string_view text) noexcept : bytes(text.data(), text.size()) {}
  /// The bytes of a text that ends with NUL.
  bytes(const char* text) noexcept : bytes(std::string_view(text)) {}
  /// The bytes of a text.
  bytes(const std::string& text) noexcept : bytes(std::string_view(text)) {}
  /// The bytes of a container of bytes or characters, such as a vector or a span.
  template <class Container,
            class = std::enable_if_t<
                !std::is_same_v<std::decay_t<Container>, bytes> &&
                !std::is_convertible_v<const Container&, std::string_view> &&
                std::is_trivially_copyable_v<std::remove_reference_t<
                    decltype(*std::data(std::declval<const Container&>()))>> &&
                sizeof(*std::data(std::declval<const Container&>())) == 1>>
  bytes(const Container& all) noexcept : bytes(std::data(all), std::size(all)) {}

  /// Returns the first byte; null if there are no bytes at all.
  [[nodiscard]] constexpr const std::byte* data() const noexcept { return data_; }
  /// Returns the number of bytes.
  [[nodiscard]] constexpr std::size_t size() const noexcept { return size_; }
  /// Whether there is no byte.
  [[nodiscard]] constexpr bool empty() const noexcept { return size_ == 0; }
  /// Returns the first byte, for loops.
  [[nodiscard]] constexpr const std::byte* begin() const noexcept { return data_; }
  /// Returns the end, for loops.
  [[nodiscard]] constexpr const std::byte* end() const noexcept { return data_ + size_; }
  /// Returns a byte.
  [[nodiscard]] constexpr std::byte operator[](std::size_t at) const noexcept { return data_[at]; }

  /// Returns the bytes as a text.
  [[nodiscard]] std::string_view text() const noexcept {
    return {reinterpret_cast<const char*>(data_), size_};
  }
  /// Returns a copy as a string.
  [[nodiscard]] std::string string() const { return std::string(text()); }

 private:
  const std::byte* data_ = nullptr;
  std::size_t size_ = 0;
};

/// A view of a text, or of an array of texts: `"arm"`, or a vector or an array of texts.
class texts {
 public:
  /// No text.
  constexpr texts() noexcept = default;
  /// A text. An empty text is none.
  constexpr texts(std::string_view text) noexcept : text_(text), size_(text.empty() ? 0 : 1) {}
  /// A text that ends with NUL.
  constexpr texts(const char* text) noexcept : texts(std::string_view(text)) {}
  /// A text.
  texts(const std::string& text) noexcept : texts(std::string_view(text)) {}
  /// The texts of a container of string views.
  template <class Container,
            class = std::enable_if_t<
                std::is_same_v<const std::string_view*,
                               decltype(std::data(std::declval<const Container&>()))>>,
            class = void>
  texts(const Container& all) noexcept : views_(std::data(all)), size_(std::size(all)) {}
  /// The texts of a container of strings.
  template <class Container,
            class = std::enable_if_t<
                std::is_same_v<const std::string*,
                               decltype(std::data(std::declval<const Container&>()))>>>
  texts(const Container& all) noexcept : strings_(std::data(all)), size_(std::size(all)) {}

  /// Returns the number of texts.
  [[nodiscard]] constexpr std::size_t size() const noexcept { return size_; }
  /// Returns a text.
  [[nodiscard]] std::string_view operator[](std::size_t at) const noexcept {
    return views_ != nullptr ? views_[at] : strings_ != nullptr ? strings_[at] : text_;
  }

 private:
  std::string_view text_;
  const std::string_view* views_ = nullptr;
  const std::string* strings_ = nullptr;
  std::size_t size_ = 0;
};

/// A user-defined parameter of a message.
struct parameter {
  /// The name, one word.
  std::string_view name{};
  /// The value.
  std::string_view value{};
};

class agent;
class lock;
class member;

/// What gives the fences of a message: a lock, or the membership of a leader. It owns nothing.
class guard {
 public:
  /// Without fences.
  constexpr guard() noexcept = default;
  /// The fences of a lock.
  guard(const lock& held) noexcept;
  /// The fence of the leader of a coalition.
  guard(const member& leader) noexcept;

  /// Returns the handle for the C interface.
  [[nodiscard]] constexpr fipa_handle raw() const noexcept { return raw_; }

 private:
  // An empty object gives a handle that does not exist, so that no call sends without the fence.
  explicit guard(fipa_handle raw) noexcept : raw_(raw == 0 ? ~fipa_handle{0} : raw) {}

  fipa_handle raw_ = 0;
};

/// A message to be sent. It owns nothing: what its fields refer to must last until the call has
/// returned. A field that is not set is not part of the message.
struct message {
  /// The act, such as `request` or `inform`. Calls that begin a protocol have a default.
  std::string_view performative{};
  /// Names of the receivers, or patterns such as `arm_.*`.
  texts to{};
  /// The content.
  bytes content{};
  /// The language of the content.
  std::string_view language{};
  /// The encoding of the content.
  std::string_view encoding{};
  /// The ontology of the content.
  std::string_view ontology{};
  /// The interaction protocol.
  std::string_view protocol{};
  /// The conversation identifier.
  std::string_view conversation_id{};
  /// The text that an answer has as its `in_reply_to`.
  std::string_view reply_with{};
  /// The `reply_with` of the message that this one answers.
  std::string_view in_reply_to{};
  /// Names of the agents that get the answers instead of the sender.
  texts reply_to{};
  /// Time by which an answer is due.
  std::optional<std::chrono::system_clock::time_point> reply_by{};
  /// The first user-defined parameter.
  const parameter* parameters = nullptr;
  /// Number of the user-defined parameters.
  std::size_t parameter_count = 0;
  /// The lock or the membership whose fences the message carries.
  fipa::guard guard{};
};

namespace detail {

inline fipa_text text(std::string_view text) noexcept {
  return {reinterpret_cast<const std::uint8_t*>(text.data()), text.size()};
}

inline fipa_bytes raw(bytes content) noexcept {
  return {reinterpret_cast<const std::uint8_t*>(content.data()), content.size()};
}

inline std::string_view view(fipa_text text) noexcept {
  return {reinterpret_cast<const char*>(text.data), text.len};
}

template <class T>
T sized() noexcept {
  T structure{};
  structure.size = sizeof(T);
  return structure;
}

/// The last failure of this thread.
inline error last(fipa_result code) {
  return error(static_cast<errc>(code), std::string(view(fipa_error())));
}

inline result<void> checked(fipa_result code) {
  if (code == FIPA_RESULT_OK) return {};
  return last(code);
}

[[noreturn]] inline void raise(const error& cause) {
#if FIPA_EXCEPTIONS
  throw failure(cause);
#else
  (void)cause;
  std::abort();
#endif
}

/// Texts in the form of the C interface.
class text_array {
 public:
  explicit text_array(const texts& all) : size_(all.size()) {
    if (size_ > few_.size()) many_.resize(size_);
    fipa_text* at = size_ > few_.size() ? many_.data() : few_.data();
    for (std::size_t i = 0; i < size_; i++) at[i] = text(all[i]);
  }

  [[nodiscard]] const fipa_text* data() const noexcept {
    return size_ > few_.size() ? many_.data() : few_.data();
  }
  [[nodiscard]] std::size_t size() const noexcept { return size_; }

 private:
  std::array<fipa_text, 4> few_{};
  std::vector<fipa_text> many_;
  std::size_t size_;
};

/// A message in the form of the C interface.
class raw_message {
 public:
  explicit raw_message(const message& from);
  raw_message(const raw_message&) = delete;
  raw_message& operator=(const raw_message&) = delete;

  [[nodiscard]] const fipa_message* get() const noexcept { return &message_; }

 private:
  text_array to_;
  text_array reply_to_;
  std::vector<fipa_parameter> parameters_;
  fipa_message message_ = sized<fipa_message>();
};

/// The owner of a handle.
template <class Owner>
class handle {
 public:
  handle(const handle&) = delete;
  handle& operator=(const handle&) = delete;

  /// Whether the object has a handle.
  explicit operator bool() const noexcept { return raw_ != 0; }
  /// Returns the handle for the C interface. The object still owns it.
  [[nodiscard]] fipa_handle raw() const noexcept { return raw_; }
  /// Returns the handle for the C interface. The caller closes it.
  [[nodiscard]] fipa_handle release() noexcept { return std::exchange(raw_, 0); }
  /// Makes an object of a handle of the C interface. The object closes it.
  [[nodiscard]] static Owner adopt(fipa_handle raw) noexcept {
    Owner owner;
    owner.raw_ = raw;
    return owner;
  }
  /// Closes the handle, and reports a failure, which the destructor cannot. An empty object stays
  /// as it is.
  result<void> close() {
    if (raw_ == 0) return {};
    return checked(fipa_close(release()));
  }

 protected:
  handle() noexcept = default;
  handle(handle&& other) noexcept : raw_(other.release()) {}
  handle& operator=(handle&& other) noexcept {
    if (this != &other) {
      drop();
      raw_ = other.release();
    }
    return *this;
  }
  ~handle() { drop(); }

 private:
  void drop() noexcept {
    if (raw_ != 0) fipa_close(release());
  }

  fipa_handle raw_ = 0;
};

/// The text of a handle; empty without a handle.
inline std::string_view read_text(fipa_handle raw) noexcept {
  fipa_text text{};
  if (raw != 0) fipa_read_text(raw, &text);
  return view(text);
}

/// The result of a call that has written a handle.
template <class Owner>
result<Owner> owned(fipa_result code, fipa_handle raw) {
  if (code == FIPA_RESULT_OK) return Owner::adopt(raw);
  return last(code);
}

}  // namespace detail

template <class T>
const fipa::error& result<T>::error() const& noexcept {
  static const fipa::error none;
  const auto* cause = std::get_if<0>(&state_);
  return cause != nullptr ? *cause : none;
}

template <class T>
fipa::error result<T>::error() && noexcept {
  auto* cause = std::get_if<0>(&state_);
  return cause != nullptr ? std::move(*cause) : fipa::error();
}

template <class T>
T& result<T>::value() & {
  if (!has_value()) detail::raise(error());
  return present(*this);
}

template <class T>
const T& result<T>::value() const& {
  if (!has_value()) detail::raise(error());
  return present(*this);
}

template <class T>
T result<T>::value() && {
  return std::move(value());
}

inline void result<void>::value() const {
  if (!has_value()) detail::raise(error_);
}

/// Returns the version of the library, such as `0.1.0`.
[[nodiscard]] inline std::string_view version() noexcept { return detail::view(fipa_version()); }

/// A text in JSON.
class json : public detail::handle<json> {
 public:
  /// Without a text.
  json() noexcept {}

  /// Returns the text, which is valid as long as this object.
  [[nodiscard]] std::string_view view() const& noexcept { return detail::read_text(raw()); }
  /// A view of a temporary object would be invalid at once.
  std::string_view view() const&& = delete;
  /// Returns a copy.
  [[nodiscard]] std::string string() const { return std::string(view()); }
};

/// What each receiver of a message has got.
struct outcomes {
  /// Whether each receiver has got the letter.
  bool delivered = false;
  /// An array with an object per receiver: see `fipa_send`.
  fipa::json details{};
};

/// A view of a message that was received. It is valid as long as the letter or the task.
class message_view {
 public:
  /// A view of the structure of the C interface.
  explicit message_view(const fipa_message& raw) noexcept : raw_(raw) {}

  /// Returns the act.
  [[nodiscard]] std::string_view performative() const noexcept { return view(raw_.performative); }
  /// Returns the name of the sender.
  [[nodiscard]] std::string_view sender() const noexcept { return view(raw_.sender); }
  /// Returns the number of receivers.
  [[nodiscard]] std::size_t receiver_count() const noexcept { return raw_.receiver_count; }
  /// Returns the name of a receiver.
  [[nodiscard]] std::string_view receiver(std::size_t at) const noexcept {
    return view(raw_.receivers[at]);
  }
  /// Returns the number of agents that get the answers instead of the sender.
  [[nodiscard]] std::size_t reply_to_count() const noexcept { return raw_.reply_to_count; }
  /// Returns the name of an agent that gets the answers.
  [[nodiscard]] std::string_view reply_to(std::size_t at) const noexcept {
    return view(raw_.reply_to[at]);
  }
  /// Returns the content.
  [[nodiscard]] bytes content() const noexcept { return {raw_.content.data, raw_.content.len}; }
  /// Returns the language of the content.
  [[nodiscard]] std::string_view language() const noexcept { return view(raw_.language); }
  /// Returns the encoding of the content.
  [[nodiscard]] std::string_view encoding() const noexcept { return view(raw_.encoding); }
  /// Returns the ontology of the content.
  [[nodiscard]] std::string_view ontology() const noexcept { return view(raw_.ontology); }
  /// Returns the interaction protocol.
  [[nodiscard]] std::string_view protocol() const noexcept { return view(raw_.protocol); }
  /// Returns the conversation identifier.
  [[nodiscard]] std::string_view conversation_id() const noexcept {
    return view(raw_.conversation_id);
  }
  /// Returns the text that an answer has as its `in_reply_to`.
  [[nodiscard]] std::string_view reply_with() const noexcept { return view(raw_.reply_with); }
  /// Returns the `reply_with` of the message that this one answers.
  [[nodiscard]] std::string_view in_reply_to() const noexcept { return view(raw_.in_reply_to); }
  /// Returns the time by which an answer is due.
  [[nodiscard]] std::optional<std::chrono::system_clock::time_point> reply_by() const noexcept {
    if (raw_.reply_by == 0) return std::nullopt;
    using clock = std::chrono::system_clock;
    const std::chrono::nanoseconds since(raw_.reply_by);
    return clock::time_point(std::chrono::duration_cast<clock::duration>(since));
  }
  /// Returns the number of user-defined parameters.
  [[nodiscard]] std::size_t parameter_count() const noexcept { return raw_.parameter_count; }
  /// Returns a user-defined parameter.
  [[nodiscard]] fipa::parameter parameter(std::size_t at) const noexcept {
    return {view(raw_.parameters[at].name), view(raw_.parameters[at].value)};
  }
  /// Returns the value of a user-defined parameter.
  [[nodiscard]] std::optional<std::string_view> parameter(std::string_view name) const noexcept {
    for (std::size_t at = 0; at < parameter_count(); at++) {
      if (parameter(at).name == name) return parameter(at).value;
    }
    return std::nullopt;
  }

 private:
  static std::string_view view(fipa_text text) noexcept { return detail::view(text); }

  fipa_message raw_;
};

namespace detail {

/// A handle with a message.
template <class Owner>
class readable : public handle<Owner> {
 public:
  /// Returns the content, which is valid as long as this object. It may be in memory of the sender,
  /// which can change it. An empty object has none.
  [[nodiscard]] bytes content() const& noexcept {
    fipa_bytes content{};
    if (this->raw() != 0) fipa_read_content(this->raw(), &content);
    return {content.data, content.len};
  }
  /// The content of a temporary object would be invalid at once.
  bytes content() const&& = delete;

  /// Returns the message, which is valid as long as this object. Without an object, all fields are
  /// empty.
  [[nodiscard]] message_view message() const& noexcept {
    auto read = sized<fipa_message>();
    if (this->raw() != 0) fipa_read_message(this->raw(), &read);
    return message_view(read);
  }
  /// The message of a temporary object would be invalid at once.
  message_view message() const&& = delete;

  /// Returns the transport that has brought the letter; empty for a letter of this process itself.
  [[nodiscard]] std::string_view via() const& noexcept { return view(info().via); }
  /// A text of a temporary object would be invalid at once.
  std::string_view via() const&& = delete;
  /// Returns how the message violates its protocol, if the configuration says to check it.
  [[nodiscard]] std::string_view violation() const& noexcept { return view(info().violation); }
  /// A text of a temporary object would be invalid at once.
  std::string_view violation() const&& = delete;
  /// Returns whether the content is read in shared memory of the sender. A process has a bounded
  /// number of such contents: at most 15 of one sender. It gets copies of further ones.
  [[nodiscard]] bool in_place() const noexcept { return info().in_place != 0; }

 protected:
  readable() noexcept = default;

 private:
  [[nodiscard]] fipa_letter_info info() const noexcept {
    auto info = sized<fipa_letter_info>();
    if (this->raw() != 0) fipa_read_info(this->raw(), &info);
    return info;
  }
};

}  // namespace detail

/// A content that is kept: longer than its agent and its domain, without a copy.
///
/// A process holds a bounded number of contents in shared memory. Copy what is kept for long.
class content {
 public:
  /// Without a content.
  content() noexcept {}
  /// Takes the handle of a letter or a task, which closes with this object.
  template <class Owner>
  explicit content(detail::readable<Owner>&& from) noexcept
      : view_(static_cast<const detail::readable<Owner>&>(from).content()),
        owner_(json::adopt(from.release())) {}
  /// Moves the content.
  content(content&& other) noexcept
      : view_(std::exchange(other.view_, bytes())), owner_(std::move(other.owner_)) {}
  /// Moves the content.
  content& operator=(content&& other) noexcept {
    owner_ = std::move(other.owner_);
    view_ = std::exchange(other.view_, bytes());
    return *this;
  }

  /// Returns the bytes, which are valid as long as this object.
  [[nodiscard]] bytes view() const& noexcept { return view_; }
  /// A view of a temporary object would be invalid at once.
  bytes view() const&& = delete;

 private:
  bytes view_;
  // Only closes the handle.
  json owner_;
};

/// A letter, an answer or a notification.
class letter : public detail::readable<letter> {
 public:
  /// Without a letter.
  letter() noexcept {}
};

/// An operation that was begun. It ends without a further item when the object is destroyed.
class operation : public detail::handle<operation> {
 public:
  /// Without an operation.
  operation() noexcept {}

  /// Asks the other side to cancel the conversation. See `fipa_cancel`.
  result<void> cancel() const { return detail::checked(fipa_cancel(raw())); }
};

/// Accepts conversations until the object is destroyed. See `agent::serve`.
class server : public detail::handle<server> {
 public:
  /// Without a server.
  server() noexcept {}
};

/// The acts of a participant: the values of `fipa_reply`.
enum class reply : std::int32_t {
  /// Agrees; the result follows.
  agree = FIPA_REPLY_AGREE,
  /// The result, or the answer. The last message.
  inform = FIPA_REPLY_INFORM,
  /// Refuses, with the reason. The last message.
  refuse = FIPA_REPLY_REFUSE,
  /// Reports a failure, with the reason. The last message.
  failure = FIPA_REPLY_FAILURE,
  /// An `inform` after which the conversation goes on.
  notify = FIPA_REPLY_NOTIFY,
  /// A proposal. The decision is `event::decision`.
  propose = FIPA_REPLY_PROPOSE,
};

/// A conversation that an agent serves. It ends with `failure` if the object is destroyed before a
/// last message.
class task : public detail::readable<task> {
 public:
  /// Without a task.
  task() noexcept {}

  /// Returns the number that `item::refers_to` has in items about this task.
  [[nodiscard]] std::uint64_t id() const noexcept { return raw(); }
  /// Sends a message, and waits until it is delivered; a proposal, until it is decided on.
  result<void> send(reply act, bytes content = {}) const {
    return detail::checked(
        fipa_task_reply(raw(), static_cast<std::int32_t>(act), detail::raw(content)));
  }
  /// Agrees; the result follows.
  result<void> agree(bytes content = {}) const { return send(reply::agree, content); }
  /// Sends the result, or confirms a cancel. The last message.
  result<void> inform(bytes content = {}) const { return send(reply::inform, content); }
  /// Refuses, with the reason. The last message.
  result<void> refuse(bytes reason = {}) const { return send(reply::refuse, reason); }
  /// Reports a failure, with the reason. The last message.
  result<void> fail(bytes reason = {}) const { return send(reply::failure, reason); }
  /// Informs, and the conversation goes on.
  result<void> notify(bytes content = {}) const { return send(reply::notify, content); }
  /// Sends a message without waiting. The item is `event::ended`.
  result<void> begin_send(reply act, bytes content, std::uint64_t tag) const {
    return detail::checked(
        fipa_begin_task_reply(raw(), static_cast<std::int32_t>(act), detail::raw(content), tag));
  }
};

/// The answers to a call for proposals. Without an award, all proposals are rejected when the
/// object is destroyed.
class bids : public detail::handle<bids> {
 public:
  /// Without answers.
  bids() noexcept {}

  /// Returns a proposal, with an index from 0 to below `item::number`.
  [[nodiscard]] result<letter> proposal(std::size_t index) const {
    fipa_handle read = 0;
    const auto code = fipa_read_bid(raw(), index, &read);
    return detail::owned<letter>(code, read);
  }
  /// Returns the other answers in JSON, valid as long as this object: see `fipa_read_bid`.
  [[nodiscard]] std::string_view others() const& noexcept { return detail::read_text(raw()); }
  /// A text of a temporary object would be invalid at once.
  std::string_view others() const&& = delete;
  /// Accepts the proposals of these indices, and rejects the others; each gets the content. The
  /// items are `event::awarded` per accepted proposal, and then `event::ended`.
  result<void> award(const std::vector<std::size_t>& accepted, bytes content, std::uint64_t tag,
                     limit within = unlimited) const {
    return detail::checked(fipa_award(raw(), accepted.data(), accepted.size(),
                                      detail::raw(content), within.milliseconds(), tag));
  }
};

/// An action that an agent offers. It is withdrawn, and its goals are cancelled, when the object is
/// destroyed.
class offer : public detail::handle<offer> {
 public:
  /// Without an action.
  offer() noexcept {}
};

/// A goal of an action that this agent offers. It fails if the object is destroyed before its end.
class goal : public detail::handle<goal> {
 public:
  /// Without a goal.
  goal() noexcept {}

  /// Returns the number that `item::refers_to` has if the goal is to stop.
  [[nodiscard]] std::uint64_t id() const noexcept { return raw(); }
  /// Returns the arguments in JSON, valid as long as this object.
  [[nodiscard]] std::string_view arguments() const& noexcept { return detail::read_text(raw()); }
  /// A text of a temporary object would be invalid at once.
  std::string_view arguments() const&& = delete;
  /// Accepts the goal of an action with `decides`. Without effect on other goals, and on one that is
  /// accepted already.
  result<void> accept() const { return detail::checked(fipa_goal_accept(raw())); }
  /// Reports the progress: a JSON object with `fraction`, `note` and `value`, each optional.
  result<void> progress(std::string_view json) const {
    return detail::checked(fipa_goal_progress(raw(), detail::text(json)));
  }
  /// Ends the goal with its result, a value in JSON or an empty text.
  result<void> succeed(std::string_view json = {}) const {
    return detail::checked(fipa_goal_end(raw(), 1, detail::text(json)));
  }
  /// Ends the goal with a failure. A goal of an action with `decides` that was not accepted is refused.
  result<void> fail(std::string_view reason) const {
    return detail::checked(fipa_goal_end(raw(), 0, detail::text(reason)));
  }
};

/// The state of a lock.
struct lock_state {
  /// Whether the agent holds all resources.
  bool is_held = false;
  /// Time until the shortest lease ends unless it is renewed; nothing if no owner gives a lease.
  std::optional<std::chrono::milliseconds> remaining{};
  /// The fence of the first resource, valid as long as the lock. Empty if its owner gives none.
  std::string_view fence{};
};

/// A lock of resources, released when the object is destroyed.
class lock : public detail::handle<lock> {
 public:
  /// Without a lock.
  lock() noexcept {}

  /// Returns the state.
  [[nodiscard]] result<lock_state> state() const& {
    auto info = detail::sized<fipa_lock_info>();
    if (const auto code = fipa_read_lock(raw(), &info); code != FIPA_RESULT_OK) {
      return detail::last(code);
    }
    lock_state state;
    state.is_held = info.is_held != 0;
    if (info.remaining_ms >= 0) state.remaining = std::chrono::milliseconds(info.remaining_ms);
    state.fence = detail::view(info.fence);
    return state;
  }
  /// A text of a temporary object would be invalid at once.
  result<lock_state> state() const&& = delete;
};

/// The membership of an agent in a coalition, until the object is destroyed. The items are
/// `event::change`.
class member : public detail::handle<member> {
 public:
  /// Without a membership.
  member() noexcept {}

  /// Gives up the lead, if the agent leads.
  result<void> resign() const { return detail::checked(fipa_resign(raw())); }
  /// Checks the fence of a command of a leader. If the error is `errc::stale`, it must not be acted
  /// on.
  template <class Owner>
  result<void> check(const detail::readable<Owner>& letter) const {
    return detail::checked(fipa_check_fence(raw(), letter.raw()));
  }
};

/// A coalition that an agent has founded. It is dissolved when the object is destroyed.
class coalition : public detail::handle<coalition> {
 public:
  /// Without a coalition.
  coalition() noexcept {}

  /// Replaces the members.
  result<void> change(const texts& members) const {
    const detail::text_array names(members);
    return detail::checked(fipa_change_coalition(raw(), names.data(), names.size()));
  }
};

inline guard::guard(const lock& held) noexcept : guard(held.raw()) {}
inline guard::guard(const member& leader) noexcept : guard(leader.raw()) {}

/// A resource that an agent owns until the object is destroyed.
class owned_resource : public detail::handle<owned_resource> {
 public:
  /// Without a resource.
  owned_resource() noexcept {}

  /// Checks the fence of a letter or a task. If the error is `errc::stale`, it must not be acted
  /// on.
  template <class Owner>
  result<void> check(const detail::readable<Owner>& letter) const {
    return detail::checked(fipa_check_fence(raw(), letter.raw()));
  }
};

namespace detail {

/// Memory that the caller writes.
template <class Owner>
class writable : public handle<Owner> {
 public:
  /// Returns the first byte.
  [[nodiscard]] std::byte* data() const noexcept { return this->raw() == 0 ? nullptr : data_; }
  /// Returns the number of bytes.
  [[nodiscard]] std::size_t size() const noexcept { return this->raw() == 0 ? 0 : size_; }
#if defined(__cpp_lib_span)
  /// Returns a span.
  [[nodiscard]] std::span<std::byte> span() const noexcept { return {data(), size()}; }
#endif

 protected:
  writable() noexcept = default;
  static result<Owner> of(fipa_result code, fipa_handle raw, std::uint8_t* data,
                          std::size_t size) {
    auto made = owned<Owner>(code, raw);
    if (made) {
      made->data_ = reinterpret_cast<std::byte*>(data);
      made->size_ = size;
    }
    return made;
  }

 private:
  std::byte* data_ = nullptr;
  std::size_t size_ = 0;
};

}  // namespace detail

/// Memory for the content of a message. Receivers on this host read it in place. Sending empties
/// the object.
class loan : public detail::writable<loan> {
 public:
  /// Without memory.
  loan() noexcept {}

  /// Sends the message as `agent::send`.
  result<void> send(limit within = as_configured) {
    return sent(fipa_send_loan(raw(), within.milliseconds(), nullptr));
  }
  /// Sends the message as `agent::begin_send`.
  result<void> begin_send(std::uint64_t tag, limit within = as_configured) {
    return sent(fipa_begin_send_loan(raw(), within.milliseconds(), tag));
  }

 private:
  friend class agent;

  result<void> sent(fipa_result code) {
    auto outcome = detail::checked(code);
    // The call has closed the handle, unless it has had no effect.
    if (code != FIPA_RESULT_BAD_HANDLE && code != FIPA_RESULT_FORKED) (void)release();
    return outcome;
  }
};

/// Memory for a notification. Subscribers on this host read it in place. Publishing empties the
/// object.
class notification_loan : public detail::writable<notification_loan> {
 public:
  /// Without memory.
  notification_loan() noexcept {}

  /// Notifies all subscribers, and returns their number.
  result<std::size_t> publish() {
    std::size_t subscribers = 0;
    const auto code = fipa_publish_loan(raw(), &subscribers);
    if (code == FIPA_RESULT_OK) {
      (void)release();
      return subscribers;
    }
    auto cause = detail::last(code);
    // The call has closed the handle, unless it has had no effect.
    if (code != FIPA_RESULT_BAD_HANDLE && code != FIPA_RESULT_FORKED) (void)release();
    return cause;
  }

 private:
  friend class publisher;
};

/// A topic. A field that is not set has its default.
struct topic {
  /// The name.
  std::string_view name{};
  /// The media type of the contents, such as `image/jpeg`, for users.
  std::string_view media_type{};
  /// Notifications per second: the topic is then a stream. See `fipa_topic`.
  double rate = 0.0;
  /// Number of the newest contents that a new subscriber gets at once, at most 64.
  std::size_t latched = 0;
};

/// Publishes a topic until the object is destroyed.
class publisher : public detail::handle<publisher> {
 public:
  /// Without a topic.
  publisher() noexcept {}

  /// Notifies all subscribers, and returns their number. See `fipa_publish`.
  result<std::size_t> publish(bytes content) const {
    std::size_t subscribers = 0;
    const auto code = fipa_publish(raw(), detail::raw(content), &subscribers);
    if (code != FIPA_RESULT_OK) return detail::last(code);
    return subscribers;
  }
  /// Loans memory for a notification.
  [[nodiscard]] result<notification_loan> loan(std::size_t size) const {
    fipa_handle made = 0;
    std::uint8_t* memory = nullptr;
    const auto code = fipa_loan_notification(raw(), size, &made, &memory);
    return notification_loan::of(code, made, memory, size);
  }
};

/// How an agent owns a resource. A field that is not set has its default: see `fipa_own_options`.
struct own_options {
  /// Lease of a grant.
  std::chrono::milliseconds lease{0};
  /// Directory of the state file, which keeps fences rising over restarts.
  std::string_view state_dir{};
  /// Without a state file.
  bool is_volatile = false;
  /// Grants at once, because no lock of an earlier run is in use.
  bool forget = false;
};

namespace detail {

inline fipa_own_options raw(const own_options& options) noexcept {
  auto chosen = sized<fipa_own_options>();
  chosen.lease_ms = static_cast<std::int64_t>(options.lease.count());
  chosen.state_dir = text(options.state_dir);
  chosen.is_volatile = options.is_volatile ? 1 : 0;
  chosen.forget = options.forget ? 1 : 0;
  return chosen;
}

}  // namespace detail

/// The description of an agent in the directory.
struct agent_options {
  /// The kind of agent, for searches.
  std::string_view agent_type{};
  /// Free text.
  std::string_view description{};
};

/// An agent, deregistered when the object is destroyed.
class agent : public detail::handle<agent> {
 public:
  /// Without an agent.
  agent() noexcept {}

  /// Sends a message, and waits until each receiver has an outcome. The text of the error lists the
  /// outcomes.
  result<void> send(const fipa::message& message, limit within = as_configured) const {
    const detail::raw_message raw_message(message);
    return detail::checked(fipa_send(raw(), raw_message.get(), within.milliseconds(), nullptr));
  }
  /// Sends a message as `send`, and returns the outcomes also if a receiver has not got the letter.
  [[nodiscard]] result<fipa::outcomes> send_for_outcomes(const fipa::message& message,
                                                         limit within = as_configured) const {
    const detail::raw_message raw_message(message);
    fipa_handle details = 0;
    const auto code = fipa_send(raw(), raw_message.get(), within.milliseconds(), &details);
    if (details == 0) return detail::last(code);
    return fipa::outcomes{code == FIPA_RESULT_OK, json::adopt(details)};
  }
  /// Sends a message without waiting. The item is `event::outcomes`. Letters leave in the order of
  /// the calls.
  result<void> begin_send(const fipa::message& message, std::uint64_t tag,
                          limit within = as_configured) const {
    const detail::raw_message raw_message(message);
    return detail::checked(fipa_begin_send(raw(), raw_message.get(), within.milliseconds(), tag));
  }
  /// Sends an answer to a letter, as `send`, in the same conversation. What `message` sets takes
  /// precedence.
  template <class Owner>
  result<void> answer(const detail::readable<Owner>& letter, const fipa::message& message,
                      limit within = as_configured) const {
    const detail::raw_message raw_message(message);
    return detail::checked(
        fipa_answer(raw(), letter.raw(), raw_message.get(), within.milliseconds(), nullptr));
  }
  /// Loans memory for the content of a message, in shared memory where possible.
  [[nodiscard]] result<fipa::loan> loan(const fipa::message& message, std::size_t size) const {
    const detail::raw_message raw_message(message);
    fipa_handle made = 0;
    std::uint8_t* memory = nullptr;
    const auto code = fipa_loan(raw(), raw_message.get(), size, &made, &memory);
    return fipa::loan::of(code, made, memory, size);
  }

  /// Waits for the next letter. Nothing if none has arrived.
  [[nodiscard]] result<std::optional<letter>> receive(limit within = unlimited) const {
    fipa_handle received = 0;
    const auto code = fipa_receive(raw(), within.milliseconds(), &received);
    if (code == FIPA_RESULT_OK) return std::optional(letter::adopt(received));
    if (code == FIPA_RESULT_EMPTY) return std::optional<letter>();
    return detail::last(code);
  }
  /// Makes letters items of the kind `event::letter`, until the operation is destroyed. No letter
  /// is lost.
  [[nodiscard]] result<operation> listen(std::uint64_t tag) const {
    fipa_handle begun = 0;
    const auto code = fipa_listen(raw(), tag, &begun);
    return detail::owned<operation>(code, begun);
  }

  /// Requests an action from one agent, or asks it if the act is `query-ref` or `query-if`. Waits
  /// for the answer.
  [[nodiscard]] result<letter> request(const fipa::message& message,
                                       limit within = unlimited) const {
    const detail::raw_message raw_message(message);
    fipa_handle answer = 0;
    const auto code = fipa_request(raw(), raw_message.get(), within.milliseconds(), &answer);
    return detail::owned<letter>(code, answer);
  }
  /// Begins a request. The items are `event::agreed`, and then `event::answer` or `event::ended`.
  [[nodiscard]] result<operation> begin_request(const fipa::message& message, std::uint64_t tag,
                                                limit within = unlimited) const {
    const detail::raw_message raw_message(message);
    fipa_handle begun = 0;
    const auto code =
        fipa_begin_request(raw(), raw_message.get(), within.milliseconds(), tag, &begun);
    return detail::owned<operation>(code, begun);
  }
  /// Serves a protocol, such as `fipa-request` or `fipa-query`. The items are `event::task` and
  /// `event::cancel`.
  [[nodiscard]] result<server> serve(std::string_view protocol, std::uint64_t tag) const {
    fipa_handle made = 0;
    const auto code = fipa_serve(raw(), detail::text(protocol), tag, &made);
    return detail::owned<server>(code, made);
  }

  /// Calls the receivers, names and patterns, for proposals, with a limit of 10 s if none is set.
  /// The item is `event::bids`, or `event::ended` with the failure.
  [[nodiscard]] result<operation> begin_call(const fipa::message& message, std::uint64_t tag,
                                             limit within = as_configured) const {
    const detail::raw_message raw_message(message);
    fipa_handle begun = 0;
    const auto code =
        fipa_begin_call(raw(), raw_message.get(), within.milliseconds(), tag, &begun);
    return detail::owned<operation>(code, begun);
  }

  /// Offers an action, which a JSON object describes: see `fipa_offer`. The items are `event::goal`
  /// and `event::stop`.
  [[nodiscard]] result<fipa::offer> offer(std::string_view description, std::uint64_t tag) const {
    fipa_handle made = 0;
    const auto code = fipa_offer(raw(), detail::text(description), tag, &made);
    return detail::owned<fipa::offer>(code, made);
  }
  /// Lists the actions of a robot. The item is `event::result`, or `event::ended` with the failure.
  [[nodiscard]] result<operation> begin_actions(std::string_view robot, std::uint64_t tag) const {
    fipa_handle begun = 0;
    const auto code = fipa_begin_actions(raw(), detail::text(robot), tag, &begun);
    return detail::owned<operation>(code, begun);
  }
  /// Invokes an action of a robot. `arguments` is empty or a JSON object. The goal carries the
  /// fence of `guard`, if there is one. The items are `event::accepted`, `event::progress`, and
  /// then `event::result`, or `event::ended` with the failure.
  [[nodiscard]] result<operation> begin_goal(std::string_view robot, std::string_view action,
                                             std::string_view arguments, std::uint64_t tag,
                                             limit within = unlimited,
                                             fipa::guard guard = {}) const {
    fipa_handle begun = 0;
    const auto code = fipa_begin_goal(raw(), detail::text(robot), detail::text(action),
                                      detail::text(arguments), guard.raw(),
                                      within.milliseconds(), tag, &begun);
    return detail::owned<operation>(code, begun);
  }

  /// Publishes a topic.
  [[nodiscard]] result<fipa::publisher> publisher(const fipa::topic& topic) const {
    auto described = detail::sized<fipa_topic>();
    described.name = detail::text(topic.name);
    described.media_type = detail::text(topic.media_type);
    described.rate = topic.rate;
    described.latched = topic.latched;
    fipa_handle made = 0;
    const auto code = fipa_publisher(raw(), &described, &made);
    return detail::owned<fipa::publisher>(code, made);
  }
  /// Subscribes to a topic: `message` has the publishing agent as its receiver and the name as its
  /// content. `keep` is empty, `all` or `latest N`. The items are `event::notification`,
  /// `event::interrupted` and `event::ended`.
  [[nodiscard]] result<operation> subscribe(const fipa::message& message, std::uint64_t tag,
                                            std::string_view keep = {},
                                            limit within = as_configured) const {
    const detail::raw_message raw_message(message);
    fipa_handle begun = 0;
    const auto code = fipa_subscribe(raw(), raw_message.get(), detail::text(keep),
                                     within.milliseconds(), tag, &begun);
    return detail::owned<operation>(code, begun);
  }

  /// Locks resources, all of them or none.
  [[nodiscard]] result<fipa::lock> lock(const texts& resources, limit within = unlimited) const {
    const detail::text_array names(resources);
    fipa_handle made = 0;
    const auto code = fipa_lock(raw(), names.data(), names.size(), within.milliseconds(), &made);
    return detail::owned<fipa::lock>(code, made);
  }
  /// Locks resources without waiting. The items are `event::lock`, and `event::ended` when the lock
  /// has ended.
  [[nodiscard]] result<operation> begin_lock(const texts& resources, std::uint64_t tag,
                                             limit within = unlimited) const {
    const detail::text_array names(resources);
    fipa_handle begun = 0;
    const auto code =
        fipa_begin_lock(raw(), names.data(), names.size(), within.milliseconds(), tag, &begun);
    return detail::owned<operation>(code, begun);
  }
  /// Lists a service in the directory facilitator, and waits for the answer. `service` is a JSON
  /// object with a `type`: see `fipa_register_service`.
  [[nodiscard]] result<void> register_service(std::string_view service) const {
    return detail::checked(fipa_register_service(raw(), detail::text(service)));
  }
  /// Removes all services from the directory facilitator, except topics. Waits for the answer.
  [[nodiscard]] result<void> deregister_services() const {
    return detail::checked(fipa_deregister_services(raw()));
  }
  /// Searches for agents with a service, and waits for the answer, a JSON array. `pattern` is empty,
  /// or a JSON object: see `fipa_search_services`.
  [[nodiscard]] result<json> search_services(std::string_view pattern = {}) const {
    fipa_handle found = 0;
    const auto code = fipa_search_services(raw(), detail::text(pattern), &found);
    return detail::owned<json>(code, found);
  }
  /// Founds a coalition: one name for these agents. `options` is as for `own`.
  [[nodiscard]] result<coalition> found_coalition(std::string_view name, const texts& members,
                                                  const own_options& options = {}) const {
    const detail::text_array names(members);
    const auto chosen = detail::raw(options);
    fipa_handle made = 0;
    const auto code = fipa_found_coalition(raw(), detail::text(name), names.data(), names.size(),
                                           &chosen, &made);
    return detail::owned<coalition>(code, made);
  }
  /// Takes part in a coalition, which may be founded later. The items are `event::change`.
  [[nodiscard]] result<member> join_coalition(std::string_view name, std::uint64_t tag) const {
    fipa_handle made = 0;
    const auto code = fipa_join_coalition(raw(), detail::text(name), tag, &made);
    return detail::owned<member>(code, made);
  }
  /// Owns a resource, whose locks other agents then request.
  [[nodiscard]] result<owned_resource> own(std::string_view resource,
                                           const own_options& options = {}) const {
    const auto chosen = detail::raw(options);
    fipa_handle made = 0;
    const auto code = fipa_own(raw(), detail::text(resource), &chosen, &made);
    return detail::owned<owned_resource>(code, made);
  }
};

/// What an item is: the values of `fipa_event`.
enum class event : std::int32_t {
  /// The operation has ended: `item::error` says how.
  ended = FIPA_EVENT_ENDED,
  /// A message has its outcomes: `item::take_json`.
  outcomes = FIPA_EVENT_OUTCOMES,
  /// A letter has arrived: `item::take_letter`.
  letter = FIPA_EVENT_LETTER,
  /// The directory or a coalition has changed: `item::take_json`.
  change = FIPA_EVENT_CHANGE,
  /// The other agent has agreed to a request.
  agreed = FIPA_EVENT_AGREED,
  /// The answer to a request: `item::take_letter`.
  answer = FIPA_EVENT_ANSWER,
  /// A conversation that this agent serves has begun: `item::take_task`.
  task = FIPA_EVENT_TASK,
  /// A notification of a subscription: `item::take_letter`.
  notification = FIPA_EVENT_NOTIFICATION,
  /// A lock is held: `item::take_lock`.
  lock = FIPA_EVENT_LOCK,
  /// The initiator of a task cancels it, or is gone if `item::error` says so: `item::refers_to`.
  cancel = FIPA_EVENT_CANCEL,
  /// A subscription is interrupted for the reason in `item::error`, and goes on when the publisher
  /// returns.
  interrupted = FIPA_EVENT_INTERRUPTED,
  /// The answers to a call for proposals: `item::take_bids`. `item::number` is that of the
  /// proposals.
  bids = FIPA_EVENT_BIDS,
  /// The result of an accepted proposal: `item::take_letter`, or none and the failure.
  /// `item::number` is the index of the proposal.
  awarded = FIPA_EVENT_AWARDED,
  /// The initiator has decided on the proposal of a task, which is `item::refers_to`.
  /// `item::number` is 1 if it has accepted.
  decision = FIPA_EVENT_DECISION,
  /// A goal of an action that this agent offers: `item::take_goal`.
  goal = FIPA_EVENT_GOAL,
  /// A goal, which is `item::refers_to`, is to stop for the reason in `item::error`.
  stop = FIPA_EVENT_STOP,
  /// A robot has accepted a goal.
  accepted = FIPA_EVENT_ACCEPTED,
  /// The progress of a goal: `item::take_json`.
  progress = FIPA_EVENT_PROGRESS,
  /// The result of a goal or of a question: `item::take_json`.
  result = FIPA_EVENT_RESULT,
};

/// An item of the queue of a domain. What is not taken out of it is closed with it.
class item {
 public:
  /// An item of the C interface. The failure is the last one of this thread.
  explicit item(const fipa_item& raw)
      : tag_(raw.tag), number_(raw.number), kind_(static_cast<event>(raw.kind)) {
    if (raw.result != FIPA_RESULT_OK) error_ = detail::last(raw.result);
    switch (kind_) {
      case event::outcomes:
      case event::letter:
      case event::change:
      case event::answer:
      case event::task:
      case event::notification:
      case event::lock:
      case event::bids:
      case event::awarded:
      case event::goal:
      case event::progress:
      case event::result:
        // The class of the handle follows when it is taken.
        owner_ = json::adopt(raw.handle);
        break;
      case event::cancel:
      case event::decision:
      case event::stop:
        // The handle was given out before, with the task or the goal.
        refers_to_ = raw.handle;
        break;
      case event::ended:
      case event::agreed:
      case event::interrupted:
      case event::accepted:
        break;
    }
  }

  /// Returns the tag with which the operation was begun.
  [[nodiscard]] std::uint64_t tag() const noexcept { return tag_; }
  /// Returns the kind.
  [[nodiscard]] event kind() const noexcept { return kind_; }
  /// Whether the operation has not failed.
  [[nodiscard]] bool succeeded() const noexcept { return error_.code() == errc::ok; }
  /// Returns the failure of the operation; its code is `errc::ok` if there is none.
  [[nodiscard]] const fipa::error& error() const& noexcept { return error_; }
  /// Returns the number of the item: see `event`. For a notification, the number of those that were
  /// missed just before.
  [[nodiscard]] std::uint64_t number() const noexcept { return number_; }
  /// Returns the `task::id` or `goal::id` that the item is about; 0 for other kinds.
  [[nodiscard]] std::uint64_t refers_to() const noexcept { return refers_to_; }

  /// Takes the letter, the answer, the notification or the result of a proposal out.
  [[nodiscard]] result<letter> take_letter() {
    return take<letter>(kind_ == event::letter || kind_ == event::answer ||
                        kind_ == event::notification || kind_ == event::awarded);
  }
  /// Takes the task out.
  [[nodiscard]] result<task> take_task() { return take<task>(kind_ == event::task); }
  /// Takes the lock out.
  [[nodiscard]] result<lock> take_lock() { return take<lock>(kind_ == event::lock); }
  /// Takes the answers to a call for proposals out.
  [[nodiscard]] result<bids> take_bids() { return take<bids>(kind_ == event::bids); }
  /// Takes the goal out.
  [[nodiscard]] result<goal> take_goal() { return take<goal>(kind_ == event::goal); }
  /// Takes the handle out, for the C interface. The caller closes it. Zero if there is none.
  [[nodiscard]] fipa_handle release() noexcept { return owner_.release(); }
  /// Takes the outcomes, the change, the progress or the result out.
  [[nodiscard]] result<json> take_json() {
    return take<json>(kind_ == event::outcomes || kind_ == event::change ||
                      kind_ == event::progress || kind_ == event::result);
  }

 private:
  template <class Owner>
  result<Owner> take(bool is_kind) {
    if (!is_kind || !owner_) {
      return fipa::error(errc::bad_handle, "the item has none of this kind, or it was taken");
    }
    return Owner::adopt(owner_.release());
  }

  std::uint64_t tag_;
  std::uint64_t number_;
  std::uint64_t refers_to_ = 0;
  event kind_;
  fipa::error error_;
  json owner_;
};

/// How a process joins a domain. A field that is not set has its default.
struct domain_options {
  /// The configuration file. Without it, the file that the environment selects: see
  /// `fipa_domain_options`.
  std::string_view config{};
  /// Values that override the file, each as `key=value`.
  texts set{};
};

namespace detail {

inline fipa_domain_options raw(const domain_options& options, const text_array& set) noexcept {
  auto chosen = sized<fipa_domain_options>();
  chosen.config = text(options.config);
  chosen.set = set.data();
  chosen.set_count = set.size();
  return chosen;
}

}  // namespace detail

#if defined(FIPA_GATEWAY)
/// The gateway of this host in the process, as `fipa up` runs it, until the object is destroyed.
class gateway : public detail::handle<gateway> {
 public:
  /// Without a gateway.
  gateway() noexcept {}

  /// Runs the gateway. Only in a library with the feature `gateway`.
  [[nodiscard]] static result<gateway> open(const domain_options& options = {}) {
    const detail::text_array set(options.set);
    const auto chosen = detail::raw(options, set);
    fipa_handle opened = 0;
    const auto code = fipa_open_gateway(&chosen, &opened);
    return detail::owned<gateway>(code, opened);
  }
};
#endif

/// The membership of this process in a domain, which it leaves when the object is destroyed.
class domain : public detail::handle<domain> {
 public:
  /// Without a domain.
  domain() noexcept {}

  /// Joins a domain.
  [[nodiscard]] static result<domain> open(const domain_options& options = {}) {
    const detail::text_array set(options.set);
    const auto chosen = detail::raw(options, set);
    fipa_handle opened = 0;
    const auto code = fipa_open(&chosen, &opened);
    return detail::owned<domain>(code, opened);
  }

  /// Registers an agent.
  [[nodiscard]] result<agent> add_agent(std::string_view name,
                                        const agent_options& options = {}) const {
    auto described = detail::sized<fipa_agent_options>();
    described.agent_type = detail::text(options.agent_type);
    described.description = detail::text(options.description);
    fipa_handle made = 0;
    const auto code = fipa_register(raw(), detail::text(name), &described, &made);
    return detail::owned<agent>(code, made);
  }
  /// Returns the known agents as a JSON array: see `fipa_agents`. An argument is empty, a name or a
  /// pattern.
  [[nodiscard]] result<json> agents(std::string_view pattern = {},
                                    std::string_view agent_type = {}) const {
    fipa_handle found = 0;
    const auto code =
        fipa_agents(raw(), detail::text(pattern), detail::text(agent_type), &found);
    return detail::owned<json>(code, found);
  }
  /// Reports the routes of letters to the agents of a pattern as JSON.
  [[nodiscard]] result<json> routes(std::string_view pattern = {}) const {
    fipa_handle report = 0;
    const auto code = fipa_routes(raw(), detail::text(pattern), &report);
    return detail::owned<json>(code, report);
  }
  /// Counts the contents of at least 1 KiB that have arrived through shared memory.
  [[nodiscard]] result<fipa_content_counts> content_counts() const {
    auto counts = detail::sized<fipa_content_counts>();
    const auto code = fipa_read_content_counts(raw(), &counts);
    if (code != FIPA_RESULT_OK) return detail::last(code);
    return counts;
  }
  /// Makes changes of the directory items of the kind `event::change`, until the operation is
  /// destroyed.
  [[nodiscard]] result<operation> follow_agents(std::uint64_t tag) const {
    fipa_handle begun = 0;
    const auto code = fipa_follow_agents(raw(), tag, &begun);
    return detail::owned<operation>(code, begun);
  }

  /// Takes the next item. Nothing if there is none within the limit.
  [[nodiscard]] result<std::optional<item>> next(limit within = unlimited) const {
    auto taken = detail::sized<fipa_item>();
    const auto code = fipa_next(raw(), within.milliseconds(), &taken);
    if (code == FIPA_RESULT_OK) return std::optional<item>(std::in_place, taken);
    if (code == FIPA_RESULT_EMPTY) return std::optional<item>();
    return detail::last(code);
  }
  /// Returns a descriptor for poll, epoll or an event loop. It is readable until `next(at_once)`
  /// has returned nothing. The caller neither reads nor closes it, and stops polling it before it
  /// closes the domain.
  [[nodiscard]] result<int> descriptor() const {
    std::int32_t descriptor = -1;
    const auto code = fipa_fd(raw(), &descriptor);
    if (code != FIPA_RESULT_OK) return detail::last(code);
    return static_cast<int>(descriptor);
  }
};

namespace detail {

inline raw_message::raw_message(const message& from) : to_(from.to), reply_to_(from.reply_to) {
  auto& it = message_;
  it.performative = text(from.performative);
  it.receivers = to_.data();
  it.receiver_count = to_.size();
  it.reply_to = reply_to_.data();
  it.reply_to_count = reply_to_.size();
  it.content = raw(from.content);
  it.language = text(from.language);
  it.encoding = text(from.encoding);
  it.ontology = text(from.ontology);
  it.protocol = text(from.protocol);
  it.conversation_id = text(from.conversation_id);
  it.reply_with = text(from.reply_with);
  it.in_reply_to = text(from.in_reply_to);
  if (from.reply_by) {
    const auto since = from.reply_by->time_since_epoch();
    it.reply_by = std::chrono::duration_cast<std::chrono::nanoseconds>(since).count();
  }
  parameters_.reserve(from.parameter_count);
  for (std::size_t at = 0; at < from.parameter_count; at++) {
    const parameter& one = from.parameters[at];
    parameters_.push_back({text(one.name), text(one.value)});
  }
  it.parameters = parameters_.data();
  it.parameter_count = parameters_.size();
  it.lock = from.guard.raw();
}

}  // namespace detail

#if !FIPA_EXCEPTIONS
}  // namespace without_exceptions
#endif
}  // namespace v0
}  // namespace fipa

#endif
