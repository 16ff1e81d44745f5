//! Any text is a protocol, or is refused with existing line numbers. A protocol can be run with any
//! messages.

#![no_main]

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::Performative;
use fipa_monitor::{Header, Library, Machine, Monitor};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    let machine = match Machine::read("own", text) {
        Ok(machine) => machine,
        Err(error) => {
            let lines = text.matches('\n').count() + 1;
            assert!(!error.mistakes.is_empty());
            let mut places = error.mistakes.iter().map(|mistake| mistake.line);
            return assert!(places.all(|line| (1..=lines).contains(&line)));
        }
    };
    let name = machine.name().to_owned();
    assert!(!machine.initial().id().is_empty());
    let mut library = Library::standard();
    let _ = library.add(machine);
    let library = Arc::new(library);
    run(Monitor::observer(Arc::clone(&library)), &name);
    run(Monitor::agent(library, "ann"), &name);
});

fn run(mut monitor: Monitor, name: &str) {
    let mut now = SystemTime::UNIX_EPOCH + Duration::from_secs(1_700_000_000);
    for round in 0..6_usize {
        for (number, act) in Performative::STANDARD.iter().enumerate() {
            let agents = ["ann", "ben", "cid"];
            let header = Header::new(act.clone())
                .sender(agents[(number + round) % 3])
                .receivers([agents[(number + round + 1 + number % 2) % 3]])
                .reply_to(["dan", "cid"].into_iter().skip(round % 3))
                .protocol(name)
                .conversation_id("c");
            monitor.check(&header, now);
            now += Duration::from_secs(1);
            monitor.handle_timeout(now);
        }
    }
}
