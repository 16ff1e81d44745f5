//! Blocking calls on behalf of a future.
//!
//! Joining a domain and registering a name wait for other processes by polling file locks, and write
//! files, which takes seconds on a slow disk. They run on the runtime's threads for blocking calls.

use fipa_sds::Cancellation;
use tokio::runtime::Handle;
use tokio::sync::oneshot;

/// Runs `work` on a thread for blocking calls, and returns its result; `None` if the runtime shuts
/// down. Dropping the future cancels the work, and a result that is not returned is dropped on such
/// a thread as well, because dropping an agent or a domain waits for other processes, too.
pub(crate) async fn run<T: Send + 'static>(
    runtime: &Handle,
    work: impl FnOnce(&Cancellation) -> T + Send + 'static,
) -> Option<T> {
    let cancellation = Cancellation::new();
    let (sender, result) = oneshot::channel();
    let mut pending = Pending {
        result,
        cancellation: cancellation.clone(),
        runtime: runtime.clone(),
    };
    let thread = runtime.spawn_blocking(move || {
        // A result that has no receiver any more is dropped here.
        drop(sender.send(work(&cancellation)));
    });
    if let Ok(result) = (&mut pending.result).await {
        return Some(result);
    }
    match thread.await {
        Err(error) if error.is_panic() => std::panic::resume_unwind(error.into_panic()),
        _ => None,
    }
}

/// The result of work that may not have ended.
struct Pending<T: Send + 'static> {
    result: oneshot::Receiver<T>,
    cancellation: Cancellation,
    runtime: Handle,
}

impl<T: Send + 'static> Drop for Pending<T> {
    fn drop(&mut self) {
        self.cancellation.cancel();
        self.result.close();
        if let Ok(result) = self.result.try_recv() {
            drop(self.runtime.spawn_blocking(move || drop(result)));
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
        let caught = std::panic::catch_unwind(|| {
            runtime.block_on(run(runtime.handle(), |_| panic!("here")))
        });
        assert!(caught.is_err());
    }
}
