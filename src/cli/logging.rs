//! What the long-running commands say while they run: on stderr, a line for each thing.

use std::io::IsTerminal as _;

use tracing_subscriber::EnvFilter;

/// Zenoh warns of settings that are meant, such as that nobody is found by gossip.
const DEFAULT: &str = "warn,zenoh=error,holdfast=info";

/// Starts it: our own news and others' warnings, or what the environment variable `RUST_LOG` asks for.
pub fn start() {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(DEFAULT));
    let lines = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_ansi(std::io::stderr().is_terminal())
        .with_writer(std::io::stderr);
    // An error says that it was started before.
    let _ = lines.try_init();
}
