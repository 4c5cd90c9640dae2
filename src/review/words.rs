//! What the figures mean, in sentences for those who run a site.

use super::Review;
use crate::reference::Part;
use crate::state::{GnssState, Mode};

/// Beyond these, something is worth a look: silence and refusals in percent, an outage in s, an inflation, a delay in s,
/// a fix in the whole solution that counts less in percent.
const SILENT_PERCENT: f64 = 1.0;
const REFUSED_PERCENT: f64 = 5.0;
const OUTAGE_S: f64 = 60.0;
const INFLATION: f64 = 2.0;
const DELAY_S: f64 = 0.5;
const ODD_PERCENT: f64 = 2.0;
/// A start that takes longer is worth a word, s.
const START_S: f64 = 60.0;

/// What to know first.
pub(super) fn in_short(review: &Review) -> Vec<String> {
    let mut sentences = Vec::new();
    let percent = |wanted: Mode| {
        review.coverage.iter().find(|share| share.mode == wanted).map_or(0.0, |share| share.percent)
    };
    sentences.push(format!(
        "In {} the position was known for {:.1} % of the time: {:.1} % with satellites, {:.1} % held without them by lidar and IMU, {:.1} % by the IMU alone.",
        span(review.span_s),
        100.0 - percent(Mode::Initializing),
        percent(Mode::Main),
        percent(Mode::Fallback),
        percent(Mode::ImuOnly),
    ));
    let longest =
        review.outages.iter().max_by(|a, b| (a.end_s - a.start_s).total_cmp(&(b.end_s - b.start_s)));
    match longest {
        None => sentences.push("Satellites were never lost.".to_owned()),
        Some(longest) => {
            let all: f64 = review.outages.iter().map(|outage| outage.end_s - outage.start_s).sum();
            let judged: Vec<f64> = review.outages.iter().filter_map(|outage| outage.live_off_m).collect();
            let off = judged.iter().copied().max_by(f64::total_cmp).map_or_else(String::new, |off| {
                let when = match judged.len() == review.outages.len() {
                    true => "Meanwhile".to_owned(),
                    false => format!("In the {} of these that can be judged", judged.len()),
                };
                format!(" {when} the position was off by {} at most.", length(off))
            });
            let lost = match review.outages.len() {
                1 => format!("once, for {}", span(all)),
                count => format!(
                    "{}, for {} in all and {} at most",
                    times(count),
                    span(all),
                    span(longest.end_s - longest.start_s)
                ),
            };
            sentences.push(format!("Satellites were lost {lost}.{off}"));
        }
    }
    if let Some(all) = review.gain.as_ref().and_then(|gain| gain.parts.first()) {
        sentences.push(judged(all));
    }
    if let Some(why) = &review.not_smoothed {
        sentences.push(format!("The session cannot be judged as a whole: it {why}."));
    }
    if let Some(moved) = &review.consistency_cm {
        sentences.push(format!(
            "New measurements moved the position that was predicted by {} on average, and by less than {} in 95 of 100 cases.",
            length(moved.mean / 100.0),
            length(moved.p95 / 100.0)
        ));
    }
    match review.restarts.len() {
        0 => {}
        count => sentences.push(format!("The estimate had to begin anew {}.", times(count))),
    }
    sentences
}

fn judged(all: &Part) -> String {
    format!(
        "Judged by the whole session, which also knows what came later, the live position was right to {} across the ground in 95 of 100 cases and to {} always; its height to {}, its heading to {:.2}° in 95 of 100.",
        length(all.horizontal_m.p95),
        length(all.horizontal_m.max),
        length(all.vertical_m.p95),
        all.heading_deg.p95
    )
}

/// What stood out.
pub(super) fn look_at(review: &Review) -> Vec<String> {
    let mut sentences: Vec<String> =
        review.lost.iter().map(|lost| format!("Part of the recording is missing: {lost}.")).collect();
    for part in &review.unsure {
        let when = format!("From {} to {} after the start", span(part.start_s), span(part.end_s));
        sentences.push(match &part.why_unsolved {
            Some(why) => {
                format!("{when} the session has no solution as a whole and nothing is judged: it {why}.")
            }
            None => {
                format!("{when} the solution of the whole session is not final, nor is what is judged by it.")
            }
        });
    }
    let start_s =
        review.seconds.iter().find(|second| second.position_sigma_m.is_some()).map(|second| second.at_s);
    if let Some(start_s) = start_s.filter(|start_s| *start_s > START_S) {
        sentences.push(format!(
            "The position was known only after {}. Leave the machine at rest under open sky for some seconds after switching it on.",
            span(start_s)
        ));
    }
    for outage in review.outages.iter().filter(|outage| outage.end_s - outage.start_s > OUTAGE_S) {
        let why = match outage.cause {
            GnssState::Silent => "no fixes came: look at the receiver, its cable and its correction data",
            GnssState::Frozen => "fixes did not change while the machine moved: look at the receiver",
            GnssState::Degraded => "the receiver said itself that it is unsure: sky view or correction data",
            _ => {
                "fixes contradicted each other or the motion: reflections, as beside walls, or wrong correction data"
            }
        };
        sentences.push(format!(
            "From {} to {} after the start satellites did not help: {why}.",
            span(outage.start_s),
            span(outage.end_s)
        ));
    }
    for sensor in &review.sensors {
        let name = sensor.sensor;
        if 100.0 * sensor.silent_s > SILENT_PERCENT * review.span_s {
            let at_most = match sensor.silences {
                1 => String::new(),
                _ => format!(" in all and {} at most", span(sensor.longest_silence_s)),
            };
            let count = times(sensor.silences as usize);
            sentences.push(format!("{name} was silent {count}, for {}{at_most}.", span(sensor.silent_s)));
        }
        let refused = 100.0 * sensor.refused as f64 / sensor.readings.max(1) as f64;
        if refused > REFUSED_PERCENT {
            let why =
                sensor.last_refusal.as_ref().map_or(String::new(), |why| format!(", at last since it {why}"));
            sentences.push(format!("{refused:.0} % of the readings of {name} were refused{why}."));
        }
        if let Some(delay) = sensor.delay_us.filter(|delay| delay.p99 > 1e6 * DELAY_S) {
            sentences.push(format!(
                "{name} arrives late: 1 of 100 readings after {:.1} s or more. Look at its clock and its line.",
                delay.p99 / 1e6
            ));
        }
    }
    let [horizontal, vertical] = review.innovations.inflation;
    if horizontal.max(vertical) > INFLATION {
        sentences.push(format!(
            "The receiver is surer of itself than it should be: its error bounds had to be multiplied by up to {horizontal:.1} across the ground and {vertical:.1} in height."
        ));
    }
    if let Some(odd) = review.innovations.weighted_down_percent.filter(|odd| *odd > ODD_PERCENT) {
        sentences
            .push(format!("{odd:.1} % of the fixes that were believed do not fit the session as a whole."));
    }
    for restart in &review.restarts {
        sentences.push(format!(
            "{} after the start the estimate began anew: {}.",
            span(restart.at_s),
            restart.what
        ));
    }
    if review.latency.recorded_before_sent > 0 {
        sentences.push(
            "Messages were recorded before they were sent: the clocks of machine and recorder differ."
                .to_owned(),
        );
    }
    sentences
}

fn times(count: usize) -> String {
    match count {
        1 => "once".to_owned(),
        2 => "twice".to_owned(),
        count => format!("{count} times"),
    }
}

/// A span as people say it.
pub(super) fn span(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..10 => format!("{seconds:.1} s"),
        10..120 => format!("{whole} s"),
        120..7_200 => format!("{} min {} s", whole / 60, whole % 60),
        _ => format!("{} h {} min", whole / 3_600, whole / 60 % 60),
    }
}

/// A length as people say it.
pub(super) fn length(metres: f64) -> String {
    match metres.abs() {
        size if size < 0.00095 => format!("{:.1} mm", 1e3 * metres),
        size if size < 0.0095 => format!("{:.0} mm", 1e3 * metres),
        size if size < 0.995 => format!("{:.1} cm", 1e2 * metres),
        _ => format!("{metres:.2} m"),
    }
}
