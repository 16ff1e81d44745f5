//! Access rules. Any rules are accepted or refused. Only the rules that match a letter decide about
//! it.

use std::time::{Duration, Instant};

use fipa::fuzzing::Access;

use crate::input::Input;

/// Reads rules and letters from the bytes, and checks each decision.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let rate = input.below(4);
    let deny = lines(&mut input);
    let allow = lines(&mut input);
    let Some(mut access) = Access::new(&deny, &allow, rate) else {
        return;
    };
    let denies = Access::new(&deny, &[], 0);
    let allows = Access::new(&allow, &[], 0);
    let mut now = Instant::now();
    let mut sent = 0_u32;
    let began = now;
    while !input.is_empty() {
        let (sender, receiver) = (name(&mut input), name(&mut input));
        let performative = input.one_of(&["inform", "request", "cfp", ""]);
        let protocol = input.one_of(&[None, Some("fipa-request"), Some("")]);
        let passes = access.passes(sender, receiver, performative, protocol);
        // The allow rules are tried as deny rules, which shows the letters that they match.
        let named = |rules: &Option<Access>| {
            let rules = rules.as_ref();
            rules.is_some_and(|it| !it.passes(sender, receiver, performative, protocol))
        };
        let expected =
            !named(&denies) && (allow.iter().all(|it| it.1.is_empty()) || named(&allows));
        assert_eq!(passes, expected, "{sender:?} to {receiver:?}");
        sent += u32::from(access.may_send(1, "rover", now));
        // Names from another source must not change the rate limit of this one.
        access.may_send(2, sender, now);
        if rate > 0 {
            let seconds = now.duration_since(began).as_secs_f64();
            let most = rate as f64 * (seconds + 1.0) + 1.0;
            assert!(f64::from(sent) <= most, "{sent} letters in {seconds} s");
        }
        now += Duration::from_millis(u64::from(input.byte()));
    }
}

fn name<'a>(input: &mut Input<'a>) -> &'a str {
    match input.below(4) {
        0 => std::str::from_utf8(input.bytes(30)).unwrap_or_default(),
        _ => input.one_of(&["rover", "arm", "rover_1", "rover_.*", "x", "ARM"]),
    }
}

fn lines<'a>(input: &mut Input<'a>) -> Vec<(&'a str, Vec<&'a str>)> {
    let count = input.below(4);
    (0..count)
        .map(|_| {
            let sender = name(input);
            let receivers = (0..input.below(3)).map(|_| match input.below(3) {
                0 => std::str::from_utf8(input.bytes(60)).unwrap_or_default(),
                1 => name(input),
                _ => input.one_of(&[
                    "arm performative=inform,cfp",
                    "arm protocol=fipa-request",
                    ".* performative=request protocol=x",
                    "arm performative=",
                ]),
            });
            (sender, receivers.collect())
        })
        .collect()
}
