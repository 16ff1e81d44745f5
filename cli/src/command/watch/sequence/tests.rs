use std::time::{Duration, SystemTime};

use unicode_width::UnicodeWidthStr;

use super::*;

fn step(ms: u64, from: &str, to: &str, label: &str) -> Step {
    Step {
        at: SystemTime::UNIX_EPOCH + Duration::from_millis(1_700_000_000_000 + ms),
        from: from.to_owned(),
        to: to.to_owned(),
        label: label.to_owned(),
        failed: None,
        violation: None,
    }
}

/// A contract net with a protocol violation and a failed delivery.
pub(in super::super) fn contract_net() -> Conversation {
    let steps = vec![
        step(0, "rover", "arm_1", "cfp"),
        step(1, "rover", "arm_2", "cfp (tcp)"),
        step(12, "arm_2", "rover", "propose (tcp)"),
        Step {
            violation: Some("inform from arm_1 to rover breaks fipa-contract-net".into()),
            ..step(1250, "arm_1", "rover", "inform")
        },
        Step {
            failed: Some("no such agent".into()),
            ..step(1251, "rover", "arm_1", "reject-proposal")
        },
    ];
    Conversation::of("lift-7", "fipa-contract-net", steps)
}

#[test]
fn a_contract_net_is_drawn() {
    let look = Look {
        width: Some(60),
        color: false,
    };
    let expected = "\
conversation lift-7 (fipa-contract-net)
         rover            arm_1            arm_2
+0.000   │ cfp            │                │
         ├───────────────►│                │
+0.001   │ cfp (tcp)      │                │
         ├────────────────┼───────────────►│
+0.012   │ propose (tcp)  │                │
         │◄───────────────┼────────────────┤
+1.250   │ inform         │                │
         │◄───────────────┤                │
    ✗ inform from arm_1 to rover breaks fipa-contract-net
+1.251   │ reject-proposal: no such agent  │
         ├───────────────✗│                │
         │                │                │
";
    assert_eq!(draw(&contract_net(), look), expected);
}

#[test]
fn a_diagram_fits_any_width_with_any_names() {
    let mut steps = Vec::new();
    for other in 0..30 {
        let name = format!("机器人_with_a_very_long_name_{other}");
        steps.push(step(other, "rover", &name, "cfp"));
        steps.push(step(other, &name, "rover", "propose"));
        steps.push(step(other, &name, &name, "inform"));
    }
    let conversation = Conversation::of("c", &"p".repeat(200), steps);
    for width in [1, 40, 61, 80, 133, 400] {
        let look = Look {
            width: Some(width),
            color: false,
        };
        for line in draw(&conversation, look).lines() {
            assert!(line.width() <= width.max(MIN_WIDTH), "{width}: {line}");
        }
    }
}

#[test]
fn labels_name_the_participants_of_a_shared_lifeline() {
    let steps: Vec<Step> = (0..9)
        .map(|other| step(other, "rover", &format!("arm_{other}"), "cfp"))
        .collect();
    let conversation = Conversation::of("c", "fipa-contract-net", steps);
    let look = Look {
        width: Some(60),
        color: false,
    };
    let text = draw(&conversation, look);
    assert!(text.contains("7 others"), "{text}");
    assert!(text.contains("cfp → arm_8"), "{text}");
}

#[test]
fn only_violations_and_failures_are_colored() {
    let look = Look {
        width: Some(60),
        color: true,
    };
    let text = draw(&contract_net(), look);
    let painted = text.lines().filter(|line| line.contains('\u{1b}')).count();
    assert_eq!(painted, 5, "{text}");
}
