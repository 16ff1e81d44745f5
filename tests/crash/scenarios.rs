//! The scenarios: which process is killed, and in which state.

use std::time::Duration;

use fastrand::Rng;
use rustix::process::Signal;

use crate::cluster::{Cluster, TestProcess, wait_for};
use crate::process::LARGE;

/// A round. At its end, only the survivors run.
pub(crate) type Scenario = fn(&mut Cluster, &mut Rng);

/// All scenarios.
pub(crate) const SCENARIOS: [(&str, Scenario); 13] = [
    ("receiver before it takes a letter", receiver_before_taking),
    ("receiver holding borrowed content", receiver_holding),
    ("receivers holding shared content", receivers_of_many),
    ("receiver while idle", receiver_idle),
    ("receiver with a full mailbox", receiver_full),
    ("receiver at any moment", receiver_busy),
    ("sender after loaning", sender_loaning),
    ("sender before the acknowledgment", sender_unacknowledged),
    ("sender holding acknowledgments", sender_acknowledged),
    ("sender of shared content", sender_of_many),
    ("gateway at any moment", gateway),
    ("gateway with letters in custody", gateway_with_custody),
    ("all roles, with new processes", all_together),
];

/// Sleeps for a random time below 20 ms.
fn pause(random: &mut Rng) {
    std::thread::sleep(Duration::from_micros(random.u64(..20_000)));
}

fn wait_for_sending(cluster: &Cluster, process: &TestProcess) {
    wait_for(
        || cluster.sent(process).0 > 0,
        || format!("timed out waiting for {} to send", process.name),
    );
}

fn receiver_before_taking(cluster: &mut Cluster, random: &mut Rng) {
    let receiver = cluster.start_process("take", "nothing", "");
    let sender = cluster.start_process("take", "stream", &format!("anchor,{}", receiver.name));
    receiver.wait_until("ready");
    sender.wait_until("ready");
    wait_for_sending(cluster, &sender);
    receiver.signal(Signal::STOP);
    let before = cluster.send_from_pulse(&receiver.name, 5, 5000);
    pause(random);
    cluster.kill(receiver);
    cluster.wait_for_pulse(&before);
    cluster.quit_process(sender);
}

fn receiver_holding(cluster: &mut Cluster, random: &mut Rng) {
    let receiver = cluster.start_process("hold", "nothing", "");
    receiver.wait_until("ready");
    let sender = cluster.start_process("take", "stream", &receiver.name);
    let holding = cluster.send_from_pulse(&receiver.name, 20, 5000);
    wait_for(
        || cluster.taken(&receiver) > 4,
        || "timed out waiting for held letters".to_owned(),
    );
    pause(random);
    cluster.kill(receiver);
    cluster.wait_for_pulse(&holding);
    sender.wait_until("ready");
    cluster.quit_process(sender);
}

fn receivers_of_many(cluster: &mut Cluster, random: &mut Rng) {
    let receivers = [(); 2].map(|()| cluster.start_process("hold", "nothing", ""));
    for receiver in &receivers {
        receiver.wait_until("ready");
    }
    let [first, second] = &receivers;
    let all = format!("anchor,{},{}", first.name, second.name);
    let sender = cluster.start_process("take", "many", &all);
    let many = cluster.send_from_pulse(&all, 20, LARGE);
    wait_for(
        || cluster.taken(first) > 4 && cluster.taken(second) > 4,
        || "timed out waiting for held letters".to_owned(),
    );
    for receiver in receivers {
        pause(random);
        cluster.kill(receiver);
    }
    cluster.wait_for_pulse(&many);
    sender.wait_until("ready");
    cluster.quit_process(sender);
}

fn receiver_idle(cluster: &mut Cluster, random: &mut Rng) {
    let receivers: Vec<_> = (0..3)
        .map(|_| cluster.start_process("take", "nothing", ""))
        .collect();
    // The first is a peer of `pulse`, the second runs, and the third may still be starting.
    receivers[0].wait_until("ready");
    receivers[1].wait_until("ready");
    let idle = cluster.send_from_pulse(&receivers[0].name, 1, 1500);
    cluster.wait_for_pulse(&idle);
    pause(random);
    for receiver in receivers {
        cluster.kill(receiver);
    }
}

fn receiver_full(cluster: &mut Cluster, random: &mut Rng) {
    let receiver = cluster.start_process("ignore", "nothing", "");
    receiver.wait_until("ready");
    // First the queue fills, then, while the receiver is stopped, the mailbox.
    let queue = cluster.send_from_pulse(&receiver.name, 24, 1500);
    cluster.wait_for_pulse(&queue);
    receiver.signal(Signal::STOP);
    let mailbox = cluster.send_from_pulse(&receiver.name, 40, 1500);
    let sender = cluster.start_process("take", "stream", &receiver.name);
    sender.wait_until("ready");
    wait_for_sending(cluster, &sender);
    pause(random);
    cluster.kill(receiver);
    cluster.wait_for_pulse(&mailbox);
    cluster.quit_process(sender);
}

fn receiver_busy(cluster: &mut Cluster, random: &mut Rng) {
    let receiver = cluster.start_process("take", "nothing", "");
    receiver.wait_until("ready");
    let sender = cluster.start_process("take", "stream", &receiver.name);
    let busy = cluster.send_from_pulse(&receiver.name, 200, 5000);
    pause(random);
    cluster.kill(receiver);
    cluster.wait_for_pulse(&busy);
    cluster.kill(sender);
}

fn sender_loaning(cluster: &mut Cluster, random: &mut Rng) {
    let receiver = cluster.start_process("take", "nothing", "");
    receiver.wait_until("ready");
    let sender = cluster.start_process("take", "loan", &format!("anchor,{}", receiver.name));
    sender.wait_until("loaned");
    pause(random);
    cluster.kill(sender);
    cluster.quit_process(receiver);
}

fn sender_unacknowledged(cluster: &mut Cluster, random: &mut Rng) {
    let receiver = cluster.start_process("take", "nothing", "");
    receiver.wait_until("ready");
    let sender = cluster.start_process("take", "stream", &receiver.name);
    wait_for_sending(cluster, &sender);
    receiver.signal(Signal::STOP);
    pause(random);
    cluster.kill(sender);
    receiver.signal(Signal::CONT);
    pause(random);
    cluster.quit_process(receiver);
}

fn sender_acknowledged(cluster: &mut Cluster, random: &mut Rng) {
    let receiver = cluster.start_process("hold", "nothing", "");
    receiver.wait_until("ready");
    let sender = cluster.start_process("take", "stream", &format!("anchor,{}", receiver.name));
    wait_for_sending(cluster, &sender);
    pause(random);
    sender.signal(Signal::STOP);
    // Time for the answers to arrive.
    pause(random);
    cluster.kill(sender);
    cluster.quit_process(receiver);
}

fn sender_of_many(cluster: &mut Cluster, random: &mut Rng) {
    let receivers = ["take", "hold"].map(|receives| cluster.start_process(receives, "nothing", ""));
    for receiver in &receivers {
        receiver.wait_until("ready");
    }
    let [first, second] = &receivers;
    let all = format!("anchor,{},{}", first.name, second.name);
    let sender = cluster.start_process("take", "many", &all);
    wait_for_sending(cluster, &sender);
    pause(random);
    cluster.kill(sender);
    for receiver in receivers {
        cluster.quit_process(receiver);
    }
}

fn gateway(cluster: &mut Cluster, random: &mut Rng) {
    let gateway = cluster.start_process("gateway", "nothing", "");
    if random.bool() {
        gateway.wait_until("ready");
    }
    let meanwhile = cluster.send_from_pulse("anchor", 50, 5000);
    pause(random);
    cluster.kill(gateway);
    cluster.wait_for_pulse(&meanwhile);
}

fn gateway_with_custody(cluster: &mut Cluster, random: &mut Rng) {
    let far_gateway = cluster.start_remote("gateway");
    far_gateway.wait_until("ready");
    let receiver = cluster.start_remote("take");
    let at = far_gateway.output_after("at");
    let gateway = cluster.start_gateway_to(&at);
    // The end of the custody concludes these letters, with any outcome.
    cluster.wait_until_reached(&receiver.name);
    far_gateway.signal(Signal::STOP);
    let custody = cluster.send_from_pulse(&receiver.name, 12, 5000);
    pause(random);
    cluster.kill(gateway);
    cluster.wait_for_pulse(&custody);
    far_gateway.signal(Signal::CONT);
    cluster.quit_process(receiver);
    cluster.quit_process(far_gateway);
}

fn all_together(cluster: &mut Cluster, random: &mut Rng) {
    let mut processes = vec![cluster.start_process("gateway", "nothing", "")];
    let mut names = vec!["anchor".to_owned()];
    for _ in 0..3 {
        let receives = ["take", "hold", "ignore"][random.usize(..3)];
        processes.push(cluster.start_process(receives, "stream", &names.join(",")));
        names.push(processes[processes.len() - 1].name.clone());
    }
    let to = names[names.len() - 1].clone();
    let all_1 = cluster.send_from_pulse(&to, 30, 5000);
    let all_2 = cluster.send_from_pulse("anchor", 30, 1500);
    for _ in 0..8 {
        pause(random);
        match random.u8(..4) {
            // A new process, which may be killed while it starts.
            0 => processes.push(cluster.start_process("take", "stream", &names.join(","))),
            1 => processes[random.usize(..processes.len())].signal(Signal::STOP),
            2 => processes[random.usize(..processes.len())].signal(Signal::CONT),
            _ if processes.len() > 1 => {
                let victim = processes.swap_remove(random.usize(..processes.len()));
                cluster.kill(victim);
            }
            _ => {}
        }
    }
    random.shuffle(&mut processes);
    for process in processes {
        cluster.kill(process);
    }
    cluster.wait_for_pulse(&all_1);
    cluster.wait_for_pulse(&all_2);
}
