//! Conversations as sequence diagrams in SVG.

use fipa_drawing::{Arrow, Page, Section, Sequence, Step};

use super::conversations::Conversation;

/// One page with a sequence diagram of each conversation in order.
pub(super) fn page<'a>(conversations: impl Iterator<Item = &'a Conversation>) -> String {
    let page = Page {
        title: "Conversations".to_owned(),
        text: "Times are since the first letter of the conversation.".to_owned(),
        sections: conversations.map(section).collect(),
    };
    page.svg()
}

fn section(conversation: &Conversation) -> Section {
    let begin = conversation.steps.first().map(|step| step.at);
    let steps = conversation.steps.iter().map(|step| {
        let after = begin.and_then(|begin| step.at.duration_since(begin).ok());
        Step::Arrow(Arrow {
            from: step.from.clone(),
            to: step.to.clone(),
            label: step.label.clone(),
            time: format!("+{:.3} s", after.unwrap_or_default().as_secs_f64()),
            violation: step.violation.clone(),
            failed: step.failed.clone(),
        })
    });
    let sequence = Sequence {
        lanes: Vec::new(),
        steps: steps.collect(),
    };
    let section = Section::new(conversation.title(), sequence);
    match conversation.left_out {
        0 => section,
        more => Section {
            text: format!("{more} more letters were not stored."),
            ..section
        },
    }
}

#[cfg(test)]
mod tests {
    use super::super::sequence::tests::contract_net;
    use super::*;

    #[test]
    fn a_contract_net_becomes_an_svg_document() {
        let conversation = contract_net();
        let drawn = page([&conversation].into_iter());
        for text in [
            ">conversation lift-7 (fipa-contract-net)<",
            ">rover<",
            ">cfp (tcp)<",
            ">+1.250 s<",
            ">violation: inform from arm_1 to rover breaks fipa-contract-net<",
            ">not delivered: no such agent<",
        ] {
            assert!(drawn.contains(text), "{text}: {drawn}");
        }
    }
}
