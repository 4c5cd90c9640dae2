//! The command line: one file a command, each a set of arguments and a function that runs it.

pub mod evaluate;
mod progress;
pub mod simulate;
