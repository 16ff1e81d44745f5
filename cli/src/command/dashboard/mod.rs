//! The dashboard: a page of the gateway that shows the domain, and `fipa dashboard`, which opens it.
//!
//! * [`observation`] observes the domain while pages show it; [`picture`] is the state of the domain.
//! * [`offers`] follows the agents at which pages look.
//! * [`goals`] asks agents for the goals that they run.
//! * [`orders`] sends messages and cancels goals for clients, if `http.control` permits it.
//! * [`pages`] answers requests; [`view`] has the rows of a view, and their changes.
//! * `assets/` is the page: plain JavaScript modules without a build step.

mod goals;
mod observation;
mod offers;
mod orders;
mod pages;
mod picture;
mod view;

use std::fs::{self, File};
use std::io::{IsTerminal as _, Write as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::Arc;

use clap::Args;
use fipa::Config;
use fipa::admin::routes::HttpListener;
use fipa::monitor::Library;
use fipa::web::Pages;
use fipa_acl::escape;
use percent_encoding::{NON_ALPHANUMERIC, utf8_percent_encode};
use serde_json::json;
use tokio::task::JoinHandle;

use self::observation::Observation;
use self::orders::Orders;
use crate::command::watch::checker;
use crate::membership;
use crate::options::Global;
use crate::output;
use crate::report::{self, Failure};

/// Show the robots of the domain on a web page of the gateway
///
/// Prints the link of the page, and opens it in a browser if this is a desktop. The page shows hosts and agents, the
/// links between hosts, the topics of agents, conversations and their violations, locks, running actions, letters with
/// their ways, and the last minutes again. It changes nothing, unless http.control is true.
///
/// The gateway must have the option http.listen. Everyone who has the link sees the domain: it contains the token of
/// the gateway, which only the user of the gateway can read. If http.listen is an address that other hosts reach, the page
/// is encrypted with the key of the gateway, and the browser asks once whether it may trust this key. The command prints
/// the SHA-256 fingerprint of the certificate, to compare it with the one that the browser shows.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa up --set http.listen=127.0.0.1:9790          the gateway, with the page
  fipa dashboard                                    on the same host
  ssh -L 9790:127.0.0.1:9790 robot fipa dashboard   on another computer, which then opens the link
  fipa up --set security.keys=$HOME/.config/fipa/keys --set http.listen=0.0.0.0:9790
                                                    for a tablet in the same network

JSON:
  { \"domain\": text, \"address\": text, \"link\": text, \"fingerprint\": text or null without encryption }")]
pub(crate) struct Arguments {
    /// Print the link only
    #[arg(long)]
    no_browser: bool,

    /// Print JSON, and open no browser
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let report = membership::run(async {
        let domain = membership::join_briefly(&config).await?;
        let report = membership::gateway_report(&domain, None).await;
        domain.close().await;
        report
    })?;
    let location = format!("domain {:?}", config.domain);
    let Some(report) = report else {
        return Err(Failure::failed(
            "no gateway is running, and the page is one of the gateway",
            location,
            "start it: fipa up --set http.listen=127.0.0.1:9790",
        ));
    };
    let Some(listener) = report.http else {
        return Err(Failure::failed(
            "the gateway has no HTTP listener",
            location,
            "set http.listen = \"127.0.0.1:9790\" in its configuration, and restart it",
        ));
    };
    let link = link(&listener)?;
    if arguments.json {
        let address = listener.address.to_string();
        return output::json(&json!({
            "domain": config.domain, "address": address, "link": link, "fingerprint": listener.fingerprint,
        }));
    }
    output::text(&format!("{link}\n"))?;
    if let Some(fingerprint) = &listener.fingerprint {
        let fingerprint = escape(fingerprint);
        output::text(&format!(
            "fingerprint of the certificate (SHA-256): {fingerprint}\n"
        ))?;
    }
    let is_desktop = ["DISPLAY", "WAYLAND_DISPLAY"]
        .iter()
        .any(|name| std::env::var_os(name).is_some());
    if is_desktop && !arguments.no_browser && std::io::stdout().is_terminal() {
        open_browser(&config, &link)?;
    }
    Ok(())
}

/// Returns the link of the page, with the token of the gateway.
pub(super) fn link(listener: &HttpListener) -> Result<String, Failure> {
    let token = fs::read_to_string(&listener.token_file).map_err(|error| {
        Failure::failed(
            format!("cannot read the token of the gateway: {error}"),
            escape(&listener.token_file).into_owned(),
            "run the command as the user of the gateway",
        )
    })?;
    // A token of the user's own may have characters that end a link or the attribute of a page.
    let token = utf8_percent_encode(token.trim_end(), NON_ALPHANUMERIC);
    Ok(format!("{}/#token={token}", listener.url))
}

/// Opens the link in a browser. The link goes through a file that only this user can read: all users see the
/// arguments of a command.
fn open_browser(config: &Config, link: &str) -> Result<(), Failure> {
    let Some(directory) = std::env::var_os("XDG_RUNTIME_DIR") else {
        return Ok(());
    };
    let path = PathBuf::from(directory).join(format!("fipa-dashboard-{}.html", config.domain));
    let page = format!(
        "<!doctype html><meta http-equiv=refresh content=\"0; url={link}\"><title>fipa</title>\n"
    );
    let failed = |error: std::io::Error| {
        Failure::failed(
            format!("cannot open a browser: {error}"),
            path.display().to_string(),
            "open the link above, or use --no-browser",
        )
    };
    let mut options = File::options();
    options.write(true).create(true).truncate(true).mode(0o600);
    let written = options
        .open(&path)
        .and_then(|mut file| file.write_all(page.as_bytes()));
    written.map_err(failed)?;
    let mut opener = Command::new("xdg-open");
    opener
        .arg(&path)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    let status = opener.status().map_err(failed)?;
    match status.success() {
        true => Ok(()),
        false => Err(failed(std::io::Error::other(format!("xdg-open: {status}")))),
    }
}

/// The dashboard of a gateway.
pub(super) struct Dashboard {
    observation: Arc<Observation>,
    observing: JoinHandle<()>,
}

impl Dashboard {
    /// Starts the dashboard of the gateway with this configuration. Returns its pages, too. Must be called within a
    /// tokio runtime.
    pub(super) fn start(config: &Config) -> (Self, Pages) {
        let library = Arc::new(library(config));
        let observation = Observation::new(Orders::new(config));
        let pages = pages::pages(Arc::clone(&observation), Arc::clone(&library));
        let running = observation::run(Arc::clone(&observation), library, config.clone());
        let observing = tokio::spawn(running);
        let dashboard = Self {
            observation,
            observing,
        };
        (dashboard, pages)
    }

    /// Stops observing the domain, and leaves it.
    pub(super) async fn close(self) {
        self.observation.stop();
        // A panic of the task has been reported.
        let _ = self.observing.await;
    }
}

/// The protocols for the page. Letters do not depend on them, so a file that cannot be read does not end the gateway.
fn library(config: &Config) -> Library {
    if config.http.listen.is_empty() {
        return Library::standard();
    }
    checker::protocols(&config.monitor.protocols, None).unwrap_or_else(|failure| {
        report::warn(&format!(
            "the dashboard checks the protocols of the standards only: {}",
            failure.problem()
        ));
        Library::standard()
    })
}
