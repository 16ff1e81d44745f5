//! A gateway of another host that speaks the transport's protocol and nothing else: a test writes its
//! letters.

#![allow(dead_code, reason = "no test uses all items")]
#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::{AgentId, Gateway, Kind, Letter, Message, MessageBuilder};
use fipa_mts::letter_for;
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Incarnation, LegacySource, Location, Parcel,
    Reaction, Sink, Stream, Transport as _,
};
use fipa_transport_net::{Identity, TcpConfig, TcpTransport};
use parking_lot::Mutex;

/// The messages that the stranger gets.
#[derive(Default)]
struct Inbox(Mutex<Vec<Message>>);

impl Sink for Inbox {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        if let Body::Letter(letter) = arrival.parcel.body {
            let message = Message::decode(letter.payload()).unwrap();
            self.0.lock().push(message);
        }
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {}

    fn concluded(&self, _: AttemptId, _: Conclusion) {}
}

pub(crate) struct Stranger {
    name: String,
    incarnation: Incarnation,
    transport: TcpTransport,
    inbox: Arc<Inbox>,
    gateway: (String, Incarnation),
    at: Location,
    sent: u64,
}

impl Stranger {
    /// Creates a gateway of this name on another host, which sends letters to `gateway` over TCP.
    pub(crate) fn new(name: &str, gateway: &Gateway) -> Self {
        let incarnation = Incarnation::random();
        let identity = Identity {
            name: name.to_owned(),
            incarnation,
            domain: "elsewhere".to_owned(),
            host: "elsewhere".to_owned(),
        };
        let tcp = TcpConfig::new(Vec::new(), identity);
        let transport = TcpTransport::new(tcp, tokio::runtime::Handle::current());
        let inbox = Arc::new(Inbox::default());
        transport.listen(inbox.clone()).unwrap();
        let mut locations = gateway.locations().into_iter();
        let at = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
        Self {
            name: name.to_owned(),
            incarnation,
            transport,
            inbox,
            gateway: (gateway.name().to_owned(), gateway.incarnation()),
            at: at.with_incarnation(gateway.incarnation()),
            sent: 0,
        }
    }

    /// Sends a message to the gateway.
    pub(crate) fn send(&mut self, message: MessageBuilder) {
        let (gateway, to) = &self.gateway;
        let message = message
            .sender(AgentId::new(&*self.name).unwrap())
            .receiver(AgentId::new(&**gateway).unwrap())
            .build()
            .unwrap();
        self.sent += 1;
        let parcel = Parcel {
            receiver: gateway.as_str().into(),
            stream: Stream::between(self.incarnation, *to),
            sequence: self.sent,
            after: 0,
            remaining: Duration::from_secs(30),
            transfer: self.sent,
            body: Body::Letter(letter_for(&message, SystemTime::now()).unwrap()),
        };
        self.transport
            .post(AttemptId(self.sent), &self.at, parcel)
            .unwrap();
    }

    /// Returns the reply to the message with this `reply-with`.
    pub(crate) fn reply_to(&self, question: &str) -> Option<Message> {
        let messages = self.inbox.0.lock();
        let mut replies = messages.iter();
        replies
            .find(|it| it.in_reply_to() == Some(question))
            .cloned()
    }
}

impl Drop for Stranger {
    fn drop(&mut self) {
        self.transport.close();
    }
}
