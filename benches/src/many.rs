//! Large content for many receivers, beside its limit: the content written once, and a small letter to
//! each receiver.

use serde::Serialize;

use super::measure::{Effort, WARMING, median, quantile, times};
use super::part::{End, Event, Fill, Letters, Order, Part, Spread};
use super::stage::{ProcessIndex, Stage};

/// Number of receiving agents.
const RECEIVERS: usize = 32;
/// Length of the content, in bytes.
const SIZE: usize = 1 << 20;
/// Length of the content of a small letter, in bytes.
const SMALL: usize = 100;
/// Repetitions in a round.
const TIMES: usize = 8;

/// Median times in microseconds, until the sender has all outcomes.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Many {
    pub(super) receivers: usize,
    pub(super) size: usize,
    /// Memory loaned, written and returned.
    pub(super) fill_us: f64,
    /// One small message to all.
    pub(super) small_us: f64,
    /// One message to all, its content loaned and written.
    pub(super) together_us: f64,
    /// The content in a message of its own for each receiver.
    pub(super) copies_us: f64,
    /// Ratio of `together` to the sum of the first two: the median over all rounds.
    pub(super) ratio: f64,
    /// Middle half of these ratios.
    pub(super) ratio_spread: [f64; 2],
    /// Ratio of `copies` to `together`: the median over all rounds.
    pub(super) copies_ratio: f64,
}

/// Measures through shared memory between two processes that spin.
pub(super) async fn measure(stage: &mut Stage, effort: &Effort) -> Result<Many, String> {
    let settings = [
        "transport.shm.spin=1s",
        "mts.transports=shm",
        "transport.shm.capacity=1GiB",
    ]
    .map(str::to_owned);
    let crowd = Part::Crowd { count: RECEIVERS };
    let (receiver, pattern) = stage.start(&crowd, "many", &settings).await?;
    let part = Part::Agent {
        end: End::Sender,
        name: "sender".to_owned(),
    };
    let (sender, _) = stage.start(&part, "many", &settings).await?;
    let find = Order::Find { to: pattern };
    stage.tell(sender, &find).await?;
    stage.event(sender).await?;
    let all = [
        (Spread::Fill, SIZE),
        (Spread::Together, SMALL),
        (Spread::Together, SIZE),
        (Spread::Copies, SIZE),
    ];
    let mut rounds: [Vec<f64>; 4] = Default::default();
    for _ in 0..effort.rounds {
        for ((what, size), medians) in all.iter().zip(&mut rounds) {
            medians.push(turn(stage, Ends { sender, receiver }, *what, *size).await?);
        }
    }
    let [fill, small, together, copies] = &rounds;
    let sums = fill.iter().zip(small).map(|(fill, small)| fill + small);
    let pairs = together.iter().zip(sums);
    let ratios: Vec<f64> = pairs.map(|(together, sum)| together / sum).collect();
    let pairs = copies.iter().zip(together);
    let saved: Vec<f64> = pairs.map(|(copies, together)| copies / together).collect();
    let [fill_us, small_us, together_us, copies_us] =
        [fill, small, together, copies].map(|medians| median(medians) / 1e3);
    Ok(Many {
        receivers: RECEIVERS,
        size: SIZE,
        fill_us,
        small_us,
        together_us,
        copies_us,
        ratio: median(&ratios),
        ratio_spread: [0.25, 0.75].map(|at| quantile(&ratios, at)),
        copies_ratio: median(&saved),
    })
}

/// The two processes of a turn.
#[derive(Debug, Clone, Copy)]
struct Ends {
    sender: ProcessIndex,
    receiver: ProcessIndex,
}

/// The median of one turn, in nanoseconds.
async fn turn(stage: &mut Stage, ends: Ends, what: Spread, size: usize) -> Result<f64, String> {
    let Ends { sender, receiver } = ends;
    let letters = Letters {
        count: TIMES + WARMING,
        size,
        fill: Fill::Filled,
        window: 1,
        pause_us: 0,
    };
    let receives = what != Spread::Fill;
    if receives {
        stage.tell(receiver, &Order::Receive(letters)).await?;
        stage.event(receiver).await?;
    }
    stage.tell(sender, &Order::Spread { what, letters }).await?;
    let sent = stage.event(sender).await?;
    if receives {
        stage.event(receiver).await?;
    }
    match sent {
        Event::Sent { began, ended, .. } => Ok(median(&times(&began, &ended))),
        other => Err(format!("expected times, received {other:?}")),
    }
}
