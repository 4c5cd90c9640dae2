//! A bar on stderr for what takes more than two seconds: how far, how fast, how long yet. Nothing where stderr is
//! no terminal.

use std::io::{IsTerminal, Write as _};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// What takes no longer gets no bar.
const WORTH_A_BAR: Duration = Duration::from_secs(2);
/// How long it takes is guessed from then on.
const FIRST_GUESS: Duration = Duration::from_millis(500);
/// Between two looks of the bar.
const REDRAW: Duration = Duration::from_millis(100);
/// Steps of the bar.
const STEPS: u64 = 1_000;

/// What is counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unit {
    /// Bytes of a file.
    Bytes,
    /// Seconds of data; the rate is in times real time.
    DataSeconds,
    /// Things of this name, such as poses.
    Count(&'static str),
}

/// The progress of one piece of work.
pub struct Progress {
    what: String,
    unit: Unit,
    begun: Instant,
    drawn: Instant,
    bar: Option<ProgressBar>,
    quiet: bool,
}

impl Progress {
    /// Begins; `what` is done stands before the bar, such as `reading`.
    pub fn new(what: &str, unit: Unit) -> Self {
        let now = Instant::now();
        let quiet = !std::io::stderr().is_terminal();
        Self { what: what.to_owned(), unit, begun: now, drawn: now, bar: None, quiet }
    }

    /// Tells how much of the whole is done. To be called often.
    pub fn show(&mut self, done: f64, whole: f64) {
        if self.quiet || self.drawn.elapsed() < REDRAW {
            return;
        }
        self.drawn = Instant::now();
        let elapsed = self.begun.elapsed();
        let fraction = if whole > 0.0 { (done / whole).clamp(0.0, 1.0) } else { 0.0 };
        if self.bar.is_none() && !worth_a_bar(elapsed, fraction) {
            return;
        }
        let bar = self.bar.get_or_insert_with(|| {
            let bar = ProgressBar::with_draw_target(Some(STEPS), ProgressDrawTarget::stderr());
            let style = ProgressStyle::with_template("{prefix} {bar:30} {percent:>3} % {msg}");
            bar.set_style(style.expect("the template is valid"));
            bar.set_prefix(self.what.clone());
            bar
        });
        bar.set_message(message(done, whole, elapsed.as_secs_f64(), self.unit));
        bar.set_position((fraction * STEPS as f64) as u64);
    }

    /// Writes a line of results to stdout, past the bar.
    ///
    /// # Errors
    /// The line cannot be written.
    pub fn say(&self, line: &str) -> std::io::Result<()> {
        let write = || writeln!(std::io::stdout(), "{line}");
        match &self.bar {
            Some(bar) => bar.suspend(write),
            None => write(),
        }
    }

    /// Takes the bar away.
    pub fn finish(self) {
        drop(self);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// Whether it takes, or will take, long enough.
fn worth_a_bar(elapsed: Duration, fraction: f64) -> bool {
    let whole_s = elapsed.as_secs_f64() / fraction.max(1e-9);
    elapsed >= WORTH_A_BAR || (elapsed >= FIRST_GUESS && whole_s >= WORTH_A_BAR.as_secs_f64())
}

/// Such as `12 of 45 MB, 30 MB/s, 2 s left`.
fn message(done: f64, whole: f64, elapsed_s: f64, unit: Unit) -> String {
    let rate = done / elapsed_s.max(1e-9);
    let so_far = match unit {
        Unit::Bytes => {
            let mega = |bytes: f64| bytes / 1e6;
            format!("{:.0} of {:.0} MB, {:.1} MB/s", mega(done), mega(whole), mega(rate))
        }
        Unit::Count(things) => format!("{done:.0} of {whole:.0} {things}, {rate:.0} a second"),
        Unit::DataSeconds => format!("{done:.0} of {whole:.0} s, {rate:.1} times real time"),
    };
    if rate > 0.0 { format!("{so_far}, {} left", span((whole - done).max(0.0) / rate)) } else { so_far }
}

fn span(seconds: f64) -> String {
    let seconds = seconds.round() as u64;
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3_600 => format!("{} min {} s", seconds / 60, seconds % 60),
        _ => format!("{} h {} min", seconds / 3_600, seconds / 60 % 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn message_tells_how_far_how_fast_and_how_long_yet() {
        assert_eq!(message(30e6, 90e6, 2.0, Unit::Bytes), "30 of 90 MB, 15.0 MB/s, 4 s left");
        let text = message(10.0, 4_000.0, 1.0, Unit::DataSeconds);
        assert_eq!(text, "10 of 4000 s, 10.0 times real time, 6 min 39 s left");
        assert!(message(1.0, 10_000.0, 1.0, Unit::DataSeconds).ends_with("2 h 46 min left"));
        assert_eq!(message(0.0, 1e6, 3.0, Unit::Bytes), "0 of 1 MB, 0.0 MB/s");
    }

    #[test]
    fn what_ends_within_two_seconds_gets_no_bar() {
        let at = Duration::from_millis;
        assert!(!worth_a_bar(at(400), 0.01));
        assert!(!worth_a_bar(at(600), 0.5));
        assert!(worth_a_bar(at(600), 0.2));
        assert!(worth_a_bar(at(2_000), 0.99));
        assert!(worth_a_bar(at(600), 0.0));
    }
}
