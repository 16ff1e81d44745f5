//! Conversations of two threads without a runtime.

use std::sync::Arc;
use std::thread;

use fipa::blocking::{Wait, on_thread};

use super::*;

#[test]
fn a_request_is_answered_and_another_canceled_by_threads() {
    let config = config(&["monitor.check=enforce"]);
    let open = || Domain::open(&config).wait().unwrap();
    let (here, there) = (open(), open());
    let rover = here.register("rover").wait().unwrap();
    let arm = there.register("arm").wait().unwrap();
    let answering = thread::spawn(move || {
        let first = arm.receive().wait().unwrap();
        let mut task = arm.take_part(&first).unwrap();
        task.agree("").wait().unwrap();
        assert_eq!(text(task.message()), "a crate");
        task.reply(Reply::Inform("lifted".into())).wait().unwrap();
        let second = arm.receive().wait().unwrap();
        let mut task = arm.take_part(&second).unwrap();
        task.agree("").wait().unwrap();
        let mut waits = 1;
        // A wait that ends without an output loses nothing.
        while task.cancelled().wait_within(TIMEOUT / 1000).is_none() {
            waits += 1;
        }
        let nothing = task.confirm_cancel().wait().unwrap();
        task.reply(nothing).wait().unwrap();
        waits
    });
    let lift = rover.message(Performative::Request).content("a crate");
    let lift = lift.receiver(AgentId::new("arm").unwrap());
    let mut request = rover.request(lift.clone(), TIMEOUT).wait().unwrap();
    assert!(request.agreed().wait().unwrap());
    assert_eq!(text(&request.result().wait().unwrap()), "lifted");
    let mut request = rover.request(lift, TIMEOUT).wait().unwrap();
    assert!(request.agreed().wait().unwrap());
    assert!(request.cancel(TIMEOUT).wait().unwrap());
    assert!(answering.join().unwrap() > 0);
}

#[test]
fn a_handler_that_blocks_does_not_delay_the_others() {
    let config = config(&[]);
    let domain = Domain::open(&config).wait().unwrap();
    let arm = domain.register("arm").wait().unwrap();
    // The handler of each request waits for the handler of the other.
    let both = Arc::new(std::sync::Barrier::new(2));
    let _server = arm
        .serve("fipa-request", move |mut task: Task| {
            let both = Arc::clone(&both);
            on_thread(move || {
                task.agree("").wait()?;
                both.wait();
                Ok::<_, DialogueError>(Reply::Inform("done".into()))
            })
        })
        .unwrap();
    let rover = domain.register("rover").wait().unwrap();
    let requests = [(); 2].map(|()| {
        let lift = rover.message(Performative::Request);
        let lift = lift.receiver(arm.id().clone());
        rover.request(lift, TIMEOUT).wait().unwrap()
    });
    for mut request in requests {
        assert_eq!(text(&request.result().wait().unwrap()), "done");
    }
}
