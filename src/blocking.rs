//! Calls for threads without an async runtime.
//!
//! [`Wait`] adds `wait()` to every future. A program without an async runtime calls the functions of this crate and
//! waits for what they return:
//!
//! ```no_run
//! use fipa::{Domain, Performative::Request, blocking::Wait};
//!
//! fn main() -> fipa::Result<()> {
//!     let domain = Domain::from_environment().wait()?;
//!     let rover = domain.register("rover").wait()?;
//!     let lift = rover.message(Request).receiver("arm_1").content("(lift crate)");
//!     println!("{}", rover.send(lift).wait()?);
//!     println!("{}", rover.receive().wait()?.message());
//!     domain.close().wait();
//!     Ok(())
//! }
//! ```
//!
//! One background thread of the process receives and acknowledges letters while the application does other
//! work. The first wait starts it. It sleeps when it has nothing to do.
//!
//! [`on_thread`] makes a handler of [`Agent::serve`](crate::Agent::serve) or [`Agent::offer`](crate::Agent::offer)
//! from a function that blocks.

use std::fmt::Display;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Wake, Waker};
use std::thread::{self, Thread};
use std::time::Duration;

use arc_swap::{ArcSwapOption, Guard};
use fipa_transport::threads;
use tokio::runtime::{Builder, Handle, Runtime};

use crate::domain::background;
use crate::domain::process::Owner;

/// The runtime of the background thread. It is never dropped.
static BACKGROUND: ArcSwapOption<Background> = ArcSwapOption::const_empty();

#[derive(Debug)]
struct Background {
    runtime: Runtime,
    owner: Owner,
}

/// Waits for a future on the calling thread.
///
/// A wait works on every thread. On a thread of a tokio runtime, for example in a function that asynchronous code
/// calls, it blocks that thread, and other tasks on it continue after the wait.
pub trait Wait: IntoFuture + Sized {
    /// Waits for the output.
    ///
    /// # Panics
    /// If the system refuses the background thread. Only the first wait of a process can fail so; [`start`] returns
    /// that as an error.
    fn wait(self) -> Self::Output {
        match background() {
            Ok(runtime) => block_on(&runtime, self.into_future()),
            Err(error) => panic!("cannot start the background thread of fipa: {error}"),
        }
    }

    /// Waits for the output for at most `timeout`. Returns `None` if it is not there by then, and drops the future,
    /// which cancels it.
    ///
    /// ```no_run
    /// # fn example(agent: &fipa::Agent) -> fipa::Result<()> {
    /// use std::time::Duration;
    /// use fipa::blocking::Wait;
    ///
    /// match agent.receive().wait_within(Duration::from_secs(5)) {
    ///     Some(letter) => println!("{}", letter?.message()),
    ///     None => println!("no letter within 5 s"),
    /// }
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Panics
    /// As for [`wait`](Self::wait).
    fn wait_within(self, timeout: Duration) -> Option<Self::Output> {
        async move { tokio::time::timeout(timeout, self).await.ok() }.wait()
    }
}

impl<F: IntoFuture> Wait for F {}

/// Starts the background thread, if it does not run yet. A program calls this before its first wait if it handles the
/// error, or if it gives up the right to start threads.
///
/// # Errors
/// If the system refuses the thread, with the limit that is reached.
pub fn start() -> std::io::Result<()> {
    background().map(drop)
}

/// Runs `work` on a thread of its own and returns its result. A handler of [`Agent::serve`](crate::Agent::serve) or
/// [`Agent::offer`](crate::Agent::offer) that blocks runs so, and does not delay the others.
///
/// ```no_run
/// # fn example(agent: fipa::Agent) -> fipa::Result<()> {
/// use fipa::blocking::{Wait, on_thread};
/// use fipa::protocol::{DialogueError, Reply, Task};
///
/// let mut server = agent.serve("fipa-request", |mut task: Task| {
///     on_thread(move || {
///         task.agree("").wait()?;
///         Ok::<_, DialogueError>(Reply::Inform("done".into()))
///     })
/// })?;
/// server.ended().wait();
/// # Ok(())
/// # }
/// ```
///
/// # Errors
/// The text of the error that `work` returns, of its panic, or of the thread that the system refuses.
pub async fn on_thread<T, E>(
    work: impl FnOnce() -> Result<T, E> + Send + 'static,
) -> Result<T, String>
where
    T: Send + 'static,
    E: Display + Send + 'static,
{
    match background::try_run(&Handle::current(), move |_| work()).await {
        Ok(done) => done.map_err(|error| error.to_string()),
        Err(error) => Err(error.to_string()),
    }
}

/// Returns the runtime of the background thread, which it starts if this process has none. A forked child does not
/// have the thread of its parent.
fn background() -> std::io::Result<Handle> {
    loop {
        let current = BACKGROUND.load();
        if let Some(background) = &*current
            && background.owner.is_this()
        {
            return Ok(background.runtime.handle().clone());
        }
        let started = Arc::new(Background::start()?);
        let previous = BACKGROUND.compare_and_swap(&current, Some(Arc::clone(&started)));
        if previous.as_ref().map(Arc::as_ptr) == current.as_ref().map(Arc::as_ptr) {
            // In a forked child, the runtime of the parent would wait for the end of its thread forever.
            std::mem::forget(Guard::into_inner(previous));
        } else if let Some(unused) = Arc::into_inner(started) {
            // Another thread was faster. A thread of another runtime must not wait for the end of this one.
            unused.runtime.shutdown_background();
        }
    }
}

impl Background {
    fn start() -> std::io::Result<Self> {
        // The start of a runtime panics if the system refuses its thread.
        threads::check(1)?;
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("fipa")
            .enable_all()
            .build()?;
        Ok(Self {
            runtime,
            owner: Owner::this(),
        })
    }
}

/// Waits for a future, also on a thread of another runtime.
fn block_on<F: Future>(runtime: &Handle, future: F) -> F::Output {
    if Handle::try_current().is_err() {
        return runtime.block_on(future);
    }
    // tokio refuses to block such a thread. The background thread serves timers and sockets, so this
    // one needs only to be parked. Without the budget of a task, which only a return would renew.
    let mut future = pin!(tokio::task::unconstrained(future));
    let waker = Waker::from(Arc::new(Unpark(thread::current())));
    let mut context = Context::from_waker(&waker);
    loop {
        let polled = {
            let _runtime = runtime.enter();
            future.as_mut().poll(&mut context)
        };
        match polled {
            Poll::Ready(output) => return output,
            Poll::Pending => thread::park(),
        }
    }
}

struct Unpark(Thread);

impl Wake for Unpark {
    fn wake(self: Arc<Self>) {
        self.0.unpark();
    }
}
