//! A contract net among carriers in each language: each language leads once, and in the calls of each leader each
//! carrier is awarded, is rejected and refuses. At last the carrier that is to be awarded is killed.

#![allow(clippy::expect_used, reason = "a failed precondition fails the test")]

use std::thread;

use common::{Language, Process, RunDomain, Workshop};

mod common;

/// The roles of the programs, and their indices.
const ROLES: [&str; 2] = ["bid", "call"];
const BID: usize = 0;
const CALL: usize = 1;
/// The positions of the carriers. Those at opposite corners are out of reach of each other.
const CORNERS: [(f64, f64); 4] = [(3.0, 3.0), (-3.0, 3.0), (-3.0, -3.0), (3.0, -3.0)];
/// Distance up to which a carrier makes a proposal.
const REACH: f64 = 6.0;

/// Starts a carrier per language in a domain of its own, and has the leader call for proposals.
fn run(workshop: &Workshop, languages: &[Language], leading: usize) {
    let domain = RunDomain::new();
    let start = |(language, (x, y)): (&Language, &(f64, f64))| {
        let name = format!("carrier_{}", language.extension);
        let mut command = domain.command(workshop, &language.programs[BID]);
        let carrier = Process::start(&name, command.args([&name, &x.to_string(), &y.to_string()]));
        carrier.prints("ready");
        carrier
    };
    let mut carriers: Vec<Process> = languages.iter().zip(&CORNERS).map(start).collect();
    let leader = &languages[leading];
    let mut command = domain.command(workshop, &leader.programs[CALL]);
    let name = format!("the operator in {}", leader.name);
    let mut operator = Process::start(&name, command.arg("operator"));
    operator.prints("ready");
    let all: Vec<usize> = (0..carriers.len()).collect();

    for nearest in &all {
        let proposals = called(&mut operator, &carriers, &all, *nearest);
        operator.reads("go on");
        awarded(&operator, &carriers, &proposals);
    }

    // Each language is killed once, by the calls of another leader.
    let killed = (leading + 1) % carriers.len();
    let proposals = called(&mut operator, &carriers, &all, killed);
    carriers[killed].guard.kill();
    operator.reads("go on");
    operator.prints(&format!("{}: NotDelivered", carriers[killed].name));
    for rejected in &proposals[1..] {
        carriers[*rejected].prints("rejected");
    }
    // The same crate is carried by the next one.
    let others: Vec<usize> = all.into_iter().filter(|one| *one != killed).collect();
    let proposals = called(&mut operator, &carriers, &others, killed);
    operator.reads("go on");
    awarded(&operator, &carriers, &proposals);

    operator.ends();
}

/// Calls for a crate near a corner, waits for the answers, and returns the carriers that make proposals, the nearest
/// one first.
fn called(
    operator: &mut Process,
    carriers: &[Process],
    present: &[usize],
    nearest: usize,
) -> Vec<usize> {
    let (x, y) = CORNERS[nearest];
    // Its distances from all corners differ.
    let crate_at = (x - x.signum(), y - 2.0 * y.signum());
    let distance = |at: &usize| {
        let (x, y) = CORNERS[*at];
        f64::hypot(x - crate_at.0, y - crate_at.1)
    };
    operator.reads(&format!("{} {}", crate_at.0, crate_at.1));
    let (mut near, far): (Vec<usize>, Vec<usize>) =
        present.iter().partition(|at| distance(at) <= REACH);
    near.sort_by(|one, other| distance(one).total_cmp(&distance(other)));
    for at in &near {
        operator.prints(&format!("{} at {:.1}", carriers[*at].name, distance(at)));
    }
    operator.prints(&format!("{} refused", far.len()));
    for at in far {
        carriers[at].prints("refused");
    }
    near
}

/// Waits for the result of the nearest carrier, and until the others know their rejection.
fn awarded(operator: &Process, carriers: &[Process], proposals: &[usize]) {
    let (nearest, others) = proposals.split_first().expect("a proposal");
    let name = &carriers[*nearest].name;
    carriers[*nearest].prints("accepted");
    operator.prints(&format!("{name}: carried by {name}"));
    for rejected in others {
        carriers[*rejected].prints("rejected");
    }
}

#[test]
fn each_language_leads_a_contract_net_among_carriers_in_all() {
    let workshop = Workshop::new();
    let languages = workshop.languages("the contract net", &ROLES);
    if languages.len() < CORNERS.len() {
        // A corner is empty, which `languages` has reported.
        return;
    }
    thread::scope(|scope| {
        for leading in 0..languages.len() {
            let (workshop, languages) = (&workshop, &languages);
            scope.spawn(move || run(workshop, languages, leading));
        }
    });
}
