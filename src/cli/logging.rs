//! What the long-running commands say while they run: on stderr, a line for each thing.

use tracing_subscriber::EnvFilter;

/// Starts it: our own news and others' warnings, or what the environment variable `RUST_LOG` asks for.
pub fn start() {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn,holdfast=info"));
    let lines = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    // An error says that it was started before.
    let _ = lines.try_init();
}
