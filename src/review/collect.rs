//! What is noted along a run.

use super::{Innovations, Latency, OutageReview, Review, Second, SensorReview, Share, Told, Unsure, words};
use crate::estimator::Estimator;
use crate::evaluate::Statistics;
use crate::reference::{Gain, Smoothed, SolvedChain, Step};
use crate::replay::Times;
use crate::sensors::{Arrival, Sensor};
use crate::state::{Estimate, Event, EventKind, Health, Mode, OutageReport};
use crate::time::{Span, Stamp};

/// Health is looked at so often.
const LOOK_EVERY: Span = Span::from_millis(1_000);
/// A silence is longer than so many periods, and than this.
const SILENT_PERIODS: f64 = 5.0;
const SILENT_S: f64 = 0.2;
/// The usual period is first the median of so many gaps.
const FIRST_GAPS: usize = 5;
/// No sensor speaks less often, s: two readings further apart than that tell nothing of a period.
const PERIOD_MAX_S: f64 = 2.0;
/// Estimates further apart than this are not one stretch of knowing, s.
const STRETCH_S: f64 = 0.5;

/// Notes what [`crate::reference::forward`] tells.
#[derive(Default)]
pub struct Collector {
    begin: Option<Stamp>,
    end: Stamp,
    sensors: [Track; Sensor::ALL.len()],
    by_mode: [f64; 3],
    last_estimate: Option<Stamp>,
    next_look: Option<Stamp>,
    seconds: Vec<Second>,
    moved_cm: Vec<f64>,
    /// Of this second.
    moved_most_cm: f64,
    outages: Vec<OutageReport>,
    restarts: Vec<(Stamp, String)>,
    inflation: [f64; 2],
    health: Option<Health>,
}

#[derive(Default)]
struct Track {
    readings: u64,
    last: Option<Stamp>,
    /// The first gaps between readings, s: what is usual is not known yet.
    first_gaps_s: Vec<f64>,
    /// Between readings that are no silence apart: sum, s, and how many.
    periods: (f64, u64),
    silences: (f64, u64, f64),
    delay: Times,
    /// Whether any arrived later than its stamp.
    delayed: bool,
}

impl Track {
    fn note_gap(&mut self, gap_s: f64) {
        let (sum, count) = self.periods;
        if count > 0 {
            self.judge_gap(gap_s, sum / count as f64);
        } else if gap_s > 0.0 {
            self.first_gaps_s.push(gap_s);
            if self.first_gaps_s.len() >= FIRST_GAPS {
                self.judge_first_gaps();
            }
        }
    }

    /// By their median, so that a silence among them does not pass for the usual.
    fn judge_first_gaps(&mut self) {
        let gaps_s = std::mem::take(&mut self.first_gaps_s);
        let mut sorted = gaps_s.clone();
        sorted.sort_by(f64::total_cmp);
        let Some(median_s) = sorted.get(sorted.len().saturating_sub(1) / 2) else { return };
        gaps_s.iter().for_each(|gap_s| self.judge_gap(*gap_s, median_s.min(PERIOD_MAX_S)));
    }

    fn judge_gap(&mut self, gap_s: f64, usual_s: f64) {
        if gap_s > SILENT_S.max(SILENT_PERIODS * usual_s) {
            self.silences.0 += gap_s;
            self.silences.1 += 1;
            self.silences.2 = self.silences.2.max(gap_s);
        } else if gap_s > 0.0 {
            self.periods = (self.periods.0 + gap_s, self.periods.1 + 1);
        }
    }
}

const MODES: [Mode; 3] = [Mode::Main, Mode::Fallback, Mode::ImuOnly];

impl Collector {
    /// One step of the run.
    pub fn note(&mut self, step: Step<'_>, estimator: &Estimator) {
        match step {
            Step::Taken(arrival, estimate) => {
                self.note_arrival(arrival);
                estimate.into_iter().for_each(|estimate| self.note_estimate(estimate));
                let now = arrival.arrival;
                if self.next_look.is_none_or(|next| now >= next) {
                    self.next_look = Some(now + LOOK_EVERY);
                    self.look(now, estimator.health());
                }
            }
            Step::Corrected(_, correction) => {
                if let Some(correction_m) = correction.correction_m {
                    self.moved_cm.push(100.0 * correction_m);
                    self.moved_most_cm = self.moved_most_cm.max(100.0 * correction_m);
                }
            }
            Step::Told(event) => self.note_event(event),
            Step::Ended => self.health = Some(estimator.health()),
        }
    }

    fn note_arrival(&mut self, arrival: &Arrival) {
        self.begin.get_or_insert(arrival.arrival);
        self.end = arrival.arrival;
        let (stamp, track) = (arrival.reading.stamp(), &mut self.sensors[arrival.reading.sensor() as usize]);
        track.readings += 1;
        track.delayed |= arrival.arrival > stamp;
        if let Ok(nanos) = u64::try_from((arrival.arrival - stamp).as_nanos()) {
            track.delay.note(nanos);
        }
        let Some(last) = track.last.replace(stamp) else { return };
        track.note_gap(stamp.seconds_since(last));
    }

    fn note_estimate(&mut self, estimate: &Estimate) {
        let Some(last) = self.last_estimate.replace(estimate.stamp) else { return };
        let since_s = estimate.stamp.seconds_since(last);
        if let Some(place) = MODES.iter().position(|mode| *mode == estimate.mode)
            && (0.0..=STRETCH_S).contains(&since_s)
        {
            self.by_mode[place] += since_s;
        }
    }

    fn note_event(&mut self, event: &Event) {
        match &event.what {
            EventKind::OutageEnded(report) => self.outages.push(report.clone()),
            EventKind::Restarted { reason } => {
                self.restarts.push((Stamp::from_nanos(event.stamp_ns), reason.clone()));
            }
            _ => {}
        }
    }

    fn look(&mut self, now: Stamp, health: Health) {
        let begin = self.begin.unwrap_or(now);
        self.seconds.push(Second {
            at_s: now.seconds_since(begin),
            position_sigma_m: health.position_sigma_m,
            test_ratio: health.worst_test_sensor.map(|_| health.worst_test_ratio),
            moved_cm: std::mem::take(&mut self.moved_most_cm),
        });
        for (most, inflation) in self.inflation.iter_mut().zip(health.gnss_inflation) {
            *most = most.max(inflation);
        }
    }

    /// The run is over. What of it could be solved as a whole, or why nothing could.
    pub fn finish(
        mut self,
        machine: &str,
        smoothed: Result<(Gain, &Smoothed), String>,
        latency: Latency,
        lost: Vec<String>,
    ) -> Review {
        self.sensors.iter_mut().for_each(Track::judge_first_gaps);
        let begin = self.begin.unwrap_or_default();
        let span_s = self.end.seconds_since(begin);
        let (gain, smoothed, not_smoothed) = match smoothed {
            Ok((gain, smoothed)) => (Some(gain), Some(smoothed), None),
            Err(why) => (None, None, Some(why)),
        };
        let chains = smoothed.map_or(&[][..], |smoothed| &smoothed.chains);
        let weighted_down = |of: fn(&SolvedChain) -> usize| chains.iter().map(of).sum::<usize>() as f64;
        let fixes = weighted_down(|chain| chain.factors.positions);
        let odd = weighted_down(|chain| chain.factors.weighted_down);
        let running = self.health.as_ref().and_then(|health| health.outage.clone());
        self.outages.extend(running.filter(|outage| outage.end_stamp_ns.is_none()));
        let outages = self.outages.iter().map(|outage| outage_review(outage, begin, self.end, gain.as_ref()));
        let mut review = Review {
            machine: machine.to_owned(),
            begin_s: begin.as_seconds(),
            span_s,
            in_short: Vec::new(),
            look_at: Vec::new(),
            coverage: self.coverage(span_s),
            sensors: self.sensors(),
            outages: outages.collect(),
            innovations: Innovations {
                weighted_down_percent: (fixes > 0.0).then(|| 100.0 * odd / fixes),
                ..self.innovations()
            },
            latency,
            restarts: self
                .restarts
                .iter()
                .map(|(stamp, what)| Told { at_s: stamp.seconds_since(begin), what: what.clone() })
                .collect(),
            gain,
            not_smoothed,
            unsure: smoothed.map_or_else(Vec::new, |smoothed| unsure(smoothed, begin)),
            lost,
            consistency_cm: Statistics::of(std::mem::take(&mut self.moved_cm)),
            seconds: self.seconds,
        };
        review.in_short = words::in_short(&review);
        review.look_at = words::look_at(&review);
        review
    }

    fn coverage(&self, span_s: f64) -> Vec<Share> {
        let share = |mode, time_s: f64| Share { mode, time_s, percent: 100.0 * time_s / span_s.max(1e-9) };
        let known: f64 = self.by_mode.iter().sum();
        let modes = MODES.into_iter().zip(self.by_mode).map(|(mode, time_s)| share(mode, time_s));
        modes.chain([share(Mode::Initializing, (span_s - known).max(0.0))]).collect()
    }

    fn sensors(&self) -> Vec<SensorReview> {
        let told = self.health.as_ref().map_or(&[][..], |health| &health.sensors);
        let review = |(sensor, track): (Sensor, &Track)| {
            let told = told.iter().find(|told| told.sensor == sensor);
            let (sum, count) = track.periods;
            SensorReview {
                sensor: sensor.name(),
                readings: track.readings,
                rate_hz: if sum > 0.0 { count as f64 / sum } else { 0.0 },
                silent_s: track.silences.0,
                silences: track.silences.1,
                longest_silence_s: track.silences.2,
                refused: told.map_or(0, |told| told.refused),
                last_refusal: told.and_then(|told| told.last_refusal.clone()),
                delay_us: track.delayed.then(|| track.delay.distribution()),
            }
        };
        let spoke = Sensor::ALL.into_iter().zip(&self.sensors).filter(|(_, track)| track.readings > 0);
        spoke.map(review).collect()
    }

    fn innovations(&self) -> Innovations {
        let ratios: Vec<f64> = self.seconds.iter().filter_map(|second| second.test_ratio).collect();
        let beyond = ratios.iter().filter(|ratio| **ratio > 1.0).count();
        let seconds = ratios.len() as u64;
        let Some(statistics) = Statistics::of(ratios) else { return Innovations::default() };
        Innovations {
            seconds,
            beyond_percent: 100.0 * beyond as f64 / seconds as f64,
            median_ratio: statistics.median,
            p95_ratio: statistics.p95,
            inflation: self.inflation,
            weighted_down_percent: None,
        }
    }
}

fn outage_review(outage: &OutageReport, begin: Stamp, end: Stamp, gain: Option<&Gain>) -> OutageReview {
    let from = Stamp::from_nanos(outage.start_stamp_ns);
    let to = outage.end_stamp_ns.map_or(end, Stamp::from_nanos);
    OutageReview {
        start_s: from.seconds_since(begin),
        end_s: to.seconds_since(begin),
        ended: outage.end_stamp_ns.is_some(),
        cause: outage.cause,
        travelled_m: outage.travelled_m,
        jump_m: outage.jump_m,
        live_off_m: gain.and_then(|gain| gain.largest_between(from, to)),
    }
}

/// What of a session has no solution, or none that is final.
fn unsure(smoothed: &Smoothed, begin: Stamp) -> Vec<Unsure> {
    let unsolved = smoothed.unsolved.iter().map(|part| Unsure {
        start_s: part.start_s - begin.as_seconds(),
        end_s: part.end_s - begin.as_seconds(),
        why_unsolved: Some(part.why.clone()),
    });
    let moving = smoothed.chains.iter().filter(|chain| !chain.converged).filter_map(|chain| {
        let (first, last) = chain.nodes.first().zip(chain.nodes.last())?;
        let [start_s, end_s] = [first, last].map(|node| node.stamp.seconds_since(begin));
        Some(Unsure { start_s, end_s, why_unsolved: None })
    });
    unsolved.chain(moving).collect()
}
