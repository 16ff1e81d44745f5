//! Running actions on the page, and their cancel.

use fipa::Domain;
use fipa::actions::{Action, Execution, Offer, Progress};
use serde_json::json;
use tokio::runtime::Runtime;

use super::*;
use crate::common::Running;

/// A robot that drives until it is to stop.
pub(crate) struct Robot {
    _offer: Offer,
    _agent: fipa::Agent,
    _domain: Domain,
    _runtime: Runtime,
}

impl Robot {
    /// Starts a robot with these operators.
    pub(crate) fn start(host: &Host, name: &str, operators: &[&str]) -> Self {
        let mut config = config_of(host);
        config.access.operators = operators.iter().map(|&it| it.to_owned()).collect();
        let runtime = Runtime::new().unwrap();
        let domain = runtime.block_on(Domain::open(&config)).unwrap();
        let agent = runtime.block_on(domain.register(name)).unwrap();
        let offer = agent.offer(Action::new("drive"), |(): (), run: Execution| async move {
            run.progress(Progress::fraction(0.25).note("<b>on the way</b>"));
            let cause = run.stopped().await;
            Err::<(), _>(format!("{cause:?}"))
        });
        Self {
            _offer: offer.unwrap(),
            _agent: agent,
            _domain: domain,
            _runtime: runtime,
        }
    }
}

/// Lets a robot drive for the agent `rover`. Returns when the robot has accepted.
pub(crate) fn drive(host: &Host, robot: &str) -> Running {
    let agent = format!("rover-of-{robot}");
    let driving = host.start(&[
        "do", robot, "drive", "--json", "--agent", &agent, "--id", "g-1",
    ]);
    assert!(driving.ready.contains("accepted"), "{}", driving.ready);
    driving
}

/// The row of the goal of a robot.
fn goal(shown: &Shown, robot: &str) -> Value {
    let (_, _, body) = shown.ask("GET", "/api/locks", &shown.bearer(), "");
    let view: Value = serde_json::from_str(&body).unwrap();
    let key = json!([robot, format!("rover-of-{robot}"), "g-1"]).to_string();
    view["goals"][key].clone()
}

fn order(robot: &str) -> String {
    format!(r#"{{"robot": "{robot}", "goal": "g-1", "client": "rover-of-{robot}"}}"#)
}

#[test]
fn a_running_action_is_seen_and_cancelled_from_the_page() {
    let host = Host::new();
    let shown = Shown::start(
        &host,
        "127.0.0.1:0",
        &["http.control=true", "mts.name=base"],
    );
    // One lets the page cancel its goals, the other does not.
    let _crex = Robot::start(&host, "crex", &["dashboard@base"]);
    let _arm = Robot::start(&host, "arm", &["boss"]);
    let mut driving = drive(&host, "crex");
    let mut other = drive(&host, "arm");
    let name = "a_running_action_is_seen_and_cancelled_from_the_page";
    let browser = shown.open(name, 390, 844);
    if let Some(browser) = &browser {
        browser.value("location.hash = '#/locks'");
        browser.wait_for("25 % · <b>on the way</b>");
    }
    until("the judgement of both robots", || {
        goal(&shown, "crex")["may_cancel"] == true && goal(&shown, "arm")["may_cancel"] == false
    });
    // The robot judges, too, and not the page alone.
    let headers = shown.bearer() + &shown.of_page();
    let (status, _, body) = shown.ask("POST", "/api/cancel", &headers, &order("arm"));
    assert_eq!(status, 403, "{body}");
    assert!(body.contains("access.operators"), "{body}");
    for (headers, status) in [(shown.bearer(), 403), (shown.of_page(), 401)] {
        let answer = shown.ask("POST", "/api/cancel", &headers, &order("crex"));
        assert_eq!(answer.0, status);
    }
    let misnamed = r#"{"robot": "crex", "goal": "g-2", "client": "rover-of-crex"}"#;
    for (wrong, status) in [
        ("{}", 400),
        (r#"{"robot": "", "goal": "g-1", "client": "rover"}"#, 400),
        (misnamed, 403),
    ] {
        let answer = shown.ask("POST", "/api/cancel", &headers, wrong);
        assert_eq!(answer.0, status, "{wrong}: {answer:?}");
    }

    match &browser {
        Some(browser) => {
            let buttons = "document.querySelectorAll('td button').length";
            until("one button", || browser.value(buttons) == 1);
            browser.wait_for("not permitted by arm");
            browser.value("document.querySelector('td button').click()");
            browser.wait_for("drive of crex: cancelled by the operator dashboard@base");
            // All pages see it, and by which agent.
            until("the row of the cancelled goal", || {
                let wanted = |row: &String| row.contains("by the operator dashboard@base");
                rows(browser).iter().any(wanted)
            });
            assert_eq!(browser.value("document.documentElement.scrollWidth"), 390);
            browser.assert_no_messages();
        }
        None => {
            let answer = shown.ask("POST", "/api/cancel", &headers, &order("crex"));
            assert_eq!(answer.0, 200, "{answer:?}");
        }
    }
    let (code, log) = driving.end();
    assert_eq!(code, Some(1), "{log}");
    assert!(
        log.contains("cancelled by the operator dashboard@base"),
        "{log}"
    );
    until("the end of the goal", || goal(&shown, "crex").is_null());
    assert_eq!(goal(&shown, "arm")["state"], "executing");
    assert!(!other.has_ended());
}

#[test]
fn a_page_without_control_shows_actions_and_cancels_none() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &["mts.name=base"]);
    let _crex = Robot::start(&host, "crex", &["dashboard@base"]);
    let mut driving = drive(&host, "crex");
    until("the goal", || goal(&shown, "crex")["note"].is_string());
    assert_eq!(goal(&shown, "crex")["may_cancel"], Value::Null);
    let headers = shown.bearer() + &shown.of_page();
    let (status, _, body) = shown.ask("POST", "/api/cancel", &headers, &order("crex"));
    assert_eq!(status, 403, "{body}");
    assert!(body.contains("http.control"), "{body}");
    let name = "a_page_without_control_shows_actions_and_cancels_none";
    let Some(browser) = shown.open(name, 1280, 800) else {
        return;
    };
    browser.value("location.hash = '#/locks'");
    browser.wait_for("25 %");
    assert_eq!(
        browser.value("document.querySelectorAll('button').length"),
        0
    );
    assert_eq!(goal(&shown, "crex")["state"], "executing");
    assert!(!driving.has_ended());
    browser.assert_no_messages();
}
