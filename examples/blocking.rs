//! The calls without an async runtime: agents in threads.
//!
//! ```console
//! $ cargo run --example blocking
//! ```

#![allow(clippy::print_stdout, reason = "an example prints")]

use std::thread;
use std::time::Duration;

use fipa::Performative::{Inform, QueryRef};
use fipa::blocking::Wait;
use fipa::{Agent, Domain};

fn main() -> fipa::Result<()> {
    let domain = Domain::from_environment().wait()?;
    let battery = domain.register("battery").wait()?;
    let answering = thread::spawn({
        let battery = battery.clone();
        move || answer_all(&battery)
    });

    let rover = domain.register("rover").wait()?;
    for _ in 0..3 {
        let question = rover
            .message(QueryRef)
            .receiver("battery")
            .reply_with(rover.unique_id())
            .content("charge");
        rover.send(question).wait()?;
        if let Some(answer) = rover.receive_within(Duration::from_secs(60)).wait()? {
            let charge: f64 = answer.message().parse()?;
            println!("{charge:.1} %");
        }
    }

    // The end of the registration ends the thread, too.
    battery.deregister()?;
    if let Ok(answered) = answering.join() {
        answered?;
    }
    domain.close().wait();
    Ok(())
}

fn answer_all(battery: &Agent) -> fipa::Result<()> {
    let mut charge = 80.0;
    while let Ok(letter) = battery.receive().wait() {
        let answer = battery.reply(letter.message(), Inform);
        battery.send(answer.content(charge.to_string())).wait()?;
        charge -= 0.5;
    }
    Ok(())
}
