//! The matrix: who is killed, and when.

use std::time::Duration;

use fastrand::Rng;
use rustix::process::Signal;

use crate::actor::LARGE;
use crate::stage::{Actor, Stage, wait_for};

/// A round. Afterwards only the survivors are there.
pub(crate) type Cell = fn(&mut Stage, &mut Rng);

/// All cells.
pub(crate) const CELLS: [(&str, Cell); 13] = [
    ("receiver before it takes a letter", receiver_before_taking),
    ("receiver holding borrowed content", receiver_holding),
    ("receivers holding content for many", receivers_of_many),
    ("receiver while idle", receiver_idle),
    ("receiver with a full mailbox", receiver_full),
    ("receiver at any moment", receiver_busy),
    ("sender after loaning", sender_loaning),
    ("sender before the acknowledgement", sender_unacknowledged),
    ("sender holding acknowledgements", sender_acknowledged),
    ("sender of content for many", sender_of_many),
    ("gateway at any moment", gateway),
    ("gateway with letters in custody", gateway_with_custody),
    ("all together, with newcomers", all_together),
];

/// A random moment.
fn pause(random: &mut Rng) {
    std::thread::sleep(Duration::from_micros(random.u64(..20_000)));
}

fn wait_for_sending(stage: &Stage, actor: &Actor) {
    wait_for(
        || stage.sent(actor).0 > 0,
        || format!("{} does not send", actor.name),
    );
}

fn receiver_before_taking(stage: &mut Stage, random: &mut Rng) {
    let receiver = stage.enter("take", "nothing", "");
    let sender = stage.enter("take", "stream", &format!("anchor,{}", receiver.name));
    receiver.wait_until("ready");
    sender.wait_until("ready");
    wait_for_sending(stage, &sender);
    receiver.signal(Signal::STOP);
    let before = stage.pulse_sends(&receiver.name, 5, 5000);
    pause(random);
    stage.kill(receiver);
    stage.wait_for_pulse(&before);
    stage.dismiss(sender);
}

fn receiver_holding(stage: &mut Stage, random: &mut Rng) {
    let receiver = stage.enter("hold", "nothing", "");
    receiver.wait_until("ready");
    let sender = stage.enter("take", "stream", &receiver.name);
    let holding = stage.pulse_sends(&receiver.name, 20, 5000);
    wait_for(
        || stage.taken(&receiver) > 4,
        || "nothing is held".to_owned(),
    );
    pause(random);
    stage.kill(receiver);
    stage.wait_for_pulse(&holding);
    sender.wait_until("ready");
    stage.dismiss(sender);
}

fn receivers_of_many(stage: &mut Stage, random: &mut Rng) {
    let receivers = [(); 2].map(|()| stage.enter("hold", "nothing", ""));
    for receiver in &receivers {
        receiver.wait_until("ready");
    }
    let [first, second] = &receivers;
    let all = format!("anchor,{},{}", first.name, second.name);
    let sender = stage.enter("take", "many", &all);
    let many = stage.pulse_sends(&all, 20, LARGE);
    wait_for(
        || stage.taken(first) > 4 && stage.taken(second) > 4,
        || "nothing is held".to_owned(),
    );
    for receiver in receivers {
        pause(random);
        stage.kill(receiver);
    }
    stage.wait_for_pulse(&many);
    sender.wait_until("ready");
    stage.dismiss(sender);
}

fn receiver_idle(stage: &mut Stage, random: &mut Rng) {
    let receivers: Vec<_> = (0..3).map(|_| stage.enter("take", "nothing", "")).collect();
    // One is known, one is there, one may not have begun.
    receivers[0].wait_until("ready");
    receivers[1].wait_until("ready");
    let idle = stage.pulse_sends(&receivers[0].name, 1, 1500);
    stage.wait_for_pulse(&idle);
    pause(random);
    for receiver in receivers {
        stage.kill(receiver);
    }
}

fn receiver_full(stage: &mut Stage, random: &mut Rng) {
    let receiver = stage.enter("deaf", "nothing", "");
    receiver.wait_until("ready");
    // The queue fills, then, while it is stopped, the mailbox.
    let queue = stage.pulse_sends(&receiver.name, 24, 1500);
    stage.wait_for_pulse(&queue);
    receiver.signal(Signal::STOP);
    let mailbox = stage.pulse_sends(&receiver.name, 40, 1500);
    let sender = stage.enter("take", "stream", &receiver.name);
    sender.wait_until("ready");
    wait_for_sending(stage, &sender);
    pause(random);
    stage.kill(receiver);
    stage.wait_for_pulse(&mailbox);
    stage.dismiss(sender);
}

fn receiver_busy(stage: &mut Stage, random: &mut Rng) {
    let receiver = stage.enter("take", "nothing", "");
    receiver.wait_until("ready");
    let sender = stage.enter("take", "stream", &receiver.name);
    let busy = stage.pulse_sends(&receiver.name, 200, 5000);
    pause(random);
    stage.kill(receiver);
    stage.wait_for_pulse(&busy);
    stage.kill(sender);
}

fn sender_loaning(stage: &mut Stage, random: &mut Rng) {
    let receiver = stage.enter("take", "nothing", "");
    receiver.wait_until("ready");
    let sender = stage.enter("take", "loan", &format!("anchor,{}", receiver.name));
    sender.wait_until("loaned");
    pause(random);
    stage.kill(sender);
    stage.dismiss(receiver);
}

fn sender_unacknowledged(stage: &mut Stage, random: &mut Rng) {
    let receiver = stage.enter("take", "nothing", "");
    receiver.wait_until("ready");
    let sender = stage.enter("take", "stream", &receiver.name);
    wait_for_sending(stage, &sender);
    receiver.signal(Signal::STOP);
    pause(random);
    stage.kill(sender);
    receiver.signal(Signal::CONT);
    pause(random);
    stage.dismiss(receiver);
}

fn sender_acknowledged(stage: &mut Stage, random: &mut Rng) {
    let receiver = stage.enter("hold", "nothing", "");
    receiver.wait_until("ready");
    let sender = stage.enter("take", "stream", &format!("anchor,{}", receiver.name));
    wait_for_sending(stage, &sender);
    pause(random);
    sender.signal(Signal::STOP);
    // Long enough for the answers.
    pause(random);
    stage.kill(sender);
    stage.dismiss(receiver);
}

fn sender_of_many(stage: &mut Stage, random: &mut Rng) {
    let receivers = ["take", "hold"].map(|receives| stage.enter(receives, "nothing", ""));
    for receiver in &receivers {
        receiver.wait_until("ready");
    }
    let [first, second] = &receivers;
    let all = format!("anchor,{},{}", first.name, second.name);
    let sender = stage.enter("take", "many", &all);
    wait_for_sending(stage, &sender);
    pause(random);
    stage.kill(sender);
    for receiver in receivers {
        stage.dismiss(receiver);
    }
}

fn gateway(stage: &mut Stage, random: &mut Rng) {
    let gateway = stage.enter("gateway", "nothing", "");
    if random.bool() {
        gateway.wait_until("ready");
    }
    let meanwhile = stage.pulse_sends("anchor", 50, 5000);
    pause(random);
    stage.kill(gateway);
    stage.wait_for_pulse(&meanwhile);
}

fn gateway_with_custody(stage: &mut Stage, random: &mut Rng) {
    let far_gateway = stage.enter_afar("gateway");
    far_gateway.wait_until("ready");
    let receiver = stage.enter_afar("take");
    let at = far_gateway.said_after("at");
    let gateway = stage.enter_knowing(&at);
    // Its end gives these letters their outcomes, whatever became of them.
    stage.pulse_reaches(&receiver.name);
    far_gateway.signal(Signal::STOP);
    let custody = stage.pulse_sends(&receiver.name, 12, 5000);
    pause(random);
    stage.kill(gateway);
    stage.wait_for_pulse(&custody);
    far_gateway.signal(Signal::CONT);
    stage.dismiss(receiver);
    stage.dismiss(far_gateway);
}

fn all_together(stage: &mut Stage, random: &mut Rng) {
    let mut actors = vec![stage.enter("gateway", "nothing", "")];
    let mut names = vec!["anchor".to_owned()];
    for _ in 0..3 {
        let receives = ["take", "hold", "deaf"][random.usize(..3)];
        actors.push(stage.enter(receives, "stream", &names.join(",")));
        names.push(actors[actors.len() - 1].name.clone());
    }
    let to = names[names.len() - 1].clone();
    let all_1 = stage.pulse_sends(&to, 30, 5000);
    let all_2 = stage.pulse_sends("anchor", 30, 1500);
    for _ in 0..8 {
        pause(random);
        match random.u8(..4) {
            // A newcomer, which may be killed before it is there.
            0 => actors.push(stage.enter("take", "stream", &names.join(","))),
            1 => actors[random.usize(..actors.len())].signal(Signal::STOP),
            2 => actors[random.usize(..actors.len())].signal(Signal::CONT),
            _ if actors.len() > 1 => {
                let victim = actors.swap_remove(random.usize(..actors.len()));
                stage.kill(victim);
            }
            _ => {}
        }
    }
    random.shuffle(&mut actors);
    for actor in actors {
        stage.kill(actor);
    }
    stage.wait_for_pulse(&all_1);
    stage.wait_for_pulse(&all_2);
}
