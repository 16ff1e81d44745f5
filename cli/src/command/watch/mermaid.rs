//! Conversations as a Mermaid sequence diagram.

use std::collections::HashMap;
use std::fmt::Write as _;

use super::conversations::Conversation;
use crate::output::mermaid;

/// One diagram with all conversations in order.
pub(super) fn diagram<'a>(conversations: impl Iterator<Item = &'a Conversation>) -> String {
    let conversations: Vec<&Conversation> = conversations.collect();
    let mut text = String::from("sequenceDiagram\n");
    let mut aliases: HashMap<&str, String> = HashMap::new();
    for name in conversations.iter().flat_map(|it| it.participants()) {
        if !aliases.contains_key(name) {
            // A name can contain any text, also with a meaning in Mermaid.
            let alias = format!("p{}", aliases.len() + 1);
            let _ = writeln!(text, "    participant {alias} as {}", mermaid(name));
            aliases.insert(name, alias);
        }
    }
    let alias = |name: &str| aliases.get(name).map_or("", String::as_str);
    for conversation in conversations {
        let participants = conversation.participants();
        let (Some(first), Some(last)) = (participants.first(), participants.last()) else {
            continue;
        };
        let title = mermaid(&conversation.title());
        let over = match participants.len() {
            1 => alias(first).to_owned(),
            _ => format!("{},{}", alias(first), alias(last)),
        };
        let _ = writeln!(text, "    Note over {over}: {title}");
        for step in &conversation.steps {
            let (from, to) = (alias(&step.from), alias(&step.to));
            let label = mermaid(&step.label);
            let _ = match &step.failed {
                None => writeln!(text, "    {from}->>{to}: {label}"),
                Some(why) => writeln!(text, "    {from}-x{to}: {label}: {}", mermaid(why)),
            };
            if let Some(violation) = &step.violation {
                let _ = writeln!(
                    text,
                    "    Note over {from}: violation: {}",
                    mermaid(violation)
                );
            }
        }
        if conversation.left_out > 0 {
            let (over, more) = (alias(first), conversation.left_out);
            let _ = writeln!(text, "    Note over {over}: {more} more letters");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::sequence::tests::contract_net;
    use super::*;

    #[test]
    fn a_contract_net_becomes_a_mermaid_diagram() {
        let conversation = contract_net();
        assert_eq!(
            diagram([&conversation].into_iter()),
            "\
sequenceDiagram
    participant p1 as rover
    participant p2 as arm_1
    participant p3 as arm_2
    Note over p1,p3: conversation lift-7 (fipa-contract-net)
    p1->>p2: cfp
    p1->>p3: cfp (tcp)
    p3->>p1: propose (tcp)
    p2->>p1: inform
    Note over p2: violation: inform from arm_1 to rover breaks fipa-contract-net
    p1-xp2: reject-proposal: no such agent
"
        );
    }
}
