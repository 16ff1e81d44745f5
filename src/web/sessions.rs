//! The sessions of browsers: a browser sends the token once and gets a cookie for it, which no script can read.

use std::collections::VecDeque;
use std::io;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use subtle::ConstantTimeEq as _;

use super::token::random_text;

/// Maximum number of sessions. A further one ends the oldest.
const MAX_SESSIONS: usize = 16;

/// Time after which a session ends.
pub(super) const LIFETIME: Duration = Duration::from_secs(12 * 3600);

/// The sessions of a listener.
#[derive(Debug, Default)]
pub(super) struct Sessions {
    /// The oldest first.
    open: Mutex<VecDeque<Session>>,
}

struct Session {
    secret: String,
    ends: Instant,
}

// Without the secret.
impl std::fmt::Debug for Session {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Session")
            .field("ends", &self.ends)
            .finish_non_exhaustive()
    }
}

impl Sessions {
    /// Begins a session. Returns its secret.
    ///
    /// # Errors
    /// If the operating system gives no random bytes.
    pub(super) fn begin(&self, now: Instant) -> io::Result<String> {
        let secret = random_text()?;
        let mut open = self.open.lock();
        open.retain(|session| session.ends > now);
        if open.len() >= MAX_SESSIONS {
            open.pop_front();
        }
        open.push_back(Session {
            secret: secret.clone(),
            ends: now + LIFETIME,
        });
        Ok(secret)
    }

    /// Whether a session has this secret. The time does not depend on the position of a wrong byte.
    pub(super) fn has(&self, now: Instant, given: &[u8]) -> bool {
        let open = self.open.lock();
        let mut running = open.iter().filter(|session| session.ends > now);
        running.any(|session| session.is(given))
    }

    /// Ends the session with this secret.
    pub(super) fn end(&self, given: &[u8]) {
        self.open.lock().retain(|session| !session.is(given));
    }
}

impl Session {
    fn is(&self, given: &[u8]) -> bool {
        self.secret.as_bytes().ct_eq(given).into()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use super::*;

    #[test]
    fn sessions_end_by_time_by_request_and_for_newer_ones() {
        let sessions = Sessions::default();
        let now = Instant::now();
        let first = sessions.begin(now).unwrap();
        assert_eq!(first.len(), 32);
        assert!(sessions.has(now, first.as_bytes()));
        assert!(!sessions.has(now, b""));
        assert!(
            !sessions.has(now, first.to_uppercase().as_bytes())
                || first.bytes().all(|it| it.is_ascii_digit())
        );
        assert!(!sessions.has(now + LIFETIME, first.as_bytes()));
        sessions.end(first.as_bytes());
        assert!(!sessions.has(now, first.as_bytes()));

        let all: Vec<String> = (0..=MAX_SESSIONS)
            .map(|_| sessions.begin(now).unwrap())
            .collect();
        let (oldest, others) = all.split_first().unwrap();
        assert!(!sessions.has(now, oldest.as_bytes()));
        assert!(others.iter().all(|it| sessions.has(now, it.as_bytes())));
        assert!(!format!("{sessions:?}").contains(&others[0]));
    }
}
