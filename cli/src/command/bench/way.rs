//! The ways that are measured, and what each of them is compared with.

use fipa::Kind;

use super::part::{End, Event, Fill, Letters, Order, Part, Socket, Wait};
use super::stage::{Stage, Who};

/// What letters go through.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sort {
    /// Two agents on one host.
    Agents(Kind),
    /// Two agents on two hosts, and a gateway on each.
    Gateways(Kind),
    /// The same between gateways that have proved to each other who they are: TCP with TLS, or QUIC.
    Secured(Kind),
    /// Letters that are encoded already, through the shared memory transport alone.
    Letters,
    /// Bare iceoryx2.
    Iceoryx,
    /// A bare socket.
    Socket(Socket),
    /// Publications of zenoh, in shared memory of its own or through TCP alone.
    Zenoh { shared_memory: bool },
    /// Bare iceoryx2, then bare TCP, then bare iceoryx2.
    Relay,
}

impl Sort {
    /// What this is compared with: the least that moving the bytes so can cost.
    pub(super) fn limit(self) -> Option<Self> {
        match self {
            Self::Agents(Kind::Shm) | Self::Letters => Some(Self::Iceoryx),
            Self::Agents(_) => Some(Self::Socket(Socket::Unix)),
            Self::Gateways(_) | Self::Secured(_) => Some(Self::Relay),
            Self::Zenoh {
                shared_memory: true,
            } => Some(Self::Iceoryx),
            Self::Zenoh { .. } => Some(Self::Socket(Socket::Tcp)),
            Self::Iceoryx | Self::Socket(_) | Self::Relay => None,
        }
    }

    /// What this is the safer way of: what encryption costs is told by both in the same rounds.
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
            Self::Relay => "raw relay".to_owned(),
        }
    }

    /// Whether there is memory to loan, which makes a difference between filling it and not.
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

    /// What may be too large is tried before.
    fn is_ours(self) -> bool {
        matches!(self, Self::Agents(_) | Self::Gateways(_) | Self::Secured(_))
    }

    /// How many letters are under way when throughput is measured.
    pub(super) fn window(fill: Fill) -> usize {
        match fill {
            Fill::Copied => 16,
            // As many loans as a process may have.
            _ => 8,
        }
    }
}

/// One way, ready to be used.
#[derive(Debug)]
pub(super) struct Way {
    pub(super) sort: Sort,
    pub(super) wait: Wait,
    sender: Who,
    receiver: Who,
    between: Vec<Who>,
}

/// One turn of a way.
#[derive(Debug)]
pub(super) struct Turn {
    /// When each letter was begun, was there, and was known to be there.
    pub(super) began: Vec<u64>,
    pub(super) arrived: Vec<u64>,
    pub(super) ended: Vec<u64>,
    /// Of all processes together.
    pub(super) cpu_ns: u64,
}

impl Way {
    /// Starts the processes of a way.
    pub(super) async fn open(stage: &mut Stage, sort: Sort, wait: Wait) -> Result<Self, String> {
        let ends = [End::Sender, End::Receiver];
        let own = |part: &str| format!("{}{part}", short(sort, wait));
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
        let (sender, receiver, address) = match sort {
            Sort::Agents(kind) => {
                let settings = settings(kind.name());
                let (from, to) = agents(["a", "b"].map(str::to_owned));
                let (receiver, name) = stage.start(&to, &own(""), &settings).await?;
                let (sender, _) = stage.start(&from, &own(""), &settings).await?;
                (sender, receiver, Some(name))
            }
            Sort::Gateways(kind) | Sort::Secured(kind) => {
                let mut settings = settings(&format!("shm,{kind}"));
                let hosts = ["1", "2"].map(own);
                let mut keys = Vec::new();
                if let Sort::Secured(_) = sort {
                    // Without a key quic is refused; which one it is matters to gateways only.
                    keys = stage.keys(&hosts)?;
                    settings.extend(keys.first().cloned());
                    settings.push("security.loopback=true".to_owned());
                    // As between processes of one host, which are not held back either.
                    settings.push("security.peer_letters=0".to_owned());
                    settings.push("security.peer_bytes=0".to_owned());
                }
                for (number, domain) in hosts.into_iter().enumerate() {
                    let mut settings = settings.clone();
                    settings.push(format!("mts.name={}", Stage::domain(&domain)));
                    settings.extend(keys.get(number).cloned());
                    let (who, _) = stage.start(&Part::Gateway, &domain, &settings).await?;
                    between.push(who);
                }
                // Other measurements on this machine can be heard of.
                let (from, to) = agents(["-a", "-b"].map(|end| Stage::domain(&own(end))));
                let (receiver, name) = stage.start(&to, &own("2"), &settings).await?;
                let (sender, _) = stage.start(&from, &own("1"), &settings).await?;
                (sender, receiver, Some(name))
            }
            Sort::Letters => {
                let settings = settings("shm");
                let [from, to] = ends.map(|end| Part::Letters { end });
                let (receiver, address) = stage.start(&to, &own(""), &settings).await?;
                let (sender, _) = stage.start(&from, &own(""), &settings).await?;
                (sender, receiver, Some(address))
            }
            Sort::Iceoryx => {
                let settings = settings("shm");
                let [from, to] = ends.map(|end| Part::Iceoryx { end, wait });
                let (receiver, _) = stage.start(&to, &own(""), &settings).await?;
                let (sender, _) = stage.start(&from, &own(""), &settings).await?;
                (sender, receiver, None)
            }
            Sort::Socket(kind) => {
                let [from, to] = ends.map(|end| Part::Socket { end, kind });
                let (receiver, address) = stage.start(&to, "raw", &[]).await?;
                let (sender, _) = stage.start(&from, "raw", &[]).await?;
                (sender, receiver, Some(address))
            }
            Sort::Zenoh { shared_memory } => {
                let (receiver, address) = stage.start_zenoh(End::Receiver, shared_memory).await?;
                let (sender, _) = stage.start_zenoh(End::Sender, shared_memory).await?;
                (sender, receiver, Some(address))
            }
            Sort::Relay => {
                let settings = settings("shm");
                let [from, to] = ends.map(|end| Part::Iceoryx { end, wait });
                let [near, far] = ends.map(|end| Part::Relay { end });
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
            sort,
            wait,
            sender,
            receiver,
            between,
        })
    }

    /// Whether letters of this size go this way; if not, why.
    pub(super) async fn takes(&self, stage: &mut Stage, size: usize) -> Result<(), String> {
        if !self.sort.is_ours() {
            return Ok(());
        }
        // An agent's queue takes the letter whether it is being received or not.
        let one = Letters {
            count: 1,
            size,
            fill: Fill::Copied,
            window: 1,
        };
        stage.tell(self.sender, &Order::Send(one)).await?;
        stage.event(self.sender).await?;
        stage.tell(self.receiver, &Order::Receive(one)).await?;
        stage.event(self.receiver).await?;
        stage.event(self.receiver).await?;
        Ok(())
    }

    /// Sends letters this way.
    pub(super) async fn turn(&self, stage: &mut Stage, letters: Letters) -> Result<Turn, String> {
        let before = self.cpu(stage).await?;
        stage.tell(self.receiver, &Order::Receive(letters)).await?;
        let Event::Receiving = stage.event(self.receiver).await? else {
            return Err("the receiver has another order".to_owned());
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
            return Err("the two ends have run another order".to_owned());
        };
        let all = [began.len(), ended.len(), arrived.len()];
        if all != [letters.count; 3] {
            return Err(format!("expected {} letters, not {all:?}", letters.count));
        }
        Ok(Turn {
            began,
            arrived,
            ended,
            cpu_ns: sending + receiving + between,
        })
    }

    /// What the processes in between have used so far.
    async fn cpu(&self, stage: &mut Stage) -> Result<u64, String> {
        let mut all = 0;
        for who in &self.between {
            stage.tell(*who, &Order::Cpu).await?;
            match stage.event(*who).await? {
                Event::Cpu { ns } => all += ns,
                other => return Err(format!("expected a time, not {other:?}")),
            }
        }
        Ok(all)
    }
}

async fn find(stage: &mut Stage, who: Who, to: String) -> Result<(), String> {
    stage.tell(who, &Order::Find { to }).await?;
    match stage.event(who).await? {
        Event::Found => Ok(()),
        other => Err(format!("expected an end, not {other:?}")),
    }
}

/// A few letters that tell ways apart, for names of domains.
fn short(sort: Sort, wait: Wait) -> String {
    let wait = match wait {
        Wait::Spin => 's',
        Wait::Block => 'b',
    };
    match sort {
        Sort::Agents(kind) => format!("{kind}{wait}"),
        Sort::Gateways(kind) => format!("g{kind}{wait}"),
        Sort::Secured(kind) => format!("s{kind}{wait}"),
        Sort::Letters => format!("let{wait}"),
        Sort::Iceoryx => format!("ice{wait}"),
        Sort::Socket(_) | Sort::Zenoh { .. } => "raw".to_owned(),
        Sort::Relay => format!("rel{wait}"),
    }
}
