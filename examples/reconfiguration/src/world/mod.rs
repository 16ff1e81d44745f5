//! The process of the world: it has the truth about all poses. Robots and items reach it as their hardware.

mod bodies;
mod server;

pub use self::bodies::World;
pub use self::server::run;
