//! Letters to agents of other platforms at the addresses in their identifiers, and the addresses that a gateway must
//! not dial. A platform is a listening port that reads requests of HTTP.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::time::Duration;

use fipa::{Agent, AgentId, Deliveries, Domain, Gateway, Message, Outcome, Performative};
use fipa_testbed::jade;
use support::config;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::timeout;

/// Ends a test that hangs.
const TIMEOUT: Duration = Duration::from_secs(60);

/// A host with a gateway that uses HTTP.
async fn host(settings: &[&str]) -> (Gateway, Domain, String) {
    let own = [
        "mts.transports=[\"shm\", \"unix\", \"http\"]",
        "transport.http.listen=[\"127.0.0.1:0\"]",
        "mts.deadline=30s",
    ];
    let config = config(&[&own, settings].concat());
    let gateway = Gateway::open(&config).await.unwrap();
    let domain = Domain::open(&config).await.unwrap();
    let http = gateway.locations().into_iter();
    let http = http
        .map(|it| it.to_string())
        .find(|it| it.starts_with("http://"));
    let http = http.unwrap();
    let at = http
        .strip_prefix("http://")
        .unwrap()
        .split(['/', '#', ';'])
        .next();
    (gateway, domain, at.unwrap().to_owned())
}

/// A platform.
struct Platform(TcpListener);

impl Platform {
    async fn new() -> Self {
        Self(TcpListener::bind("127.0.0.1:0").await.unwrap())
    }

    fn address(&self) -> String {
        format!("http://{}/acc", self.0.local_addr().unwrap())
    }

    /// Reads these many letters, on any connections, and answers them.
    async fn read(&self, count: usize) -> Vec<Message> {
        let mut messages = Vec::new();
        while messages.len() < count {
            let (mut stream, _) = timeout(TIMEOUT, self.0.accept()).await.unwrap().unwrap();
            let mut bytes = Vec::new();
            while messages.len() < count {
                let Some(len) = request_len(&bytes) else {
                    if stream.read_buf(&mut bytes).await.unwrap() == 0 {
                        break;
                    }
                    continue;
                };
                let rest = bytes.split_off(len);
                let request = std::mem::replace(&mut bytes, rest);
                messages.push(message_of(&request));
                let answer =
                    b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: Keep-Alive\r\n\r\n";
                stream.write_all(answer).await.unwrap();
            }
        }
        messages
    }

    /// Whether a connection has come.
    async fn was_dialed(&self) -> bool {
        timeout(Duration::from_millis(1), self.0.accept())
            .await
            .is_ok()
    }
}

/// Returns the length of the request at the beginning, if it is complete.
fn request_len(bytes: &[u8]) -> Option<usize> {
    let head = bytes.windows(4).position(|it| it == b"\r\n\r\n")? + 4;
    let end = head + jade::content_length(&bytes[..head]);
    (bytes.len() >= end).then_some(end)
}

fn message_of(request: &[u8]) -> Message {
    let head = jade::message(request).to_vec().into();
    let payload = fipa_acl::Payload {
        head,
        ..fipa_acl::Payload::default()
    };
    Message::decode(&payload).unwrap()
}

/// Sends a message as a platform does.
async fn post(message: &str, receiver: &str, http: &str) {
    let to = format!("<agent-identifier><name>{receiver}</name></agent-identifier>");
    let body = format!(
        "--b\r\nContent-Type: application/xml\r\n\r\n<?xml version=\"1.0\"?><envelope><params index=\"1\"><to>{to}</to>\
         <acl-representation>fipa.acl.rep.string.std</acl-representation><date>20260101Z000000000</date>\
         <intended-receiver>{to}</intended-receiver></params></envelope>\r\n--b\r\nContent-Type: application/text\
         \r\n\r\n{message}\r\n--b--\r\n"
    );
    let request = format!(
        "POST http://{http}/acc HTTP/1.1\r\nContent-Type: multipart/mixed ; boundary=\"b\"\r\nContent-Length: {}\
         \r\n\r\n{body}",
        body.len()
    );
    let mut stream = TcpStream::connect(http).await.unwrap();
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = [0; 15];
    stream.read_exact(&mut answer).await.unwrap();
    assert_eq!(&answer, b"HTTP/1.1 200 OK");
}

fn at(name: &str, addresses: &[&str]) -> AgentId {
    let id = AgentId::new(name).unwrap();
    let with = |id: AgentId, address: &&str| id.with_address(*address).unwrap();
    addresses.iter().fold(id, with)
}

async fn send(agent: &Agent, to: AgentId, content: &str) -> Deliveries {
    let message = agent.message(Performative::Inform).receiver(to);
    agent
        .send(message.content(content.to_owned()))
        .await
        .unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_is_reached_at_the_first_address_that_takes_its_letter_and_letters_stay_in_order()
{
    let (_gateway, domain, http) = host(&[]).await;
    let (platform, closed) = (Platform::new().await, Platform::new().await);
    let refusing = closed.address();
    drop(closed);
    let rover = domain.register("rover").await.unwrap();
    let to = at("echo@jade", &[&refusing, &platform.address()]);
    let content = |number: u32| {
        let message = rover.message(Performative::Inform).receiver(to.clone());
        message.content(number.to_string())
    };
    // The first letter waits for the introduction, and the others behind it.
    let sending = (0..10).map(|number| rover.send(content(number)));
    let sending: Vec<_> = sending.collect();
    let read = platform.read(10).await;
    for one in sending {
        let deliveries = one.await.unwrap();
        let [delivery] = &deliveries.0[..] else {
            panic!("{deliveries}");
        };
        assert!(
            matches!(delivery.outcome, Outcome::Sent { .. }),
            "{deliveries}"
        );
    }
    let contents = read.iter().map(|it| it.content().unwrap().to_vec());
    let expected = (0..10).map(|it: u32| it.to_string().into_bytes());
    assert!(contents.eq(expected), "{read:?}");
    let here = format!("http://{http}/acc");
    assert_eq!(read[0].sender().unwrap().addresses(), [&*here]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_received_identifier_dials_only_what_is_permitted() {
    let (_gateway, domain, http) = host(&[]).await;
    let third = Platform::new().await;
    let rover = domain.register("rover").await.unwrap();
    let arm = domain.register("arm").await.unwrap();
    let own = format!("http://{http}/acc");
    for address in [
        third.address().as_str(),
        &third.address().replace("127.0.0.1", "localhost"),
        "http://10.255.255.7:7778/acc",
        "http://169.254.169.254/latest",
        "http://[fe80::1]:7778/acc",
        "http://224.0.0.1:7778/acc",
        &own,
    ] {
        let failed = send(&rover, at("x@evil", &[address]).received(), "x").await;
        let text = failed.to_string();
        assert!(
            !failed.all_succeeded() && text.contains("contacts.networks"),
            "{address}: {text}"
        );
    }
    let many: Vec<String> = (0..500)
        .map(|it| format!("http://10.{}.{}.9/x", it / 250, it % 250))
        .collect();
    let many: Vec<&str> = many.iter().map(String::as_str).collect();
    let failed = send(&rover, at("x@evil", &many).received(), "x").await;
    assert_eq!(
        failed.to_string().matches("is not dialed").count(),
        8,
        "{failed}"
    );
    // The directory has the name, so the addresses are ignored.
    let sent = send(&rover, at("arm", &[&third.address()]).received(), "for arm").await;
    assert!(sent.all_succeeded(), "{sent}");
    let sent = send(&rover, at("arm", &[&third.address()]), "for arm").await;
    assert!(sent.all_succeeded(), "{sent}");
    for _ in 0..2 {
        let received = timeout(TIMEOUT, arm.receive()).await.unwrap().unwrap();
        assert_eq!(received.content().unwrap(), "for arm");
    }
    assert!(!third.was_dialed().await);
    // The same address that the program gives itself.
    let given = at("y@jade", &[&third.address()]);
    let (sent, read) = tokio::join!(send(&rover, given, "y"), third.read(1));
    assert!(sent.all_succeeded(), "{sent}");
    assert_eq!(read[0].receivers()[0].name(), "y@jade");
    // That platform took a letter, so another agent there is reached, but no other port.
    let other = at("z@jade", &[&third.address()]).received();
    let (sent, _) = tokio::join!(send(&rover, other, "z"), third.read(1));
    assert!(sent.all_succeeded(), "{sent}");
    let port = Platform::new().await;
    let failed = send(&rover, at("w@jade", &[&port.address()]).received(), "w").await;
    assert!(
        !failed.all_succeeded() && !port.was_dialed().await,
        "{failed}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_listed_network_is_dialed() {
    let (_gateway, domain, _) = host(&["contacts.networks=[\"127.0.0.0/8\"]"]).await;
    let platform = Platform::new().await;
    let rover = domain.register("rover").await.unwrap();
    let to = at("x@jade", &[&platform.address()]).received();
    let (sent, read) = tokio::join!(send(&rover, to, "x"), platform.read(1));
    assert!(sent.all_succeeded(), "{sent}");
    assert_eq!(read[0].content().unwrap(), "x");
}

#[tokio::test(flavor = "multi_thread")]
async fn answers_go_to_a_reply_to_of_the_same_platform_only() {
    let (_gateway, domain, http) = host(&[]).await;
    let (platform, third) = (Platform::new().await, Platform::new().await);
    let arm = domain.register("arm").await.unwrap();
    let asked = |reply_to: &str, at: &str| {
        format!(
            "(REQUEST :sender (agent-identifier :name asker@jade :addresses (sequence {})) :receiver (set \
             (agent-identifier :name arm)) :reply-to (set (agent-identifier :name {reply_to} :addresses (sequence \
             {at}))) :content \"x\" :reply-with r1)",
            platform.address()
        )
    };
    let answer = async |message: &str| {
        post(message, "arm", &http).await;
        let received = timeout(TIMEOUT, arm.receive()).await.unwrap().unwrap();
        let answer = arm.reply(received.message(), Performative::Inform);
        arm.send(answer.content("done")).await.unwrap()
    };
    let message = asked("boss@jade", &platform.address());
    let (sent, read) = tokio::join!(answer(&message), platform.read(1));
    assert!(sent.all_succeeded(), "{sent}");
    assert_eq!(read[0].receivers()[0].name(), "boss@jade");
    let failed = answer(&asked("x@evil", &third.address())).await;
    assert!(!failed.all_succeeded(), "{failed}");
    assert!(failed.to_string().contains("contacts.networks"), "{failed}");
    assert!(!third.was_dialed().await);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_description_in_a_directory_facilitator_leads_to_the_platform_that_registered_it() {
    let (gateway, domain, http) = host(&[]).await;
    let (platform, third) = (Platform::new().await, Platform::new().await);
    let rover = domain.register("rover").await.unwrap();
    let df = format!("df@{}", gateway.name());
    let register = format!(
        "(REQUEST :sender (agent-identifier :name seller@jade :addresses (sequence {})) :receiver (set \
         (agent-identifier :name {df})) :content \"((action (agent-identifier :name {df}) (register \
         (df-agent-description :name (agent-identifier :name seller@jade :addresses (sequence {})) :services (set \
         (service-description :name s :type selling))))))\" :language fipa-sl0 :ontology fipa-agent-management \
         :protocol fipa-request :conversation-id c1 :reply-with r1)",
        platform.address(),
        third.address(),
    );
    post(&register, &df, &http).await;
    let answer = platform.read(1).await;
    assert_eq!(
        *answer[0].performative(),
        Performative::Inform,
        "{answer:?}"
    );
    let selling = fipa::platform::ServiceDescription::of_type("selling").into();
    let found = rover.df().unwrap().search(&selling).await.unwrap();
    let seller = found[0].name.clone().unwrap();
    assert_eq!(seller.addresses(), [third.address()]);
    let (sent, read) = tokio::join!(send(&rover, seller, "buy"), platform.read(1));
    assert!(sent.all_succeeded(), "{sent}");
    assert_eq!(read[0].content().unwrap(), "buy");
    assert!(!third.was_dialed().await);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_directory_facilitator_at_an_address_is_asked() {
    let (_gateway, domain, _) = host(&[]).await;
    let platform = Platform::new().await;
    let rover = domain.register("rover").await.unwrap();
    let df = rover.df_of(at("df@jade", &[&platform.address()]));
    let any = fipa::platform::AgentDescription::default();
    let search = timeout(TIMEOUT, df.search(&any));
    let read = async {
        let read = platform.read(1).await;
        assert_eq!(read[0].receivers()[0].name(), "df@jade");
    };
    // The platform does not answer.
    tokio::select! {
        searched = search => panic!("{searched:?}"),
        () = read => {}
    }
}
