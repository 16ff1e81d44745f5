//! Which message is for whom: for a conversation that is led by a call, or for whoever receives.

use std::collections::{HashMap, VecDeque};

use parking_lot::Mutex;
use tokio::sync::Notify;

use crate::agent::{Agent, Incoming, ReceiveError};

/// Most messages that are put aside for one reader while another one takes messages in. When there
/// are as many, letters stay in the agent's queue, and their senders are held back.
const MAX_ASIDE: usize = 1_024;

type Received = Result<Incoming, ReceiveError>;

/// The messages that were taken in by somebody else than they are for.
#[derive(Default)]
pub(crate) struct Desk {
    state: Mutex<State>,
    changed: Notify,
}

#[derive(Default)]
struct State {
    /// Of conversations that are led, by id.
    led: HashMap<String, VecDeque<Received>>,
    others: VecDeque<Received>,
}

/// For whom somebody waits.
#[derive(Clone, Copy)]
enum Reader<'a> {
    Conversation(&'a str),
    Others,
}

impl Desk {
    pub(crate) fn begin(&self, id: &str) {
        let queues = &mut self.state.lock().led;
        queues.insert(id.to_owned(), VecDeque::new());
    }

    /// The conversation is over; what it has not read goes to whoever receives.
    pub(crate) fn end(&self, id: &str) {
        let mut state = self.state.lock();
        let left = state.led.remove(id).unwrap_or_default();
        state.others.extend(left);
        drop(state);
        self.changed.notify_waiters();
    }

    /// The next message of a conversation.
    pub(crate) async fn next_of(&self, agent: &Agent, id: &str) -> Received {
        self.next(agent, Reader::Conversation(id)).await
    }

    /// The next message of no conversation that is led.
    pub(crate) async fn next_other(&self, agent: &Agent) -> Received {
        self.next(agent, Reader::Others).await
    }

    pub(crate) fn other_now(&self, agent: &Agent) -> Result<Option<Incoming>, ReceiveError> {
        loop {
            if let Some(put_aside) = self.state.lock().take(Reader::Others) {
                return put_aside.map(Some);
            }
            match agent.letter_now() {
                None => return Ok(None),
                Some(received) => self.put(received),
            }
        }
    }

    /// Everything that was put aside, for nobody will read it any more.
    pub(crate) fn drain(&self) -> Vec<Received> {
        let mut state = self.state.lock();
        let mut all: Vec<Received> = state.others.drain(..).collect();
        all.extend(state.led.drain().flat_map(|(_, queue)| queue));
        all
    }

    async fn next(&self, agent: &Agent, reader: Reader<'_>) -> Received {
        loop {
            // Before looking, so that what changes afterwards is noticed.
            let changed = self.changed.notified();
            let room = {
                let mut state = self.state.lock();
                if let Some(put_aside) = state.take(reader) {
                    drop(state);
                    // There is room again for those who take letters in.
                    self.changed.notify_waiters();
                    return put_aside;
                }
                state.has_room()
            };
            tokio::select! {
                biased;
                () = changed => {}
                received = agent.next_letter(), if room => {
                    if let Err(ReceiveError::Closed) = received {
                        return received;
                    }
                    self.put(received);
                }
                () = agent.closed(), if !room => return Err(ReceiveError::Closed),
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
        self.others.len().max(led) < MAX_ASIDE
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
