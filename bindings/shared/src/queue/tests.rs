//! Tests of the queue, with and without its descriptor.

use std::sync::Barrier;
use std::thread;

use futures_util::stream::iter;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use tokio::sync::{mpsc, oneshot};

use super::*;

const NOW: Option<Duration> = Some(Duration::ZERO);

/// Whether the descriptor becomes readable within `seconds`.
fn is_readable(queue: &Queue<u32>, seconds: i64) -> bool {
    let descriptor = queue.descriptor().unwrap();
    let mut polled = [PollFd::from_borrowed_fd(descriptor, PollFlags::IN)];
    let within = Timespec {
        tv_sec: seconds,
        tv_nsec: 0,
    };
    poll(&mut polled, Some(&within)).unwrap() == 1
}

fn item(tag: u64, event: u32) -> Option<Item<u32>> {
    Some(Item { tag, event })
}

#[test]
fn operations_end_with_their_tags_and_streams_take_turns() {
    let queue = Queue::new();
    assert_eq!(queue.next(NOW), None);
    queue.follow(1, iter(0..100));
    queue.begin(2, async { 7 });
    let first: Vec<_> = (0..4).map(|_| queue.next(None).unwrap().tag).collect();
    assert!(
        first.contains(&2),
        "a stream holds up the others: {first:?}"
    );
    let rest: Vec<_> = (0..97).map(|_| queue.next(None).unwrap().event).collect();
    assert_eq!(rest.last(), Some(&99));
    assert!(rest.is_sorted());
    assert_eq!(queue.next(NOW), None);
}

#[test]
fn an_abandoned_operation_takes_nothing_and_is_dropped() {
    let queue = Queue::new();
    let (sender, mut receiver) = mpsc::unbounded_channel();
    let taken = Arc::new(Mutex::new(0));
    let count = Arc::clone(&taken);
    let operation = queue.begin(1, async move {
        let event = receiver.recv().await.unwrap();
        *count.lock() += 1;
        event
    });
    assert_eq!(queue.next(NOW), None);
    sender.send(5).unwrap();
    operation.abandon();
    assert!(sender.is_closed(), "dropped without another call");
    assert_eq!(queue.next(NOW), None);
    assert_eq!(*taken.lock(), 0);
    assert!(queue.shared.running.lock().is_empty());
}

#[test]
fn the_descriptor_is_readable_until_the_queue_has_answered_empty() {
    let queue = Queue::new();
    assert!(
        is_readable(&queue, 0),
        "items may be ready when it is asked for"
    );
    assert_eq!(queue.next(NOW), None);
    assert!(!is_readable(&queue, 0));

    queue.follow(1, iter([1, 2]));
    assert!(is_readable(&queue, 0), "an operation has begun");
    assert_eq!(queue.next(NOW), item(1, 1));
    assert!(is_readable(&queue, 0), "another item is there");
    assert_eq!(queue.next(NOW), item(1, 2));
    assert_eq!(queue.next(NOW), None);
    assert!(!is_readable(&queue, 0));

    let (sender, receiver) = oneshot::channel();
    queue.begin(2, async { receiver.await.unwrap() });
    assert_eq!(queue.next(NOW), None);
    assert!(!is_readable(&queue, 0));
    sender.send(9).unwrap();
    assert!(is_readable(&queue, 0));
    assert_eq!(queue.next(NOW), item(2, 9));
}

#[test]
fn the_descriptor_stays_right_if_the_program_also_waits() {
    let queue = Queue::new();
    assert!(is_readable(&queue, 0));
    assert_eq!(queue.next(NOW), None);
    let (sender, mut receiver) = mpsc::unbounded_channel();
    let events = futures_util::stream::poll_fn(move |context| receiver.poll_recv(context));
    queue.follow(1, events);
    assert_eq!(queue.next(Some(Duration::from_millis(1))), None);
    assert_eq!(queue.next(NOW), None);
    sender.send(1).unwrap();
    sender.send(2).unwrap();
    assert_eq!(queue.next(None), item(1, 1));
    assert!(is_readable(&queue, 0), "the second item is there");
    assert_eq!(queue.next(NOW), item(1, 2));
    assert_eq!(queue.next(NOW), None);
    sender.send(3).unwrap();
    assert!(is_readable(&queue, 0));
}

#[test]
fn an_operation_that_begins_wakes_the_thread_that_waits() {
    let queue = Queue::new();
    let waiting = queue.clone();
    let thread = thread::spawn(move || waiting.next(None));
    queue.begin(3, async { 4 });
    assert_eq!(thread.join().unwrap(), item(3, 4));
}

/// Two threads write, two take items by the descriptor, and one waits. Each item arrives once, and a descriptor that
/// stays silent with an item left would end the test by its time limit.
#[test]
fn no_wake_up_is_lost_between_threads() {
    const EACH: u32 = 20_000;
    let queue = Queue::new();
    let barrier = Arc::new(Barrier::new(2));
    let mut threads = Vec::new();
    for tag in 0..2 {
        let (sender, mut receiver) = mpsc::unbounded_channel();
        queue.follow(
            tag,
            futures_util::stream::poll_fn(move |context| receiver.poll_recv(context)),
        );
        let barrier = Arc::clone(&barrier);
        threads.push(thread::spawn(move || {
            barrier.wait();
            for number in 0..EACH {
                sender.send(number).unwrap();
                if number % 7 == 0 {
                    thread::yield_now();
                }
            }
        }));
    }
    let mut expected = [0, 0];
    for _ in 0..2 * EACH {
        let item = loop {
            assert!(
                is_readable(&queue, 60),
                "the descriptor is silent: {expected:?}"
            );
            if let Some(item) = queue.next(NOW) {
                break item;
            }
        };
        let next = &mut expected[usize::try_from(item.tag).unwrap()];
        assert_eq!(item.event, *next);
        *next += 1;
    }
    for thread in threads {
        thread.join().unwrap();
    }
    assert_eq!(expected, [EACH, EACH]);
    assert_eq!(queue.next(NOW), None);
}
