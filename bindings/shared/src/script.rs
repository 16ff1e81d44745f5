//! Operations that emit several events.

use futures_core::Stream;
use futures_util::stream::poll_fn;
use tokio::sync::mpsc;

use crate::failure::Failure;

/// Sends the events of an operation. At most two wait, so an operation does not run ahead of its program.
#[derive(Debug)]
pub struct Emitter<E>(mpsc::Sender<Result<E, Failure>>);

impl<E> Emitter<E> {
    /// Sends an event, and waits until there is room for it.
    pub async fn emit(&self, event: E) {
        // Fails only if the operation was abandoned, which drops this future, too.
        let _ = self.0.send(Ok(event)).await;
    }
}

/// Returns the events that a function emits. An error is the last one.
pub fn script<E, F, R>(run: R) -> impl Stream<Item = Result<E, Failure>> + Send + use<E, F, R>
where
    E: Send + 'static,
    R: FnOnce(Emitter<E>) -> F,
    F: Future<Output = Result<(), Failure>> + Send + 'static,
{
    let (sender, mut events) = mpsc::channel(1);
    let running = run(Emitter(sender.clone()));
    let mut running = Some(Box::pin(async move {
        if let Err(failure) = running.await {
            // As in `emit`.
            let _ = sender.send(Err(failure)).await;
        }
    }));
    poll_fn(move |context| {
        if let Some(script) = &mut running
            && script.as_mut().poll(context).is_ready()
        {
            // Its emitter, too, so that the stream ends after the last event.
            running = None;
        }
        events.poll_recv(context)
    })
}
