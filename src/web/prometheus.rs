//! Metrics in the text format of Prometheus.

use fipa_transport::counts::{self, BUCKETS, DeliveryTimes};
use prometheus::proto::{
    Bucket, Counter, Gauge, Histogram, LabelPair, Metric, MetricFamily, MetricType,
};
use prometheus::{Encoder as _, TextEncoder, process_collector::ProcessCollector};

/// The media type of the text.
pub(super) const FORMAT: &str = "text/plain; version=0.0.4; charset=utf-8";

/// The labels of a value, with their names.
type Labels<'a> = &'a [(&'static str, &'a str)];

/// Metrics at one moment.
#[derive(Default)]
pub(crate) struct Families(Vec<MetricFamily>);

impl Families {
    /// Adds a counter with one value for each combination of labels.
    pub(crate) fn counter(&mut self, name: &str, help: &str) -> Values<'_> {
        self.family(name, help, MetricType::COUNTER)
    }

    /// Adds a value that may fall, one for each combination of labels.
    pub(crate) fn gauge(&mut self, name: &str, help: &str) -> Values<'_> {
        self.family(name, help, MetricType::GAUGE)
    }

    /// Adds a distribution of times, one for each combination of labels.
    pub(crate) fn histogram(&mut self, name: &str, help: &str) -> Values<'_> {
        self.family(name, help, MetricType::HISTOGRAM)
    }

    /// Adds what the system counts of this process.
    pub(crate) fn process(&mut self) {
        let collector = ProcessCollector::for_self();
        self.0
            .extend(prometheus::core::Collector::collect(&collector));
    }

    fn family(&mut self, name: &str, help: &str, kind: MetricType) -> Values<'_> {
        let mut family = MetricFamily::default();
        family.set_name(name.to_owned());
        family.set_help(help.to_owned());
        family.set_field_type(kind);
        self.0.push(family);
        Values {
            families: &mut self.0,
            kind,
            metrics: Vec::new(),
        }
    }
}

/// The values of a metric. They are added when this is dropped.
pub(crate) struct Values<'a> {
    families: &'a mut Vec<MetricFamily>,
    kind: MetricType,
    metrics: Vec<Metric>,
}

impl Values<'_> {
    /// Adds the value with these labels.
    #[expect(
        clippy::cast_precision_loss,
        reason = "the text format has floating-point numbers"
    )]
    pub(crate) fn count(&mut self, labels: Labels<'_>, value: u64) {
        self.value(labels, value as f64);
    }

    /// Adds the value with these labels.
    pub(crate) fn value(&mut self, labels: Labels<'_>, value: f64) {
        let mut metric = labeled(labels);
        if self.kind == MetricType::COUNTER {
            let mut counter = Counter::default();
            counter.set_value(value);
            metric.set_counter(counter);
        } else {
            let mut gauge = Gauge::default();
            gauge.set_value(value);
            metric.set_gauge(gauge);
        }
        self.metrics.push(metric);
    }

    /// Adds the times with these labels.
    pub(crate) fn times(&mut self, labels: Labels<'_>, times: &DeliveryTimes) {
        let mut sum = 0_u64;
        let buckets = (0..BUCKETS).zip(times.buckets).map(|(number, letters)| {
            sum = sum.wrapping_add(letters);
            let mut bucket = Bucket::default();
            bucket.set_upper_bound(counts::bound(number).as_secs_f64());
            bucket.set_cumulative_count(sum);
            bucket
        });
        let mut histogram = Histogram::default();
        histogram.set_bucket(buckets.collect());
        histogram.set_sample_count(times.count);
        histogram.set_sample_sum(times.sum.as_secs_f64());
        let mut metric = labeled(labels);
        metric.set_histogram(histogram);
        self.metrics.push(metric);
    }
}

impl Drop for Values<'_> {
    fn drop(&mut self) {
        match self.families.last_mut() {
            Some(family) if !self.metrics.is_empty() => {
                family.set_metric(std::mem::take(&mut self.metrics));
            }
            // The text format has no metric without values.
            _ => drop(self.families.pop()),
        }
    }
}

fn labeled(labels: Labels<'_>) -> Metric {
    let labels = labels.iter().map(|(name, value)| {
        let mut label = LabelPair::default();
        label.set_name((*name).to_owned());
        label.set_value((*value).to_owned());
        label
    });
    let mut metric = Metric::default();
    metric.set_label(labels.collect());
    metric
}

/// Writes metrics as text.
///
/// # Errors
/// The reason why they have no text.
pub(super) fn text(families: &Families) -> Result<String, String> {
    let mut text = Vec::new();
    let written = TextEncoder::new().encode(&families.0, &mut text);
    written.map_err(|error| error.to_string())?;
    String::from_utf8(text).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

    use std::time::Duration;

    use super::*;

    #[test]
    fn metrics_have_their_text() {
        let mut families = Families::default();
        let mut peers = families.gauge("fipa_peer", "A peer.");
        peers.value(&[("host", "a\"\n\\b")], 0.5);
        drop(peers);
        drop(families.counter("fipa_none_total", "Without values."));
        let mut times = DeliveryTimes {
            count: 3,
            sum: Duration::from_millis(2500),
            ..Default::default()
        };
        times.buckets[1] = 2;
        families
            .histogram("fipa_delivery_seconds", "Times.")
            .times(&[("transport", "shm")], &times);
        let text = text(&families).unwrap();
        let mut lines = text.lines();
        assert_eq!(lines.next(), Some("# HELP fipa_peer A peer."));
        assert_eq!(lines.next(), Some("# TYPE fipa_peer gauge"));
        assert_eq!(lines.next(), Some("fipa_peer{host=\"a\\\"\\n\\\\b\"} 0.5"));
        assert!(!text.contains("fipa_none"));
        for line in [
            "fipa_delivery_seconds_bucket{transport=\"shm\",le=\"0.000001\"} 0",
            "fipa_delivery_seconds_bucket{transport=\"shm\",le=\"0.000004\"} 2",
            "fipa_delivery_seconds_bucket{transport=\"shm\",le=\"16.777216\"} 2",
            "fipa_delivery_seconds_bucket{transport=\"shm\",le=\"+Inf\"} 3",
            "fipa_delivery_seconds_sum{transport=\"shm\"} 2.5",
            "fipa_delivery_seconds_count{transport=\"shm\"} 3",
        ] {
            assert!(text.lines().any(|found| found == line), "{line}\n{text}");
        }
    }
}
