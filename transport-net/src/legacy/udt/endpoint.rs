//! The core as the protocol of an [endpoint](crate::datagrams::endpoint), and the task that translates
//! its letters without a lock.

use std::collections::HashSet;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Instant;

use fipa_transport::{Kind, LegacySource, Sink, TransportError, log_limit, quota_address};

use super::core::{Core, CoreEvent};
use crate::datagrams::endpoint::Endpoint;
use crate::datagrams::{Fragments, Protocol, WithProtocol};
use crate::legacy::letter;

impl Protocol for Core {
    const KIND: Kind = Kind::Udt;
    // The size of packets is agreed on before the MTU of the path is known.
    const FRAGMENTS: Fragments = Fragments::Allowed;

    /// Does nothing: a handshake contains no addresses of this side.
    fn listens_on(&mut self, _listening: Vec<String>) {}

    fn lost(&mut self, lost: &HashSet<IpAddr>, local: impl Fn(u32) -> Option<IpAddr>) {
        self.lost(Instant::now(), lost, local);
    }

    fn cannot_begin(&mut self, number: u32, error: TransportError) {
        self.cannot_begin(Instant::now(), number, error);
    }

    /// Does nothing: the packet counts as lost, and the system fragments the next one.
    fn too_big(&mut self, _number: u32, _size: usize) {}

    fn close(&mut self) {
        self.close(Instant::now());
    }

    fn deliver(event: CoreEvent, sink: &dyn Sink, with: &WithProtocol<'_, Self>) {
        match event {
            CoreEvent::Concluded(attempt, conclusion) => sink.concluded(attempt, conclusion),
            CoreEvent::TooLarge(beginning, from) => {
                // Without its envelope, no sender can be told.
                if let Ok((letter, signature)) = letter::standard(&beginning) {
                    let source = LegacySource {
                        address: from.ip().to_canonical(),
                        signature,
                    };
                    let reason = "the letter is too large for UDT (max_letter)";
                    sink.refused_unframed(letter, Kind::Udt, source, reason);
                }
            }
            // The reservation of the memory ends when the sink has the letter.
            CoreEvent::Arrived(arrived, from) => match letter::standard(&arrived.bytes) {
                Ok((letter, signature)) => {
                    let source = LegacySource {
                        address: from.ip().to_canonical(),
                        signature,
                    };
                    sink.arrived_unframed(letter, Kind::Udt, source);
                }
                Err(error) => with(&mut |core| {
                    core.count_nonsense();
                    log_limit::warn!(
                        of: quota_address(from.ip()),
                        "{from}: letter over UDT refused: {error}"
                    );
                }),
            },
        }
    }
}

/// The task that translates letters. If it is dropped before it is done, as when a translation panics,
/// the letters that still wait are concluded, and the next letter starts another task.
pub(super) struct Translator {
    endpoint: Arc<Endpoint<Core>>,
    /// Maximum length of a translated letter.
    max: usize,
    /// Whether no letter was left.
    done: bool,
}

impl Translator {
    pub(super) fn new(endpoint: Arc<Endpoint<Core>>, max: usize) -> Self {
        Self {
            endpoint,
            max,
            done: false,
        }
    }

    /// Translates all letters that wait.
    pub(super) async fn run(mut self) {
        let begin = |core: &mut Core, _: Instant| core.begin_translation();
        let mut next = self.endpoint.call(begin).flatten();
        while let Some(translation) = next.take() {
            let translated = translation.run(self.max);
            let handled = self.endpoint.post(&translation.to, |core, now| {
                let fresh = core.handle_translated(now, translated);
                next = core.begin_translation();
                Ok(fresh)
            });
            if handled.is_err() {
                // The endpoint has been closed, which has concluded the letter.
                break;
            }
            if next.is_some() {
                // Other tasks of the runtime take their turns.
                tokio::task::yield_now().await;
            }
        }
        self.done = true;
    }
}

impl Drop for Translator {
    fn drop(&mut self) {
        if !self.done {
            self.endpoint.call(|core, _| core.end_translations());
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use fipa_acl::Letter;
    use fipa_testbed::until;
    use fipa_transport::{
        Arrival, AttemptId, Conclusion, Incarnation, Location, Reaction, TransportErrorKind,
    };
    use parking_lot::Mutex;

    use super::*;
    use crate::UdtLimits;

    #[derive(Default)]
    struct ConclusionSink(Mutex<Vec<(AttemptId, Conclusion)>>);

    impl Sink for ConclusionSink {
        fn arrived(&self, _: Arrival) -> Reaction {
            Reaction::Later
        }

        fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {}

        fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
            self.0.lock().push((attempt, conclusion));
        }
    }

    #[test]
    fn a_translator_that_is_dropped_concludes_the_letters_that_wait() {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let handle = runtime.handle().clone();
        let endpoint = Endpoint::new(Vec::new(), Incarnation::from_u64(1), handle);
        let sink = Arc::new(ConclusionSink::default());
        endpoint
            .open(sink.clone(), |_, now| {
                let access = Box::new(|_| true);
                Core::new(UdtLimits::default(), access, Box::new(|| 7), now)
            })
            .unwrap();
        let to = Location::new(Kind::Udt, "127.0.0.1:9").unwrap();
        let post = |attempt: u64| {
            let letter = Letter::new(Bytes::from_static(b"x"), Bytes::new());
            let attempt = AttemptId(attempt);
            let starts =
                endpoint.queue(|core| core.post(attempt, &to, "arm".into(), letter.clone()));
            starts.unwrap()
        };
        assert!(post(1));
        assert!(!post(2));
        // As far as a translation that panics.
        let begun = endpoint.call(|core, _| core.begin_translation());
        assert!(begun.flatten().is_some());
        drop(Translator::new(Arc::clone(&endpoint), 100));
        until("the conclusions", || sink.0.lock().len() == 2);
        for (_, conclusion) in sink.0.lock().iter() {
            assert!(
                matches!(conclusion, Conclusion::NotSent(error) if error.fault == TransportErrorKind::Closed),
                "{conclusion:?}"
            );
        }
        assert!(post(3), "another task is needed");
        endpoint.close();
        until("the last conclusion", || sink.0.lock().len() == 3);
    }
}
