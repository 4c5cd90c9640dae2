//! The command line: one file a command, each a set of arguments and a function that runs it.

#[cfg(feature = "shells")]
pub mod demo;
mod progress;
pub mod simulate;
#[cfg(feature = "shells")]
pub mod site;
