//! Blocking calls on behalf of a future.
//!
//! Joining a domain and registering a name wait for other processes by polling file locks, and write
//! files, which takes seconds on a slow disk. They run on [threads] of their own. If the system refuses
//! another thread, the call fails with an error that names the limit.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;

use fipa_sds::{Cancellation, RegisterError};
use fipa_transport::threads::{self, ThreadError};
#[cfg(any(feature = "net", feature = "protocols"))]
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::sync::oneshot;

use crate::error::OpenError;

/// The error if a blocking call has no result.
#[derive(Debug, thiserror::Error)]
pub(crate) enum BackgroundError {
    /// The runtime has been shut down.
    #[error("the runtime has been shut down")]
    Ended,
    /// The system refuses another thread.
    #[error(transparent)]
    Thread(#[from] ThreadError),
    /// The call has panicked.
    #[error("panicked: {}", message(.0))]
    Panicked(Box<dyn Any + Send>),
}

impl From<BackgroundError> for OpenError {
    fn from(error: BackgroundError) -> Self {
        match error {
            BackgroundError::Thread(error) => Self::Thread(error.into()),
            _ => Self::NoRuntime,
        }
    }
}

impl From<BackgroundError> for RegisterError {
    fn from(error: BackgroundError) -> Self {
        match error {
            BackgroundError::Thread(error) => Self::Failed(Arc::new(error)),
            // Without a runtime, the domain has no tasks any more.
            _ => Self::Closed,
        }
    }
}

/// Runs `work` on a thread of its own, within the context of the runtime, and returns its result.
/// Dropping the future cancels the work, and a result that is not returned is dropped on such a thread
/// as well, because dropping an agent or a domain waits for other processes, too. A panic is passed on.
pub(crate) async fn run<T: Send + 'static>(
    runtime: &Handle,
    work: impl FnOnce(&Cancellation) -> T + Send + 'static,
) -> Result<T, BackgroundError> {
    match try_run(runtime, work).await {
        Err(BackgroundError::Panicked(panic)) => resume_unwind(panic),
        other => other,
    }
}

/// Runs `work` like [`run`]. A panic is an error.
pub(crate) async fn try_run<T: Send + 'static>(
    runtime: &Handle,
    work: impl FnOnce(&Cancellation) -> T + Send + 'static,
) -> Result<T, BackgroundError> {
    if has_ended(runtime) {
        return Err(BackgroundError::Ended);
    }
    let cancellation = Cancellation::new();
    let (sender, result) = oneshot::channel();
    let mut pending = Pending {
        result,
        cancellation: cancellation.clone(),
    };
    let inside = runtime.clone();
    threads::spawn(move || {
        let _inside = inside.enter();
        let done = catch_unwind(AssertUnwindSafe(|| work(&cancellation)));
        // A result that has no receiver any more is dropped here.
        drop(sender.send(done));
    })?;
    match (&mut pending.result).await {
        Ok(done) => done.map_err(BackgroundError::Panicked),
        Err(_) => Err(BackgroundError::Ended),
    }
}

/// Runs `work` on a thread of its own, within the context of the runtime, and returns its end. If the system
/// refuses another thread, the work has ended on the calling one, because it must not be left out.
#[cfg(any(feature = "net", feature = "protocols"))]
pub(crate) fn finish<W: FnOnce() + Send + 'static>(
    runtime: &Handle,
    work: W,
) -> impl Future<Output = ()> + Send + use<W> {
    let (sender, ended) = oneshot::channel::<()>();
    let work = Arc::new(Mutex::new(Some(work)));
    let (inside, taken) = (runtime.clone(), Arc::clone(&work));
    let started = threads::spawn(move || {
        let _inside = inside.enter();
        let _ended = sender;
        run_once(&taken);
    });
    if started.is_err() {
        run_once(&work);
    }
    async {
        // The end drops the sender.
        let _ = ended.await;
    }
}

#[cfg(any(feature = "net", feature = "protocols"))]
fn run_once(work: &Mutex<Option<impl FnOnce()>>) {
    let work = work.lock().take();
    if let Some(work) = work {
        work();
    }
}

/// Whether the runtime has been shut down. It then drops a task at once.
fn has_ended(runtime: &Handle) -> bool {
    let task = runtime.spawn(std::future::pending::<()>());
    let ended = task.is_finished();
    task.abort();
    ended
}

/// Returns the message of a panic.
fn message(panic: &Box<dyn Any + Send>) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("no message")
}

/// The result of work that may not have ended.
struct Pending<T: Send + 'static> {
    result: oneshot::Receiver<std::thread::Result<T>>,
    cancellation: Cancellation,
}

impl<T: Send + 'static> Drop for Pending<T> {
    fn drop(&mut self) {
        self.cancellation.cancel();
        self.result.close();
        if let Ok(result) = self.result.try_recv() {
            // Without another thread, it is dropped here.
            let _ = threads::spawn(move || drop(result));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use tokio::runtime::Builder;

    use super::*;

    /// Reports the thread on which it is dropped.
    struct Reporting(mpsc::Sender<std::thread::ThreadId>);

    impl Drop for Reporting {
        fn drop(&mut self) {
            let _ = self.0.send(std::thread::current().id());
        }
    }

    #[test]
    fn a_result_without_a_receiver_is_dropped_on_another_thread() {
        let runtime = Builder::new_current_thread().build().unwrap();
        for is_finished in [false, true] {
            let (dropped, drops) = mpsc::channel();
            let (finish, may_finish) = mpsc::channel::<()>();
            let (done, finished) = mpsc::channel();
            runtime.block_on(async {
                let mut pending = Box::pin(run(runtime.handle(), move |cancellation| {
                    may_finish.recv().unwrap();
                    let result = Reporting(dropped);
                    done.send(cancellation.is_canceled()).unwrap();
                    result
                }));
                let polled = poll_once(&mut pending);
                assert!(polled.is_none());
                if is_finished {
                    finish.send(()).unwrap();
                    assert!(!finished.recv().unwrap());
                }
                drop(pending);
                if !is_finished {
                    finish.send(()).unwrap();
                    assert!(finished.recv().unwrap());
                }
            });
            assert_ne!(drops.recv().unwrap(), std::thread::current().id());
        }
    }

    /// Polls a future once.
    fn poll_once<F: Future + Unpin>(future: &mut F) -> Option<F::Output> {
        let mut context = std::task::Context::from_waker(std::task::Waker::noop());
        match std::pin::Pin::new(future).poll(&mut context) {
            std::task::Poll::Ready(output) => Some(output),
            std::task::Poll::Pending => None,
        }
    }

    #[test]
    fn a_panic_is_passed_on() {
        let runtime = Builder::new_current_thread().build().unwrap();
        let caught = catch_unwind(|| runtime.block_on(run(runtime.handle(), |_| panic!("here"))));
        assert!(caught.is_err());
    }

    #[test]
    fn without_a_runtime_no_work_is_begun() {
        let runtime = Builder::new_current_thread().build().unwrap();
        let handle = runtime.handle().clone();
        drop(runtime);
        let other = Builder::new_current_thread().build().unwrap();
        let ran = other.block_on(run(&handle, |_| ()));
        assert!(matches!(ran, Err(BackgroundError::Ended)));
    }

    #[test]
    fn a_panic_is_an_error_with_its_message() {
        let runtime = Builder::new_current_thread().build().unwrap();
        let ran = runtime.block_on(try_run(runtime.handle(), |_| panic!("here: {}", 7)));
        let error: BackgroundError = ran.map(|(): ()| ()).unwrap_err();
        assert_eq!(error.to_string(), "panicked: here: 7");
    }
}
