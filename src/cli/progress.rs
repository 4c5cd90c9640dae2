//! A bar on stderr for what takes more than a moment.

use indicatif::{ProgressBar, ProgressStyle};

/// A bar of 1000 steps with a message; invisible where stderr is not a terminal.
pub fn bar() -> ProgressBar {
    let bar = ProgressBar::new(1000);
    let style = ProgressStyle::with_template("{bar:40} {percent:>3} % {msg} ({eta} left)");
    bar.set_style(style.expect("the template is valid"));
    bar
}
