//! The command line: one file a command, each a set of arguments and a function that runs it.

#[cfg(feature = "shells")]
pub mod machine;
mod progress;
pub mod simulate;
