//! The header says what the library has.

use std::path::Path;
use std::{env, fs};

#[test]
fn the_header_is_that_of_the_sources() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let config = cbindgen::Config::from_root_or_default(here);
    let mut made = Vec::new();
    cbindgen::Builder::new()
        .with_crate(here)
        .with_config(config)
        .generate()
        .expect("cbindgen reads the sources")
        .write(&mut made);
    let made = String::from_utf8(made).expect("the header is UTF-8");
    let header = here.join("include/fipa.h");
    if env::var_os("FIPA_BLESS").is_some() {
        fs::write(&header, &made).expect("the header can be written");
    }
    let committed = fs::read_to_string(&header).unwrap_or_default();
    assert!(
        made == committed,
        "include/fipa.h differs from the sources; run this test with FIPA_BLESS=1"
    );
}
