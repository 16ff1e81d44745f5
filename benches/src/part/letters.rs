//! Encoded letters through the shared memory transport alone, without directory, delivery core or
//! agents. The difference to bare iceoryx2 is the cost of acknowledgments, bounds and crash safety.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use fipa::Config;
use fipa_acl::{Letter, Payload};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Incarnation, Kind, LegacySource, Location,
    Parcel, Reaction, Sink, Stream, Transport,
};
use fipa_transport_shm::ShmTransport;
use parking_lot::Mutex;
use tokio::runtime::{Builder, Runtime};

use super::iceoryx::{make_ready, place};
use super::orders::{
    ContentProbe, End, Fill, Letters, Peer, Sent, byte_of, execute_orders, now_ns,
};
use crate::error::chain_text;

/// The bytes before and behind the content, as long as in messages of agents.
const ENVELOPE: &[u8] = &[2; 80];
const HEAD: &[u8] = &[1; 120];
const TAIL: &[u8] = &[1; 1];
/// Name of the receiver.
const NAME: &str = "arm_left";
/// Deadline of a letter.
const REMAINING: Duration = Duration::from_secs(5);

pub(super) fn play(config: &Config, end: End) -> Result<(), String> {
    let runtime = Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .map_err(chain_text)?;
    let config = place(config, "letters")?;
    let endpoint = ShmTransport::new(config, runtime.handle().clone()).map_err(chain_text)?;
    let heard = Arc::new(ReceivedLetters::default());
    endpoint.listen(heard.clone()).map_err(chain_text)?;
    let mut both = Both {
        endpoint,
        heard,
        to: None,
        ready: Vec::new(),
        next: 0,
        _runtime: runtime,
    };
    let address = match end {
        End::Receiver => both.endpoint.location().to_string(),
        End::Sender => String::new(),
    };
    execute_orders(&mut both, address);
    both.endpoint.close();
    Ok(())
}

/// Arrived letters with their times, until they are checked.
#[derive(Default)]
struct ReceivedLetters {
    // Only a probe of the content: held content occupies a slot of the sender.
    arrived: Mutex<Vec<(u64, ContentProbe)>>,
    concluded: Mutex<Vec<(u64, AttemptId, Conclusion)>>,
}

impl Sink for ReceivedLetters {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        if let Body::Letter(letter) = &arrival.parcel.body {
            let seen = ContentProbe::of(&letter.payload().content);
            self.arrived.lock().push((now_ns(), seen));
        }
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _letter: Letter, _via: Kind, _from: LegacySource) {}

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        self.concluded.lock().push((now_ns(), attempt, conclusion));
    }
}

/// One end of the path.
struct Both {
    endpoint: ShmTransport,
    heard: Arc<ReceivedLetters>,
    to: Option<Location>,
    /// Content in the application's memory.
    ready: Vec<u8>,
    /// Number of the next attempt.
    next: u64,
    // Dropped after the endpoint, whose tasks run on it.
    _runtime: Runtime,
}

impl Both {
    /// Dispatches a letter and returns the time before.
    fn begin(&mut self, letters: &Letters, number: usize) -> Result<(AttemptId, u64), String> {
        let to = self.to.as_ref().ok_or("no receiver is set")?;
        let byte = byte_of(number);
        let ready = (letters.fill == Fill::Copied).then(|| {
            make_ready(&mut self.ready, letters.size, byte);
            Bytes::copy_from_slice(&self.ready)
        });
        let began = now_ns();
        let content = match ready {
            Some(content) => content,
            None => {
                let front = NAME.len() + ENVELOPE.len() + HEAD.len();
                let loan = self.endpoint.loan(to, front, letters.size, TAIL.len());
                let mut loan = loan.map_err(chain_text)?.ok_or("no memory is loaned")?;
                if letters.fill == Fill::Filled {
                    loan.content_mut().fill(byte);
                }
                loan.freeze()
            }
        };
        self.next += 1;
        let attempt = AttemptId(self.next);
        let dispatched = self.endpoint.post(attempt, to, parcel(content));
        dispatched.map_err(chain_text)?;
        Ok((attempt, began))
    }

    /// Polls for conclusions once.
    fn collect(
        &self,
        open: &mut HashMap<AttemptId, usize>,
        ended: &mut [u64],
    ) -> Result<(), String> {
        self.endpoint.drive();
        for (at, attempt, conclusion) in self.heard.concluded.lock().drain(..) {
            if conclusion != Conclusion::Answered(Answer::Accepted) {
                return Err(format!("a letter ended as {conclusion:?}"));
            }
            let place = open.remove(&attempt).and_then(|one| ended.get_mut(one));
            *place.ok_or("a letter ended twice")? = at;
        }
        Ok(())
    }
}

impl Peer for Both {
    fn find(&mut self, to: &str) -> Result<(), String> {
        self.to = Some(to.parse().map_err(chain_text)?);
        Ok(())
    }

    fn receive(&mut self, letters: &Letters) -> Result<Vec<u64>, String> {
        let mut at = Vec::with_capacity(letters.count);
        while at.len() < letters.count {
            self.endpoint.drive();
            for (time, seen) in self.heard.arrived.lock().drain(..) {
                seen.check(letters, at.len())?;
                at.push(time);
            }
        }
        Ok(at)
    }

    fn send(&mut self, letters: &Letters) -> Result<Sent, String> {
        let mut sent = Sent::with_room(letters);
        sent.ended.resize(letters.count, 0);
        let mut open = HashMap::with_capacity(letters.window);
        for number in 0..letters.count {
            while open.len() >= letters.window {
                self.collect(&mut open, &mut sent.ended)?;
            }
            let (attempt, began) = self.begin(letters, number)?;
            sent.began.push(began);
            open.insert(attempt, number);
        }
        while !open.is_empty() {
            self.collect(&mut open, &mut sent.ended)?;
        }
        Ok(sent)
    }
}

fn parcel(content: Bytes) -> Parcel {
    let payload = Payload {
        head: Bytes::from_static(HEAD),
        content,
        tail: Bytes::from_static(TAIL),
    };
    Parcel {
        receiver: NAME.into(),
        stream: Stream::between(Incarnation::from_u64(1), Incarnation::from_u64(2)),
        sequence: 1,
        after: 0,
        remaining: REMAINING,
        transfer: 0,
        body: Body::Letter(Letter::new(Bytes::from_static(ENVELOPE), payload)),
    }
}
