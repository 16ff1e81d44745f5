//! Recordings of letters.
//!
//! * Any file is a recording, or is refused, in pieces of any length with the same result.
//! * The entries of a recording are the same after they are written and read again.
//! * The letters can be judged.

use std::sync::{Arc, LazyLock};
use std::time::{Duration, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_monitor::recording::{Reader, Recorded, RecordingError, append, begin};
use fipa_monitor::{Header, Library, Monitor};

/// Parsing the standard protocols takes longer than anything else here.
static PROTOCOLS: LazyLock<Arc<Library>> = LazyLock::new(|| Arc::new(Library::standard()));

fn read(file: &[u8], piece: usize) -> (Vec<Recorded>, Result<bool, RecordingError>) {
    let (mut reader, mut all) = (Reader::new(), Vec::new());
    for piece in file.chunks(piece) {
        reader.push(piece);
        loop {
            match reader.next_entry() {
                Ok(Some(one)) => all.push(one),
                Ok(None) => break,
                Err(error) => return (all, Err(error)),
            }
        }
    }
    (all, Ok(reader.is_complete()))
}

/// Reads the bytes as a recording, and judges its letters.
pub fn play(bytes: &[u8]) {
    let (all, result) = read(bytes, bytes.len().max(1));
    let in_pieces = read(bytes, 3);
    assert_eq!(in_pieces, (all.clone(), result));
    let mut file = Vec::new();
    begin(&mut file);
    // A message in another encoding may be longer in this one.
    let kept = all.into_iter().filter(|one| append(one, &mut file).is_ok());
    let kept: Vec<Recorded> = kept.collect();
    let (again, complete) = read(&file, 64);
    assert_eq!((&again, complete), (&kept, Ok(true)));
    let mut monitor = Monitor::observer(Arc::clone(&PROTOCOLS));
    for one in &kept {
        if let Some(message) = &one.message {
            let header = Header::from(message).copy_for(one.receiver.as_str());
            let _ = monitor.check(&header, one.at);
            monitor.handle_timeout(one.at);
        }
    }
}

/// Returns recordings of a conversation, whole and in part.
#[must_use]
pub fn seeds() -> Vec<Vec<u8>> {
    let id = |name| AgentId::new(name).expect("a name");
    let mut file = Vec::new();
    begin(&mut file);
    let acts = [
        (Performative::Request, "ann", "ben"),
        (Performative::Agree, "ben", "ann"),
        (Performative::Inform, "ben", "ann"),
    ];
    for (number, (act, from, to)) in (1..).zip(acts) {
        let message = Message::builder(act)
            .sender(id(from))
            .receiver(id(to))
            .protocol("fipa-request")
            .conversation_id("c")
            .build();
        let recorded = Recorded {
            at: SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000 + number),
            answer_within: None,
            receiver: to.to_owned(),
            undelivered: false,
            from_service: false,
            may_continue: number == 2,
            after_loss: number == 3,
            message: message.ok(),
        };
        append(&recorded, &mut file).expect("a short entry");
    }
    let half = file.get(..file.len() / 2).unwrap_or_default().to_vec();
    vec![file, half]
}
