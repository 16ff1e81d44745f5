//! The span in which a letter is sent arrives with it: in another process, over gateways, in a conversation.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::time::Duration;

use fipa::Performative::{Inform, Request};
use fipa::blocking::Wait;
use fipa::protocol::{Reply, Task};
use fipa::{Agent, Config, Domain, Gateway, Incoming, Kind};
use fipa_testbed::{ignored_test, until_async};
use opentelemetry::Context;
use opentelemetry::trace::{
    FutureExt as _, SpanContext, TraceContextExt as _, TraceState, Tracer as _, TracerProvider as _,
};
use opentelemetry_sdk::trace::{InMemorySpanExporter, SdkTracer, SdkTracerProvider};
use support::{config, inform, load};
use tracing_subscriber::layer::SubscriberExt as _;

const TIMEOUT: Duration = Duration::from_secs(60);

/// The configuration of the process that a test starts, a setting in a line.
const CONFIG: &str = "FIPA_TRACES_CONFIG";

/// A tracer, and the spans that have ended.
struct Tracing {
    _provider: SdkTracerProvider,
    tracer: SdkTracer,
    ended: InMemorySpanExporter,
}

impl Tracing {
    fn new() -> Self {
        let ended = InMemorySpanExporter::default();
        let provider = SdkTracerProvider::builder()
            .with_simple_exporter(ended.clone())
            .build();
        Self {
            tracer: provider.tracer("traces"),
            _provider: provider,
            ended,
        }
    }

    /// A context with a new span.
    fn context(&self) -> Context {
        Context::new().with_span(self.tracer.start("send"))
    }

    /// Handles a message in a span of its own, and checks that it is a child of this one.
    #[track_caller]
    fn handle(&self, received: &Context, parent: &SpanContext) {
        let span = received.span().span_context().clone();
        assert!(span.is_remote());
        assert_eq!(line(&span), line(parent));
        drop(self.tracer.start_with_context("handle", received));
        let ended = self.ended.get_finished_spans().unwrap();
        let handled = ended.iter().find(|span| span.name == "handle").unwrap();
        assert_eq!(handled.parent_span_id, parent.span_id());
        assert_eq!(handled.span_context.trace_id(), parent.trace_id());
        assert!(handled.parent_span_is_remote);
        self.ended.reset();
    }
}

/// The span that a letter carries.
fn line(span: &SpanContext) -> String {
    let (trace, id, flags) = (span.trace_id(), span.span_id(), span.trace_flags());
    format!("{trace} {id} {flags:02x} {}", span.trace_state().header())
}

fn span_of(context: &Context) -> SpanContext {
    context.span().span_context().clone()
}

/// The same span with the longest state that is sent.
fn with_long_state(context: &Context) -> Context {
    let span = span_of(context);
    let members = [
        ("a", "x".repeat(250)),
        ("b", "y".repeat(250)),
        ("c", "z".repeat(4)),
    ];
    let state = TraceState::from_key_value(members).unwrap();
    assert_eq!(state.header().len(), 512);
    let (trace, id, flags) = (span.trace_id(), span.span_id(), span.trace_flags());
    Context::new().with_remote_span_context(SpanContext::new(trace, id, flags, false, state))
}

fn receive(agent: &Agent) -> Incoming {
    agent.receive_within(TIMEOUT).wait().unwrap().unwrap()
}

#[test]
fn the_span_arrives_in_another_process_over_shared_memory() {
    let mark = support::mark();
    let set = format!("domain=traces-{mark}\nmts.transports=shm");
    let domain = Domain::open(&load(set.lines())).wait().unwrap();
    let arm = domain.register("arm").wait().unwrap();
    let child = ignored_test("inside_rover").env(CONFIG, &set).spawn();
    let mut child = child.unwrap();

    let tracing = Tracing::new();
    for len in [0, 10_000, 1 << 20] {
        let letter = receive(&arm);
        assert_eq!(letter.via, Some(Kind::Shm));
        let content = letter.content().unwrap();
        let (told, rest) = content.split_at(content.iter().position(|it| *it == b'\n').unwrap());
        assert_eq!(rest.len(), len + 1);
        assert_eq!(fipa::is_in_place(&content), len > 0, "{len}");
        let context = letter.trace_context();
        let span = span_of(&context);
        assert_eq!(line(&span).as_bytes(), told, "{len}");
        tracing.handle(&context, &span);
    }
    let letter = receive(&arm);
    assert_eq!(letter.message().text(), "no span");
    assert!(!letter.trace_context().has_active_span());
    let envelope = letter.letter().parse_envelope().unwrap();
    assert_eq!(envelope.effective().user_defined, []);
    assert!(child.wait().unwrap().success());
    domain.close().wait();
}

#[test]
#[ignore = "is run by the other test in a process of its own"]
fn inside_rover() {
    let config = load(std::env::var(CONFIG).unwrap().lines());
    let domain = Domain::open(&config).wait().unwrap();
    let rover = domain.register("rover").wait().unwrap();
    let tracing = Tracing::new();

    let current = with_long_state(&tracing.context()).attach();
    let told = line(&span_of(&Context::current())) + "\n";
    let sent = rover.send(inform(&rover, "arm", &told));
    assert!(sent.wait().unwrap().all_succeeded());
    for len in [10_000, 1 << 20] {
        let message = rover.message(Inform).receiver("arm");
        let mut loan = rover.loan(message, told.len() + len).unwrap();
        let memory = loan.content_mut();
        memory.fill(b'.');
        memory[..told.len()].copy_from_slice(told.as_bytes());
        let sent = rover.send_loan(loan).wait().unwrap();
        assert!(sent.all_succeeded(), "{sent}");
    }
    drop(current);
    let sent = rover.send(inform(&rover, "arm", "no span")).wait().unwrap();
    assert!(sent.all_succeeded(), "{sent}");
    domain.close().wait();
}

/// Two gateways whose addresses have this host part, with an agent behind each.
async fn over_gateways(host: &str) {
    let listen = format!("transport.tcp.listen=[\"{host}:0\"]");
    let far_config = config(&[&listen]);
    let (far, far_host) = both(&far_config).await;
    let arm = far_host.register("arm").await.unwrap();
    let mut locations = far.locations().into_iter();
    let at = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
    assert!(at.address().starts_with(host), "{at}");
    let knows = format!("discovery.static={{ far = [\"tcp://{}\"] }}", at.address());
    let (near, near_host) = both(&config(&[&listen, &knows])).await;
    let rover = near_host.register("rover").await.unwrap();
    until_async("the arm is known", || {
        near_host.directory().known("arm").is_some()
    })
    .await;

    let tracing = Tracing::new();
    let context = with_long_state(&tracing.context());
    let sent = async { rover.send(inform(&rover, "arm", "hello")).await };
    let sent = sent.with_context(context.clone()).await.unwrap();
    assert_eq!(sent.0[0].outcome.via(), Some(Kind::Tcp), "{sent}");
    let letter = arm.receive().await.unwrap();
    let envelope = letter.letter().parse_envelope().unwrap();
    assert_eq!(envelope.extensions.len(), 2, "the stamps of both gateways");
    tracing.handle(&letter.trace_context(), &span_of(&context));
    for domain in [near_host, far_host] {
        domain.close().await;
    }
    near.close().await;
    far.close().await;
}

async fn both(config: &Config) -> (Gateway, Domain) {
    let gateway = Gateway::open(config).await.unwrap();
    (gateway, Domain::open(config).await.unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_span_arrives_over_two_gateways_over_ipv4() {
    over_gateways("127.0.0.1").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_span_arrives_over_two_gateways_over_ipv6() {
    over_gateways("[::1]").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_has_the_span_of_its_first_message_and_the_answer_that_of_the_task() {
    let config = config(&[]);
    let domain = Domain::open(&config).await.unwrap();
    let rover = domain.register("rover").await.unwrap();
    let arm = domain.register("arm").await.unwrap();
    let handler = async |task: Task| {
        let span = line(&span_of(&task.trace_context()));
        Ok::<_, String>(Reply::Inform(span.into()))
    };
    let _server = arm
        .serve("fipa-request", move |task| Box::pin(handler(task)))
        .unwrap();
    let context = Tracing::new().context();
    let lift = rover
        .message(Request)
        .receiver("arm")
        .content("(lift crate)");
    let request = async { rover.request(lift, TIMEOUT).await.unwrap().result().await };
    let result = request.with_context(context.clone()).await.unwrap();
    assert_eq!(result.text(), line(&span_of(&context)));
    domain.close().await;
}

/// As `docs/book/src/what-happened.md` says.
#[tokio::test]
async fn a_span_of_tracing_is_sent_and_becomes_the_parent_of_another_one() {
    use tracing::Instrument as _;
    use tracing_opentelemetry::OpenTelemetrySpanExt as _;

    let tracing = Tracing::new();
    let tracer = tracing.tracer.clone();
    // ANCHOR: layer
    let layer = tracing_opentelemetry::layer().with_tracer(tracer);
    let subscriber = tracing_subscriber::registry().with(layer);
    // ANCHOR_END: layer
    let _default = tracing::subscriber::set_default(subscriber);
    let domain = Domain::open(&config(&[])).await.unwrap();
    let rover = domain.register("rover").await.unwrap();
    let arm = domain.register("arm").await.unwrap();

    let drive = tracing::info_span!("drive");
    let sent = async { rover.send(inform(&rover, "arm", "hello")).await };
    assert!(
        sent.instrument(drive.clone())
            .await
            .unwrap()
            .all_succeeded()
    );
    // ANCHOR: handle
    let letter = arm.receive().await.unwrap();
    let handle = tracing::info_span!("handle");
    handle.set_parent(letter.trace_context()).unwrap();
    // ANCHOR_END: handle
    let parent = span_of(&drive.context());
    assert!(parent.is_valid());
    drop((handle, drive));

    let ended = tracing.ended.get_finished_spans().unwrap();
    let handled = ended.iter().find(|span| span.name == "handle").unwrap();
    assert_eq!(handled.parent_span_id, parent.span_id());
    assert_eq!(handled.span_context.trace_id(), parent.trace_id());
    domain.close().await;
}
