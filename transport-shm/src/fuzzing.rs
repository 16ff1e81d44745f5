//! Parts that the fuzz targets reach; `fuzz/` has the targets.

pub use crate::layout::fuzzing::{HEADER_LEN, VERSION, ack, header};
