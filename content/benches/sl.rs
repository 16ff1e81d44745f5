//! Compares SL and JSON: this crate and serde_json write and read the same values in one run.
//!
//! Only the ratio of both is meaningful. Absolute times depend on the machine.

use std::collections::BTreeMap;
use std::hint::black_box;
use std::time::Duration;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use fipa_content::{Printer, Term, from_slice, to_vec};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename = "pose")]
struct Pose {
    x: f64,
    y: f64,
    yaw: f64,
    frame: Option<String>,
}

/// The goal of an action.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Goal {
    Dock {
        target: Pose,
        speed: f64,
        retries: u8,
        backwards: bool,
    },
}

/// An action that a robot offers.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename = "action-description", rename_all = "kebab-case")]
struct Description {
    name: String,
    description: String,
    parameters: Vec<Parameter>,
    labels: BTreeMap<String, String>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename = "parameter-description", rename_all = "kebab-case")]
struct Parameter {
    name: String,
    unit: Option<String>,
    minimum: Option<f64>,
    maximum: Option<f64>,
}

fn pose(index: u32) -> Pose {
    let index = f64::from(index);
    Pose {
        x: index * 0.37 - 11.25,
        y: (index * 0.71).sin(),
        yaw: index / 7.0,
        frame: Some("sherpa/emi_2".to_owned()),
    }
}

fn description(index: u32) -> Description {
    let parameter = |name: &str, unit: Option<&str>| Parameter {
        name: name.to_owned(),
        unit: unit.map(str::to_owned),
        minimum: Some(0.0),
        maximum: Some(f64::from(index) + 0.5),
    };
    Description {
        name: format!("dock-{index}"),
        description: "Drives to the dock in front of the target and connects \"gently\".".into(),
        parameters: vec![parameter("speed", Some("m/s")), parameter("retries", None)],
        labels: BTreeMap::from([("vendor".into(), "DFKI".into())]),
    }
}

/// Measures writing and reading of the value, and of a tree of it.
fn measure<T: Serialize + DeserializeOwned>(criterion: &mut Criterion, name: &str, value: &T) {
    let sl = to_vec(value).expect("SL");
    let json = serde_json::to_vec(value).expect("JSON");
    let mut group = criterion.benchmark_group(name);
    group.bench_function(BenchmarkId::new("write value", "JSON"), |bench| {
        bench.iter(|| serde_json::to_vec(black_box(value)));
    });
    group.bench_function(BenchmarkId::new("write value", "SL"), |bench| {
        bench.iter(|| to_vec(black_box(value)));
    });
    group.bench_function(BenchmarkId::new("read value", "JSON"), |bench| {
        bench.iter(|| serde_json::from_slice::<T>(black_box(&json)));
    });
    group.bench_function(BenchmarkId::new("read value", "SL"), |bench| {
        bench.iter(|| from_slice::<T>(black_box(&sl)));
    });
    group.bench_function(BenchmarkId::new("parse tree", "JSON"), |bench| {
        bench.iter(|| serde_json::from_slice::<serde_json::Value>(black_box(&json)));
    });
    group.bench_function(BenchmarkId::new("parse tree", "SL"), |bench| {
        bench.iter(|| Term::parse(black_box(&sl)).is_ok());
    });
    let term = Term::parse(&sl).expect("SL").into_owned();
    let tree: serde_json::Value = serde_json::from_slice(&json).expect("JSON");
    group.bench_function(BenchmarkId::new("print tree", "JSON"), |bench| {
        bench.iter(|| serde_json::to_vec(black_box(&tree)));
    });
    group.bench_function(BenchmarkId::new("print tree", "SL"), |bench| {
        bench.iter(|| Printer::new().print(black_box(&term)));
    });
    group.finish();
}

fn sl(criterion: &mut Criterion) {
    let goal = Goal::Dock {
        target: pose(3),
        speed: 0.25,
        retries: 3,
        backwards: false,
    };
    measure(criterion, "goal", &goal);
    let path: Vec<_> = (0..1000).map(pose).collect();
    measure(criterion, "path of 1000 poses", &path);
    let offers: Vec<_> = (0..100).map(description).collect();
    measure(criterion, "100 descriptions", &offers);
}

criterion_group! {
    name = benches;
    config = Criterion::default()
        .warm_up_time(Duration::from_millis(200))
        .measurement_time(Duration::from_millis(800));
    targets = sl
}
criterion_main!(benches);
