//! Hands received messages to their readers: a call that leads a conversation, or `receive`.

use std::collections::{HashMap, VecDeque};

use parking_lot::Mutex;
use tokio::sync::Notify;

use crate::endpoint::Endpoint;
use crate::error::ReceiveError;
use crate::incoming::Incoming;

/// Maximum number of messages that are set aside for one reader while another reader receives.
/// Beyond it letters stay in the agent's queue, and their senders wait.
const MAX_SET_ASIDE: usize = 1_024;

type Received = Result<Incoming, ReceiveError>;

/// The messages that one reader received for another.
#[derive(Default)]
pub(crate) struct Demultiplexer {
    state: Mutex<State>,
    changed: Notify,
}

#[derive(Default)]
struct State {
    /// Messages of the led conversations, by conversation id.
    led: HashMap<String, VecDeque<Received>>,
    others: VecDeque<Received>,
}

/// A reader that waits for a message.
#[derive(Clone, Copy)]
enum Reader<'a> {
    Conversation(&'a str),
    Others,
}

impl Demultiplexer {
    /// Starts a queue for a conversation that a call leads.
    pub(crate) fn begin(&self, id: &str) {
        let queues = &mut self.state.lock().led;
        queues.insert(id.to_owned(), VecDeque::new());
    }

    /// Ends a conversation. Its unread messages go to `receive`.
    pub(crate) fn end(&self, id: &str) {
        let mut state = self.state.lock();
        let left = state.led.remove(id).unwrap_or_default();
        state.others.extend(left);
        drop(state);
        self.changed.notify_waiters();
    }

    /// Waits for the next message of a conversation.
    pub(crate) async fn next_of(&self, endpoint: &Endpoint, id: &str) -> Received {
        self.next(endpoint, Reader::Conversation(id)).await
    }

    /// Waits for the next message of no led conversation.
    pub(crate) async fn next_other(&self, endpoint: &Endpoint) -> Received {
        self.next(endpoint, Reader::Others).await
    }

    /// Returns the next message of no led conversation, if one is available now.
    pub(crate) fn other_now(&self, endpoint: &Endpoint) -> Result<Option<Incoming>, ReceiveError> {
        loop {
            if let Some(set_aside) = self.state.lock().take(Reader::Others) {
                return set_aside.map(Some);
            }
            match endpoint.letter_now() {
                None => return Ok(None),
                Some(received) => self.put(received),
            }
        }
    }

    /// Removes and returns all messages that were set aside.
    pub(crate) fn drain(&self) -> Vec<Received> {
        let mut state = self.state.lock();
        let mut all: Vec<Received> = state.others.drain(..).collect();
        all.extend(state.led.drain().flat_map(|(_, queue)| queue));
        all
    }

    async fn next(&self, endpoint: &Endpoint, reader: Reader<'_>) -> Received {
        loop {
            // Created before the check, so that no change after the check is missed.
            let changed = self.changed.notified();
            let room = {
                let mut state = self.state.lock();
                if let Some(set_aside) = state.take(reader) {
                    drop(state);
                    // Readers that wait for room may receive again.
                    self.changed.notify_waiters();
                    return set_aside;
                }
                state.has_room()
            };
            tokio::select! {
                biased;
                () = changed => {}
                received = endpoint.next_letter(), if room => {
                    if let Err(ReceiveError::Closed) = received {
                        return received;
                    }
                    self.put(received);
                }
                () = endpoint.closed(), if !room => return Err(ReceiveError::Closed),
            }
        }
    }

    fn put(&self, received: Received) {
        self.state.lock().put(received);
        self.changed.notify_waiters();
    }
}

impl State {
    fn take(&mut self, reader: Reader<'_>) -> Option<Received> {
        match reader {
            Reader::Conversation(id) => self.led.get_mut(id)?.pop_front(),
            Reader::Others => self.others.pop_front(),
        }
    }

    fn has_room(&self) -> bool {
        let led = self.led.values().map(VecDeque::len).max().unwrap_or(0);
        self.others.len().max(led) < MAX_SET_ASIDE
    }

    fn put(&mut self, received: Received) {
        let message = match &received {
            Ok(incoming) => Some(&incoming.message),
            Err(ReceiveError::Violation { incoming, .. }) => Some(&incoming.message),
            Err(_) => None,
        };
        let id = message.and_then(|message| message.conversation_id());
        match id.and_then(|id| self.led.get_mut(id)) {
            Some(queue) => queue.push_back(received),
            None => self.others.push_back(received),
        }
    }
}
