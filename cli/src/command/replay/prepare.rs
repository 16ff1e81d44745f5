//! Prepares a recorded letter for being sent again.

use std::time::{Duration, SystemTime};

use fipa::locks::FENCE;
use fipa::{Message, Performative, Time, is_pattern};
use fipa_acl::json::message_from_json;
use fipa_locking::codec::is_lock_protocol;
use serde_json::{Value, json};

use crate::command::record::file::letter::RecordedLetter;

/// First part of the names of replayed senders.
pub(super) const PREFIX: &str = "replay/";

/// Returns the name of the agent that sends the letters of this sender.
pub(super) fn renamed(sender: &str) -> String {
    format!("{PREFIX}{sender}")
}

/// The reason for which a letter is left out; `None` if it can be sent.
pub(super) fn reason_to_leave_out(letter: &RecordedLetter, all: bool) -> Option<&'static str> {
    let Some(message) = &letter.message else {
        return Some("the message is unknown");
    };
    if letter.is_from_service() {
        return Some("sent by a message transport service");
    }
    if is_pattern(&letter.receiver) {
        return Some("the receiver is a pattern");
    }
    if letter.is_cut {
        return Some("the content is not whole in the recording");
    }
    if message.sender().is_none() {
        return Some("the message has no sender");
    }
    match all {
        true => None,
        false => effect(message),
    }
}

/// The effect of a message that a replay must not repeat by itself.
fn effect(message: &Message) -> Option<&'static str> {
    use Performative::{
        AcceptProposal, Cfp, Other, Propagate, Proxy, Request, RequestWhen, RequestWhenever,
    };
    let has_fence = |(name, _): &(String, String)| name.eq_ignore_ascii_case(FENCE);
    if message.user_defined().iter().any(has_fence) {
        return Some("it has a fence");
    }
    if message.protocol().is_some_and(is_lock_protocol) {
        return Some("it belongs to a lock");
    }
    match message.performative() {
        Request | RequestWhen | RequestWhenever | Propagate | Proxy => Some("it is a request"),
        Cfp => Some("it is a call for proposals"),
        AcceptProposal => Some("it is an award"),
        // Agents of the robot may take it for a command.
        Other(_) => Some("its performative is none of FIPA"),
        _ => None,
    }
}

/// Returns the message to send now. `run` makes the conversations those of this replay.
pub(super) fn message(letter: &RecordedLetter, run: &str, now: SystemTime) -> Option<Message> {
    let recorded = letter.message.as_ref()?;
    let mut json = letter.message_json.clone();
    let object = json.as_object_mut()?;
    let name = renamed(recorded.sender()?.name());
    object.insert("sender".to_owned(), json!({ "name": name }));
    object.insert("receivers".to_owned(), json!([{ "name": letter.receiver }]));
    // Answers go to the sender.
    object.remove("reply_to");
    if let Some(conversation) = recorded.conversation_id() {
        let conversation = Value::String(format!("{run}/{conversation}"));
        object.insert("conversation_id".to_owned(), conversation);
    }
    let by = recorded.reply_by().filter(|by| !by.is_relative());
    let by = by.and_then(|by| moved(by.to_system_time(letter.at), letter.at, now));
    // The end of all times, year 9999, stays.
    let by = by.and_then(|by| Time::from_system_time(by).ok()?.to_rfc3339());
    if let Some(by) = by {
        object.insert("reply_by".to_owned(), Value::String(by));
    }
    message_from_json(&json).ok()
}

/// Moves a time by the time from the recording to now.
fn moved(time: SystemTime, recorded: SystemTime, now: SystemTime) -> Option<SystemTime> {
    match time.duration_since(recorded) {
        Ok(later) => now.checked_add(later),
        Err(earlier) => now.checked_sub(earlier.duration()),
    }
}

/// A difference between two letters from which on it is a change of the clock: a host without a battery begins in 1970,
/// and gets the time later.
const CLOCK_SET_FORWARD: Duration = Duration::from_secs(24 * 60 * 60);
/// The same for a clock that is set back. Letters of several processes are not exactly in the order of their times.
const CLOCK_SET_BACK: Duration = Duration::from_secs(60);

/// The course of the recorded time.
#[derive(Debug)]
pub(super) struct Course {
    speed: f64,
    latest: Option<SystemTime>,
    /// The recorded time from the first letter to the latest, without changes of the clock.
    elapsed: Duration,
}

impl Course {
    pub(super) fn new(speed: f64) -> Self {
        Self {
            speed,
            latest: None,
            elapsed: Duration::ZERO,
        }
    }

    /// The time from the beginning of the replay at which a letter is sent. Call it for each letter in turn.
    pub(super) fn delay(&mut self, letter: SystemTime) -> Duration {
        let latest = self.latest.unwrap_or(letter);
        match letter.duration_since(latest) {
            Ok(later) => {
                if later < CLOCK_SET_FORWARD {
                    self.elapsed = self.elapsed.saturating_add(later);
                }
                self.latest = Some(letter);
            }
            Err(earlier) if earlier.duration() > CLOCK_SET_BACK => self.latest = Some(letter),
            Err(_) => {}
        }
        Duration::try_from_secs_f64(self.elapsed.as_secs_f64() / self.speed)
            .unwrap_or(Duration::MAX)
    }
}

#[cfg(test)]
mod tests {
    use std::time::UNIX_EPOCH;

    use super::*;

    fn letter(message: &Value, check: &Value) -> RecordedLetter {
        let json = json!({
            "receiver": "arm", "content_length": 2, "letter": { "message": message }, "check": check,
        });
        RecordedLetter::read(json.to_string().as_bytes(), 1_700_000_000_000_000_000).unwrap()
    }

    fn said(performative: &str) -> Value {
        json!({
            "performative": performative, "sender": { "name": "rover" }, "content": "go",
            "receivers": [{ "name": "arm" }, { "name": "leg" }], "conversation_id": "c",
            "reply_to": [{ "name": "other" }], "reply_by": "2023-11-14T22:13:25.000Z",
        })
    }

    #[test]
    fn letters_with_an_effect_are_left_out() {
        let reason = |message: &Value, all| reason_to_leave_out(&letter(message, &json!({})), all);
        for (act, is_sent) in [
            ("inform", true),
            ("propose", true),
            ("request", false),
            ("request-when", false),
            ("cfp", false),
            ("accept-proposal", false),
            ("proxy", false),
            ("REQUEST", false),
            ("go-home", false),
        ] {
            assert_eq!(reason(&said(act), false).is_none(), is_sent, "{act}");
            assert_eq!(reason(&said(act), true), None, "{act}");
        }
        let mut fenced = said("inform");
        fenced["user_defined"] = json!({ "fipa-fence": "dock 1" });
        assert_eq!(reason(&fenced, false), Some("it has a fence"));
        let mut lock = said("inform");
        lock["protocol"] = "ricart_agrawala".into();
        assert_eq!(reason(&lock, false), Some("it belongs to a lock"));
        let mut cut = said("inform");
        cut.as_object_mut().unwrap().remove("content");
        assert!(reason(&cut, true).is_some());
        // The letters of a hostile file must not reach all agents.
        let mut all = letter(&said("inform"), &json!({}));
        all.receiver = ".*".to_owned();
        assert!(reason_to_leave_out(&all, true).is_some());
        let service = letter(&said("inform"), &json!({ "from_service": true }));
        assert!(reason_to_leave_out(&service, true).is_some());
    }

    #[test]
    fn a_replayed_message_has_another_sender_conversation_and_time() {
        let now = UNIX_EPOCH + Duration::from_secs(1_800_000_000);
        let message = message(&letter(&said("inform"), &json!({})), "run", now).unwrap();
        assert_eq!(message.sender().unwrap().name(), "replay/rover");
        let receivers: Vec<&str> = message.receivers().iter().map(|it| it.name()).collect();
        assert_eq!(receivers, ["arm"]);
        assert_eq!(message.conversation_id(), Some("run/c"));
        assert!(message.reply_to().is_empty());
        // Five seconds after the letter, in both times.
        let by = message.reply_by().unwrap().to_system_time(now);
        assert_eq!(by, now + Duration::from_secs(5));
        let mut forever = said("inform");
        forever["reply_by"] = "9999-12-31T23:59:59.999Z".into();
        let message = super::message(&letter(&forever, &json!({})), "run", now).unwrap();
        let by = message.reply_by().unwrap().to_rfc3339();
        assert_eq!(by.as_deref(), Some("9999-12-31T23:59:59.999Z"));
    }

    #[test]
    fn the_speed_divides_the_time() {
        let at = |seconds| UNIX_EPOCH + Duration::from_secs(seconds);
        let mut course = Course::new(2.0);
        let mut delay = |seconds| course.delay(at(seconds)).as_secs();
        assert_eq!(delay(10), 0);
        assert_eq!(delay(14), 2);
        // A letter that was observed late.
        assert_eq!(delay(12), 2);
        assert_eq!(delay(20), 5);
        // The clock is set, and set back.
        assert_eq!(delay(1_700_000_000), 5);
        assert_eq!(delay(1_700_000_004), 7);
        assert_eq!(delay(1000), 7);
        assert_eq!(delay(1002), 8);
    }
}
