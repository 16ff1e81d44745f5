//! The process's side of requests to read the configuration again: a request of a watcher goes to the part of the
//! process that reads the configuration, and its answer goes back as one datagram.

use std::sync::Arc;

use fipa_transport::log_limit::Cut;
use serde::{Deserialize, Serialize};
use tokio::sync::mpsc;

use super::connection::{Connection, RELOAD};
use crate::config::{ConfigError, Reloaded};

/// Maximum number of requests that wait to be answered. Further ones are answered as not followed.
const MAX_REQUESTS: usize = 16;

/// The answer of a process to a request to read its configuration again.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "result", rename_all = "snake_case")]
#[non_exhaustive]
pub enum ReloadAnswer {
    /// It has applied the configuration.
    Reloaded(Reloaded),
    /// It has read a configuration with mistakes, and applied nothing.
    Refused {
        /// The mistakes.
        error: String,
    },
    /// It does not follow a configuration file, so it must be restarted.
    NotFollowed,
    /// It did not answer in time.
    Silent,
}

/// The requests of `fipa reload` to this process.
#[derive(Debug)]
pub struct ReloadRequests {
    requests: mpsc::Receiver<ReloadRequest>,
}

impl ReloadRequests {
    pub(super) fn new() -> (mpsc::Sender<ReloadRequest>, Self) {
        let (sender, requests) = mpsc::channel(MAX_REQUESTS);
        (sender, Self { requests })
    }

    /// Waits for the next request. Returns `None` after the process has left the domain, and after another part of it
    /// has taken over the requests. Dropping the future loses no request.
    pub async fn next(&mut self) -> Option<ReloadRequest> {
        self.requests.recv().await
    }
}

/// A request to read the configuration again. A request that is dropped without an answer is answered as not followed.
#[derive(Debug)]
pub struct ReloadRequest {
    watcher: Option<Arc<Connection>>,
}

impl ReloadRequest {
    pub(super) fn new(watcher: Arc<Connection>) -> Self {
        Self {
            watcher: Some(watcher),
        }
    }

    /// Answers the request.
    pub fn answer(mut self, reloaded: &Result<Reloaded, ConfigError>) {
        let answer = match reloaded {
            Ok(reloaded) => ReloadAnswer::Reloaded(reloaded.clone()),
            Err(error) => ReloadAnswer::Refused {
                error: Cut(fipa_acl::ErrorChain(error)).to_string(),
            },
        };
        self.send(&answer);
    }

    fn send(&mut self, answer: &ReloadAnswer) {
        if let Some(watcher) = self.watcher.take() {
            watcher.send_answer(written(answer));
        }
    }
}

impl Drop for ReloadRequest {
    fn drop(&mut self) {
        self.send(&ReloadAnswer::NotFollowed);
    }
}

fn written(answer: &ReloadAnswer) -> Vec<u8> {
    let mut bytes = RELOAD.to_vec();
    // Texts and lists of them are always representable.
    bytes.extend(serde_json::to_vec(answer).unwrap_or_default());
    bytes
}

/// Reads the answer of a process; `None` if the datagram is no answer.
pub(crate) fn read_answer(bytes: &[u8]) -> Option<ReloadAnswer> {
    serde_json::from_slice(bytes.strip_prefix(&RELOAD)?).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_is_read_as_it_was_written() {
        let reloaded = Reloaded {
            applied: vec!["routes".to_owned()],
            later: vec!["mts.queue".to_owned()],
        };
        let error = "line 1: \u{1b}[2J".to_owned();
        for answer in [
            ReloadAnswer::Reloaded(reloaded),
            ReloadAnswer::Refused { error },
            ReloadAnswer::NotFollowed,
        ] {
            let bytes = written(&answer);
            assert_eq!(read_answer(&bytes), Some(answer));
            for len in 0..bytes.len() {
                assert_eq!(read_answer(&bytes[..len]), None, "{len}");
            }
        }
        assert_eq!(read_answer(b"fipw\x01{}"), None);
    }
}
