//! The log on standard error: lines of text, or one JSON object on each line.
//!
//! Names and texts of peers cannot break a line, and characters that could deceive a reader are escaped, in both
//! formats.

use std::fmt::{self, Debug};
use std::io::IsTerminal;

use anstyle::Style;
use clap::ValueEnum;
use fipa::log_limit::Cut;
use fipa_acl::{escape, is_unprintable};
use tracing::field::Field;
use tracing::{Event, Subscriber};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::format::{self, Format, Json, JsonFields, Writer};
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::registry::LookupSpan;

use crate::log_output::LogOutput;
use crate::{output, report};

/// Environment variable with the format of the log, for services that are started without options.
const FORMAT_VARIABLE: &str = "FIPA_LOG_FORMAT";

/// Format of the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogFormat {
    /// Lines of text
    Text,
    /// One JSON object per line: timestamp, level, target, fields with the message, spans
    Json,
}

/// Starts logging to standard error. Standard output carries only the results of a command. Without a format, the
/// environment decides.
pub(crate) fn start(default_filter: &str, format: Option<LogFormat>) {
    let filter = if std::env::var_os("RUST_LOG").is_some_and(|value| !value.is_empty()) {
        EnvFilter::try_from_default_env().unwrap_or_else(|error| {
            report::warn(&format!(
                "ignoring $RUST_LOG, which is not a valid log filter: {error}"
            ));
            EnvFilter::new(default_filter)
        })
    } else {
        EnvFilter::new(default_filter)
    };
    let builder = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(|| LogOutput);
    match format.unwrap_or_else(format_of_environment) {
        LogFormat::Text => builder
            .with_ansi(std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none())
            .fmt_fields(format::debug_fn(text_field))
            .init(),
        LogFormat::Json => builder
            .with_ansi(false)
            .fmt_fields(JsonFields::new())
            .event_format(JsonLines(format::format().json()))
            .init(),
    }
}

fn format_of_environment() -> LogFormat {
    let value = std::env::var_os(FORMAT_VARIABLE).unwrap_or_default();
    if value.is_empty() {
        return LogFormat::Text;
    }
    let value = value.to_string_lossy();
    LogFormat::from_str(&value, false).unwrap_or_else(|_| {
        report::warn(&format!(
            "ignoring ${FORMAT_VARIABLE}, which is neither text nor json: {}",
            escape(&value)
        ));
        LogFormat::Text
    })
}

/// Writes one field of an event as text. A value can contain names and texts of peers, so a value with
/// unprintable characters is escaped. Other values stay as they are: they may be escaped already.
fn text_field(writer: &mut Writer<'_>, field: &Field, value: &dyn Debug) -> fmt::Result {
    // Lines for debugging are not cut by the library.
    let mut text = Cut(format_args!("{value:?}")).to_string();
    if text.contains(is_unprintable) {
        text = escape(&text).into_owned();
    }
    match field.name() {
        "message" => writer.write_str(&text),
        // The source location of an event from a crate that logs with `log`.
        name if name.starts_with("log.") => Ok(()),
        name if writer.has_ansi_escapes() => {
            let (italic, dimmed) = (Style::new().italic(), Style::new().dimmed());
            write!(writer, " {italic}{name}{italic:#}{dimmed}={dimmed:#}{text}")
        }
        name => write!(writer, " {name}={text}"),
    }
}

/// The JSON format of `tracing-subscriber`, which leaves unprintable characters behind ASCII as they are.
struct JsonLines(Format<Json>);

impl<S, N> FormatEvent<S, N> for JsonLines
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let mut line = String::new();
        self.0
            .format_event(context, Writer::new(&mut line), event)?;
        writeln!(writer, "{}", output::visible_in_json(line.trim_end()))
    }
}
