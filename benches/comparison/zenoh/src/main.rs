//! A sender or receiver that uses zenoh, for `fipa bench --zenoh PROGRAM`.
//!
//! It executes the same orders as the processes of `fipa bench` itself. A letter is a publication; an
//! empty publication in return acknowledges it. The peers are connected directly over TCP on the
//! loopback interface, with or without zenoh's shared memory. A sender connects to one receiver or several:
//! the order to find them has their addresses, separated by commas.

use std::sync::mpsc::{Receiver as Queue, Sender as Into, channel};
use std::time::{Duration, Instant};

use clap::Parser;
use orders::{End, Fill, Letters, Peer, Sent, byte_of, check, execute_orders, now_ns, to_text};
use zenoh::bytes::ZBytes;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::shm::{
    BlockOn, GarbageCollect, PosixShmProviderBackend, ShmProvider, ShmProviderBuilder,
};
use zenoh::{Config, Session, Wait as _};

#[path = "../../../src/part/orders.rs"]
mod orders;

/// Run the zenoh sender or receiver of a measurement; `fipa bench --zenoh` starts this program
///
/// Example: fipa bench --zenoh benches/comparison/zenoh/target/release/fipa-comparison-zenoh
#[derive(Debug, Parser)]
struct Arguments {
    /// Sender or receiver
    #[arg(long)]
    end: End,
    /// Use zenoh's shared memory
    #[arg(long)]
    shared_memory: bool,
}

const LETTERS: &str = "bench/letters";
const ANSWERS: &str = "bench/answers";

/// Size of the shared memory, in bytes: the same as that of `fipa bench`.
const CAPACITY: usize = 1 << 30;

/// Timeout of steps that usually take less than a second.
const STEP_TIMEOUT: Duration = Duration::from_secs(30);

/// Maximum wait for the answer to a greeting before it is repeated.
const GREETING_INTERVAL: Duration = Duration::from_millis(50);

fn main() -> Result<(), String> {
    let Arguments { end, shared_memory } = Arguments::parse();
    match end {
        End::Sender => {
            let mut sender = Sender {
                shared_memory,
                connected: None,
            };
            execute_orders(&mut sender, String::new());
        }
        End::Receiver => {
            let session = open("listen", "tcp/127.0.0.1:0", shared_memory)?;
            let locators = session.info().locators().wait();
            let address = locators.first().ok_or("zenoh listens on no address")?;
            let address = address.to_string();
            let mut receiver = Receiver::new(session)?;
            execute_orders(&mut receiver, address);
        }
    }
    Ok(())
}

/// Opens a session that listens on or connects to addresses, without scouting. They are separated by commas.
fn open(how: &str, addresses: &str, shared_memory: bool) -> Result<Session, String> {
    let mut config = Config::default();
    let addresses: Vec<String> = addresses.split(',').map(|it| format!("\"{it}\"")).collect();
    let other = if how == "listen" { "connect" } else { "listen" };
    for (key, value) in [
        ("mode", "\"peer\"".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        (
            &format!("{how}/endpoints"),
            format!("[{}]", addresses.join(",")),
        ),
        (&format!("{other}/endpoints"), "[]".to_owned()),
        ("transport/shared_memory/enabled", shared_memory.to_string()),
    ] {
        config.insert_json5(key, &value).map_err(to_text)?;
    }
    zenoh::open(config).wait().map_err(to_text)
}

/// Declares a publisher that sends each publication at once, and blocks instead of dropping it.
fn publisher(session: &Session, key: &'static str) -> Result<Publisher<'static>, String> {
    let publisher = session
        .declare_publisher(key)
        .congestion_control(CongestionControl::Block)
        .priority(Priority::RealTime)
        .express(true);
    publisher.wait().map_err(to_text)
}

struct Receiver {
    arrived: Queue<(u64, ZBytes)>,
    _letters: Subscriber<()>,
    _session: Session,
}

impl Receiver {
    fn new(session: Session) -> Result<Self, String> {
        let answers = publisher(&session, ANSWERS)?;
        let (into, arrived): (Into<(u64, ZBytes)>, _) = channel();
        let letters = session
            .declare_subscriber(LETTERS)
            .callback(move |sample| {
                let at = now_ns();
                let content = sample.payload().clone();
                // The sender detects a failed answer by its timeout.
                let _answered = answers.put(ZBytes::new()).wait();
                // A greeting has no content, and is only answered.
                if !content.is_empty() {
                    let _taken = into.send((at, content));
                }
            })
            .wait()
            .map_err(to_text)?;
        Ok(Self {
            arrived,
            _letters: letters,
            _session: session,
        })
    }
}

impl Peer for Receiver {
    fn receive(&mut self, letters: &Letters) -> Result<Vec<u64>, String> {
        let mut at = Vec::with_capacity(letters.count);
        for number in 0..letters.count {
            let (arrived, content) = self.arrived.recv_timeout(STEP_TIMEOUT).map_err(to_text)?;
            check(&content.to_bytes(), letters, number)?;
            at.push(arrived);
        }
        Ok(at)
    }
}

struct Sender {
    shared_memory: bool,
    connected: Option<Connected>,
}

struct Connected {
    receivers: usize,
    letters: Publisher<'static>,
    answered: Queue<u64>,
    memory: Option<ShmProvider<PosixShmProviderBackend>>,
    _answers: Subscriber<()>,
    _session: Session,
}

impl Connected {
    /// Connects to the receivers at these addresses.
    fn to(addresses: &str, shared_memory: bool) -> Result<Self, String> {
        let session = open("connect", addresses, shared_memory)?;
        let (into, answered) = channel();
        let answers = session
            .declare_subscriber(ANSWERS)
            .callback(move |_| {
                let _taken = into.send(now_ns());
            })
            .wait()
            .map_err(to_text)?;
        let memory = if shared_memory {
            let backend = PosixShmProviderBackend::builder(CAPACITY).wait();
            let backend = backend.map_err(to_text)?;
            Some(ShmProviderBuilder::backend(backend).wait())
        } else {
            None
        };
        let connected = Self {
            receivers: addresses.split(',').count(),
            letters: publisher(&session, LETTERS)?,
            answered,
            memory,
            _answers: answers,
            _session: session,
        };
        connected.greet()?;
        Ok(connected)
    }

    /// Sends greetings until all receivers answer one: then all subscriptions are active.
    fn greet(&self) -> Result<(), String> {
        let until = Instant::now() + STEP_TIMEOUT;
        while Instant::now() < until {
            self.letters.put(ZBytes::new()).wait().map_err(to_text)?;
            let answer = || self.answered.recv_timeout(GREETING_INTERVAL);
            let is_complete = (0..self.receivers).all(|_| answer().is_ok());
            // Discards late answers.
            while self.answered.recv_timeout(GREETING_INTERVAL * 4).is_ok() {}
            if is_complete {
                return Ok(());
            }
        }
        Err("no answer from a receiver".to_owned())
    }

    /// Creates the content of a letter and records its start time.
    fn content(
        &self,
        letters: &Letters,
        number: usize,
        began: &mut Vec<u64>,
    ) -> Result<ZBytes, String> {
        let byte = byte_of(number);
        let (Some(memory), true) = (&self.memory, letters.fill != Fill::Copied) else {
            // Without loaned memory, content that is not filled is prepared before the start time.
            if letters.fill == Fill::Filled {
                let mut content = vec![0; letters.size];
                began.push(now_ns());
                content.fill(byte);
                return Ok(content.into());
            }
            let content = ZBytes::from(vec![byte; letters.size]);
            began.push(now_ns());
            return Ok(content);
        };
        began.push(now_ns());
        let loan = memory.alloc(letters.size);
        let loan = loan.with_policy::<BlockOn<GarbageCollect>>().wait();
        let mut loan = loan.map_err(to_text)?;
        if letters.fill == Fill::Filled {
            loan.fill(byte);
        }
        Ok(loan.into())
    }

    /// Waits for as many answers as one letter gets. Returns the time of the last one.
    fn answer(&self) -> Result<u64, String> {
        let mut last = 0;
        for _ in 0..self.receivers {
            last = self.answered.recv_timeout(STEP_TIMEOUT).map_err(to_text)?;
        }
        Ok(last)
    }
}

impl Peer for Sender {
    fn find(&mut self, to: &str) -> Result<(), String> {
        self.connected = Some(Connected::to(to, self.shared_memory)?);
        Ok(())
    }

    fn send(&mut self, letters: &Letters) -> Result<Sent, String> {
        let connected = self.connected.as_ref().ok_or("not connected")?;
        let mut sent = Sent::with_room(letters);
        for number in 0..letters.count {
            while sent.began.len() - sent.ended.len() >= letters.window {
                sent.ended.push(connected.answer()?);
            }
            std::thread::sleep(letters.pause());
            let content = connected.content(letters, number, &mut sent.began)?;
            connected.letters.put(content).wait().map_err(to_text)?;
        }
        while sent.ended.len() < sent.began.len() {
            sent.ended.push(connected.answer()?);
        }
        Ok(sent)
    }
}
