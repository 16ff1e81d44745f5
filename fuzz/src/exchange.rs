//! Letters of the directory exchange from malicious neighbors and an honest one.
//!
//! * A neighbor adds only entries of its own agents, within the limits.
//! * A malicious neighbor neither changes nor blocks the entries of the honest one.
//! * DF entries belong to agents that their gateway lists, and are within their bounds.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_sds::{Directory, Entry, Exchange, MtsId, OwnDfEntry, Present, Reach, Role, Source};
use fipa_transport::{Incarnation, Location};

use crate::input::Input;

const OWN: Incarnation = Incarnation::from_u64(1);
const HONEST: Incarnation = Incarnation::from_u64(2);
const LIARS: [Incarnation; 3] = [
    Incarnation::from_u64(3),
    Incarnation::from_u64(4),
    Incarnation::from_u64(u64::MAX),
];

fn location(of: Incarnation) -> Location {
    let text = format!("tcp://192.0.2.{}:7788", of.as_u64() % 250);
    let location: Location = text.parse().expect("a location");
    location.with_incarnation(of)
}

fn agent(name: &str, incarnation: u64, gateway: Incarnation) -> Arc<Entry> {
    Arc::new(Entry {
        name: name.into(),
        agent_type: "robot".into(),
        incarnation: Incarnation::from_u64(incarnation),
        locations: vec![location(gateway)],
        mts: MtsId::new("mts", gateway),
        description: String::new(),
        registered: SystemTime::UNIX_EPOCH,
        source: Source::Host,
        reach: Reach::Local,
        peer: fipa_transport::PeerId::THIS_HOST,
        role: Role::Agent,
    })
}

/// Returns the DF entry of an agent, whose text is its name.
fn df(agent: &Entry) -> OwnDfEntry {
    OwnDfEntry {
        name: Arc::clone(&agent.name),
        incarnation: agent.incarnation,
        text: Arc::clone(&agent.name),
        addresses: vec!["http://10.0.0.1:7778/acc".to_owned()],
        lease: None,
    }
}

/// Decodes the bytes into letters and events of neighbors, and runs a gateway with them.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let mut now = Instant::now();
    let mut here = Exchange::new(7);
    let mut there = Exchange::new(8);
    // Malicious neighbors claim the rover, and the earlier registration keeps a name. None of them
    // claims the lander.
    let rover = agent("rover", 100, HONEST);
    let lander = agent("lander", 102, HONEST);
    let arm = agent("arm", 101, OWN);
    here.handle_own(now, [&arm]);
    there.handle_own(now, [&rover, &lander]);
    here.handle_own_df(now, vec![df(&arm)]);
    there.handle_own_df(now, vec![df(&rover), df(&lander)]);
    let gateways = |with: &[Incarnation]| -> Vec<Present> {
        let all = with
            .iter()
            .map(|one| Present::unproved(MtsId::new("mts", *one), vec![location(*one)]));
        all.collect()
    };
    let mut present = vec![HONEST, LIARS[0], LIARS[1], LIARS[2]];
    here.handle_neighbors(now, &gateways(&present));
    there.handle_neighbors(now, &gateways(&[OWN]));
    let mut last: BTreeMap<Incarnation, Vec<u8>> = BTreeMap::new();
    while !input.is_empty() {
        let liar = input.one_of(&LIARS);
        match input.byte() % 10 {
            0..=4 => {
                let content = letter(&mut input, &last, liar);
                drop(here.handle_letter(now, liar, &content));
            }
            5 => {
                // The neighbor appears or disappears.
                match present.iter().position(|it| *it == liar) {
                    Some(at) => drop(present.remove(at)),
                    None => present.push(liar),
                }
                here.handle_neighbors(now, &gateways(&present));
            }
            6 => {
                // Another gateway has the location of the neighbor.
                here.handle_silence(now, &location(liar));
            }
            _ => now += input.time().min(Duration::from_secs(60)),
        }
        exchange((&mut here, &mut there), now, input.byte(), &mut last);
        here.handle_timeout(now);
        there.handle_timeout(now);
        check(&here);
    }
    // Soon after, each honest gateway has the agents of the other one in its directory.
    for _ in 0..400 {
        now += Duration::from_millis(500);
        exchange((&mut here, &mut there), now, 0, &mut last);
    }
    for (gateway, name) in [(&here, "lander"), (&there, "arm")] {
        let known = gateway.directory().entries();
        let honest = known
            .iter()
            .any(|it| &*it.name == name && it.mts.incarnation.as_u64() < 3);
        assert!(honest, "{name} is missing from the directory");
        let df = gateway.directory().df_entries();
        let honest = df
            .iter()
            .any(|it| &*it.text == name && it.name == it.text && it.gateway.as_u64() < 3);
        assert!(honest, "the DF entry of {name} is missing");
    }
}

/// Delivers the due letters of both honest gateways. `how` decides if letters to malicious
/// neighbors succeed.
fn exchange(
    (here, there): (&mut Exchange, &mut Exchange),
    now: Instant,
    how: u8,
    last: &mut BTreeMap<Incarnation, Vec<u8>>,
) {
    for _ in 0..64 {
        let Some((to, content)) = here.poll_letter(now) else {
            break;
        };
        assert!(content.len() <= Exchange::MAX_CONTENT);
        if to == HONEST {
            drop(there.handle_letter(now, OWN, &content));
            here.handle_sent(now, to, true);
        } else {
            last.insert(to, content);
            here.handle_sent(now, to, how & 1 == 0);
        }
    }
    for _ in 0..64 {
        let Some((to, content)) = there.poll_letter(now) else {
            break;
        };
        drop(here.handle_letter(now, HONEST, &content));
        there.handle_sent(now, to, true);
    }
}

/// Returns a letter of a malicious neighbor: nearly valid JSON, the last letter to that neighbor,
/// or any bytes.
fn letter(
    input: &mut Input<'_>,
    last: &BTreeMap<Incarnation, Vec<u8>>,
    liar: Incarnation,
) -> Vec<u8> {
    match input.below(8) {
        0 => input.long_bytes().to_vec(),
        1 => last.get(&liar).cloned().unwrap_or_default(),
        2 => br#"{"version":1,"tell":"again"}"#.to_vec(),
        3 => br#"{"version":1,"tell":"goodbye"}"#.to_vec(),
        kind => {
            let agents: Vec<serde_json::Value> = (0..input.below(4)).map(|_| told(input)).collect();
            let (from, to) = (input.number(), input.number());
            let tell = match kind {
                4 | 5 => serde_json::json!({ "full": {
                    "version": from, "first": input.byte() & 1 == 0, "last": input.byte() & 1 == 0,
                    "agents": agents } }),
                _ => {
                    let left = input.one_of(&[vec![], vec!["rover"], vec!["a", "a"]]);
                    serde_json::json!({ "changes": {
                        "from": from, "to": to, "agents": agents, "left": left } })
                }
            };
            serde_json::json!({ "version": 1, "tell": tell })
                .to_string()
                .into()
        }
    }
}

fn told(input: &mut Input<'_>) -> serde_json::Value {
    let name = match input.below(3) {
        0 => String::from_utf8_lossy(input.bytes(20)).into_owned(),
        _ => input
            .one_of(&["rover", "arm", "a", "b", "arm_.*", ""])
            .to_owned(),
    };
    let id = Incarnation::from_u64(input.number()).to_string();
    let mut agent = serde_json::json!({ "name": name, "id": id, "registered": input.number() });
    if input.byte() & 1 == 0 {
        let long = input.one_of(&[0, Exchange::MAX_DF_ENTRY, Exchange::MAX_DF_ENTRY + 1]);
        let text = String::from_utf8_lossy(input.bytes(20)).into_owned() + &"x".repeat(long);
        agent["df"] = serde_json::json!({ "entry": text });
        if input.byte() & 1 == 0 {
            agent["df"]["lease"] = input.number().into();
        }
    }
    if input.byte() & 3 == 0 {
        let members = input.one_of(&[vec!["a", "b"], vec![], vec!["a", "a"], vec!["rover"]]);
        agent["coalition"] = serde_json::json!({ "members": members, "leader": "a" });
    }
    agent
}

/// Checks that every entry belongs to the gateway that sent it and is within the limits.
fn check(here: &Exchange) {
    let directory = here.directory();
    let all = directory.df_entries();
    assert!(all.len() <= Exchange::MAX_TOTAL_DF_ENTRIES / 2);
    for df in &all {
        assert!(df.text.len() <= Exchange::MAX_DF_ENTRY);
        assert!(df.gateway != OWN);
        let holder = directory.known(&df.name);
        let holder = holder.expect("an agent with a DF entry is listed");
        assert!(holder.mts.incarnation != df.gateway || holder.incarnation == df.incarnation);
    }
    let known = here.directory().entries();
    assert!(known.len() <= Exchange::MAX_TOTAL);
    for entry in known.iter() {
        entry
            .check()
            .expect("an accepted entry is within the limits");
        let gateway = entry.mts.incarnation;
        assert!(gateway != OWN, "{} is listed at this gateway", entry.name);
        assert_eq!(entry.source, Source::Exchange);
        let all = entry.locations.iter();
        let own = all.map(Location::incarnation).all(|it| it == gateway);
        assert!(own, "{} has a location of another gateway", entry.name);
    }
}
