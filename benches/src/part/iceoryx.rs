//! Bare iceoryx2: a request, and its response as the acknowledgment; and samples for subscribers.

use std::collections::VecDeque;
use std::ffi::OsStr;
use std::path::PathBuf;

use fipa::Config;
use fipa_transport::Incarnation;
use fipa_transport_shm::ShmConfig;
use fipa_transport_shm::raw::{
    RawClient, RawNode, RawPending, RawPublisher, RawServer, RawSubscriber, Wait,
};

use super::orders::{
    End, Fill, Letters, Peer, Sent, byte_of, check, execute_orders, now_ns, to_text,
};

/// The name of the service between the two.
const NAME: &str = "raw";

pub(super) fn play(config: &Config, end: End, wait: Wait) -> Result<(), String> {
    let node = node(config)?;
    match end {
        End::Receiver => {
            let server = node.serve(NAME).map_err(to_text)?;
            execute_orders(&mut Receiver { server, wait }, String::new());
        }
        End::Sender => {
            let client = node.connect(NAME).map_err(to_text)?;
            let ready = Vec::new();
            let mut sender = Sender {
                client,
                wait,
                ready,
            };
            execute_orders(&mut sender, String::new());
        }
    }
    Ok(())
}

/// Publishes to this number of subscribers, which block.
pub(super) fn publish(config: &Config, subscribers: usize) -> Result<(), String> {
    let node = node(config)?;
    let publisher = node.publish(NAME, subscribers).map_err(to_text)?;
    execute_orders(&mut Publisher { publisher }, String::new());
    Ok(())
}

pub(super) fn subscribe(config: &Config) -> Result<(), String> {
    let subscriber = node(config)?.subscribe(NAME).map_err(to_text)?;
    execute_orders(&mut Subscriber { subscriber }, String::new());
    Ok(())
}

/// A node with a directory of its own.
pub(super) fn node(config: &Config) -> Result<RawNode, String> {
    RawNode::open(&place(config, "raw")?).map_err(to_text)
}

/// Shared memory for one path, below the directory of the measurement.
pub(super) fn place(config: &Config, what: &str) -> Result<ShmConfig, String> {
    let place = std::env::var_os("FIPA_RUNTIME_DIR")
        .filter(|place| place != OsStr::new(""))
        .ok_or("FIPA_RUNTIME_DIR is not set")?;
    // iceoryx2 has sockets there, whose paths are short: the last word distinguishes the domains.
    let path = config.domain.rsplit('-').next().unwrap_or_default();
    let root = PathBuf::from(place).join(format!("{what}-{path}"));
    let shm = &config.transport.shm;
    Ok(ShmConfig {
        capacity: shm.capacity,
        // The prefix of the files of real domains.
        ..ShmConfig::new(
            root,
            format!("fipa_{}_{what}", config.domain),
            Incarnation::random(),
        )
    })
}

struct Receiver {
    server: RawServer,
    wait: Wait,
}

impl Peer for Receiver {
    fn receive(&mut self, letters: &Letters) -> Result<Vec<u64>, String> {
        let mut at = Vec::with_capacity(letters.count);
        for number in 0..letters.count {
            let request = self.server.receive(self.wait).map_err(to_text)?;
            at.push(now_ns());
            check(request.payload(), letters, number)?;
            self.server.answer(request, self.wait).map_err(to_text)?;
        }
        Ok(at)
    }
}

struct Sender<'a> {
    client: RawClient<'a>,
    wait: Wait,
    ready: Vec<u8>,
}

impl Sender<'_> {
    fn begin(
        &mut self,
        letters: &Letters,
        number: usize,
        sent: &mut Sent,
    ) -> Result<RawPending, String> {
        let byte = byte_of(number);
        if letters.fill == Fill::Copied {
            make_ready(&mut self.ready, letters.size, byte);
        }
        sent.began.push(now_ns());
        let mut loan = self.client.loan(letters.size).map_err(to_text)?;
        match letters.fill {
            Fill::Loaned => {}
            Fill::Filled => loan.content_mut().fill(byte),
            Fill::Copied => loan.content_mut().copy_from_slice(&self.ready),
        }
        self.client.send(loan, self.wait).map_err(to_text)
    }

    fn end(&self, pending: &RawPending, sent: &mut Sent) -> Result<(), String> {
        self.client.answered(pending, self.wait).map_err(to_text)?;
        sent.ended.push(now_ns());
        Ok(())
    }
}

impl Peer for Sender<'_> {
    fn send(&mut self, letters: &Letters) -> Result<Sent, String> {
        let mut sent = Sent::with_room(letters);
        let mut under_way = VecDeque::with_capacity(letters.window);
        for number in 0..letters.count {
            if under_way.len() >= letters.window
                && let Some(first) = under_way.pop_front()
            {
                self.end(&first, &mut sent)?;
            }
            under_way.push_back(self.begin(letters, number, &mut sent)?);
        }
        for rest in under_way {
            self.end(&rest, &mut sent)?;
        }
        Ok(sent)
    }
}

struct Publisher<'a> {
    publisher: RawPublisher<'a>,
}

impl Peer for Publisher<'_> {
    /// A sample is not acknowledged: its end is that of the call.
    fn send(&mut self, letters: &Letters) -> Result<Sent, String> {
        let mut sent = Sent::with_room(letters);
        for number in 0..letters.count {
            std::thread::sleep(letters.pause());
            sent.began.push(now_ns());
            let mut loan = self.publisher.loan(letters.size).map_err(to_text)?;
            loan.content_mut().fill(byte_of(number));
            self.publisher.send(loan, Wait::Block).map_err(to_text)?;
            sent.ended.push(now_ns());
        }
        Ok(sent)
    }
}

struct Subscriber {
    subscriber: RawSubscriber,
}

impl Peer for Subscriber {
    fn receive(&mut self, letters: &Letters) -> Result<Vec<u64>, String> {
        let mut at = Vec::with_capacity(letters.count);
        for number in 0..letters.count {
            let sample = self.subscriber.receive(Wait::Block).map_err(to_text)?;
            at.push(now_ns());
            check(sample.payload(), letters, number)?;
        }
        Ok(at)
    }
}

/// Makes content that begins and ends with this byte.
pub(super) fn make_ready(content: &mut Vec<u8>, size: usize, byte: u8) {
    content.resize(size, 0);
    for at in [0, size.saturating_sub(1)] {
        if let Some(place) = content.get_mut(at) {
            *place = byte;
        }
    }
}
