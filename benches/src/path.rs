//! The measured paths and their limits.

use fipa::Kind;

use super::part::{End, Event, Fill, Letters, Order, Part, Socket, Wait, Wire};
use super::stage::{ProcessIndex, Stage};

/// The mechanism of a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mechanism {
    /// Two agents on one host.
    Agents(Kind),
    /// Two agents on two hosts, and a gateway on each.
    Gateways(Kind),
    /// Two agents on two hosts, and gateways that have authenticated each other: TCP with TLS, or QUIC.
    Secured(Kind),
    /// Encoded letters through the shared memory transport alone.
    Letters,
    /// Bare iceoryx2.
    Iceoryx,
    /// A bare socket.
    Socket(Socket),
    /// Publications of zenoh, in shared memory of its own or through TCP alone.
    Zenoh { shared_memory: bool },
    /// Bare iceoryx2, then a bare connection, then bare iceoryx2.
    Relay(Wire),
}

impl Mechanism {
    /// The limit: the bare mechanism that moves the same bytes.
    pub(super) fn limit(self) -> Option<Self> {
        match self {
            Self::Agents(Kind::Shm) | Self::Letters => Some(Self::Iceoryx),
            Self::Agents(_) => Some(Self::Socket(Socket::Unix)),
            Self::Gateways(_) => Some(Self::Relay(Wire::Tcp)),
            Self::Secured(Kind::Tcp) => Some(Self::Relay(Wire::Tls)),
            Self::Secured(_) => Some(Self::Relay(Wire::Quic)),
            Self::Zenoh {
                shared_memory: true,
            } => Some(Self::Iceoryx),
            Self::Zenoh { .. } => Some(Self::Socket(Socket::Tcp)),
            Self::Iceoryx | Self::Socket(_) | Self::Relay(_) => None,
        }
    }

    /// The path without encryption, measured in the same rounds.
    pub(super) fn plain(self) -> Option<Self> {
        matches!(self, Self::Secured(_)).then_some(Self::Gateways(Kind::Tcp))
    }

    pub(super) fn name(self) -> String {
        match self {
            Self::Agents(kind) => kind.to_string(),
            Self::Gateways(kind) => format!("gateways {kind}"),
            Self::Secured(Kind::Tcp) => "gateways tcp, tls".to_owned(),
            Self::Secured(kind) => format!("gateways {kind}"),
            Self::Letters => "shm, encoded".to_owned(),
            Self::Iceoryx => "raw iceoryx2".to_owned(),
            Self::Socket(Socket::Tcp) => "raw tcp".to_owned(),
            Self::Socket(Socket::Unix) => "raw unix socket".to_owned(),
            Self::Zenoh {
                shared_memory: true,
            } => "zenoh shm".to_owned(),
            Self::Zenoh { .. } => "zenoh tcp".to_owned(),
            Self::Relay(Wire::Tcp) => "raw relay".to_owned(),
            Self::Relay(Wire::Tls) => "raw relay, rustls".to_owned(),
            Self::Relay(Wire::Quic) => "raw relay, quinn".to_owned(),
        }
    }

    /// Whether the path loans memory, so that loaned and filled content differ.
    pub(super) fn loans(self) -> bool {
        matches!(
            self,
            Self::Agents(Kind::Shm)
                | Self::Letters
                | Self::Iceoryx
                | Self::Zenoh {
                    shared_memory: true
                }
        )
    }

    /// Whether a size may be too large for the path, so that it is tried first.
    fn is_ours(self) -> bool {
        matches!(self, Self::Agents(_) | Self::Gateways(_) | Self::Secured(_))
    }

    /// Number of letters in flight when the rate of letters with content of this size, in bytes, is
    /// measured.
    pub(super) fn window(fill: Fill, size: usize) -> usize {
        let letters = match fill {
            Fill::Copied => 16,
            // The maximum number of loans of a process.
            _ => 8,
        };
        letters.min(MAX_IN_FLIGHT / size).max(1)
    }
}

/// Maximum content in flight when the rate is measured, in bytes: it fits into a receiver's queue,
/// which holds 64 MiB by default.
pub(super) const MAX_IN_FLIGHT: usize = 48 << 20;

/// A path whose processes run.
#[derive(Debug)]
pub(super) struct BenchPath {
    pub(super) mechanism: Mechanism,
    pub(super) wait: Wait,
    sender: ProcessIndex,
    receiver: ProcessIndex,
    between: Vec<ProcessIndex>,
}

/// Times of one turn, in nanoseconds of the shared clock.
#[derive(Debug)]
pub(super) struct Turn {
    /// Start of each letter.
    pub(super) began: Vec<u64>,
    /// Arrival of each letter, decoded.
    pub(super) arrived: Vec<u64>,
    /// Acknowledgment of each letter.
    pub(super) ended: Vec<u64>,
    /// Processor time of all processes together.
    pub(super) cpu_ns: u64,
}

impl BenchPath {
    /// Starts the processes of a path.
    pub(super) async fn open(
        stage: &mut Stage,
        mechanism: Mechanism,
        wait: Wait,
    ) -> Result<Self, String> {
        let ends = [End::Sender, End::Receiver];
        let own = |part: &str| format!("{}{part}", short(mechanism, wait));
        let spin = match wait {
            Wait::Spin => "transport.shm.spin=1s",
            Wait::Block => "transport.shm.spin=0s",
        };
        let settings = |transports: &str| {
            vec![
                spin.to_owned(),
                format!("mts.transports={transports}"),
                "transport.shm.capacity=1GiB".to_owned(),
            ]
        };
        let agents = |[from, to]: [String; 2]| {
            let agent = |end, name| Part::Agent { end, name };
            (agent(End::Sender, from), agent(End::Receiver, to))
        };
        let mut between = Vec::new();
        let (sender, receiver, address) = match mechanism {
            Mechanism::Agents(kind) => {
                let settings = settings(kind.name());
                let (from, to) = agents(["a", "b"].map(str::to_owned));
                let (receiver, name) = stage.start(&to, &own(""), &settings).await?;
                let (sender, _) = stage.start(&from, &own(""), &settings).await?;
                (sender, receiver, Some(name))
            }
            Mechanism::Gateways(kind) | Mechanism::Secured(kind) => {
                let mut settings = settings(&format!("shm,{kind}"));
                let hosts = ["1", "2"].map(own);
                let mut keys = Vec::new();
                if let Mechanism::Secured(_) = mechanism {
                    // QUIC is refused without keys; agents need any keys, gateways their own.
                    keys = stage.keys(&hosts)?;
                    settings.extend(keys.first().cloned());
                    settings.push("security.loopback=true".to_owned());
                    // No rate limit, as between processes of one host.
                    settings.push("security.peer_letters=0".to_owned());
                    settings.push("security.peer_bytes=0".to_owned());
                }
                let with_keys = |number| {
                    let mut settings = settings.clone();
                    settings.extend(keys.get(number).cloned());
                    settings
                };
                between = stage.start_gateways(&hosts, with_keys).await?;
                let (from, to) = agents(["-a", "-b"].map(|end| Stage::domain(&own(end))));
                let (receiver, name) = stage.start(&to, &own("2"), &settings).await?;
                let (sender, _) = stage.start(&from, &own("1"), &settings).await?;
                (sender, receiver, Some(name))
            }
            Mechanism::Letters => {
                let settings = settings("shm");
                let [from, to] = ends.map(|end| Part::Letters { end });
                let (receiver, address) = stage.start(&to, &own(""), &settings).await?;
                let (sender, _) = stage.start(&from, &own(""), &settings).await?;
                (sender, receiver, Some(address))
            }
            Mechanism::Iceoryx => {
                let settings = settings("shm");
                let [from, to] = ends.map(|end| Part::Iceoryx { end, wait });
                let (receiver, _) = stage.start(&to, &own(""), &settings).await?;
                let (sender, _) = stage.start(&from, &own(""), &settings).await?;
                (sender, receiver, None)
            }
            Mechanism::Socket(kind) => {
                let [from, to] = ends.map(|end| Part::Socket { end, kind });
                let (receiver, address) = stage.start(&to, "raw", &[]).await?;
                let (sender, _) = stage.start(&from, "raw", &[]).await?;
                (sender, receiver, Some(address))
            }
            Mechanism::Zenoh { shared_memory } => {
                let (receiver, address) = stage.start_zenoh(End::Receiver, shared_memory).await?;
                let (sender, _) = stage.start_zenoh(End::Sender, shared_memory).await?;
                (sender, receiver, Some(address))
            }
            Mechanism::Relay(wire) => {
                let settings = settings("shm");
                let [from, to] = ends.map(|end| Part::Iceoryx { end, wait });
                let [near, far] = ends.map(|end| Part::Relay { end, wire });
                let (receiver, _) = stage.start(&to, &own("2"), &settings).await?;
                let (far, address) = stage.start(&far, &own("2"), &settings).await?;
                let (near, _) = stage.start(&near, &own("1"), &settings).await?;
                let (sender, _) = stage.start(&from, &own("1"), &settings).await?;
                find(stage, near, address).await?;
                between.extend([near, far]);
                (sender, receiver, None)
            }
        };
        if let Some(address) = address {
            find(stage, sender, address).await?;
        }
        Ok(Self {
            mechanism,
            wait,
            sender,
            receiver,
            between,
        })
    }

    /// Sends one letter of this size; an error says why the path does not carry it.
    pub(super) async fn takes(&self, stage: &mut Stage, size: usize) -> Result<(), String> {
        if !self.mechanism.is_ours() {
            return Ok(());
        }
        // The agent's queue takes the letter before the agent receives it.
        let one = Letters {
            count: 1,
            size,
            fill: Fill::Copied,
            window: 1,
            pause_us: 0,
        };
        stage.tell(self.sender, &Order::Send(one)).await?;
        stage.event(self.sender).await?;
        stage.tell(self.receiver, &Order::Receive(one)).await?;
        stage.event(self.receiver).await?;
        stage.event(self.receiver).await?;
        Ok(())
    }

    /// Sends letters along the path.
    pub(super) async fn turn(&self, stage: &mut Stage, letters: Letters) -> Result<Turn, String> {
        let before = self.cpu(stage).await?;
        stage.tell(self.receiver, &Order::Receive(letters)).await?;
        let Event::Receiving = stage.event(self.receiver).await? else {
            return Err("the receiver is not ready".to_owned());
        };
        stage.tell(self.sender, &Order::Send(letters)).await?;
        let sent = stage.event(self.sender).await?;
        let received = stage.event(self.receiver).await?;
        let between = self.cpu(stage).await? - before;
        let (
            Event::Sent {
                began,
                ended,
                cpu_ns: sending,
            },
            Event::Received {
                at: arrived,
                cpu_ns: receiving,
            },
        ) = (sent, received)
        else {
            return Err("the ends did not send their times".to_owned());
        };
        let all = [began.len(), ended.len(), arrived.len()];
        if all != [letters.count; 3] {
            return Err(format!(
                "sent, acknowledged and received {all:?} of {} letters",
                letters.count
            ));
        }
        Ok(Turn {
            began,
            arrived,
            ended,
            cpu_ns: sending + receiving + between,
        })
    }

    /// Processor time that the processes between the ends have used, in nanoseconds.
    async fn cpu(&self, stage: &mut Stage) -> Result<u64, String> {
        let mut all = 0;
        for who in &self.between {
            stage.tell(*who, &Order::Cpu).await?;
            match stage.event(*who).await? {
                Event::Cpu { ns } => all += ns,
                other => return Err(format!("expected a time, received {other:?}")),
            }
        }
        Ok(all)
    }
}

async fn find(stage: &mut Stage, who: ProcessIndex, to: String) -> Result<(), String> {
    stage.tell(who, &Order::Find { to }).await?;
    match stage.event(who).await? {
        Event::Found => Ok(()),
        other => Err(format!("expected an end, received {other:?}")),
    }
}

/// A short text that distinguishes paths, for names of domains.
fn short(mechanism: Mechanism, wait: Wait) -> String {
    let wait = match wait {
        Wait::Spin => 's',
        Wait::Block => 'b',
    };
    match mechanism {
        Mechanism::Agents(kind) => format!("{kind}{wait}"),
        Mechanism::Gateways(kind) => format!("g{kind}{wait}"),
        Mechanism::Secured(kind) => format!("s{kind}{wait}"),
        Mechanism::Letters => format!("let{wait}"),
        Mechanism::Iceoryx => format!("ice{wait}"),
        Mechanism::Socket(_) | Mechanism::Zenoh { .. } => "raw".to_owned(),
        Mechanism::Relay(wire) => format!("r{wire:?}{wait}").to_lowercase(),
    }
}
