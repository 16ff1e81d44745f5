//! Views of the dashboard in a real browser: the offers of agents, coalitions, and the last minutes again.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

#[path = "common/browser.rs"]
#[allow(dead_code, reason = "no test uses all items")]
mod browser;
mod common;
#[path = "common/listener.rs"]
#[allow(dead_code, reason = "no test uses all items")]
mod listener;

use std::fs;
use std::process::Stdio;

use browser::Browser;
use common::{Host, Running};
use fipa::topics::Topic;
use fipa_testbed::{until, until_some};
use listener::Shown;
use serde_json::Value;

/// An image of one pixel.
const PNG: &[u8] = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\x01\0\0\0\x01\x08\x02\0\0\0\x90wS\xde\
    \0\0\0\x0cIDATx\x9cc\xf8\xcf\xc0\0\0\x03\x01\x01\0\xc9\xfe\x92\xef\0\0\0\0IEND\xaeB`\x82";

impl Shown {
    /// Asks for a path. Returns the status, the head of the answer in lower case, and the body.
    fn bytes(&self, path: &str, headers: &str) -> (u16, String, Vec<u8>) {
        let address = self.address;
        let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n{headers}\r\n");
        let (status, head, body) = self.exchange_bytes(&request);
        (status, head.to_ascii_lowercase(), body)
    }

    fn status(&self, path: &str) -> u16 {
        self.bytes(path, &self.bearer()).0
    }

    fn json(&self, path: &str) -> Value {
        let (status, _, body) = self.bytes(path, &self.bearer());
        assert_eq!(status, 200, "{path}");
        serde_json::from_slice(&body).unwrap()
    }

    /// Opens a view in a browser.
    fn open(&self, name: &str, size: (u32, u32), view: &str) -> Option<Browser> {
        let browser = Browser::open_page(name, size, (self.address, &self.token))?;
        go(&browser, view);
        Some(browser)
    }
}

fn go(browser: &Browser, view: &str) {
    browser.value(&format!("location.hash = '#/{view}'"));
}

/// The rows of the tables whose caption begins so, as lines of text.
fn rows(browser: &Browser, caption: &str) -> Vec<String> {
    let rows = browser.value(&format!(
        "[...document.querySelectorAll('table')].filter((table) => table.caption.textContent.startsWith('{caption}') \
         && table.offsetParent).flatMap((table) => [...table.tBodies[0].rows].map((row) => row.innerText))"
    ));
    let rows = rows.as_array().unwrap().iter();
    rows.map(|row| row.as_str().unwrap().replace(['\n', '\t'], " "))
        .collect()
}

/// Number of subscribers of a topic, as its publisher counts.
fn subscribers(host: &Host, agent: &str, topic: &str) -> u64 {
    let listed = host.run(&["topics", agent, "--json"]).done_json();
    let topics = listed[0]["topics"].as_array().unwrap();
    let topic = topics.iter().find(|it| it["name"] == topic).unwrap();
    topic["subscribers"].as_u64().unwrap()
}

#[test]
fn an_agent_is_shown_with_its_services_and_the_newest_values_of_its_topics() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let _crane = host.start(&["df", "register", "crane", "lifting", "--property", "load=5"]);
    let mut battery = host.command(&["publish", "battery", "charge", "-"]);
    battery.stdin(Stdio::piped());
    let mut battery = Running::new(battery);
    let file = host.path("image.png");
    fs::write(&file, PNG).unwrap();
    let file = file.to_str().unwrap();
    let _camera = host.start(&[
        "publish",
        "camera",
        "image",
        "--type",
        "image/png",
        "--rate",
        "20",
        "--content-file",
        file,
    ]);
    let name = "an_agent_is_shown_with_its_services_and_the_newest_values_of_its_topics";
    let Some(browser) = shown.open(name, (390, 844), "agent/crane") else {
        return;
    };
    until("the service", || {
        let rows = rows(&browser, "Services");
        rows.len() == 1 && rows[0].contains("lifting") && rows[0].contains("load = 5")
    });

    // Text from outside stays text, and each value replaces the one before.
    go(&browser, "agent/battery");
    for value in ["<img src=x onerror=alert(1)>", "((= (charge) 80.5))"] {
        battery.write_line(value);
        until(value, || {
            let rows = rows(&browser, "Topics");
            rows.len() == 1 && rows[0].starts_with("charge") && rows[0].contains(value)
        });
    }
    assert_eq!(
        browser.value("document.querySelectorAll('main img').length"),
        0
    );
    assert_eq!(subscribers(&host, "battery", "charge"), 1);

    // An image, which the browser loads with its session, and the next one.
    go(&browser, "agent/camera");
    let source = || browser.value("document.querySelector('img.newest')?.src");
    until("the image", || {
        browser.value("document.querySelector('img.newest')?.naturalWidth") == 1
    });
    let first = source();
    until("the next image", || source() != first);
    assert!(rows(&browser, "Topics")[0].contains("image of 1 × 1 pixels"));
    assert_eq!(browser.value("document.documentElement.scrollWidth"), 390);
    let path = "/api/image?name=camera&topic=image";
    let (status, head, body) = shown.bytes(path, &shown.bearer());
    assert!(
        status == 200 && head.contains("content-type: image/png"),
        "{head}"
    );
    assert_eq!(body, PNG);
    assert_eq!(shown.bytes(path, "").0, 401);
    assert_eq!(shown.status("/api/image?name=battery&topic=charge"), 404);
    assert_eq!(shown.status("/api/image?name=camera"), 404);

    // The subscription ends with the look.
    go(&browser, "fleet");
    until("no subscriber", || {
        subscribers(&host, "battery", "charge") == 0
    });
    until("no image", || shown.status(path) == 404);
    browser.assert_no_messages();
}

#[test]
fn four_topics_of_an_agent_are_followed_and_any_other_one_on_demand() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let mut config = fipa::Config::for_host("sensors");
    config.domain.clone_from(&host.domain);
    config.runtime_dir = host.path("run").to_str().unwrap().to_owned();
    config.discovery.mdns = false;
    let domain = runtime.block_on(fipa::Domain::open(&config)).unwrap();
    let agent = runtime.block_on(domain.register("sensors")).unwrap();
    let publishers: Vec<_> = (0..6)
        .map(|number| {
            let _entered = runtime.enter();
            let topic = Topic::new(format!("t{number}")).latched(1);
            let publisher = agent.publisher(topic).unwrap();
            let content = match number {
                // Larger than what a page shows.
                0 => vec![b'x'; (1 << 20) + 1],
                _ => format!("value {number}").into_bytes(),
            };
            drop(runtime.block_on(publisher.publish(content)));
            publisher
        })
        .collect();
    let topics = |path: &str| {
        until_some(path, || {
            let topics = shown.json(path)["topics"].clone();
            let with_value = topics
                .as_object()?
                .values()
                .filter(|it| !it["value"].is_null());
            (with_value.count() == 3).then_some(topics)
        })
    };
    let first = topics("/api/agent?name=sensors");
    let followed = |topics: &Value| -> Vec<String> {
        let all = topics.as_object().unwrap().iter();
        let followed = all.filter(|(_, topic)| topic["followed"] == true);
        followed.map(|(name, _)| name.clone()).collect()
    };
    assert_eq!(followed(&first), ["t0", "t1", "t2", "t3"]);
    assert!(
        first["t0"]["problem"].as_str().unwrap().contains("1 MiB"),
        "{first:#}"
    );
    assert_eq!(first["t3"]["value"]["text"], "value 3");

    let name = "four_topics_of_an_agent_are_followed_and_any_other_one_on_demand";
    let Some(browser) = shown.open(name, (1280, 800), "agent/sensors") else {
        return;
    };
    browser.wait_for("Follow t5");
    browser.value("[...document.querySelectorAll('main a')].find((it) => it.textContent === 'Follow t5').click()");
    browser.wait_for("value 5");
    let rows = rows(&browser, "Topics");
    assert_eq!(rows.len(), 6);
    assert!(rows[3].contains("Follow t3"), "{rows:?}");
    browser.assert_no_messages();
    drop(publishers);
}

#[test]
fn coalitions_are_groups_with_their_leader() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    let arm = host.echo("arm");
    let _rover = host.echo("rover");
    let platoon = [
        "coalition",
        "platoon",
        "rover",
        "arm",
        "ghost",
        "--leader",
        "rover",
    ];
    let _platoon = host.start(&platoon);
    let name = "coalitions_are_groups_with_their_leader";
    let Some(browser) = shown.open(name, (390, 844), "fleet") else {
        return;
    };
    until("the members", || {
        rows(&browser, "Members of platoon").len() == 3
    });
    let members = rows(&browser, "Members of platoon");
    assert!(members[0].starts_with("rover leader"), "{members:?}");
    assert!(members[2].contains("not in the directory"), "{members:?}");
    let _ = arm.signal("-KILL");
    until("the end of arm", || {
        rows(&browser, "Members of platoon")[1].starts_with("arm ended")
    });
    assert_eq!(browser.value("document.documentElement.scrollWidth"), 390);
    go(&browser, "agent/platoon");
    browser.wait_for("Members: rover (leader), arm, ghost");
    browser.assert_no_messages();
}

/// Sends a letter of a conversation.
fn say(host: &Host, conversation: &str, to: &str) {
    let letter = [
        "send",
        "--to",
        to,
        "--conversation-id",
        conversation,
        "--content",
        "x",
    ];
    host.run(&letter).done();
}

#[test]
fn a_slider_shows_the_letters_and_agents_of_a_time() {
    let host = Host::new();
    let shown = Shown::start(&host, "127.0.0.1:0", &[]);
    for wrong in ["/api/past", "/api/past?at=-1", "/api/past?at=now"] {
        assert_eq!(shown.status(wrong), 400, "{wrong}");
    }
    let far = format!("/api/past?at={}", u64::MAX);
    assert_eq!(shown.json(&far)["letters"], serde_json::json!({}));
    let crane = host.echo("crane");
    let _depot = host.echo("depot");
    let name = "a_slider_shows_the_letters_and_agents_of_a_time";
    let Some(browser) = shown.open(name, (1280, 800), "past") else {
        return;
    };
    let names = || rows(&browser, "Hosts at this time").concat();
    let letters = || rows(&browser, "Letters").concat();
    until("both agents", || {
        names().contains("crane") && names().contains("depot")
    });
    say(&host, "early", "crane");
    until("the early letter", || letters().contains("early"));
    let newest = || {
        browser
            .value("Number(document.querySelector('[type=range]').max)")
            .as_u64()
            .unwrap()
    };
    // The second after the letter, and one in which crane still runs.
    let early = newest() + 1;
    until("a later time", || newest() >= early + 2);
    let _ = crane.signal("-KILL");
    until("the end of crane", || !names().contains("crane"));
    say(&host, "late", "depot");
    until("the late letter", || letters().contains("late"));
    assert!(letters().contains("early"));
    assert!(
        rows(&browser, "Agents and hosts")
            .concat()
            .contains("crane ended")
    );

    browser.value(&format!(
        "(() => {{ const slider = document.querySelector('[type=range]'); slider.value = {early}; \
         slider.dispatchEvent(new Event('input')); }})()"
    ));
    until("crane again", || names().contains("crane"));
    until("the early letter alone", || {
        letters().contains("early") && !letters().contains("late")
    });
    assert!(rows(&browser, "Conversations").concat().contains("early"));
    assert!(
        !rows(&browser, "Agents and hosts")
            .concat()
            .contains("crane ended")
    );
    let said =
        browser.value("document.querySelector('[type=range]').getAttribute('aria-valuetext')");
    assert!(said.as_str().unwrap().contains(':'), "{said}");
    // The address leads to this time again.
    assert_eq!(browser.value("location.hash"), format!("#/past/{early}"));

    browser.value(
        "[...document.querySelectorAll('button')].find((it) => it.textContent === 'Now').click()",
    );
    until("the present", || {
        !names().contains("crane") && letters().contains("late")
    });
    browser.assert_no_messages();
}
