//! The answers at the gateway's listener: the page with its parts, views, and their changes as they happen.

use std::collections::HashMap;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::body::Bytes;
use axum::extract::{DefaultBodyLimit, Path, Query, State};
use axum::http::StatusCode;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::sse::{Event, Sse};
use axum::response::{IntoResponse as _, Response};
use axum::routing::{get, post};
use axum::{Extension, Router};
use fipa::actions::ActionError;
use fipa::monitor::Library;
use fipa::web::{KeepOpen, Pages};
use futures_util::stream;
use serde_json::Value;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, Interval, MissedTickBehavior};

use super::observation::Observation;
use super::orders::OrderError;
use super::picture::{Wanted, cancelled_object};
use super::view::View;
use crate::command::protocol::drawing;

/// Maximum number of pages that follow the domain at the same time.
const MAX_STREAMS: usize = 16;

/// Maximum size of an order, in bytes.
const MAX_ORDER: usize = 64 << 10;

/// Minimum time between two changes that a page gets.
const PACE: Duration = Duration::from_millis(200);

/// Time after which a stream ends, so that the browser begins another one, with a session that is still valid.
const MAX_STREAM: Duration = Duration::from_secs(600);

/// Time without a change after which a page gets a sign of life.
const SIGN_OF_LIFE: Duration = Duration::from_secs(10);

/// The parts of the page: path, media type, content.
const PARTS: [(&str, &str, &str); 19] = [
    (
        "/",
        "text/html; charset=utf-8",
        include_str!("assets/index.html"),
    ),
    (
        "/api/openapi.json",
        "application/json",
        include_str!("assets/openapi.json"),
    ),
    ("/style.css", CSS, include_str!("assets/style.css")),
    ("/uplot.css", CSS, include_str!("assets/uplot.css")),
    ("/uplot.js", JAVASCRIPT, include_str!("assets/uplot.js")),
    (
        "/uplot.license",
        "text/plain; charset=utf-8",
        include_str!("assets/uplot.license"),
    ),
    ("/chart.js", JAVASCRIPT, include_str!("assets/chart.js")),
    ("/main.js", JAVASCRIPT, include_str!("assets/main.js")),
    ("/live.js", JAVASCRIPT, include_str!("assets/live.js")),
    (
        "/elements.js",
        JAVASCRIPT,
        include_str!("assets/elements.js"),
    ),
    ("/fleet.js", JAVASCRIPT, include_str!("assets/fleet.js")),
    (
        "/conversations.js",
        JAVASCRIPT,
        include_str!("assets/conversations.js"),
    ),
    ("/offers.js", JAVASCRIPT, include_str!("assets/offers.js")),
    (
        "/coalitions.js",
        JAVASCRIPT,
        include_str!("assets/coalitions.js"),
    ),
    ("/past.js", JAVASCRIPT, include_str!("assets/past.js")),
    ("/goals.js", JAVASCRIPT, include_str!("assets/goals.js")),
    ("/locks.js", JAVASCRIPT, include_str!("assets/locks.js")),
    ("/letters.js", JAVASCRIPT, include_str!("assets/letters.js")),
    (
        "/icon.svg",
        "image/svg+xml",
        include_str!("assets/icon.svg"),
    ),
];
const CSS: &str = "text/css; charset=utf-8";
const JAVASCRIPT: &str = "text/javascript; charset=utf-8";

#[derive(Clone)]
struct Shown {
    observation: Arc<Observation>,
    library: Arc<Library>,
    places: Arc<Semaphore>,
}

impl Shown {
    /// Keeps the domain observed and, if clients may give orders, the connection open: an order may take longer than
    /// others have. Its waits are bounded.
    fn wait_for_order(&self, connection: &KeepOpen) {
        self.observation.keep();
        if self.observation.orders.are_permitted() {
            connection.keep();
        }
    }
}

/// Returns the pages that show what is observed.
pub(super) fn pages(observation: Arc<Observation>, library: Arc<Library>) -> Pages {
    let shown = Shown {
        observation,
        library,
        places: Arc::new(Semaphore::new(MAX_STREAMS)),
    };
    let part =
        |router: Router,
         (path, media_type, content): (&'static str, &'static str, &'static str)| {
            // A browser asks each time, so that it never mixes parts of two versions.
            let headers = [(CONTENT_TYPE, media_type), (CACHE_CONTROL, "no-cache")];
            router.route(path, get(move || async move { (headers, content) }))
        };
    let protected = Router::new()
        .route("/api/live/{view}", get(live))
        .route("/api/protocol.svg", get(protocol))
        .route("/api/image", get(image))
        .route("/api/send", post(send))
        .route("/api/cancel", post(cancel))
        .layer(DefaultBodyLimit::max(MAX_ORDER))
        .route("/api/{view}", get(snapshot))
        .with_state(shown);
    Pages {
        public: PARTS.into_iter().fold(Router::new(), part),
        protected,
    }
}

/// The answer to a request for no view.
type Refusal = (StatusCode, String);

/// The view that a path and its parameters name.
fn wanted(view: &str, parameters: &mut HashMap<String, String>) -> Result<Wanted, Refusal> {
    let mut parameter = |name: &str| {
        let missing = || {
            (
                StatusCode::BAD_REQUEST,
                format!("the parameter {name} is missing\n"),
            )
        };
        parameters.remove(name).ok_or_else(missing)
    };
    match view {
        "fleet" => Ok(Wanted::Fleet),
        "agent" => parameter("name").map(|name| Wanted::Agent {
            name,
            topic: parameter("topic").ok(),
        }),
        "conversations" => Ok(Wanted::Conversations),
        "conversation" => parameter("id").map(Wanted::Conversation),
        "locks" => Ok(Wanted::Locks),
        "letters" => Ok(Wanted::Letters),
        "past" => {
            let wrong = |_| {
                let why = "the parameter at is not a number of seconds since 1970\n";
                (StatusCode::BAD_REQUEST, why.to_owned())
            };
            parameter("at")?.parse().map(Wanted::Past).map_err(wrong)
        }
        _ => {
            let why = "the views are fleet, agent, conversations, conversation, locks, letters and past\n";
            Err((StatusCode::NOT_FOUND, why.to_owned()))
        }
    }
}

/// Answers with a view as it is now.
async fn snapshot(
    State(shown): State<Shown>,
    Path(view): Path<String>,
    Query(mut parameters): Query<HashMap<String, String>>,
) -> Response {
    match wanted(&view, &mut parameters) {
        Ok(wanted) => {
            let json = shown.observation.view(&wanted).json();
            ([(CONTENT_TYPE, "application/json")], json).into_response()
        }
        Err(refusal) => refusal.into_response(),
    }
}

/// Answers with the drawing of a protocol, in which a state is marked.
async fn protocol(
    State(shown): State<Shown>,
    Query(parameters): Query<HashMap<String, String>>,
) -> Response {
    let parameter = |name: &str| parameters.get(name).map(String::as_str);
    let machine = parameter("name").and_then(|name| shown.library.find(name));
    let Some(machine) = machine else {
        return (StatusCode::NOT_FOUND, "the protocol is not known\n").into_response();
    };
    let svg = drawing::svg(machine, false, parameter("state"));
    ([(CONTENT_TYPE, "image/svg+xml")], svg).into_response()
}

/// Answers with the newest image of a topic that is followed.
async fn image(
    State(shown): State<Shown>,
    Query(parameters): Query<HashMap<String, String>>,
) -> Response {
    let (name, topic) = (parameters.get("name"), parameters.get("topic"));
    let image = name
        .zip(topic)
        .and_then(|(name, topic)| shown.observation.offers.image(name, topic));
    match image {
        Some((media_type, content)) => ([(CONTENT_TYPE, media_type)], content).into_response(),
        None => (StatusCode::NOT_FOUND, "no image of this topic is known\n").into_response(),
    }
}

/// Sends a message, and answers with its outcomes.
async fn send(
    State(shown): State<Shown>,
    Extension(connection): Extension<KeepOpen>,
    order: Bytes,
) -> Response {
    shown.wait_for_order(&connection);
    answer_to_order(shown.observation.orders.send(&order).await)
}

/// Cancels a goal, and answers with its end.
async fn cancel(
    State(shown): State<Shown>,
    Extension(connection): Extension<KeepOpen>,
    order: Bytes,
) -> Response {
    shown.wait_for_order(&connection);
    let cancelled = shown.observation.cancel(&order).await;
    answer_to_order(cancelled.map(|cancelled| cancelled_object(&cancelled)))
}

fn answer_to_order(executed: Result<Value, OrderError>) -> Response {
    match executed {
        Ok(outcome) => {
            let json = outcome.to_string();
            ([(CONTENT_TYPE, "application/json")], json).into_response()
        }
        Err(error) => {
            let status = match error {
                OrderError::NoControl | OrderError::Robot(ActionError::Refused(_)) => {
                    StatusCode::FORBIDDEN
                }
                OrderError::NotReady => StatusCode::SERVICE_UNAVAILABLE,
                OrderError::Robot(_) | OrderError::GoesOn => StatusCode::GATEWAY_TIMEOUT,
                _ => StatusCode::BAD_REQUEST,
            };
            (status, format!("{error}\n")).into_response()
        }
    }
}

/// A page that follows a view.
struct Following {
    observation: Arc<Observation>,
    wanted: Wanted,
    /// The state that the page has.
    sent: Option<Arc<View>>,
    began: Instant,
    at: Instant,
    pace: Interval,
    _place: OwnedSemaphorePermit,
}

/// Answers with a view, and with its changes as they happen.
async fn live(
    State(shown): State<Shown>,
    Path(view): Path<String>,
    Query(mut parameters): Query<HashMap<String, String>>,
    Extension(connection): Extension<KeepOpen>,
) -> Response {
    let wanted = match wanted(&view, &mut parameters) {
        Ok(wanted) => wanted,
        Err(refusal) => return refusal.into_response(),
    };
    let Ok(place) = Arc::clone(&shown.places).try_acquire_owned() else {
        let why = format!("{MAX_STREAMS} pages follow this host already; close one\n");
        return (StatusCode::SERVICE_UNAVAILABLE, why).into_response();
    };
    connection.keep();
    let mut pace = tokio::time::interval(PACE);
    pace.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let following = Following {
        observation: shown.observation,
        wanted,
        sent: None,
        began: Instant::now(),
        at: Instant::now(),
        pace,
        _place: place,
    };
    let events = stream::unfold(following, |mut following| async {
        if following.began.elapsed() >= MAX_STREAM {
            return None;
        }
        let event = following.next().await;
        Some((Ok::<_, Infallible>(event), following))
    });
    Sse::new(events).into_response()
}

impl Following {
    /// Waits for the next change. Called again only when the page has taken the last one: a slow page gets fewer
    /// changes, each with all that has happened since.
    async fn next(&mut self) -> Event {
        loop {
            self.pace.tick().await;
            let view = self.observation.view(&self.wanted);
            let event = match &self.sent {
                None => Some(Event::default().event("snapshot").data(view.json())),
                Some(sent) if Arc::ptr_eq(sent, &view) => None,
                Some(sent) => view
                    .changes_since(sent)
                    .map(|changes| Event::default().event("changes").data(changes)),
            };
            self.sent = Some(view);
            let now = Instant::now();
            if let Some(event) = event {
                self.at = now;
                return event;
            }
            if now.duration_since(self.at) >= SIGN_OF_LIFE {
                self.at = now;
                return Event::default().event("alive").data("{}");
            }
        }
    }
}
