//! Messages of locks: any message is read or refused, and agents that handle them stay within bounds.
//!
//! * A message that was read is the same after it was written.
//! * The owner has at most one live grant, and admits its fence only.
//! * Fences of an owner rise.

use fipa_acl::{AgentId, Message, Performative};
use fipa_locking::{
    Act, Action, Algorithm, AnyAlgorithm, Content, Event, Fence, LockPeer, Locks, Options,
    OwnerState, Resource, codec,
};

use crate::input::Input;

const NAMES: [&str; 3] = ["arm", "rover", "mallory"];

fn id(name: &str) -> AgentId {
    AgentId::new(name).expect("a name")
}

fn peer(input: &mut Input<'_>) -> LockPeer {
    let name = input.one_of(&NAMES);
    LockPeer::new(name, u64::from(input.byte() % 2)).expect("a name")
}

fn bay() -> Resource {
    Resource::new("bay").expect("a name")
}

/// Returns the content of a message with this performative, sometimes with some of its bytes replaced.
fn content(input: &mut Input<'_>, act: &Performative, kind: Algorithm) -> Vec<u8> {
    let number = u32::from(input.byte());
    let resource = input.one_of(&["bay", "bay", "bay", "dock"]);
    let fence = format!(
        "{}.{number}.{:016x}@{}#{resource}",
        input.byte() % 3,
        input.byte() % 2,
        input.one_of(&["crane", "arm"])
    );
    let text = match (act, input.below(3)) {
        (Performative::Request, 0 | 1) if kind == Algorithm::OwnerQueue => resource.to_owned(),
        (Performative::Request | Performative::Agree, _) if kind == Algorithm::OwnerQueue => {
            format!("{resource}\n{}", number % 10)
        }
        (Performative::Request | Performative::Agree, _) if kind.has_token() => {
            format!("{resource}\n{number}")
        }
        (Performative::Request | Performative::Agree, _) => format!("{number}\n{resource}"),
        (Performative::Propagate, 0) => {
            format!("{resource}\ngeneration {number}\nlast 1 arm\nnext rover")
        }
        (Performative::Propagate, _) => format!(
            "22 serialization::archive 17 0 0 {} {resource} 0 0 1 0 0 0 3 arm {number} 0 0 1 0 5 rover",
            resource.len()
        ),
        (Performative::Inform, 1) => format!("{resource}\n{fence}"),
        (Performative::Inform, 0) => format!("{resource}\n{fence}\n{number}"),
        (Performative::Confirm, 0) => format!("{resource}\n{fence}"),
        (Performative::Refuse, 0) => format!("{resource}\nnot-live"),
        _ => resource.to_owned(),
    };
    let mut content = text.into_bytes();
    if input.below(3) == 0 {
        let at = input.below(content.len() + 1);
        let remove = input.below(8).min(content.len() - at);
        let insert = input.bytes(24);
        drop(content.splice(at..at + remove, insert.iter().copied()));
    }
    content
}

fn message(input: &mut Input<'_>, kind: Algorithm, from: &LockPeer) -> Option<Message> {
    let act = input.one_of(&[
        Performative::Request,
        Performative::Agree,
        Performative::Confirm,
        Performative::Disconfirm,
        Performative::Inform,
        Performative::Refuse,
        Performative::Propagate,
        Performative::QueryIf,
    ]);
    let protocol = match input.below(5) {
        0 => codec::DISCOVER,
        1 => codec::PROBE,
        2 => codec::FENCES,
        _ => kind.protocol(),
    };
    let mut builder = Message::builder(act.clone())
        .sender(id(from.name()))
        .protocol(protocol)
        .conversation_id(format!("{}_{}", from.name(), input.byte() % 8))
        .content(content(input, &act, kind));
    if input.below(4) != 0 {
        builder = builder.ontology(codec::ONTOLOGY);
    }
    if input.below(2) == 0 {
        builder = builder.language(input.one_of(&[codec::TOKEN, codec::BOOST_TOKEN]));
    }
    let asked = input.byte().to_string();
    if input.below(4) != 0 {
        builder = builder.reply_with(asked.clone()).in_reply_to(asked);
    }
    builder.build().ok()
}

/// Runs an owner with the messages and timeouts that the bytes encode.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let kind = input.one_of(&Algorithm::ALL);
    let me = LockPeer::new("crane", 7).expect("a name");
    let mut locks: Locks<AnyAlgorithm> = Locks::new(me, kind, Options::default());
    let (mut now, mut out) = (0, Vec::new());
    let state = OwnerState::first().next_life(Options::default().lease);
    locks.own(now, &bay(), &state, &mut out);
    // No other agent contradicts.
    now = Options::default().claim;
    locks.handle_timeout(now, &mut out);
    let mut last: Option<Fence> = None;
    let mut raised = None;
    while !input.is_empty() {
        match input.below(10) {
            0 => {
                now += u64::from(input.byte()) * 64;
                while let Some(due) = locks.poll_timeout().filter(|due| *due <= now) {
                    locks.handle_timeout(due, &mut out);
                }
            }
            1 => locks.depart(now, &peer(&mut input), &mut out),
            2 => drop(locks.lock(now, &bay(), Some(u64::from(input.byte())), &mut out)),
            _ => {
                let from = peer(&mut input);
                let Some(message) = message(&mut input, kind, &from) else {
                    continue;
                };
                let Ok(read) = codec::decode(&message, kind) else {
                    continue;
                };
                let written = codec::encode(&read, kind, &id(from.name()), &id("crane"));
                let written = written.expect("what was read can be written");
                assert_eq!(codec::decode(&written, kind).as_ref(), Ok(&read));
                locks.handle(now, &from, &read, &mut out);
            }
        }
        for action in out.drain(..) {
            match action {
                Action::Send { to, mut message } => {
                    let written = codec::encode(&message, kind, &id("crane"), &id(to.name()));
                    let written = written.expect("the core sends valid messages");
                    // The Boost archive of a token has no generation.
                    if let Content::Lock {
                        act: Act::Token(token),
                        ..
                    } = &mut message.content
                        && token.archive.is_some()
                    {
                        token.generation = None;
                    }
                    assert_eq!(codec::decode(&written, kind).as_ref(), Ok(&message));
                }
                Action::Event(Event::Granted { grant, .. }) => {
                    if let Some(fence) = grant.fence {
                        let rises = last
                            .as_ref()
                            .is_none_or(|last| last.position() < fence.position());
                        assert!(rises, "{last:?} before {fence}");
                        last = Some(fence);
                    }
                }
                Action::Event(Event::Raised { resource, epoch }) => {
                    assert_eq!(resource, bay());
                    raised = Some(epoch);
                }
                Action::Event(_) => {}
            }
        }
        if let Some(epoch) = raised {
            // The store takes a while.
            if input.below(2) == 0 {
                raised = None;
                locks.stored(now, &bay(), epoch, &mut out);
            }
        }
        let owner = locks
            .owner(&bay())
            .expect("an established owner stays the owner");
        if let Some(last) = &last {
            let live = owner.live(now).and_then(|grant| grant.fence.as_ref());
            assert_eq!(locks.admit(now, &bay(), last), live == Some(last));
        }
        assert!(owner.waiters().count() <= 2 * NAMES.len() + 1);
        assert!(locks.status(now).count() <= 4_096);
    }
}
