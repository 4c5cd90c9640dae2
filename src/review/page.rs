//! The page of a session.

use jiff::Timestamp;

use super::words::{length, span};
use super::{Latency, Review};
use crate::evaluate::report::{Axis, Band, Page, Plot, Scale, Series, Style, Table, figure};
use crate::replay::Distribution;
use crate::state::{GnssState, Mode};

/// One page for all runs of a session.
pub fn page(title: &str, reviews: &[Review]) -> Page {
    let mut page = Page::new(title);
    page.text(
        "What the machines' own sensors say of this session. There is no survey to hold it against: the session was \
         solved once more as a whole, and the live positions are judged by that. What misleads all sensors alike shows \
         in neither.",
    );
    for review in reviews {
        machine(&mut page, review);
    }
    page
}

fn machine(page: &mut Page, review: &Review) {
    let name = &review.machine;
    page.heading(&format!("{name}: in short"));
    if let Some(begin) = date(review.begin_s) {
        page.text(&format!("From {begin}, for {}.", span(review.span_s)));
    }
    review.in_short.iter().for_each(|sentence| {
        page.text(sentence);
    });
    page.heading(&format!("{name}: what to look at"));
    if review.look_at.is_empty() {
        page.text("Nothing stood out.");
    }
    review.look_at.iter().for_each(|sentence| {
        page.text(sentence);
    });
    page.heading(&format!("{name}: coverage"));
    page.table(coverage(review)).plot(sigma_plot(review)).table(sensors(review));
    page.heading(&format!("{name}: outages of GNSS"));
    if review.outages.is_empty() {
        page.text("None.");
    } else {
        page.table(outages(review));
    }
    if review.gain.is_some() {
        page.heading(&format!("{name}: live against the whole session"));
        page.table(gain(review)).plot(gain_plot(review));
    }
    page.heading(&format!("{name}: innovations"));
    page.table(innovations(review)).plot(innovation_plot(review));
    page.heading(&format!("{name}: consistency of prediction and update"));
    page.table(consistency(review)).plot(moved_plot(review));
    page.heading(&format!("{name}: latency"));
    page.table(latency(review));
}

/// Of a stamp since 1970; none of one that counts from elsewhere.
fn date(begin_s: f64) -> Option<String> {
    let begin = Timestamp::from_second(begin_s as i64).ok().filter(|_| begin_s > 1e9)?;
    Some(begin.strftime("%Y-%m-%d %H:%M:%S UTC").to_string())
}

fn coverage(review: &Review) -> Table {
    let mut table = Table::new("What the position rested on", &["", "time", "of the session, %"]);
    for share in &review.coverage {
        let name = match share.mode {
            Mode::Main => "satellites (main)",
            Mode::Fallback => "lidar and IMU (fallback)",
            Mode::ImuOnly => "IMU alone (imu_only)",
            Mode::Initializing => "unknown (before the start, between two starts)",
        };
        table.row(name, &[span(share.time_s), format!("{:.1}", share.percent)]);
    }
    table
}

fn sensors(review: &Review) -> Table {
    let header = ["", "readings", "rate, Hz", "silences", "longest", "refused, %", "delay, ms", "99 %, ms"];
    let mut table = Table::new("Sensors", &header);
    for sensor in &review.sensors {
        let delay = |of: fn(&Distribution) -> f64| {
            sensor.delay_us.as_ref().map_or("–".to_owned(), |delay| figure(of(delay) / 1e3))
        };
        let refused = 100.0 * sensor.refused as f64 / sensor.readings.max(1) as f64;
        table.row(
            sensor.sensor,
            &[
                sensor.readings.to_string(),
                format!("{:.1}", sensor.rate_hz),
                sensor.silences.to_string(),
                if sensor.silences > 0 { span(sensor.longest_silence_s) } else { "–".to_owned() },
                format!("{refused:.2}"),
                delay(|delay| delay.p50),
                delay(|delay| delay.p99),
            ],
        );
        if let Some(why) = &sensor.last_refusal {
            table.note(&format!("{}: last refused since it {why}", sensor.sensor));
        }
    }
    table.note("A silence is longer than five periods and a fifth of a second. Delay: from the stamp to the arrival.");
    table
}

fn outages(review: &Review) -> Table {
    let header = ["", "length", "why", "way", "live off by at most", "corrected by"];
    let mut table = Table::new("Times without satellites", &header);
    for outage in &review.outages {
        let why = match outage.cause {
            GnssState::Silent => "no fixes",
            GnssState::Frozen => "fixes froze",
            GnssState::Degraded => "receiver unsure",
            GnssState::Jumping => "fixes contradict",
            GnssState::Fixed | GnssState::Recovering => "fixes on trial",
        };
        let told = |length_m: Option<f64>| length_m.map_or("–".to_owned(), length);
        let corrected = if outage.ended { told(outage.jump_m) } else { "goes on".to_owned() };
        table.row(
            &format!("after {}", span(outage.start_s)),
            &[
                span(outage.end_s - outage.start_s),
                why.to_owned(),
                length(outage.travelled_m),
                told(outage.live_off_m),
                corrected,
            ],
        );
    }
    table
}

fn gain(review: &Review) -> Table {
    let header = [
        "",
        "samples",
        "ground RMS, cm",
        "95 %, cm",
        "max, cm",
        "height RMS, cm",
        "heading RMS, °",
        "live sigma, cm",
        "whole, cm",
    ];
    let mut table = Table::new("How far the live position was from the whole session", &header);
    for part in review.gain.iter().flat_map(|gain| &gain.parts) {
        let cm = |metres: f64| figure(100.0 * metres);
        table.row(
            part.name,
            &[
                part.samples.to_string(),
                cm(part.horizontal_m.rmse),
                cm(part.horizontal_m.p95),
                cm(part.horizontal_m.max),
                cm(part.vertical_m.rmse),
                figure(part.heading_deg.rmse),
                cm(part.live_sigma_m),
                cm(part.smoothed_sigma_m),
            ],
        );
    }
    table.note("Sigma: what each said of its own error across the ground, one standard deviation.");
    table
}

fn innovations(review: &Review) -> Table {
    let innovations = &review.innovations;
    let mut table = Table::new("How well fixes fitted what was expected", &["", "value"]);
    let mut row = |name: &str, value: String| table.row(name, &[value]);
    row("seconds with tested fixes", innovations.seconds.to_string());
    row("worst fix of a second, median, part of the limit", figure(innovations.median_ratio));
    row("the same, 95 % are smaller", figure(innovations.p95_ratio));
    row("seconds with a fix beyond the limit, %", figure(innovations.beyond_percent));
    row("receiver's sigma multiplied by at most, ground", figure(innovations.inflation[0]));
    row("the same, height", figure(innovations.inflation[1]));
    let odd = innovations.weighted_down_percent.map_or("–".to_owned(), figure);
    row("believed fixes that the whole session finds odd, %", odd);
    table
}

fn consistency(review: &Review) -> Table {
    let mut table = Table::new("How far an update moves the predicted position", &["", "cm"]);
    match &review.consistency_cm {
        None => table.note("There were no updates."),
        Some(moved) => {
            let rows = [("mean", moved.mean), ("RMS", moved.rmse), ("median", moved.median)];
            for (name, value) in
                rows.into_iter().chain([("95 % are smaller", moved.p95), ("largest", moved.max)])
            {
                table.row(name, &[figure(value)]);
            }
        }
    }
    table
}

fn latency(review: &Review) -> Table {
    let Latency { stamp_to_sent_us, sent_to_recorded_us, prediction_us, update_us, .. } = &review.latency;
    let mut table = Table::new("How late things were, ms", &["", "mean", "median", "99 %", "largest"]);
    let spread = |told: &Option<Distribution>| match told {
        None => ["–"; 4].map(str::to_owned),
        Some(told) => [told.mean, told.p50, told.p99, told.max].map(|micros| figure(micros / 1e3)),
    };
    table.row("from an IMU sample to the sending of its pose", &spread(stamp_to_sent_us));
    table.row("from the sending to the recorder", &spread(sent_to_recorded_us));
    let two = |told: &Option<[f64; 2]>, most_is_p99: bool| {
        let Some([mean, most]) = told else { return ["–"; 4].map(str::to_owned) };
        let (mean, most) = (figure(mean / 1e3), figure(most / 1e3));
        let none = "–".to_owned();
        if most_is_p99 { [mean, none.clone(), most, none] } else { [mean, none.clone(), none, most] }
    };
    table.row("on the machine: from an IMU sample to its estimate", &two(prediction_us, true));
    table.row("on the machine: an update", &two(update_us, false));
    table.note("A dash: the recording does not tell. The 99 % on the machine are those of its worst second.");
    table
}

fn bands(review: &Review) -> Vec<Band> {
    let band = |outage: &super::OutageReview| Band {
        from: outage.start_s / 60.0,
        to: outage.end_s / 60.0,
        label: "no GNSS".to_owned(),
    };
    review.outages.iter().map(band).collect()
}

fn over_time(review: &Review, title: &str, description: &str, y: Axis, series: Vec<Series>) -> Plot {
    Plot {
        title: title.to_owned(),
        description: description.to_owned(),
        x: Axis::new("time since the first reading, min"),
        y,
        series,
        bands: bands(review),
    }
}

fn of_seconds(review: &Review, value: impl Fn(&super::Second) -> Option<f64>) -> Vec<(f64, f64)> {
    let point = |second: &super::Second| (second.at_s / 60.0, value(second).unwrap_or(f64::NAN));
    review.seconds.iter().map(point).collect()
}

fn sigma_plot(review: &Review) -> Plot {
    let points = of_seconds(review, |second| Some(100.0 * second.position_sigma_m?));
    over_time(
        review,
        "How sure the live position was",
        "One standard deviation of the position across the ground, as the machine told it. It grows while there are no \
         satellites (shaded).",
        Axis::scaled("sigma, cm", Scale::Logarithmic(0.01, 1000.0)),
        vec![Series::new("live", Style::Ours, points)],
    )
}

fn gain_plot(review: &Review) -> Plot {
    let points = review.gain.as_ref().map_or(&[][..], |gain| &gain.points);
    let line = |value: fn(&crate::reference::Point) -> f64| -> Vec<(f64, f64)> {
        points.iter().map(|point| ((point.t_s - review.begin_s) / 60.0, 100.0 * value(point))).collect()
    };
    let at_most = points.iter().map(|point| 100.0 * point.horizontal_m).fold(0.0, f64::max);
    over_time(
        review,
        "How far the live position was from the whole session",
        &format!(
            "Distance across the ground between the live position and that of the whole session, at most {at_most:.1} cm, \
             beside what the live estimate said of its own error."
        ),
        Axis::scaled("distance, cm", Scale::Logarithmic(0.01, 1000.0)),
        vec![
            Series::new("live said: one sigma", Style::Truth, line(|point| point.live_sigma_m)),
            Series::new("live less whole session", Style::Ours, line(|point| point.horizontal_m)),
        ],
    )
}

fn innovation_plot(review: &Review) -> Plot {
    over_time(
        review,
        "Worst fix of each second",
        "How far the worst fix of each second was from where it was expected, as a part of the limit of what is believed. \
         What is above 1 was refused.",
        Axis::scaled("part of the limit", Scale::Logarithmic(0.001, 100.0)),
        vec![Series::new("worst fix", Style::Ours, of_seconds(review, |second| second.test_ratio))],
    )
}

fn moved_plot(review: &Review) -> Plot {
    over_time(
        review,
        "Moves of the predicted position by updates",
        "The largest of each second. A jump at the end of a time without satellites is what had gathered meanwhile.",
        Axis::scaled("moved, cm", Scale::Logarithmic(0.001, 1000.0)),
        vec![Series::new(
            "largest of a second",
            Style::Ours,
            of_seconds(review, |second| Some(second.moved_cm)),
        )],
    )
}
